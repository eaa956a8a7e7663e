"""Demonstrations: what a file may hold, and what a run does with it."""

import dataclasses
import json
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import TINY, flags
from conftest import EXAMPLES, refuses
from flax import struct

import mjx_dher
from mjx_dher import HParams, Options, RunSpec, cli, demonstrations, trainer
from mjx_dher.contract import env_spec
from mjx_dher.demonstrations import read_demonstrations, write_demonstrations
from mjx_dher.rollout import rollout
from mjx_dher.runs.folder import fingerprint, reading
from mjx_dher.spec import validate
from point_mass import PointMass, PointState
from probes import Walk

ENV = PointMass()


@struct.dataclass
class EndingState(PointState):
    done: jax.Array


class Ending(PointMass):
    """PointMass whose episodes end at the goal."""

    @property
    def spec(self):
        return dataclasses.replace(env_spec(PointMass()), ends=True)

    def _state(self, position, goal):
        state = super()._state(position, goal)
        return EndingState(state.obs, state.reward, state.success, state.success > 0)


def played(env=ENV, number=6):
    """Episodes that walk towards the goal."""
    towards = lambda _, obs: jnp.clip(10 * (obs["desired_goal"] - obs["achieved_goal"]), -1, 1)  # noqa: E731
    return jax.tree.map(np.asarray, rollout(env, towards, jax.random.key(11), number)[0])


@pytest.fixture
def file(tmp_path):
    write_demonstrations(tmp_path / "demos.npz", played())
    return tmp_path / "demos.npz"


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("env", [ENV, Ending()])
def test_episodes_come_back_as_they_were_written(tmp_path, env):
    episodes = played(env)
    write_demonstrations(tmp_path / "demos.npz", episodes)
    same(read_demonstrations(str(tmp_path / "demos.npz"), env, 6), episodes)
    assert (episodes.length.min() < env.episode_length) == (env is not ENV)


def test_shorter_episodes_are_padded_and_length_and_terminal_are_optional(tmp_path):
    env = Ending()
    episodes = played(env)
    length = int(episodes.length.max())
    arrays = {name: getattr(episodes, name) for name in ("observation", "achieved_goal", "desired_goal", "action")}
    cut = {name: x if name == "desired_goal" else x[:, : length + (name != "action")] for name, x in arrays.items()}
    np.savez(tmp_path / "demos.npz", **cut, length=episodes.length.astype(np.int64))
    same(read_demonstrations(str(tmp_path / "demos.npz"), env, 6), episodes)
    np.savez(tmp_path / "demos.npz", **{name: x[:1] for name, x in arrays.items()})
    assert read_demonstrations(str(tmp_path / "demos.npz"), ENV, 6).length.tolist() == [10]


BAD_ARRAYS = [
    ({"action": None}, ("action", "[N, T, A]", "none")),
    ({"action": np.zeros((6, 11, 2))}, ("action", "at most 10", "[6, 11, 2]")),
    ({"action": np.full((6, 10, 2), 1.5)}, ("action", "[-1, 1]", "1.5")),
    ({"action": np.zeros((6, 10, 3))}, ("action", "[6, 10, 2]", "[6, 10, 3]")),
    ({"observation": np.zeros((6, 10, 2))}, ("observation", "[6, 11, 2]", "[6, 10, 2]")),
    ({"observation": None, "desired_goal": np.zeros((6, 3))}, ("observation", "none", "desired_goal", "[6, 2]", "[6, 3]")),
    ({"achieved_goal": np.full((6, 11, 2), np.nan)}, ("achieved_goal", "finite")),
    ({"achieved_goal": np.full((6, 11, 2), 1e300)}, ("achieved_goal", "finite")),  # in float32
    ({"achieved_goal": np.full((6, 11, 2), "x")}, ("achieved_goal", "float32", "U1")),
    ({"length": np.full(6, 9)}, ("length", "10", "9")),
    ({"length": np.full(6, 9.0)}, ("length", "int32", "float64")),
    ({"terminal": np.ones(6, bool)}, ("terminal", "False", "True")),
    ({"rewards": np.ones(6)}, ("rewards", "observation, achieved_goal")),
    ({"action": np.zeros((6, 9, 2))}, ("observation must be", "[6, 10, ", "as action has shape [6, 9, 2]; got")),
]


def test_arrays_that_do_not_fit_are_refused(file):
    with np.load(file) as arrays:
        right = dict(arrays)
    for change, words in BAD_ARRAYS:
        np.savez(file, **{name: value for name, value in {**right, **change}.items() if value is not None})
        with refuses("demonstrations", file, *words):
            read_demonstrations(str(file), ENV, 6)


def test_files_that_cannot_be_used_are_refused(file, tmp_path):
    with refuses("1 to 5 episodes", "6"):
        read_demonstrations(str(file), ENV, 5)
    file.write_bytes(b"PK" + bytes(100))
    with refuses("demonstrations", file, ".npz"):
        read_demonstrations(str(file), ENV, 6)
    for name in ("none.npz", "", str(tmp_path)):
        with refuses("demonstrations", ".npz", "Minari", repr(name)):
            read_demonstrations(name, ENV, 6)
        with refuses("demonstrations", repr(name)):
            validate(RunSpec(demonstrations=name))


def test_the_ring_holds_them_and_the_normalizers_have_seen_them():
    episodes = played()
    train = trainer.make_train(ENV, TINY)
    empty = jax.jit(train.init)(jax.random.key(0), HParams())
    state = jax.jit(train.add)(empty, episodes)
    assert (int(empty.replay.size), int(state.replay.size)) == (0, 6)
    same(jax.tree.map(lambda x: np.asarray(x[:6]), state.replay.episodes), episodes)
    np.testing.assert_allclose(state.learner.observation_norm.mean, episodes.observation.mean((0, 1)), rtol=1e-5)
    same(*(jax.random.key_data(x.key) for x in (empty, state)))
    assert int(jax.jit(train.epoch)(state)[0].replay.size) == 8  # of six and four, as many as the ring holds


