"""Numbers of other kinds: 64 bits, random keys of other generators, NumPy's integers, booleans, paths, other steps, and means
without discarded episodes.
"""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import SMALL, TINY
from conftest import refuses
from flax import struct
from rich.console import Console

import mjx_dher.gym
from mjx_dher import RunSpec, learners, make_train, relabel, replay, samplers, trainer
from mjx_dher.cli.common import print_summary
from mjx_dher.config import HParams
from mjx_dher.context import Context
from mjx_dher.contract import env_spec
from mjx_dher.contrib import generators
from mjx_dher.demonstrations import read_demonstrations, write_demonstrations
from mjx_dher.evaluate import play_policy, summarize
from mjx_dher.learners import ddpg
from mjx_dher.policy import learner_policy
from mjx_dher.priorities import make, whole
from mjx_dher.rollout import rollout, where_each
from mjx_dher.runs import program
from mjx_dher.runs.folder import checkpoint, restoring
from mjx_dher.types import Episode
from point_mass import PointMass
from probes import Explodes, Walk, WalkState

ENV = f"mjx_dher.gym:{mjx_dher.gym.ENV_ID}"
HPARAMS = HParams(priority_fraction=0.5, lr_end=0.5)
CONTEXT = Context(PointMass().compute_reward, trainer.as_arrays(HPARAMS))


def both_ways(function):
    """A function's result in 32-bit mode and under jax_enable_x64, as NumPy's, with the names of its leaves."""
    results = [jax.device_get(function())]
    with jax.enable_x64(True):
        results.append(jax.device_get(function()))
    return zip(*(jax.tree_util.tree_leaves_with_path(result) for result in results), strict=True)


def assert_the_same_both_ways(function):
    for (name, own), (_, other) in both_ways(function):
        assert own.dtype == other.dtype, name
        np.testing.assert_array_equal(own, other, str(name))


def ring_of(ends):
    random = np.random.default_rng(0)
    draw = lambda *shape: random.uniform(-1, 1, shape).astype(np.float32)  # noqa: E731
    length = random.integers(2, 11, 12).astype(np.int32) if ends else np.full(12, 10, np.int32)
    episodes = Episode(draw(12, 11, 3), draw(12, 11, 2), draw(12, 2), draw(12, 10, 2), length, np.zeros(12, bool))
    one = jax.tree.map(lambda x: x[0], episodes)
    return replay.add(replay.init(one, 20, ends), episodes, np.linspace(0, 2, 12, dtype=np.float32))


# 64 bits.


@pytest.mark.parametrize("ends", [False, True])
def test_the_ring_draws_the_same_rows_and_steps_with_64_bits(ends):
    def draw():
        ring, key = ring_of(ends), jax.random.key(1)
        weights = replay.cumulative(ring)
        one = replay.sample(ring, key, 3000)
        assert np.unique(one.row).tolist() == list(range(12))
        assert np.unique(one.step).tolist() == list(range(10))
        assert np.all(np.asarray(one.step) < np.asarray(one.length))
        rows = replay.draw_rows(ring, key, 3000, 0.5, weights)
        assert np.unique(rows).tolist() == list(range(12))
        others = replay.newest_and_others(ring, key, 3, 500)
        assert np.unique(others).tolist() == list(range(12))
        return weights, one, rows, others, replay.sample_pool(ring, key, 3000)

    assert_the_same_both_ways(draw)


@pytest.mark.parametrize("sampler", ["episode", "random", "future", "final", "geometric", "epsilon_closest", "weighted"])
def test_samplers_draw_the_same_goals_with_64_bits(sampler):
    def draw():
        ring = ring_of(ends=True)
        weights = replay.cumulative(ring)
        return relabel.draw_batches(ring, jax.random.key(2), (2000,), samplers.make(sampler), CONTEXT, weights, n_step=3)

    assert_the_same_both_ways(draw)


@pytest.mark.parametrize("priority", [pytest.param("dpp", marks=pytest.mark.slow), "curriculum", "not_misleading"])
def test_priorities_choose_the_same_transitions_with_64_bits(priority):
    def draw():
        ring, chosen = ring_of(ends=False), whole(make(priority))
        weights = replay.cumulative(ring)
        return relabel.draw_batches(ring, jax.random.key(2), (512,), samplers.future, CONTEXT, weights, priority=chosen)

    assert_the_same_both_ways(draw)


@pytest.mark.parametrize(("learner", "generator"), [("ddpg", "hgg"), pytest.param("tqc", None, marks=pytest.mark.slow)])
def test_a_run_is_nearly_the_same_with_64_bits(learner, generator):
    def train():
        train = trainer.make_train(PointMass(), TINY, learner=learner, generator=generator and generators.make(generator))
        state = jax.jit(train.init)(jax.random.key(0), HPARAMS)
        for _ in range(2):
            state, metrics = jax.jit(train.epoch)(state)
            assert metrics["no_goal_share"] == 0
        return checkpoint.without_keys(state), metrics

    for (name, own), (_, other) in both_ways(train):
        assert own.dtype == other.dtype, name
        np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-4, err_msg=str(name))


