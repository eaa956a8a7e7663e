"""Environments, samplers, metrics, priorities, generators, learners and networks of one's own, as module:attribute."""

import csv
import dataclasses
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses
from sweep_helpers import compile_once  # noqa: F401

import mjx_dher
from mjx_dher import Config, HParams, RunSpec, cli, envs, samplers, spec
from mjx_dher.cli import sweep as cli_sweep
from mjx_dher.evaluate import play_policy
from mjx_dher.runs.folder import fingerprint, reading, run_folder
from point_mass import PointMass, soon

TINY = """
    --num-envs 2 --cycles-per-epoch 1 --updates-per-cycle 2 --target-period 1 --batch-size 16 --replay-size 100
    --hidden-sizes 8 --eval-episodes 2 --final-episodes 4
""".split()  # noqa: SIM905
OWN = ["--env", "my_tasks:MyTask", "--sampler", "my_tasks:soon", *TINY]
PARTS = ("metric", "priority", "generator", "learner", "networks")
OWN_PARTS = [*OWN[:2], *TINY, "--sampler", "weighted", *(word for part in PARTS for word in (f"--{part}", f"my_tasks:{part}"))]
MY_TASKS = """
import dataclasses, os, signal
import flax.linen as nn
import jax.numpy as jnp
from mjx_dher.learners.ddpg import DDPG
from mjx_dher.networks import Networks
from point_mass import PointMass, soon

class Physics:
    name = "native"  # as `Simulator` has it; the constructor of the environment has no engine to choose

    def advance(self, physics, controls):
        raise NotImplementedError

class MyTask(PointMass):
    def __init__(self):
        super().__init__()
        self.simulator = Physics()

    def check(self):  # also after each epoch, by when the folder has its description: stops this run after one
        if os.path.exists(os.path.join(os.environ.get("STOP_AFTER_AN_EPOCH", "no"), "config.json")):
            os.kill(os.getpid(), signal.SIGINT)

TWO = 2

def leave():
    raise SystemExit(4)

traced = set()  # which parts a program was made of

def metric(achieved, desired):
    traced.add("metric")
    return jnp.abs(achieved - desired[None]).max(axis=-1)

def priority(episode, context):
    traced.add("priority")
    return jnp.full((), 0.25)

def generator(key, obs, ring, context):
    traced.add("generator")
    return obs["desired_goal"]

class Actor(nn.Module):
    @nn.compact
    def __call__(self, observation, goal):
        traced.add("networks")
        return jnp.tanh(nn.Dense(2)(goal - observation))

class Critic(nn.Module):
    @nn.compact
    def __call__(self, observation, goal, action):
        return nn.Dense(1)(jnp.concatenate([goal - observation, action], axis=-1))[..., 0]

def networks(action_size, hidden_sizes, dtype):
    return Networks(Actor(), Critic())

@dataclasses.dataclass(frozen=True)
class Learner(DDPG):
    def summary(self, state):
        traced.add("learner")
        return {"updates_made": state.num_updates.astype(jnp.float32)}

def learner(config, spec, networks):
    both = networks(spec.action_size, config.hidden_sizes, "float32")
    return Learner(spec, both, both)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a module of the user's, and in it a run that was stopped."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_tasks.py").write_text(MY_TASKS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("STOP_AFTER_AN_EPOCH", "run")
        assert cli.main([*OWN, "--total-steps", "60", "--out", "run"]) == 130
    return folder


@pytest.mark.slow
def test_a_run_in_the_current_folder_s_module_is_resumed_and_evaluated(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert cli.main(["resume", "run"]) == 0
    said = capsys.readouterr().out
    assert all(part in said for part in ("my_tasks:MyTask, sampler my_tasks:soon, seed 0;", "physics native")), said
    assert cli.main(["eval", "run", "--episodes", "4"]) == 0
    assert "my_tasks:MyTask: 4 episodes" in capsys.readouterr().out
    content = json.loads((folder / "run" / "config.json").read_text())
    assert (content["env"], content["sampler"]) == ("my_tasks:MyTask", "my_tasks:soon")
    assert [row["env_steps"] for row in rows(folder / "run")] == ["20", "40", "60"]


def rows(run):
    with (run / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def parts(folder):
    """A run of which every part is the user's own: stopped after an epoch, and resumed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        import my_tasks

        patch.setenv("STOP_AFTER_AN_EPOCH", "parts")
        my_tasks.traced.clear()
        assert cli.main([*OWN_PARTS, "--total-steps", "60", "--out", "parts"]) == 130
        assert my_tasks.traced == set(PARTS)
        assert [row["env_steps"] for row in rows(folder / "parts")] == ["20"]
        patch.delenv("STOP_AFTER_AN_EPOCH")
        assert cli.main(["resume", "parts"]) == 0
    return folder / "parts"


def test_every_part_of_a_run_can_be_one_s_own(parts):
    found = reading.read_spec(parts)
    assert {part: getattr(found, part) for part in PARTS} == {part: f"my_tasks:{part}" for part in PARTS}
    assert found.sampler == "weighted"
    written = rows(parts)
    assert [row["env_steps"] for row in written] == ["20", "40", "60"]
    assert [row["priority_mean"] for row in written] == ["0.25"] * 3
    assert [row["updates_made"] for row in written] == ["2", "4", "6"]
    assert "actor_norm" not in written[0]


