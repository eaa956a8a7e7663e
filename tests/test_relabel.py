import collections
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_dher import priorities, replay, samplers
from mjx_dher.components import COMPONENTS
from mjx_dher.config import HParams
from mjx_dher.context import Context
from mjx_dher.priorities import Priority
from mjx_dher.relabel import add_pool, draw_batches, hindsight_goals, look_ahead, relabel
from mjx_dher.rollout import rollout
from mjx_dher.types import Batch, Episode
from probes import Clock

HP = HParams()
ENV = Clock(episode_length=12)
CONTEXT = Context(ENV.compute_reward, HP)
sample_of = jax.jit(replay.sample, static_argnums=2)
Numbered = collections.namedtuple("Numbered", (*HParams._fields, "choice"))


@pytest.fixture(scope="module")
def ring():
    """Episodes of a random walk: no two achieved goals are alike, but for the origin where all begin."""

    steps = jax.random.normal(jax.random.key(0), (12, 64, 2))

    @jax.jit
    def make(steps):
        episodes, _ = rollout(ENV, lambda step, obs: step, jax.random.key(0), 64, steps)
        return replay.add(replay.init(jax.tree.map(lambda x: x[0], episodes), 80), episodes)

    return make(steps)


def index_of(goal, episode_goals):
    """[B] where each goal stands in its episode, -1 if nowhere."""
    equal = np.all(np.asarray(episode_goals) == np.asarray(goal)[:, None], axis=-1)
    return np.where(equal.any(-1), equal.argmax(-1), -1)


def goals_of(ring, sample, sampler, hparams, key):
    draw = lambda ring, sample, key: hindsight_goals(add_pool(ring, sample, sampler, key), sampler, hparams, key)  # noqa: E731
    return jax.jit(draw)(ring, sample, key).goals


@pytest.mark.parametrize("name", COMPONENTS["sampler"])
def test_goals_come_from_where_the_sampler_may_look(ring, name):
    sample = sample_of(ring, jax.random.key(1), 5000)
    goals = goals_of(ring, sample, samplers.make(name), HP, jax.random.key(2))
    index, step = index_of(goals, sample.episode_goals), np.asarray(sample.step)
    if name == "random":
        anywhere = np.asarray(ring.episodes.achieved_goal[:64]).reshape(-1, 2)
        assert set(map(tuple, np.asarray(goals))) <= set(map(tuple, anywhere))
        assert (index == -1).mean() > 0.9  # 63 of 64 come from another episode
        return
    assert np.all(index >= 0), "a goal that is not of the transition's own episode"
    if name == "episode":
        assert np.any(index <= step)
    elif name == "final":
        assert np.all(index == ENV.episode_length)
    else:
        assert np.all(index > step), "a future goal must be strictly later than the step"
        assert np.any(index == step + 1)


@pytest.mark.parametrize(("gives", "log_weights"), [("[]", lambda a, d, s, h: s * 0.0), ("[13, 2]", lambda a, d, s, h: a)])
def test_a_sampler_s_log_weights_are_one_for_each_goal(ring, gives, log_weights):
    sample = sample_of(ring, jax.random.key(1), 5)
    with pytest.raises(ValueError, match="log weights") as error:
        hindsight_goals(sample, samplers.Sampler(log_weights), HP, jax.random.key(0))
    assert "[13]" in str(error.value)
    assert gives in str(error.value)


@jax.jit
def relabelled(sample, k, key):
    return relabel(sample, samplers.make("future"), Context(ENV.compute_reward, HP._replace(her_k=k)), key).batch


@pytest.mark.parametrize("k", [0.0, 1.0, 4.0, np.inf])
def test_relabelled_share(ring, k):
    sample = sample_of(ring, jax.random.key(3), 20_000)
    batch = relabelled(sample, k, jax.random.key(4))
    kept = np.all(np.asarray(batch.desired_goal == sample.desired_goal), axis=-1)
    expected = 1.0 if k == np.inf else k / (k + 1)
    assert abs((1 - kept.mean()) - expected) <= 4 * np.sqrt(expected * (1 - expected) / 20_000)