class Own(ddpg.DDPG):
    def explore(self, *args):
        return super().explore(*args).astype(float)  # as jnp.zeros without a dtype is


def test_an_own_learner_s_actions_may_have_64_bits():
    with jax.enable_x64(True):
        own = lambda *args: Own(*vars(ddpg.make(*args)).values())  # noqa: E731
        train = trainer.make_train(PointMass(), TINY, learner=learners.make(own, TINY, env_spec(PointMass())))
        state, metrics = jax.jit(train.epoch)(jax.jit(train.init)(jax.random.key(0), HPARAMS))
    assert state.replay.episodes.action.dtype == np.float32
    assert np.isfinite(metrics["critic_loss"])


# Random keys of another generator than JAX's default.


def keys_of(number):
    return jax.random.split(jax.random.key(0, impl="rbg"), number)


@struct.dataclass
class KeyedState(WalkState):
    key: jax.Array


class KeyedWalk(Walk):
    """A walk with noise, whose states have a key of another generator."""

    def reset(self, key):
        bits = jax.random.bits(key, (), jnp.uint32)
        return KeyedState(**vars(super().reset(key)), key=jax.random.fold_in(jax.random.key(0, impl="rbg"), bits))

    def step(self, state, action):
        key, noise_key = jax.random.split(state.key)
        moved = super().step(state, action + 0.5 * jax.random.normal(noise_key, (2,), jnp.float32))
        return KeyedState(**vars(moved), key=key)


def test_states_may_have_keys_of_another_generator():
    keys, others = keys_of(4), keys_of(8)[4:]
    mixed = where_each(jnp.array([True, False, True, False]), keys, others)
    assert mixed.dtype == keys.dtype
    data, own, other = map(jax.random.key_data, (mixed, keys, others))
    np.testing.assert_array_equal(data, [own[0], other[1], own[2], other[3]])
    episodes, outcome = jax.jit(lambda: rollout(KeyedWalk(), lambda _, obs: obs["desired_goal"], jax.random.key(0), 8))()
    assert episodes.length.min() < 12
    assert outcome.valid.all()
    many = mjx_dher.gym.GymVectorEnv("test_odd_numbers:KeyedWalk", num_envs=8)
    many.reset(seed=0)
    ended = [many.step(np.ones((8, 2)))[3] for _ in range(6)]
    assert 0 < np.mean(ended) < 1


def test_keys_of_another_generator_are_saved_and_restored(tmp_path):
    state = {"key": keys_of(3), "number": jnp.arange(2.0)}
    (key, number), shapes = jax.tree.leaves(state), jax.eval_shape(lambda: state)
    plain = [learner_policy._to_plain(leaf) for leaf in (key, number)]
    read = [learner_policy._from_plain(*pair) for pair in zip(plain, jax.tree.leaves(shapes))]
    placed = restoring._place([np.asarray(jax.random.key_data(key)), np.asarray(number)], shapes)
    for found in (dict(zip(state, read)), placed):
        assert found["key"].dtype == key.dtype
        np.testing.assert_array_equal(jax.random.bits(found["key"][1], (4,)), jax.random.bits(key[1], (4,)))
        np.testing.assert_array_equal(found["number"], number)


# Gymnasium.


@struct.dataclass
class Seen:
    place: jax.Array
    near: tuple
    size: int = struct.field(pytree_node=False, default=3)


class Sees(PointMass):
    """Its observations are a dataclass with an image and a bool, and its length is NumPy's."""

    def __init__(self):
        super().__init__(np.int64(3))

    def _state(self, position, goal):
        state = super()._state(position, goal)
        seen = Seen(position, (position > 0, jnp.full((2, 2), 7, jnp.uint8)))
        return dataclasses.replace(state, obs={**state.obs, "observation": seen})


def test_observations_may_be_dataclasses_with_bools_and_lengths_numpy_s():
    env = gymnasium.make(ENV, name="test_odd_numbers:Sees")
    many = mjx_dher.gym.GymVectorEnv("test_odd_numbers:Sees", num_envs=2)
    for one in (env, many):
        obs, _ = one.reset(seed=0)
        assert set(obs["observation"]) == {"place", "near"}
        assert obs in one.observation_space
        assert one.step(one.action_space.sample())[0] in one.observation_space
    near = env.observation_space["observation"]["near"]
    assert (near[0].dtype, near[1].dtype) == (np.dtype(bool), np.dtype(np.uint8))
    assert [env.step(np.zeros(2))[3] for _ in range(2)] == [False, True]
    assert [many.step(np.zeros((2, 2)))[3].all() for _ in range(2)] == [False, True]
    longer = mjx_dher.gym.GymVectorEnv("test_odd_numbers:Sees", num_envs=2, max_episode_steps=np.int64(5))
    assert longer.max_episode_steps == 5


