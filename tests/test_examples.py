"""What docs/examples and docs/tutorial.md show."""

import re

import any_model
import image_reach
import jax
import many_copies
import many_seeds
import numpy as np
import own_episodes
import own_learner
import pytest
import trap
from conftest import EXAMPLES, ROOT

from mjx_dher import cli, testing
from mjx_dher.cli.train import parse_train_args
from mjx_dher.rollout import env_spec, rollout
from point_mass import PointMass

TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text()


def test_each_is_short():
    lengths = {path.name: len(path.read_text().splitlines()) for path in EXAMPLES.glob("*.py")}
    assert lengths.pop("ddpg_her.py") < 350
    assert max(lengths.values()) < 150
    assert lengths["own_methods.py"] < 25


def test_a_regression_learns_from_replay_and_weighted_relabelling(capsys):
    own_learner.main(["--rounds", "6", "--updates", "40"])
    success = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()]
    assert len(success) == 6
    assert success[0] < 0.3
    assert success[-1] > 0.8


def test_episodes_of_a_loop_of_one_s_own(capsys):
    own_episodes.main()
    assert capsys.readouterr().out.startswith("16 episodes; a batch of 64, mean reward -")
    ours = own_episodes.play(jax.random.key(0))
    (key, action_key), env = jax.random.split(jax.random.key(0)), own_episodes.env
    actions = jax.random.uniform(action_key, (env.episode_length, 16, 2), minval=-1, maxval=1)
    theirs, _ = jax.jit(lambda key, actions: rollout(env, lambda action, obs: action, key, 16, actions))(key, actions)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(a, b)


def test_many_copies_are_stepped(capsys):
    many_copies.main(["--env", "point_mass:PointMass", "--num-envs", "4", "--steps", "3"])
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("12 steps in ")
    assert second.startswith("observations (4, 2), mean reward -")


def test_figures_of_any_model_fall(capsys):
    any_model.main(["--num-envs", "8", "--steps", "50"])
    found = re.fullmatch(
        r"after 1.00 s the centre of mass is ([\d.]+) m high, ([\d.]+) m at most\n", capsys.readouterr().out
    ).groups()
    assert 0.1 < float(found[0]) < float(found[1]) < 0.8


@pytest.mark.parametrize(
    ("example", "arguments", "least"),
    [
        pytest.param(image_reach, ["--epochs", "3"], 0.8, marks=pytest.mark.slow),
        (trap, ["--epochs", "4"], 0.6),
        pytest.param(trap, ["--epochs", "12", "--dense"], 0.6, marks=pytest.mark.slow),
    ],
)
def test_extensions_learn(example, arguments, least, capsys):
    """Each is one file of a custom task or learner: terminal states, other rewards and images."""
    example.main(arguments)
    success = [float(number) for number in re.findall(r"success ([\d.]+)", capsys.readouterr().out)]
    assert success[-1] >= least
    assert success[0] < success[-1] or success[0] > 0.9


def test_what_the_extensions_declare():
    """Falling ends the episode for any goal; rewards and observations are as the spec says."""
    for dense, highest in ((False, 1.0), (True, 5.0)):
        env = trap.Trap(dense=dense)
        actions = jax.random.uniform(jax.random.key(1), (env.episode_length, 64, 2), minval=-1, maxval=1)
        play = jax.jit(lambda key, actions, env=env: rollout(env, lambda action, obs: action, key, 64, actions))
        episodes, outcome = play(jax.random.key(0), actions)
        last = np.take_along_axis(np.array(episodes.observation), np.array(episodes.length)[:, None, None], axis=1)[:, 0]
        np.testing.assert_array_equal(episodes.terminal, np.linalg.norm(last, axis=-1) < trap.TRAP)
        assert 0 < episodes.terminal.sum() < 64
        assert np.all(outcome.bad_rewards == 0)
        assert env_spec(env).reward_range == (0.0, highest)
    image = env_spec(image_reach.ImageReach()).observation["image"]
    assert (image.shape, image.dtype) == ((12, 12, 1), np.uint8)


@pytest.mark.slow
def test_many_seeds_are_trained_at_once_and_summed_up(capsys):
    many_seeds.main(["--seeds", "4", "--epochs", "6"])
    lines = capsys.readouterr().out.splitlines()
    found = [
        re.fullmatch(r"epoch (\d), (\d+) steps: success ([\d.]+) \(([\d.]+) to ([\d.]+)\)", line).groups() for line in lines
    ]
    assert [row[:2] for row in found] == [(str(n), str(200 * n)) for n in range(1, 7)]
    success = np.array([row[2:] for row in found], float)
    assert np.all((success[:, 1] <= success[:, 0]) & (success[:, 0] <= success[:, 2]))
    assert success[-1, 0] > success[0, 0] + 0.4


def test_examples_of_tasks_and_episodes_work_under_64_bits():
    with jax.enable_x64(True):
        testing.check_env(trap.Trap())
        own_episodes.main()


def test_the_tutorial_shows_the_example_as_it_is():
    def lines(text):
        return [line.strip() for line in text.splitlines() if line.strip()]

    names = ("point_mass.py", "own_episodes.py", "own_methods.py")
    code = [line for name in names for line in lines((EXAMPLES / name).read_text())]
    blocks = re.findall(r"```python\n(.*?)```", TUTORIAL, re.S)
    shown = [lines(block) for block in blocks if "class " in block or "def " in block]
    assert len(shown) == 4
    for block in shown:
        start = code.index(block[0])
        assert code[start : start + len(block)] == block


def test_the_tutorial_s_priority_and_generator_are_as_they_should_be():
    env = PointMass()
    assert testing.check_priority("own_methods:travelled", env).startswith("priority as it should be: weights from ")
    # A half of the goals or so: those that the reset drew are half as far away.
    share = int(re.search(r"(\d+)% of the goals", testing.check_generator("own_methods:halfway", env))[1])
    assert 20 <= share <= 80
    (command,) = re.findall(r"^PYTHONPATH=docs/examples python train\.py check (.*)$", TUTORIAL, re.M)
    assert parse_train_args(command.split()).spec.generator == "own_methods:halfway"


def test_the_tutorial_s_check_passes():
    (check,) = [block for block in re.findall(r"```python\n(.*?)```", TUTORIAL, re.S) if "check_env" in block]
    namespace = {}
    exec(compile(check, "tutorial.md", "exec"), namespace)
    assert namespace["check_env"] is testing.check_env
    assert namespace["PointMass"] is PointMass


def tutorial_command():
    (command,) = re.findall(r"^PYTHONPATH=docs/examples python train\.py (--.*?[^\\])$", TUTORIAL, re.M | re.S)
    return command.replace("\\\n", "").split()


def test_the_tutorial_s_command_is_one():
    spec = parse_train_args(tutorial_command()).spec
    assert (spec.env, spec.sampler) == ("point_mass:PointMass", "point_mass:soon")


@pytest.mark.slow
def test_the_tutorial_s_command_trains(tmp_path, capsys):
    assert cli.main([*tutorial_command(), "--out", str(tmp_path / "run")]) == 0
    (success, at_reset), (_, page) = (
        re.search(r"^success ([\d.]+) .* already at reset ([\d.]+);", text, re.M).groups()
        for text in (capsys.readouterr().out, TUTORIAL)
    )
    assert float(success) >= 0.95
    assert at_reset == page  # the same on every machine, unlike the others
