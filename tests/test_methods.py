"""The published methods, beside numbers by hand."""

import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from mjx_dher import priorities, relabel, replay, samplers
from mjx_dher.config import HParams
from mjx_dher.context import Context, Values
from mjx_dher.contrib import goals, metrics
from mjx_dher.contrib import priorities as contributed
from mjx_dher.replay import Sample
from mjx_dher.types import Batch, Episode
from probes import Clock

HP = HParams()
REWARD = Clock().compute_reward  # 0 within 0.1, else -1
reward_of = jax.jit(REWARD)


def episode_of(achieved, desired=None):
    achieved = np.asarray(achieved, np.float32)
    desired = np.asarray(np.zeros(achieved.shape[1]) if desired is None else desired, np.float32)
    actions = np.zeros((len(achieved) - 1, 2), np.float32)
    return jax.tree.map(jnp.asarray, Episode(achieved, achieved, desired, actions)).filled()


def test_next_future_mixes_in_the_future_of_a_short_episode():
    weights = goals.next_future(jnp.zeros((11, 1)), jnp.zeros(1), jnp.int32(1), HP, jnp.int32(4))
    np.testing.assert_allclose(samplers.probabilities(weights)[:6], [0, 0, 0.5, 0.25, 0.25, 0], atol=1e-6)


def test_next_future_mixes_the_step_s_own_goal_with_the_future():
    achieved, desired = jnp.zeros((5, 2)), jnp.zeros(2)
    found = samplers.probabilities(goals.next_future(achieved, desired, jnp.int32(1), HP))  # k 4: a quarter
    np.testing.assert_allclose(found, [0, 0, 0.25 + 0.25, 0.25, 0.25], atol=1e-6)
    np.testing.assert_allclose(
        samplers.probabilities(goals.next_future(achieved, desired, jnp.int32(1), HP._replace(her_k=0.5))), [0, 0, 1, 0, 0]
    )
    assert samplers.make("next_future").log_weights is goals.next_future