def test_the_ring_takes_episodes_without_length_and_terminal():
    train = trainer.make_train(Ending(), TINY, priority=lambda episode, context: episode.length)
    episodes = dataclasses.replace(played(), length=None, terminal=None)
    state = jax.jit(train.add)(jax.jit(train.init)(jax.random.key(0), HParams()), episodes)
    np.testing.assert_array_equal(state.replay.priority, [10.0] * 6 + [0.0] * 2)


def test_a_run_is_trained_resumed_and_told_from_another_file_s(file, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    command = [*flags(TINY), "--final-episodes", "4", "--no-curve", "--demonstrations", str(file)]
    assert cli.main([*command, "--total-steps", "80", "--out", str(tmp_path / "run")]) == 0
    content, spec = reading.read_run(tmp_path / "run")
    assert spec.demonstrations == str(file)
    assert content["sources"]["demonstrations"].startswith("demos.npz ")
    (tmp_path / "moved").mkdir()
    name = fingerprint.trial_name(spec)
    moved = file.rename(tmp_path / "moved" / "demos.npz")
    assert fingerprint.trial_name(dataclasses.replace(spec, demonstrations=str(moved))) == name
    assert fingerprint.trial_name(dataclasses.replace(spec, demonstrations=None)) != fingerprint.trial_name(spec)
    capsys.readouterr()
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "2", "--json"]) == 0  # the policy needs no file
    assert json.loads(capsys.readouterr().out)["episodes"] == 2
    assert cli.main([*command, "--out", str(tmp_path / "other")]) == 2
    assert "demonstrations must be" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


@pytest.mark.slow
def test_a_stopped_run_ends_as_the_one_that_was_not(file, tmp_path):
    config = dataclasses.replace(TINY, total_steps=120)
    spec = RunSpec("point_mass:PointMass", config=config, demonstrations=str(file))
    options, epochs = Options(final_episodes=4), []
    train = lambda folder, stop: mjx_dher.train_runs(  # noqa: E731
        ENV,
        [spec],
        [folder],
        options=options,
        on_epoch=lambda specs, progress: epochs.append(progress.epoch),
        should_stop=lambda: epochs[-1] == stop,
    )
    train(tmp_path / "whole", 99)
    train(tmp_path / "run", 1)
    train(tmp_path / "run", 99)
    first, second = (np.load(tmp_path / name / "policy.npz") for name in ("whole", "run"))
    assert all(np.array_equal(first[name], second[name]) for name in first.files)


def test_a_minari_data_set_is_read(tmp_path, monkeypatch):
    minari, gymnasium = pytest.importorskip("minari"), pytest.importorskip("gymnasium")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    box = lambda size: gymnasium.spaces.Box(-10, 10, (size,), np.float32)  # noqa: E731
    space = gymnasium.spaces.Dict({name: box(2) for name in ("observation", "achieved_goal", "desired_goal")})
    episodes, buffers = played(Ending(), 3), []
    for number, length in enumerate(map(int, episodes.length)):
        obs = {name: getattr(episodes, name)[number, : length + 1] for name in ("observation", "achieved_goal")}
        obs["desired_goal"] = np.tile(episodes.desired_goal[number], (length + 1, 1))
        ends = np.arange(length) == length - 1
        buffer = minari.data_collector.EpisodeBuffer(
            id=number,
            observations=obs,
            actions=episodes.action[number, :length],
            rewards=list(np.zeros(length)),
            terminations=list(np.zeros(length, bool)),
            truncations=list(ends),
        )
        buffers.append(buffer)
    spaces = {"observation_space": space, "action_space": gymnasium.spaces.Box(-1, 1, (2,), np.float32)}
    minari.create_dataset_from_buffers("point/walk-v0", buffers, **spaces)
    for source in ("point/walk-v0", str(tmp_path / "point" / "walk-v0")):
        same(read_demonstrations(source, Ending(), 6), episodes)
        assert fingerprint.sources(RunSpec(demonstrations=source))["demonstrations"].startswith("walk-v0 ")
    with refuses("point/walk-v0", "length", "10"):
        read_demonstrations("point/walk-v0", ENV, 6)


def test_a_minari_episode_that_ends_at_its_goal_is_not_terminal_for_other_goals(monkeypatch, tmp_path):
    env = Walk(ends_at_goal=True)
    row = {"observation": np.zeros((4, 2)), "achieved_goal": np.array([[0, 0], [0.1, 0], [0.2, 0], [0.5, 0]])}
    episodes = [
        SimpleNamespace(
            id=number,
            observations=row | {"desired_goal": np.tile(goal, (4, 1))},
            actions=np.zeros((3, 2)),
            terminations=[False, False, True],
        )
        for number, goal in enumerate(([0.5, 0.0], [0.9, 0.0]))
    ]
    monkeypatch.setitem(sys.modules, "minari", SimpleNamespace(MinariDataset=lambda path: episodes))
    monkeypatch.setattr(demonstrations.lookup, "require_extra", lambda *names: None)
    monkeypatch.setattr(demonstrations, "find_demonstrations", lambda source: tmp_path)
    assert read_demonstrations("any", env, 6).terminal.tolist() == [False, True]
    assert read_demonstrations("any", Walk(), 6).terminal.tolist() == [True, True]


def test_a_check_of_components_takes_no_demonstrations(capsys):
    assert cli.main(["check", "--demonstrations", "episodes.npz"]) == 2
    assert "--demonstrations" in capsys.readouterr().err