def test_reward_is_compute_reward_of_the_goal_and_what_the_step_achieved(ring):
    count = 100_000

    @jax.jit
    def draw(key):
        keys = jax.random.split(key, 3)
        sample = replay.sample(ring, keys[0], count)
        return sample, relabel(sample, samplers.make("weighted"), CONTEXT, keys[1]).batch

    sample, batch = draw(jax.random.key(5))
    achieved = np.asarray(batch.next_observation)  # the probe observes just its achieved goal
    distance = np.linalg.norm(achieved - np.asarray(batch.desired_goal), axis=-1)
    sure = np.abs(distance - 0.1) > 1e-6  # float32 may fall on either side at the threshold itself
    np.testing.assert_array_equal(np.asarray(batch.reward)[sure], np.where(distance > 0.1, -1.0, 0.0)[sure])
    assert sure.mean() > 0.9999
    assert 0.01 < np.mean(np.asarray(batch.reward) == 0) < 0.99
    np.testing.assert_array_equal(batch.action, sample.action)
    np.testing.assert_array_equal(batch.observation, sample.observation)


def test_weighted_prefers_goals_near_the_desired_one(ring):
    sample = sample_of(ring, jax.random.key(6), 20_000)

    def mean_distance(name):
        goals = goals_of(ring, sample, samplers.make(name), HP, jax.random.key(7))
        return float(jnp.mean(jnp.linalg.norm(goals - sample.desired_goal, axis=-1)))

    assert mean_distance("closest") < mean_distance("epsilon_closest") < mean_distance("weighted") < mean_distance("future")


def test_a_sampler_measures_by_the_goal_distance_of_the_context():
    """Achieved goals 0, 9, 2, 4 on a circle of 10: from goal 0, the 9 is at distance 1, where the line's nearest is 2."""
    circle = lambda achieved, desired: jnp.minimum(d := jnp.abs(achieved - desired)[..., 0], 10 - d)  # noqa: E731
    goals = jnp.array([[[0.0], [9.0], [2.0], [4.0]]])
    ring = ring_of(Episode(goals, goals, jnp.zeros((1, 1)), jnp.zeros((1, 3, 1))))
    sample = sample_of(ring, jax.random.key(0), 64)
    on_line = Context(lambda achieved, desired: -(achieved - desired)[..., 0], HP._replace(her_k=jnp.inf))
    first = np.asarray(sample.step) == 0
    joined = samplers.join([samplers.make("closest"), samplers.make("final")])
    for sampler, context, expected in [
        (samplers.make("closest"), on_line, 2.0),
        (samplers.make("closest"), on_line._replace(goal_distance=circle), 9.0),
        (samplers.make("closest", goal_distance=circle), on_line, 9.0),
        (samplers.make("closest", metric=samplers.position), on_line._replace(goal_distance=circle), 2.0),
        (joined, on_line._replace(goal_distance=circle, hparams=Numbered(*on_line.hparams, 0)), 9.0),
    ]:
        draw = jax.jit(lambda sample, key, of=(sampler, context): relabel(sample, *of, key).batch.desired_goal)
        chosen = draw(sample, jax.random.key(1))
        assert set(np.asarray(chosen)[first].ravel()) == {expected}


def test_one_of_several_samplers_draws_what_it_would_alone(ring):
    """Whichever a run is told to use by its number, to the bit; `random`, which looks elsewhere in the ring, too."""
    names = ("future", "random", "weighted", "closest", "final")
    together = samplers.join([samplers.make(name) for name in names])
    sample = sample_of(ring, jax.random.key(0), 64)
    goals = set()
    for choice, name in enumerate(names):
        numbers = Numbered(*HParams(), choice)
        found = goals_of(ring, sample, together, numbers, jax.random.key(1))
        alone = goals_of(ring, sample, samplers.make(name), HParams(), jax.random.key(1))
        np.testing.assert_array_equal(found, alone)
        goals.add(found.tobytes())
    assert len(goals) == len(names)
    assert samplers.join([together]) is together


LINE = Episode(  # four steps along a line: 0, 1, 3, 6, 10
    observation=jnp.arange(5.0)[:, None] * 10,
    achieved_goal=jnp.array([[0.0], [1.0], [3.0], [6.0], [10.0]]),
    desired_goal=jnp.array([20.0]),
    action=jnp.zeros((4, 1)),
)


def near(achieved, desired):
    return -(jnp.abs(achieved - desired)[..., 0] > 0.5).astype(jnp.float32)


@jax.jit
def ring_of(episodes):
    return replay.add(replay.init(jax.tree.map(lambda x: x[0], episodes), 3), episodes)


@jax.jit
def three_ahead(ring, sample, one):
    return look_ahead(ring, sample, one, Context(near, HP._replace(gamma=0.5)), 3)