@pytest.mark.parametrize("steps", [2, 3, 4])
def test_a_copy_that_terminates_at_the_limit_is_truncated_as_a_single_environment(steps):
    single = gymnasium.make(ENV, name="probes:Walk", episode_length=steps)
    many = gymnasium.make_vec(ENV, 2, vectorization_mode="vector_entry_point", name="probes:Walk", max_episode_steps=steps)
    down = np.array([0.0, -0.4])  # to y < -1 in three steps
    many.reset(seed=0)
    for _ in range(2):
        single.reset(seed=0)
        for _ in range(min(steps, 3)):
            own, all_copies = single.step(down)[2:4], many.step(np.stack([down] * 2))[2:4]
            assert [flag.tolist() for flag in all_copies] == [[flag] * 2 for flag in own]
        assert own == (steps >= 3, steps <= 3)
        assert not np.any(many.step(np.zeros((2, 2)))[2:4])


class Whole(PointMass):
    """Its rewards are integers."""

    def compute_reward(self, achieved_goal, desired_goal):
        return super().compute_reward(achieved_goal, desired_goal).astype(jnp.int32)

    def _state(self, position, goal):
        state = super()._state(position, goal)
        return dataclasses.replace(state, reward=state.reward.astype(jnp.float32))


def test_rewards_of_goals_are_float32():
    env = mjx_dher.gym.GymEnv("test_odd_numbers:Whole")
    assert env.compute_reward(np.zeros((3, 2)), np.ones((3, 2)), {}).dtype == np.float32
    assert env.compute_reward(np.zeros(2), np.ones(2), {}).dtype == np.float32


# Demonstrations.


def test_demonstrations_are_written_to_and_read_from_an_npz_alone(tmp_path):
    episodes, _ = jax.jit(lambda: rollout(Walk(), lambda _, obs: obs["desired_goal"], jax.random.key(0), 3))()
    for name in ("demos", "demos.npy", Path("demos.NPZ")):
        with refuses(".npz", Path(name).suffix):
            write_demonstrations(tmp_path / name, episodes)
    assert list(tmp_path.iterdir()) == []
    write_demonstrations(tmp_path / "demos.npz", episodes)
    read = read_demonstrations(tmp_path / "demos.npz", Walk(), 3)
    np.testing.assert_array_equal(read.action, episodes.action)


# Seconds per step.


class Slow(PointMass):
    dt = 0.02


def test_the_resting_point_needs_the_steps_of_its_formula():
    spec = RunSpec(env="point_mass", sampler="closest", metric="resting_point_rough", config=TINY)
    program.make_loop(PointMass(), spec, program.choices_of([spec]))
    with refuses("resting_point", "dt", "0.04", "0.02"):
        program.check_runs(Slow(), [spec])
    other = dataclasses.replace(spec, metric="velocity")
    program.make_loop(Slow(), other, program.choices_of([other]))


@pytest.mark.parametrize("success", [1.0, jnp.nan])
def test_a_discarded_episode_counts_in_no_mean(success):
    """Its start is no success, and a cycle that has only such episodes leaves the epoch's mean return as it is."""

    class Starts(Explodes):
        def reset(self, key):
            state = super().reset(key)
            return dataclasses.replace(state, success=jnp.where(state.step == 0, success, 0.0))

    program = make_train(Starts(None), dataclasses.replace(SMALL, num_envs=1, cycles_per_epoch=12, replay_size=1000))
    state, metrics = jax.jit(program.epoch)(jax.jit(program.init)(jax.random.key(0), HParams()))
    kept = int(state.replay.size)
    assert 0 < kept < 12
    assert metrics["discarded_episodes"] == 12 - kept
    assert metrics["reset_success_rate"] == metrics["bad_success"] == 0
    distance = jnp.linalg.norm(state.replay.episodes.achieved_goal - state.replay.episodes.desired_goal[:, None], axis=-1)
    returns = -jnp.sum(distance[:kept, 1:] > 0.1, axis=1)
    assert float(metrics["train_return_mean"]) == pytest.approx(float(returns.mean()), abs=1e-5)


@pytest.mark.parametrize("edge", [0.2, 2.0])
def test_discarded_episodes_of_a_policy_are_counted_and_told(edge, capsys):
    still = SimpleNamespace(forward=lambda observation, goal, xp: xp.zeros_like(goal))
    outcome = play_policy(Explodes(jnp.nan, edge), still, 50, seed=1)
    summary, broken = summarize(*outcome[:4]), int(np.sum(~outcome.valid))
    assert (broken > 5) == (edge < 1)
    assert summary.get("discarded_episodes", 0) == broken
    print_summary(summary, Console(width=500))
    told = capsys.readouterr().out
    assert ("discarded" in told) == (broken > 0)
    assert broken == 0 or f"; {broken} episodes were discarded" in told
