"""What is renewed of a ring's priorities at a cycle."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import SMALL

from mjx_dher import HParams, make_train, priorities, replay, testing
from mjx_dher.context import Context
from mjx_dher.contrib import priorities as contributed
from mjx_dher.priorities import Priority
from mjx_dher.runs.program import Lane
from point_mass import PointMass
from probes import Least

ENV = PointMass()
CONTEXT = Context(ENV.compute_reward, HParams())
# The share of the run that has been made says at which cycle an episode was renewed.
BY_CYCLE = Priority(renew=lambda ring, context: jnp.full(ring.priority.shape, 1.0 + context.progress), by_part=True)


random_episodes = functools.cache(lambda: testing.trial.random_episodes(ENV))


@functools.partial(jax.jit, static_argnums=(1, 2))
def first_of(played, number, rows):
    some = jax.tree.map(lambda x: x[:number], played)
    return replay.add(replay.init(jax.tree.map(lambda x: x[0], some), rows), some, jnp.arange(1.0, number + 1))


def ring_of(number, rows):
    return first_of(random_episodes(), number, rows)


def test_the_newest_rows_come_first_and_the_others_are_of_the_whole_ring():
    ring = ring_of(5, rows=8)
    rows = np.asarray(replay.newest_and_others(ring, jax.random.key(0), 3, 1000))
    np.testing.assert_array_equal(rows[:3], [4, 3, 2])
    counts = np.bincount(rows[3:], minlength=8)
    np.testing.assert_array_equal(counts[5:], 0)
    assert (counts[:5] > 130).all()  # 200 each, 12.6 the standard deviation
    around = dataclasses.replace(ring, cursor=jnp.int32(1), size=jnp.int32(8))
    np.testing.assert_array_equal(replay.newest_and_others(around, jax.random.key(0), 3, 0), [0, 7, 6])


def test_only_the_rows_that_are_named_are_renewed():
    ring = ring_of(5, rows=8)
    seen = []

    def renew(part, context):
        seen.append((part.priority, part.size, part.episodes))
        return 10.0 + part.priority

    rows = jnp.array([3, 1, 6, 3])  # a row twice, and one that holds no episode
    renewed = priorities.renew(Priority(renew=renew), ring, CONTEXT, rows)
    np.testing.assert_array_equal(renewed.priority, [1, 12, 3, 14, 5, 0, 0, 0])
    ((weights, size, handed),) = seen
    np.testing.assert_array_equal(weights, [4, 2, 0, 4])
    assert size == 4
    np.testing.assert_array_equal(handed.achieved_goal[1], ring.episodes.achieved_goal[1])
    np.testing.assert_array_equal((renewed.size, renewed.cursor), (ring.size, ring.cursor))


def test_weights_of_the_wrong_number_are_refused():
    with pytest.raises(ValueError, match=r"weights \[E\] .*shape \[2\]; got .*\[8\]"):
        priorities.renew(Priority(renew=lambda part, context: jnp.ones(8)), ring_of(5, rows=8), CONTEXT, jnp.array([0, 1]))


def test_one_of_several_priorities_is_renewed_in_rows_as_it_is_alone():
    rows, ring = jnp.array([0, 2]), ring_of(5, rows=8)
    joined = priorities.join([priorities.eventful, BY_CYCLE])
    for number, alone in enumerate((priorities.whole(priorities.eventful), BY_CYCLE)):
        found = priorities.renew(joined, ring, CONTEXT._replace(hparams=SimpleNamespace(priority_choice=number)), rows)
        np.testing.assert_array_equal(found.priority, priorities.renew(alone, ring, CONTEXT, rows).priority)


def test_a_lane_logs_the_mean_priority_of_new_episodes_beside_one_that_renews():
    def logged(priority, hparams):
        train = make_train(ENV, SMALL, priority=priority, learner=Least())
        return jax.jit(train.epoch)(jax.jit(train.init)(jax.random.key(0), hparams))[1]["priority_mean"]

    lane = Lane(*HParams(), choice=0, priority_choice=0, generator_choice=0)
    together = logged(priorities.join([priorities.eventful, BY_CYCLE]), lane)
    np.testing.assert_array_equal(together, logged(priorities.eventful, HParams()))


def renewed_at(renewals, priority):
    """The cycle, of four, at which the episodes of each cycle were renewed last."""
    number, cycles = SMALL.num_envs, 4
    steps = cycles * number * ENV.episode_length
    config = dataclasses.replace(SMALL, renewals=renewals, cycles_per_epoch=cycles, total_steps=steps, replay_size=2 * steps)
    train = make_train(ENV, config, priority=priority, learner=Least())
    state, _ = jax.jit(train.epoch)(train.init(jax.random.key(0), HParams()))
    return np.round((np.asarray(state.replay.priority[: cycles * number]).reshape(cycles, number) - 1.0) * cycles)


def test_a_priority_that_compares_episodes_is_handed_all_of_them():
    for priority in (
        dataclasses.replace(BY_CYCLE, by_part=False),
        priorities.join([BY_CYCLE, dataclasses.replace(BY_CYCLE, by_part=False)]),
    ):
        assert not priority.by_part
    np.testing.assert_array_equal(renewed_at(1, dataclasses.replace(BY_CYCLE, by_part=False)), 3)
    assert priorities.join([priorities.eventful, BY_CYCLE]).by_part
    assert priorities.td_error.by_part
    assert not contributed.max_entropy.by_part


@pytest.mark.parametrize("renewals", [0, pytest.param(1, marks=pytest.mark.slow), 2, 10**6])
def test_a_run_renews_its_own_episodes_and_as_many_others_as_it_is_told(renewals):
    cycle, number = renewed_at(renewals, BY_CYCLE), SMALL.num_envs
    if renewals in (0, 10**6):  # all of the ring, at the last cycle
        np.testing.assert_array_equal(cycle, 3)
    else:
        assert (cycle >= np.arange(4)[:, None]).all()
        np.testing.assert_array_equal(cycle[3], 3)
        others = int((cycle > np.arange(4)[:, None]).sum())
        assert others == 0 if renewals == 1 else 0 < others < 3 * number


def test_added_demonstrations_are_renewed_too():
    """Cycles that renew their own episodes alone would leave them at 0, and never draw them."""
    train = make_train(ENV, dataclasses.replace(SMALL, renewals=1), priority=BY_CYCLE, learner=Least())
    state = train.init(jax.random.key(0), HParams())
    state = jax.jit(train.add)(state, jax.tree.map(lambda x: x[:3], random_episodes()))
    np.testing.assert_array_equal(state.replay.priority, [1.0] * 3 + [0.0] * (len(state.replay.priority) - 3))
