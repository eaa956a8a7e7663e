"""Priorities of episodes, by hand, and what of an own one is refused."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import priorities, relabel, replay, samplers
from mjx_dher.components import COMPONENTS
from mjx_dher.config import HParams
from mjx_dher.context import Context
from mjx_dher.contrib import generators
from mjx_dher.types import Episode
from probes import Clock

HP = HParams()
REWARD = Clock().compute_reward  # 0 within 0.1, else -1
CONTEXT = Context(REWARD, HP)
# Achieved goals along x of three episodes: out and back, out, and never away; all were played for (1, 1).
PATHS = jnp.array([[0.0, 0.5, 0.05], [0.0, 0.0, 0.3], [0.0, 0.0, 0.0]])[..., None] * jnp.array([1.0, 0.0])
EPISODES = Episode(PATHS, PATHS, jnp.ones((3, 2)), jnp.zeros((3, 2, 2)))


def weights(priority, hparams=HP):
    return priorities.weights(priority, EPISODES, Context(REWARD, hparams))


def test_an_episode_is_eventful_if_it_left_where_it_began():
    for row, expected in enumerate([0.0, 1.0, 0.0]):
        found = priorities.eventful(jax.tree.map(lambda x, row=row: x[row], EPISODES), CONTEXT)
        assert (found.shape, found.dtype, float(found)) == ((), jnp.float32, expected)
    np.testing.assert_array_equal(weights(priorities.eventful), [0, 1, 0])


def test_what_was_played_for_does_not_make_an_episode_eventful():
    reached = EPISODES.replace(desired_goal=PATHS[:, -1])
    np.testing.assert_array_equal(priorities.weights(priorities.eventful, reached, CONTEXT), [0, 1, 0])


def distance(episode, context):
    """How far the last achieved goal is from the first, in units of a number of the run."""
    return jnp.linalg.norm(episode.achieved_goal[-1] - episode.achieved_goal[0]) / context.hparams.temperature


def test_an_own_priority_sees_an_episode_the_reward_and_the_numbers():
    np.testing.assert_allclose(weights(distance, HP._replace(temperature=0.1)), [0.5, 3.0, 0.0], rtol=1e-6)

    def rewards(episode, context):
        assert episode.achieved_goal.shape == (3, 2)
        assert episode.action.shape == (2, 2)
        return -jnp.sum(context.compute_reward(episode.achieved_goal, episode.achieved_goal[0]))

    np.testing.assert_array_equal(weights(rewards), [1, 1, 0])


@pytest.mark.parametrize("bad", [jnp.nan, -1.0, -jnp.inf, jnp.inf, 0.0])
def test_what_is_not_a_positive_number_is_no_weight(bad):
    found = weights(lambda episode, context: jnp.where(episode.achieved_goal[-1, 0] > 0.1, 0.5, bad))
    np.testing.assert_array_equal(found, [0.0, 0.5, 0.0])


@pytest.mark.parametrize("dtype", [bool, jnp.int32, jnp.float16])
def test_weights_are_float32_whatever_the_priority_gives(dtype):
    found = weights(lambda episode, context: (episode.achieved_goal[-1, 0] > 0.1).astype(dtype))
    assert found.dtype == jnp.float32
    np.testing.assert_array_equal(found, [0, 1, 0])


@pytest.mark.parametrize(
    ("gives", "priority"),
    [
        ("[2]", lambda e, c: e.desired_goal),
        ("[3]", lambda e, c: c.compute_reward(e.achieved_goal, e.desired_goal[None])),
        ("[1]", lambda *_: jnp.ones(1)),
    ],
)
def test_a_weight_of_the_wrong_shape_is_refused(gives, priority):
    with pytest.raises(ValueError, match=r"priority: weight \[\]") as error:
        weights(priority)
    assert gives in str(error.value)


def test_make_takes_a_name_a_place_or_a_function():
    assert all(priorities.make(name) is priorities.make(row.path) for name, row in COMPONENTS["priority"].items())
    assert priorities.make("eventful") is priorities.eventful
    assert priorities.make("mjx_dher.priorities:eventful") is priorities.eventful
    assert priorities.make(distance) is distance


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("eventfull", ["priority", "'eventfull'", "did you mean 'eventful'", "module:attribute"]),
        ("mjx_dher.priorities:evntful", ["priority", "'mjx_dher.priorities:evntful'", "'eventful'"]),
        ("mjx_dher.components:COMPONENTS", ["priority", "(episode, context)", "'eventful'"]),
        (lambda: 1.0, ["priority", "(episode, context)"]),
    ],
)
def test_what_is_no_priority_is_refused(name, parts):
    with pytest.raises(ValueError, match="priority") as error:
        priorities.make(name)
    assert all(part in str(error.value) for part in parts), error.value


def test_batches_are_drawn_in_proportion_to_the_weights():
    """A quarter of a batch uniformly, from three episodes; the rest at 0.05 : 0.3 : 0."""
    empty = replay.init(jax.tree.map(lambda x: x[0], EPISODES), 4)
    ring = replay.add(empty, EPISODES.replace(action=EPISODES.action + jnp.arange(3.0)[:, None, None]), weights(distance))
    hparams = HP._replace(priority_fraction=0.75)
    args = (9, 1000), samplers.make("future"), Context(REWARD, hparams)
    batch = jax.jit(lambda ring, key: relabel.draw_batches(ring, key, *args, replay.cumulative(ring)))(ring, jax.random.key(0))
    found = np.bincount(np.asarray(batch.action[..., 0], int).ravel(), minlength=3)
    expected = 9000 * (0.25 / 3 + 0.75 * np.array([1 / 7, 6 / 7, 0]))
    assert np.sum((found - expected) ** 2 / expected) < 13.8  # 99.9 % point at 2 degrees of freedom


# Weights that are finite one by one, and whose sum is not.
HUGE = np.array([1e38, 3e38, 2e38, 0.0, 3e38], np.float32)
SHARES = HUGE / HUGE.astype(np.float64).sum()


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.slow
def test_episodes_are_drawn_by_weights_whose_sum_overflows(ends):
    rows = jax.tree.map(lambda x: jnp.stack([x[1]] * 5), EPISODES.filled())
    ring = replay.add(replay.init(jax.tree.map(lambda x: x[0], rows), 5, ends), rows, HUGE)
    drawn = replay.draw_rows(ring, jax.random.key(0), 20_000, 1.0, replay.cumulative(ring))
    np.testing.assert_allclose(np.bincount(drawn, minlength=5) / 20_000, SHARES, atol=0.02)
    np.testing.assert_allclose(replay.mean(ring.priority, ring.size), 1.8e38, rtol=1e-6)


def test_transitions_are_chosen_by_weights_whose_sum_overflows():
    candidates = 4 * 5_000
    choose = priorities.by_weight(lambda sample, batch, context: jnp.tile(HUGE[:4], 5_000))
    batch = SimpleNamespace(reward=jnp.zeros(candidates))
    kept = choose(jax.random.key(0), None, batch, 5_000, CONTEXT) % 4
    np.testing.assert_allclose(np.bincount(kept, minlength=4) / 5_000, np.array([1, 3, 2, 0]) / 6, atol=0.03)


def test_weights_whose_sum_is_fine_are_drawn_as_ever():
    weights = np.random.default_rng(0).lognormal(0, 8, 1_000).astype(np.float32)
    for scale in (1.0, 2.0**-20, 2.0**40, 2.0**70):  # a power of two changes no digit
        np.testing.assert_array_equal(
            replay._cumulate(weights * scale * replay.sum_factor(weights * scale)), replay._cumulate(weights)
        )


@pytest.mark.parametrize("normalization", ["mean", "sum", "far"])
def test_distances_whose_sum_overflows_offer_no_goal(normalization):
    distances = jnp.array([0.0, 3e38, 2e38, 3e38])
    sampler = samplers.make("weighted", metric=lambda achieved, desired: distances, normalization=normalization)
    log_weights = samplers.weigh(sampler, jnp.zeros((4, 2)), jnp.zeros(2), jnp.int32(0), HP)
    assert samplers.draw(jax.random.key(0), log_weights[None]) == 4  # no index: the transition keeps its goal, and is counted


def test_methods_that_ask_a_learner_name_the_values_that_they_lack():
    ring = replay.add(replay.init(jax.tree.map(lambda x: x[0], EPISODES), 3), EPISODES)
    obs = {"observation": PATHS[:, 0], "achieved_goal": PATHS[:, 0], "desired_goal": EPISODES.desired_goal}
    for act in (
        lambda: priorities.renew(priorities.td_error, ring, CONTEXT),
        lambda: generators.make("hgg")(jax.random.key(0), obs, ring, CONTEXT),
    ):
        with refuses("values", "uses_values"):
            act()


def test_discarded_episodes_are_not_in_the_mean_priority():
    ring = replay.add(replay.init(jax.tree.map(lambda x: x[0], EPISODES), 3), EPISODES)
    eventful = priorities.whole(priorities.eventful)
    for valid, expected in (([True, False, True], 3.0), ([True, True, True], 4.0), ([False] * 3, 0.0)):
        found = priorities.mean(eventful, ring, jnp.array([1.0, 6.0, 5.0]), jnp.array(valid), CONTEXT)
        assert found == expected