def test_a_run_that_was_stopped_ends_as_one_that_was_not(parts, folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert cli.main([*OWN_PARTS, "--total-steps", "60", "--out", "parts_in_one_go"]) == 0
    with np.load(parts / "policy.npz") as resumed, np.load(folder / "parts_in_one_go" / "policy.npz") as whole:
        assert resumed.files == whole.files
        for name in whole.files:
            np.testing.assert_array_equal(resumed[name], whole[name])


def test_a_policy_of_one_s_own_networks_is_evaluated_and_loaded(parts, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert cli.main(["eval", "parts", "--episodes", "4"]) == 0
    assert "my_tasks:MyTask: 4 episodes" in capsys.readouterr().out
    policy = mjx_dher.load_policy(parts)
    actions = policy({"observation": np.zeros((5, 2)), "desired_goal": np.arange(10.0).reshape(5, 2)})
    assert actions.shape == (5, 2)
    assert actions.std() > 0


@pytest.mark.parametrize("command", [["export", "--format", "onnx"], ["transfer", "--python", sys.executable]])
def test_what_cannot_take_a_policy_of_one_s_own_networks_says_so(parts, folder, monkeypatch, command, capsys):
    monkeypatch.chdir(folder)
    before = {path.name for path in parts.iterdir()}
    assert cli.main([command[0], "parts", *command[1:]]) == 2
    error = capsys.readouterr().err
    assert all(word in error for word in (command[0], "'my_tasks:learner'", "'my_tasks:networks'")), error
    assert {path.name for path in parts.iterdir()} == before


@pytest.mark.parametrize("part", [*PARTS, "weight_kernel"])
def test_a_part_that_is_none_is_refused(folder, monkeypatch, part, capsys):
    monkeypatch.chdir(folder)
    flag = "--" + part.replace("_", "-")
    default = getattr(RunSpec(), part)
    for name, said in {
        default[:-1]: [repr(default[:-1]), repr(default), "module:attribute"],
        "my_task:x": ["'my_task'", "'my_tasks'", "no module"],
        "my_tasks:tracd": ["'my_tasks:tracd'", "'traced'"],
    }.items():
        check_refusal(capsys, flag, name, part, *said)


def check_refusal(capsys, flag, name, *words):
    assert cli.main([*OWN, "--sampler", "weighted", flag, name, "--total-steps", "20", "--out", "refused"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert all(word in error for word in words), error
    assert not Path("refused").exists()


# It is refused later than other names, when parts are tried.
@pytest.mark.parametrize(
    "part",
    [pytest.param(x, marks=[] if x in ("metric", "generator") else pytest.mark.slow) for x in (*PARTS, "weight_kernel")],
)
def test_a_part_that_is_no_function_is_refused(folder, monkeypatch, part, capsys):
    monkeypatch.chdir(folder)
    check_refusal(capsys, "--" + part.replace("_", "-"), "my_tasks:TWO", part, "must be a function", "2")


def test_its_policy_needs_no_module(folder):
    policy = mjx_dher.load_policy(folder / "run")
    assert policy({"observation": np.zeros((5, 2)), "desired_goal": np.zeros((5, 2))}).shape == (5, 2)


def test_a_policy_is_played_where_there_is_no_check(folder):
    policy = mjx_dher.load_policy(folder / "run")
    outcome = play_policy(PointMass(), policy, num_episodes=4, seed=0)
    assert outcome.success.shape == (4,)
    with refuses("num_episodes", 0):
        play_policy(PointMass(), policy, num_episodes=0, seed=0)


def test_a_sweep_takes_them(folder, monkeypatch):
    monkeypatch.chdir(folder)
    _, (trial,) = cli_sweep.parse_sweep_args([*OWN, "--seeds", "1", "--out", "sweep"])
    assert (trial.env, trial.sampler) == ("my_tasks:MyTask", "my_tasks:soon")
    assert fingerprint.trial_name(trial).startswith("my_tasks-mytask-my_tasks-soon-s0-")
    words = [*OWN_PARTS, "--seeds", "1", "--out", "sweep"]
    words.insert(words.index("--learner") + 1, "ddpg")
    _, trials = cli_sweep.parse_sweep_args(words)
    assert [trial.learner for trial in trials] == ["ddpg", "my_tasks:learner"]
    assert {trial.networks for trial in trials} == {"my_tasks:networks"}


@pytest.mark.slow
def test_a_sweep_trains_them(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "250")  # so that the table's names are not folded
    assert cli.main(["sweep", *OWN, "--total-steps", "20", "--seeds", "1", "--lanes", "1", "--out", "sweep"]) == 0
    assert "my_tasks:soon" in capsys.readouterr().out
    assert len(list((folder / "sweep" / "cells").glob("*/result.json"))) == 1


def test_what_has_no_model_is_not_rendered():
    from mjx_dher.tools import render

    with refuses("point_mass", "model"):
        render.record_episodes(PointMass(), lambda obs, key: jnp.zeros((2, 2)), seed=0, num_episodes=2)


def test_a_fresh_run_folder_s_name_is_one_of_a_file(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with run_folder.claim_new(None, RunSpec(env="my.Tasks:Mine", sampler="my.tasks:soon", seed=3)) as path:
        assert path.name.startswith("my-tasks-mine-my-tasks-soon-s3-")


def test_make_imports_it():
    env = envs.make("point_mass:PointMass", episode_length=7)
    assert isinstance(env, PointMass)
    assert env.episode_length == 7
    assert envs.make("mjx_dher.envs.fetch:Reach", engine="native", episode_length=3).engine.name == "native"
    assert samplers.make("point_mass:soon").log_weights is soon
    assert "point_mass:PointMass" not in envs.list_envs()


UNUSABLE = [  # constructor, name, and what the error must name
    (envs.make, "pont_mass:PointMass", ["pont_mass", "point_mass"]),
    (envs.make, "mjx_dher.envs.fetsh:Reach", ["mjx_dher.envs.fetsh", "mjx_dher.envs.fetch"]),
    (envs.make, "point_mass.py:PointMass", ["'point_mass.py:PointMass'", "'point_mass:PointMass'"]),
    (envs.make, "point_mass:PontMass", ["point_mass", "PontMass", "PointMass"]),
    (envs.make, "point_mass:a:b", ["env", "module:attribute", "point_mass:a:b"]),
    (envs.make, "my_tasks:TWO", ["env", "my_tasks:TWO", 2]),
    (envs.make, "point_mass:PointState", ["reset"]),
    (envs.make, "my_tasks:leave", ["env", "my_tasks:leave", "SystemExit: 4"]),
    (envs.make, "collections:Counter", ["env", "collections:Counter"]),
    (samplers.make, "my_tasks:TWO", ["sampler", "(achieved, desired, step, hparams)", 2]),
    (samplers.make, "point_mass:PointMass", ["sampler", "(achieved, desired, step, hparams)", "PointMass"]),
    (samplers.make, "point_mass:son", ["point_mass", "son", "soon"]),
]


def test_what_cannot_be_used_is_reported(folder, monkeypatch):
    monkeypatch.syspath_prepend(str(folder))
    for make, name, parts in UNUSABLE:
        with refuses(*parts, error=(ValueError, TypeError)):
            make(name)


def test_an_environment_without_an_engine_has_none_to_choose():
    with refuses("env", "point_mass:PointMass", "engine", "native"):
        envs.make("point_mass:PointMass", engine="native")


def test_what_a_module_raises_is_named_and_the_cause_kept(monkeypatch, tmp_path):
    (tmp_path / "lacks_another.py").write_text("import not_there")
    monkeypatch.syspath_prepend(str(tmp_path))
    with refuses("env", "lacks_another:Task", "not_there") as error:
        envs.make("lacks_another:Task")
    assert isinstance(error.value.__cause__, ModuleNotFoundError)


@pytest.mark.parametrize(
    ("code", "end"),
    [
        ("import sys\nsys.exit(4)", "SystemExit: 4 (FILE, line 2)"),
        ("\nx = (", "SyntaxError: '(' was never closed (NAME, line 2)"),
    ],
)
def test_a_module_that_exits_or_has_no_syntax_is_one_error_with_one_place(code, end, monkeypatch, tmp_path, capsys):
    file = tmp_path / f"ends_{len(code)}.py"
    file.write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert cli.main(["--env", f"{file.stem}:Task"]) == 2
    end = end.replace("FILE", str(file)).replace("NAME", file.name)
    assert capsys.readouterr().err == f"error: env '{file.stem}:Task': importing it failed: {end}\n"


def test_a_task_that_exits_while_it_runs_is_an_error(monkeypatch, tmp_path, capsys):
    (tmp_path / "leaves.py").write_text(
        "import sys\nfrom docs.examples.point_mass import PointMass\n"
        "class Leaves(PointMass):\n    def compute_reward(self, *states):\n        sys.exit('no reward')\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert cli.main(["--env", "leaves:Leaves", "--out", str(tmp_path / "run")]) == 2
    assert capsys.readouterr().err.endswith("error: a task or a component has called sys.exit('no reward')\n")


def test_nothing_is_assumed_of_the_length_of_its_episodes():
    short = RunSpec(env="point_mass:PointMass", config=Config(num_envs=8, replay_size=80, batch_size=16))
    spec.validate(short)
    spec.validate(short.replace(num_envs=1, total_steps=2_000_000_000))  # 40 million cycles of 50 steps, of 40 updates each
    with refuses("replay_size", 400, 80):
        spec.validate(dataclasses.replace(short, env="push"))
    with refuses("replay_size", 160, 80):
        spec.validate(short, episode_length=20)


def test_soon_halves():
    log_weights = soon(jnp.zeros((5, 2)), jnp.zeros(2), jnp.array(1), HParams())
    np.testing.assert_allclose(samplers.probabilities(log_weights), [0, 0, 4 / 7, 2 / 7, 1 / 7], rtol=1e-6)