def test_velocity_is_a_distance_in_position_and_velocity():
    achieved = jnp.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.0]])
    # At the goal but moving by 0.3 a step: 5 * 0.3. At rest there: 0.
    np.testing.assert_allclose(metrics.velocity(achieved, jnp.array([0.3, 0.0])), [0.3, 1.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(metrics.velocity(achieved, jnp.array([0.3, 2.0]))[1], math.hypot(2.0, 1.5), rtol=1e-6)


def test_the_resting_point_is_where_friction_stops_the_object():
    speed, friction = 1.0, 0.1  # m/s; 0.04 m a step
    stop = speed**2 / (2 * friction * 9.81)  # 0.51 m ahead
    achieved = jnp.array([[0.0, 0.0, 0.4], [0.04, 0.0, 0.4]])
    found = metrics.resting_point(achieved, jnp.array([0.04 + stop, 0.0, 0.4]))
    np.testing.assert_allclose(found, [0.04 + stop, 0.0], atol=1e-5)
    rough = metrics.resting_point_rough(achieved, jnp.array([0.04, 0.0, 0.4]))
    np.testing.assert_allclose(rough[1], stop / 10, rtol=1e-4)
    falling = jnp.array([[0.0, 0.0, 0.4], [0.0, 0.0, 0.3]])
    np.testing.assert_allclose(metrics.resting_point(falling, jnp.array([0.0, 0.0, 0.3]))[1], 0.0, atol=1e-6)


def linear_values(observation, goal, action):
    return -10.0 * jnp.abs(observation[..., 0] - goal[..., 0]) + 0.0 * action[..., 0]


VALUES = Values(lambda observation, goal: jnp.zeros((*observation.shape[:-1], 2)), linear_values)
CONTEXT = Context(REWARD, HP._replace(priority_fraction=1.0), values=VALUES)


def test_energy_counts_what_was_gained():
    lifted = episode_of([[0, 0, 0.4], [0, 0, 0.4], [0, 0, 0.5], [0, 0, 0.5]])
    # 0.1 m in a step is 2.5 m/s: 0.981 + 3.125 J a kg gained at once; its loss when it stops does not count.
    np.testing.assert_allclose(priorities.energy(lifted, CONTEXT), 0.981 + 3.125, rtol=1e-4)
    np.testing.assert_allclose(priorities.energy(episode_of([[0, 0], [0.1, 0], [0.1, 0]]), CONTEXT), 3.125, rtol=1e-4)
    assert priorities.energy(episode_of(jnp.ones((4, 3))), CONTEXT) == 0.0


def test_clipped_energy_by_hand_and_by_numpy():
    lifted = episode_of([[0, 0, 0.4], [0, 0, 0.4], [0, 0, 0.5], [0, 0, 0.51]])
    # Gains of 0, 4.106 and a loss: 0.01 m a step is 0.25 m/s, 0.0313 J a kg, after 3.125.
    np.testing.assert_allclose(priorities.energy_clipped(lifted, CONTEXT), 0.5, rtol=1e-5)
    slow = np.cumsum(np.random.default_rng(0).normal(0, 0.02, (51, 3)), axis=0)
    speed = np.diff(slow, axis=0) / 0.04
    total = 9.81 * (slow[1:, 2] - slow[0, 2]) + 0.5 * (speed**2).sum(axis=1)
    gains = np.clip(np.diff(total, prepend=0.0), 0, 0.5)
    assert gains.max() == 0.5
    assert np.mean(gains == 0.5) < 0.5
    np.testing.assert_allclose(priorities.energy_clipped(episode_of(slow), CONTEXT), gains.sum(), rtol=1e-3)


def test_diversity_is_a_sum_of_determinants():
    path = [[1.0, 0, 0], [0, 2.0, 0], [1.0, 1.0, 0], [3.0, 3.0, 0]]
    pairs = itertools.pairwise(path)
    unit = [(np.array(a) / np.linalg.norm(a), np.array(b) / np.linalg.norm(b)) for a, b in pairs]
    by_hand = sum(np.linalg.det(np.stack(pair) @ np.stack(pair).T) for pair in unit)  # 1 + 1/2 + 0
    np.testing.assert_allclose(by_hand, 1.5, rtol=1e-6)
    np.testing.assert_allclose(contributed.diversity(episode_of(path), CONTEXT), by_hand, rtol=1e-5)


def ring_with(paths, rows=None):
    each = [episode_of(path) for path in paths]
    return in_ring(jax.tree.map(lambda *x: np.stack(x), *each), rows or len(each))


@functools.partial(jax.jit, static_argnums=1)
def in_ring(episodes, rows):
    return replay.add(replay.init(jax.tree.map(lambda x: x[0], episodes), rows), episodes)


def chosen(priority, seed, sample, batch, number, context):
    """What `priorities.choose` takes, compiled."""
    choose = jax.jit(lambda key, *data: priorities.choose(priority, key, *data, number, context))
    return choose(jax.random.key(seed), sample, batch)[1]


def test_max_entropy_ranks_rare_episodes_above_common_ones():
    common = [[[0.0, 0.0], [0.01 * i, 0.0]] for i in range(10)]
    rare = [[[0.0, 0.0], [0.0, 1.0]], [[0.0, 0.0], [0.0, -3.0]]]
    renew = jax.jit(lambda ring: priorities.renew(contributed.max_entropy, ring, CONTEXT))
    renewed = renew(ring_with([*common, *rare], rows=20))
    weights = np.asarray(renewed.priority)
    assert sorted(weights[:12]) == list(range(12))
    assert weights[10:12].min() > 8  # the two that are apart are rarest but for, at most, one
    np.testing.assert_array_equal(weights[12:], 0)


def test_a_mixture_of_one_cluster_is_its_gaussian():
    rows = jnp.asarray(np.random.default_rng(0).normal(2.0, 0.5, (500, 1)), jnp.float32)
    found = jax.jit(contributed.fit_mixture)(rows, jnp.ones(500, bool))
    by_hand = -0.5 * ((rows[:, 0] - rows.mean()) / rows.std()) ** 2 - jnp.log(rows.std() * math.sqrt(2 * math.pi))
    assert float(jnp.mean(jnp.abs(found - by_hand))) < 0.1


def candidates(desired, achieved_before, number, hindsight=True):
    """Transitions with goals `desired` on a line; the achieved goal before each is `achieved_before`."""
    desired = np.stack([desired, np.zeros(len(desired))], axis=-1).astype(np.float32)
    before = np.stack([achieved_before, np.zeros(len(desired))], axis=-1).astype(np.float32)
    path = np.stack([before, before], axis=1)
    own = desired + np.float32(7.0) if hindsight else desired
    zeros = np.zeros(len(desired), np.int32)
    sample = Sample(before, before, before, path, own, zeros, zeros, zeros + 1, zeros > 0)
    discounts = np.full(len(desired), HP.gamma, np.float32)
    batch = Batch(before, before, desired, before, np.asarray(reward_of(before, desired)), discounts, zeros)
    return jax.tree.map(jnp.asarray, (sample, batch))


@pytest.mark.slow
def test_the_filter_keeps_no_goal_that_was_reached_before_the_step():
    sample, batch = candidates([0.0, 0.05, 0.5, 0.05] * 50, [0.0] * 200, 50)
    np.testing.assert_array_equal(contributed.not_misled(sample, batch, CONTEXT)[:4], [0, 0, 1, 0])
    kept = chosen(contributed.not_misleading, 0, sample, batch, 50, CONTEXT)
    np.testing.assert_allclose(kept.desired_goal[:, 0], 0.5)
    own, as_it_is = candidates([0.0] * 4, [0.0] * 4, 1, hindsight=False)
    np.testing.assert_array_equal(contributed.not_misled(own, as_it_is, CONTEXT), 1)


def test_where_all_candidates_are_misleading_any_is_kept():
    sample, batch = candidates([0.0, 0.01, 0.02, 0.03] * 200, [0.0] * 800, 200)
    kept = chosen(contributed.not_misleading, 0, sample, batch, 200, CONTEXT)
    assert len(np.unique(kept.desired_goal[:, 0])) == 4


def test_errors_of_one_step_by_hand():
    sample, batch = candidates([0.05, 0.3, 0.5, 1.0], [0.0] * 4, 1)
    # Value of the next state = that of this: -10 |g|. r + 0.98 v - v, r -1 but for the first goal, which is within reach.
    by_hand = [0.0 - 0.98 * 0.5 + 0.5, -1 - 0.98 * 3 + 3, -1 - 0.98 * 5 + 5, -1 - 0.98 * 10 + 10]
    np.testing.assert_allclose(CONTEXT.td_error(batch), by_hand, atol=1e-5)
    del sample


@pytest.mark.parametrize(("backend", "number", "parts"), [("cpu", 4099, [2048]), ("cpu", 2048, []), ("gpu", 4099, [])])
def test_a_cpu_computes_errors_of_a_large_batch_in_parts(backend, number, parts, monkeypatch):
    sizes, whole = [], jax.lax.map
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(
        jax.lax, "map", lambda *inputs, batch_size: sizes.append(batch_size) or whole(*inputs, batch_size=batch_size)
    )
    _, batch = candidates(np.linspace(0.2, 1.0, number), np.zeros(number), number)
    errors = CONTEXT.td_error(batch)
    assert sizes == parts
    np.testing.assert_allclose(errors, -1 + 0.02 * 10 * np.linspace(0.2, 1.0, number), atol=1e-5)


def test_td_error_ranks_episodes_and_transitions():
    ring = ring_with([[[0.05, 0.0], [0.05, 0.0]], [[0.5, 0.0], [0.5, 0.0]]], rows=3)
    renewed = jax.jit(lambda ring: priorities.renew(priorities.td_error, ring, CONTEXT))(ring)
    np.testing.assert_allclose(renewed.priority, [0.5 * 0.02, 1 - 5 * 0.02, 0.0], atol=1e-5)
    sample, batch = candidates(np.where(np.arange(13) == 5, 0.5, 0.0), np.zeros(13), 13)  # one error of 0.9, all others 0
    kept = chosen(priorities.td_error_shared, 1, sample, batch, 13, CONTEXT)
    # It is the first candidate of place 5, and 1, 3 and 9 places after those of 4, 2 and 9.
    assert np.flatnonzero(kept.desired_goal[:, 0]).tolist() == [2, 4, 5, 9]


def curriculum_by_numpy(goals_, achieved, triples, weight):
    """CHER's greedy choice, place by place, with an explicit graph of nearest neighbours and explicit coverage."""
    size = len(goals_)
    distance = np.linalg.norm(goals_[:, None] - goals_[None], axis=-1) + np.diag(np.full(size, np.inf))
    neighbour, nearest = distance.argmin(axis=1), distance.min(axis=1)
    similarity = np.exp(-(nearest**2) / nearest.mean() ** 2)
    covered, chosen, free = np.zeros(size), [], np.ones(size, bool)
    for uniform in triples:
        best, most = -1, -np.inf
        for candidate in [i for i in np.argsort(-uniform) if free[i]][:3]:
            represented = np.where(neighbour == candidate, similarity, 0.0)
            gain = np.maximum(represented - covered, 0).sum() - weight * np.linalg.norm(goals_[candidate] - achieved[candidate])
            if gain > most:
                best, most, covered = candidate, gain, np.maximum(covered, represented)  # what has led covers its goals
        free[best] = False
        chosen.append(int(best))
    return chosen


@pytest.mark.parametrize("updates", [0, 20_000, 100_000])
def test_the_curriculum_chooses_as_its_authors_code_does(updates):
    rng = np.random.default_rng(updates)
    goals_, achieved = (rng.normal(size=(256, 3)).astype(np.float32) for _ in range(2))
    zeros = np.zeros(256, np.int32)
    sample = Sample(goals_, goals_, goals_, np.stack([achieved, achieved], axis=1), goals_, zeros, zeros, zeros + 1, zeros > 0)
    batch = Batch(goals_, goals_, jnp.asarray(goals_), achieved, zeros, zeros, zeros)
    found = contributed.pick_curriculum(jax.random.key(3), sample, batch, 64, CONTEXT._replace(updates=updates))
    uniforms = [np.asarray(jax.random.uniform(key, (128,))) for key in jax.random.split(jax.random.key(3), 64)]
    assert found.tolist() == curriculum_by_numpy(goals_[:128], achieved[:128], uniforms, 1.0001**updates)
    assert len(set(found.tolist())) == 64


def test_the_curriculum_goes_from_diverse_to_near_goals_by_hand():
    """Goals at 0, 1, 3 and 8: nearest others are 1, 0, 1 and 3, at 1, 1, 2 and 5, so the mean is 9/4."""
    sample, batch = candidates([0.0, 1.0, 3.0, 8.0], [0.0] * 4, 1)
    alike = np.exp(-((np.array([1.0, 1.0, 2.0, 5.0]) / 2.25) ** 2))
    covers = np.array([alike[1], alike[0] + alike[2], alike[3], 0.0])
    assert covers.argmax() == 1
    keys = jax.random.split(jax.random.key(0), 60)

    @jax.jit
    def first_choices(updates):
        context = CONTEXT._replace(updates=updates)
        return jax.vmap(lambda key: contributed.pick_curriculum(key, sample, batch, 2, context)[0])(keys)

    # Far below 0 updates there is no proximity; after 10,000 its weight is 2.718, and goal 0 is at the achieved one.
    for updates, ranking in ((-1e6, [1, 0, 2, 3]), (1e4, [0, 1, 2, 3])):
        found = np.bincount(np.asarray(first_choices(updates)), minlength=4)
        # Three of four are compared: the best one is missing in a quarter of the draws, and then the second is chosen.
        assert found[ranking[0]] + found[ranking[1]] == 60
        assert 35 <= found[ranking[0]] <= 55


@pytest.mark.slow
def test_a_2_dpp_draws_pairs_in_proportion_to_determinants():
    line = np.array([0.0, 0.3, 1.0, 1.0])
    sample, batch = candidates(line, [0.0] * 4, 1)
    keys = jax.random.split(jax.random.key(0), 20_000)
    pairs = np.sort(jax.vmap(lambda key: contributed.pick_diverse(key, sample, batch, 2, CONTEXT))(keys), axis=1)
    kernel = np.exp(-((line[:, None] - line) ** 2) / (2 * 0.5**2))
    expected = {(i, j): np.linalg.det(kernel[np.ix_([i, j], [i, j])]) for i in range(4) for j in range(i + 1, 4)}
    total = sum(expected.values())
    for pair, determinant in expected.items():
        assert abs(np.mean((pairs == pair).all(axis=1)) - determinant / total) < 0.015, pair


@pytest.mark.slow
def test_groups_keep_their_own_and_take_any_number():
    for number in (1, 6):
        sample, batch = candidates(np.arange(4.0 * number), [0.0] * 4 * number, number)
        for priority in (contributed.curriculum, contributed.dpp):
            indices = np.asarray(priority.choose(jax.random.key(0), sample, batch, number, CONTEXT))
            assert indices.shape == (number,)
            assert len(set(indices)) == number
            assert (indices >= 0).all()
            assert (indices < 4 * number).all()


def test_archer_multiplies_the_reward_of_replaced_goals_alone():
    sample, batch = candidates([0.5, 0.0], [0.0, 0.0], 1)
    np.testing.assert_array_equal(relabel.hindsight_factor(sample, batch, HP._replace(hindsight_reward=0.5)), [0.5, 0.5])
    own, as_it_is = candidates([0.5, 0.0], [0.0, 0.0], 1, hindsight=False)
    np.testing.assert_array_equal(relabel.hindsight_factor(own, as_it_is, HP._replace(hindsight_reward=0.5)), [1.0, 1.0])
    ring = ring_with([[[0.0, 0], [0.5, 0], [1.0, 0]]])

    @jax.jit
    def draw(ring, factor):
        context, key = Context(REWARD, HP._replace(hindsight_reward=factor)), jax.random.key(0)
        return relabel.draw_batches(ring, key, (64,), samplers.make("future"), context, replay.cumulative(ring))

    whole, half = draw(ring, 1.0), draw(ring, 0.5)
    replaced = np.any(np.asarray(whole.desired_goal) != 0, axis=-1)
    np.testing.assert_array_equal(half.reward, np.where(replaced, 0.5, 1.0) * whole.reward)
    assert set(np.unique(half.reward)) == {-1.0, -0.5, 0.0}


def test_the_matching_is_the_assignment_of_least_cost():
    cost = jnp.asarray(np.random.default_rng(3).uniform(size=(6, 6)), jnp.float32)
    rows, columns = linear_sum_assignment(cost)
    plan = np.exp(goals.match(cost, jnp.ones(6, bool), softness=0.01, rounds=500))
    np.testing.assert_array_equal(plan.argmax(axis=1)[rows], columns)
    np.testing.assert_allclose(plan.sum(axis=1), 1.0, rtol=1e-4)
    some = np.exp(goals.match(cost, jnp.array([1, 0, 1, 0, 1, 0], bool)))
    np.testing.assert_array_equal(some[:, 1::2], 0)
    np.testing.assert_allclose(some.sum(axis=0)[::2], 2.0, rtol=0.2)  # each of three columns serves two rows


def test_hgg_takes_achieved_goals_on_the_way_to_the_desired_ones():
    """Two resets, one going right and one going up; one stored episode went right, one up, two nowhere."""
    right, up, still = [[0.0, 0], [0.3, 0], [0.6, 0]], [[0.0, 0], [0, 0.3], [0, 0.6]], [[0.0, 0], [0, 0], [0, 0]]
    ring = ring_with([right, up, still, still])
    desired = jnp.tile(jnp.array([[2.0, 0.0], [0.0, 2.0]]), (32, 1))
    obs = {"observation": jnp.zeros((64, 2)), "achieved_goal": jnp.zeros((64, 2)), "desired_goal": desired}
    flat = CONTEXT._replace(values=Values(VALUES.act, lambda observation, goal, action: 0.0 * observation[..., 0]))
    found = np.asarray(jax.jit(lambda ring: goals.hindsight_goals(jax.random.key(0), obs, ring, flat))(ring))
    assert np.mean(np.abs(found - np.tile([[0.6, 0.0], [0.0, 0.6]], (32, 1))).max(axis=1) < 1e-6) > 0.9  # rows are drawn
    # A critic that says that what is far takes long makes nearer goals of them: |g - a| - (1 - gamma) V D / L.
    steep = CONTEXT._replace(
        hparams=HP, values=Values(VALUES.act, lambda o, goal, action: -50.0 * (jnp.abs(goal).sum(-1) > 0.5))
    )
    shy = np.asarray(jax.jit(lambda ring: goals.hindsight_goals(jax.random.key(0), obs, ring, steep))(ring))
    assert np.mean(np.abs(shy - np.tile([[0.3, 0.0], [0.0, 0.3]], (32, 1))).max(axis=1) < 1e-6) > 0.9


def test_hgg_leaves_the_reset_s_goals_where_nothing_moved():
    obs = {"observation": jnp.zeros((4, 2)), "achieved_goal": jnp.zeros((4, 2)), "desired_goal": jnp.ones((4, 2))}
    still = ring_with([[[0.0, 0], [0.0, 0]]] * 2)
    empty = replay.init(episode_of([[0.0, 0], [0.0, 0]]), 2)
    generate = jax.jit(lambda ring: goals.hindsight_goals(jax.random.key(0), obs, ring, CONTEXT))
    for ring in (still, empty):
        np.testing.assert_array_equal(generate(ring), obs["desired_goal"])