@pytest.mark.parametrize(
    ("step", "goal", "reward", "num_steps"),
    [
        (0, 20.0, -1 - 0.5 - 0.25, 3),  # never reached: three steps
        (0, 1.0, 0.0, 1),  # reached by the first
        (0, 3.0, -1.0, 2),  # by the second: what comes after is another goal's
        (0, 6.0, -1 - 0.5, 3),
        (2, 20.0, -1 - 0.5, 2),  # the episode ends
        (3, 10.0, 0.0, 1),
        (3, 20.0, -1.0, 1),
        (1, 1.0, -1 - 0.5 - 0.25, 3),  # where the transition began does not count
    ],
)
def test_returns_of_several_steps_by_hand(step, goal, reward, num_steps):
    """gamma 1/2, up to three steps; the second row of the ring holds the episode."""
    ring = ring_of(jax.tree.map(lambda x: jnp.stack([x + 99, x]), LINE))
    sample = replay.Sample(
        observation=LINE.observation[step][None],
        next_observation=LINE.observation[step + 1][None],
        action=LINE.action[step][None],
        episode_goals=LINE.achieved_goal[None],
        desired_goal=LINE.desired_goal[None],
        step=jnp.array([step]),
        row=jnp.array([1]),
        length=jnp.array([4]),
        terminal=jnp.array([False]),
    )
    ends = sample.observation, sample.next_observation
    one = Batch(*ends, jnp.array([[goal]]), sample.action, jnp.array([9.0]), jnp.array([0.5]), sample.row)
    batch = three_ahead(ring, sample, one)
    np.testing.assert_allclose(batch.reward, [reward])
    np.testing.assert_allclose(batch.discount, [0.5**num_steps])
    np.testing.assert_array_equal(batch.next_observation, LINE.observation[step + num_steps][None])
    np.testing.assert_array_equal(batch.observation, one.observation)


def test_samplers_and_priorities_are_given_by_name_as_functions_and_whole(ring):
    key, weights = jax.random.key(4), replay.cumulative(ring)
    sample = sample_of(ring, key, 50)
    pools = [add_pool(ring, sample, given, key).pool for given in ("random", samplers.make("random"))]
    jax.tree.map(np.testing.assert_array_equal, *pools)
    for given in ("weighted", samplers.make("weighted").log_weights, samplers.make("weighted")):
        assert add_pool(ring, sample, given, key) is sample
    eventful = priorities.make("eventful")
    assert not isinstance(eventful, Priority)
    drawn = [
        draw_batches(ring, key, (20,), "future", CONTEXT, weights, priority=given)
        for given in ("eventful", eventful, priorities.whole(eventful), None)
    ]
    for other in drawn[1:]:
        jax.tree.map(np.testing.assert_array_equal, drawn[0], other)
    assert priorities.renew(eventful, ring, CONTEXT) is ring


def test_one_step_ahead_is_the_transition(ring):
    """Drawn alike with one step and several: the same transitions and goals; with one, the reward and gamma themselves."""
    args = jax.random.key(5), (300,), samplers.make("future"), CONTEXT

    def draw(ring, n_step):
        return draw_batches(ring, *args, replay.cumulative(ring), n_step)

    single, several = (jax.jit(draw, static_argnums=1)(ring, n_step) for n_step in (1, 4))
    np.testing.assert_array_equal(single.discount, np.float32(HP.gamma))
    for name in ("observation", "action", "desired_goal"):
        np.testing.assert_array_equal(getattr(single, name), getattr(several, name))
    once = np.isclose(several.discount, HP.gamma)
    np.testing.assert_array_equal(single.next_observation[once], several.next_observation[once])
    np.testing.assert_array_equal(single.reward[once], several.reward[once])
    assert 0 < once.mean() < 1
    assert np.all(np.asarray(several.reward)[~once] <= np.asarray(single.reward)[~once])


def test_returns_of_several_steps_end_at_a_failure_in_the_last_step():
    """In a ring without `ends`, too."""
    failed = dataclasses.replace(LINE, length=jnp.int32(4), terminal=jnp.array(True))
    ring = ring_of(jax.tree.map(lambda x: x[None], failed))
    args = jax.random.key(0), (200,), samplers.make("future"), Context(near, HP._replace(gamma=0.5))
    for n_step in (1, 3):
        batch = jax.jit(lambda ring, n=n_step: draw_batches(ring, *args, replay.cumulative(ring), n))(ring)
        at_end = np.asarray(batch.next_observation[:, 0]) == 40.0
        assert at_end.any()
        assert not np.asarray(batch.discount)[at_end].any()
        assert np.asarray(batch.discount)[~at_end].all()
