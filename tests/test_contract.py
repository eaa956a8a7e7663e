"""Episodes that end early, terminal states, reward ranges and specs, against a plain Python loop and known values."""

import dataclasses
import functools
import math

import configs
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_dher import Config, HParams, learners, make_train, priorities, relabel, replay, samplers
from mjx_dher import context as context_lib
from mjx_dher.components import COMPONENTS
from mjx_dher.contract import check_first, env_spec, episode_template
from mjx_dher.rollout import rollout
from mjx_dher.runs.folder import loggers
from mjx_dher.types import Batch, EnvSpec
from probes import Corridor, Walk

HP = HParams(gamma=0.9)
T = 12
VALUES = [name for name in COMPONENTS["learner"] if name != "crl"]  # its values are not returns, and it reads no discounts


@pytest.fixture(scope="module", params=[False, True], ids=["ends", "ends_at_goal"])
def walk(request):
    """An environment, and a ring of 300 episodes of it."""
    env = Walk(T, request.param)
    steps = 0.4 * jax.random.normal(jax.random.key(0), (T, 300, 2))
    episodes, outcome = jax.jit(lambda: rollout(env, lambda step, obs: step, jax.random.key(1), 300, steps))()
    ring = jax.jit(replay.add)(replay.init(episode_template(env), 400, ends=True), episodes)
    return env, ring, jax.device_get(episodes), jax.device_get(outcome), np.asarray(steps)


def reached(achieved, desired):
    return np.float32(np.linalg.norm(achieved - desired)) <= np.float32(0.1)


def test_episodes_end_as_a_plain_loop_says(walk):
    env, _, episodes, outcome, steps = walk
    for n in range(300):
        position, total = np.zeros(2, np.float32), 0.0
        for t in range(T):
            position = position + steps[t, n]
            hit = reached(position, episodes.desired_goal[n])
            total -= not hit
            if position[0] > 1 or position[1] < -1 or (env.spec.ends_at_goal and hit):
                break
        assert episodes.length[n] == outcome.length[n] == t + 1
        assert episodes.terminal[n] == (position[1] < -1)
        assert outcome.ret[n] == total
        assert outcome.success[n] == hit
        np.testing.assert_allclose(episodes.achieved_goal[n, t + 1 :], np.tile(position, (T - t, 1)), atol=1e-5)
        np.testing.assert_array_equal(episodes.action[n, t + 1 :], 0)
    assert set(episodes.length) == set(range(1, T + 1)) - ({1} - set(episodes.length))
    assert 0 < episodes.terminal.mean() < 1


def expected(env, episodes, row, step, goal, n_step):
    """Reward, discount and last step of a return, by a loop."""
    reward, length = 0.0, int(episodes.length[row])
    for i in range(n_step):
        hit = reached(episodes.achieved_goal[row, step + i + 1], goal)
        reward += HP.gamma**i * -(not hit)
        end = step + i + 1
        if hit or end == length:
            break
    terminal = (end == length and episodes.terminal[row]) or (env.spec.ends_at_goal and hit)
    return reward, 0.0 if terminal else HP.gamma ** (i + 1), end


# A sampler sees neither the number of steps nor the end at the goal, so that two samplers have all combinations by default.
COMBINED = [
    pytest.param(*case, name, marks=[] if case == (True, 3) or name in ("future", "random") else pytest.mark.slow)
    for case in ((False, 1), (False, 3), (True, 1), (True, 3))
    for name in (*COMPONENTS["sampler"], "custom")
]


@pytest.mark.parametrize(("walk", "n_step", "name"), COMBINED, indirect=["walk"])
def test_transitions_are_those_of_a_plain_loop(walk, name, n_step):
    env, ring, episodes, _, _ = walk
    sampler = (
        samplers.make(name)
        if name != "custom"
        else samplers.make(lambda a, d, s, h: jnp.where(jnp.arange(T + 1) > s, 0.0, -jnp.inf))
    )
    context = context_lib.of_env(env, HP)
    draw = jax.jit(lambda key: relabel.draw_batches(ring, key, (1000,), sampler, context, replay.cumulative(ring), n_step))
    batch = jax.device_get(draw(jax.random.key(2)))
    hindsight, told, right = 0, [], []
    for b in range(1000):
        row, goal = batch.row[b], batch.desired_goal[b]
        goals, length = episodes.achieved_goal[row], int(episodes.length[row])
        (step,) = np.flatnonzero((goals[:length] == batch.observation[b]).all(-1))  # never a padded one
        reward, discount, end = expected(env, episodes, row, step, goal, n_step)
        distances = np.sqrt(np.sum((goals[step + 1 : end + 1] - goal) ** 2, axis=-1))
        if np.abs(distances - 0.1).min() >= 1e-6:  # rounding decides at the threshold itself
            told.append((batch.reward[b], batch.discount[b], *batch.next_observation[b]))
            right.append((reward, discount, *goals[end]))
        if name != "random" and not np.array_equal(goal, episodes.desired_goal[row]):
            places = np.flatnonzero((goals[: length + 1] == goal).all(-1))
            hindsight += 1
            assert name == "episode" or places[0] > step
            assert name != "final" or places[0] == length
    told, right = np.array(told), np.array(right)
    np.testing.assert_allclose(told[:, :2], right[:, :2], rtol=1e-5)
    np.testing.assert_array_equal(told[:, 2:], right[:, 2:])
    assert name == "random" or hindsight > 700


def test_weights_of_weighted_are_over_the_played_goals_alone():
    """Distances 1, 2, 3 after the step, then padding: the mean is 2, weights 2 - r = 1.5, 1, 0.5."""
    achieved = jnp.array([0.0, 1.0, 2.0, 3.0, 3.0, 3.0])[:, None]

    @functools.partial(jax.jit, static_argnums=0)
    def found(name, length):
        log_weights = samplers.weigh(samplers.make(name), achieved, jnp.zeros(1), jnp.int32(0), HP, length)
        return samplers.probabilities(log_weights)

    np.testing.assert_allclose(found("weighted", 3), [0, 1.5 / 3, 1 / 3, 0.5 / 3, 0, 0], atol=1e-6)
    np.testing.assert_allclose(found("final", 3), [0, 0, 0, 1, 0, 0])
    np.testing.assert_allclose(found("future", 2), [0, 0.5, 0.5, 0, 0, 0])


@pytest.mark.parametrize("fraction", [0.0, 1.0])
def test_transitions_are_drawn_alike_or_in_proportion_to_priority(walk, fraction):
    """Not episodes: one of twelve steps is drawn twelve times as often as one of a single step."""
    _, ring, episodes, _, _ = walk
    weight = np.arange(300) % 3
    ring = dataclasses.replace(ring, priority=jnp.zeros(400).at[:300].set(weight))
    draw = jax.jit(lambda ring, key: replay.draw_rows(ring, key, 200_000, fraction, replay.cumulative(ring)))
    rows = np.asarray(draw(ring, jax.random.key(0)))
    share = episodes.length * (weight if fraction else 1)
    counts, expected_counts = np.bincount(rows, minlength=400)[:300], 200_000 * share / share.sum()
    assert counts.sum() == 200_000
    used = expected_counts > 0
    assert counts[~used].sum() == 0
    chi2 = np.sum((counts[used] - expected_counts[used]) ** 2 / expected_counts[used])
    assert chi2 < used.sum() + 5 * math.sqrt(2 * used.sum())
    step_of = jax.jit(lambda ring, key, rows: replay.sample(ring, key, 200_000, rows).step)
    steps = np.asarray(step_of(ring, jax.random.key(1), jnp.asarray(rows)))
    assert (steps < episodes.length[rows]).all()


# By default, `td_error` alone is tried where episodes end at the goal. No other priority reads that.
@pytest.mark.parametrize(
    ("walk", "name"),
    [
        pytest.param(at_goal, name, marks=pytest.mark.slow if at_goal and name != "td_error" else [])
        for at_goal in (False, True)
        for name in COMPONENTS["priority"]
    ],
    indirect=["walk"],
)
def test_a_priority_does_not_see_the_padding(walk, name):
    """The weight of an episode that ended early is that of the same episode in a ring of its length."""
    env, _, episodes, _, _ = walk
    config = Config(hidden_sizes=(8,))
    learner = learners.make("ddpg", config, env_spec(env))
    values = learners.values_of(learner, jax.jit(learner.init)(jax.random.key(0)), HP)
    context = context_lib.of_env(env, HP, values=values)
    priority = priorities.whole(priorities.make(name))
    row = int(np.flatnonzero(episodes.length == 5)[0])
    whole = jax.tree.map(lambda x: jnp.asarray(x[row])[None], episodes)
    cut = whole.replace(
        observation=whole.observation[:, :6], achieved_goal=whole.achieved_goal[:, :6], action=whole.action[:, :5]
    )

    @jax.jit
    def weight(episode):
        one = replay.add(replay.init(jax.tree.map(lambda x: x[0], episode), 1, ends=True), episode)
        one = dataclasses.replace(one, priority=priorities.weights(priority, episode, context))
        return priorities.renew(priority, one, context).priority[0]

    np.testing.assert_allclose(weight(whole), weight(cut), rtol=1e-5)


# By default, one learner of each kind of critic. The others' targets are computed alike.
@pytest.mark.parametrize(
    "name", [x if x in ("ddpg", "sac", "csac", "dtqc") else pytest.param(x, marks=pytest.mark.slow) for x in VALUES]
)
def test_nothing_follows_a_terminal_transition(name):
    """With a discount of 0, an update does not depend on the next observation; with any other, it does."""
    config = Config(hidden_sizes=(8,), num_quantiles=3, dropped_quantiles=1)
    learner = learners.make(name, config, EnvSpec(jax.ShapeDtypeStruct((2,), jnp.float32), 2, 2, 5))
    state = jax.jit(learner.init)(jax.random.key(0))
    ones = jnp.ones((4, 2))
    numbers = jax.tree.map(jnp.float32, HP)

    @jax.jit
    def update(following, discount):
        batch = Batch(ones, following * ones, ones, 0.1 * ones, -jnp.ones(4), jnp.full(4, discount), jnp.arange(4))
        return learner.update(state, batch, numbers)[0].params

    def differ(discount):
        pairs = zip(jax.tree.leaves(update(0.0, discount)), jax.tree.leaves(update(2.0, discount)))
        return any((np.asarray(a) != np.asarray(b)).any() for a, b in pairs)

    assert not differ(0.0)
    assert differ(0.9)


# Values at place 0 with gamma 0.5: -1 - 0.5 - 0.25 in three steps to the trap; -1 - 0.5 and then 0 at a goal that ends the
# episode; and -2 where the clock alone ends it, however short the episodes are.
KNOWN = {"trap": (9.0, -1.75), "goal": (3.0, -1.5), "clock": (9.0, -2.0)}


# By default, one learner: with returns of two steps for the trap alone. Those of the other ends are checked for each sampler by
# test_transitions_are_those_of_a_plain_loop.
QUICK = [("goal", "ddpg", 1), ("clock", "ddpg", 1), ("trap", "ddpg", 2)]
ALL = [(kind, name, n_step) for name in VALUES for n_step in ((1, 2) if name == "ddpg" else (1, 3)) for kind in KNOWN]


@pytest.mark.parametrize(
    ("kind", "learner", "n_step"), [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in ALL if case not in QUICK)]
)
def test_values_are_known(kind, learner, n_step):
    """Truncated is not terminal; a trap is, for every goal; a goal that is reached is, for itself."""
    goal, value = KNOWN[kind]
    env = Corridor(kind, goal)
    sizes = {"num_envs": 8, "batch_size": 64, "replay_size": 200, "hidden_sizes": (32,), "eval_episodes": 2}
    config = dataclasses.replace(configs.TINY, updates_per_cycle=400, n_step=n_step, **sizes)
    hparams = HParams(gamma=0.5, polyak=0.9, critic_lr=3e-3, her_k=1.0, entropy_weight=1e-6, target_noise=0.0)
    train = make_train(env, config, sampler=samplers.make("future"), learner=learner)
    epoch = jax.jit(train.epoch)
    state, metrics = epoch(jax.jit(train.init)(jax.random.key(0), hparams))
    for _ in range(5 if learner in ("ctd3", "csac") else 1):  # whose values start in the middle of their range
        state, _ = epoch(state)
    obs = {"observation": jnp.zeros((1, 1)), "achieved_goal": jnp.zeros((1, 1)), "desired_goal": jnp.full((1, 1), goal)}
    found = train.learner.value(state.learner, obs, jnp.zeros((1, 1)), hparams)
    np.testing.assert_allclose(found, [value], atol=0.08)
    assert metrics["discarded_episodes"] == metrics["bad_rewards"] == 0
    length = {"trap": 3, "goal": 3, "clock": 5}[kind]
    np.testing.assert_array_equal(state.replay.episodes.length[:8], length)
    assert float(metrics.get("train_length_mean", length)) == length


class Wrong(Walk):
    """A walk with a spec that is not its own."""

    def __init__(self, **changes):
        super().__init__()
        self.spec = dataclasses.replace(self.spec, **changes)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"observation": jax.ShapeDtypeStruct((3,), jnp.float32)}, "observation"),
        ({"goal_size": 3}, "goal_size"),
        ({"action_size": 1}, "action_size"),
        ({"episode_length": 7}, "episode_length"),
        ({"ends": False}, "ends"),
    ],
)
def test_a_spec_that_disagrees_with_the_arrays_is_rejected_before_training(changes, field):
    with pytest.raises(ValueError, match=f"spec: {field}"):
        make_train(Wrong(**changes), Config())


class Started(Corridor):
    """A corridor in which every second start has ended."""

    def reset(self, key):
        state = super().reset(key)
        return dataclasses.replace(state, terminal=jax.random.bernoulli(key))


def test_starts_that_have_ended_are_no_episodes():
    keys, actions = jax.random.split(jax.random.key(0), 32), jnp.zeros((5, 32, 1))
    _, outcome = jax.jit(lambda: rollout(Started("trap"), lambda action, obs: action, keys, 32, actions))()
    ended = np.asarray(jax.vmap(jax.random.bernoulli)(keys))
    assert 0 < ended.sum() < 32
    np.testing.assert_array_equal(outcome.valid, ~ended)


def test_a_run_fails_when_half_of_its_rewards_leave_their_range():
    fine = {"discarded_episodes": 0, "bad_success": 0, "no_goal_share": 0}
    assert loggers.failure({**fine, "bad_rewards": 0.4}, configs.TINY, True) is None
    assert loggers.warnings({**fine, "bad_rewards": 0.4}, configs.TINY).keys() == {"bad_rewards"}
    assert "reward_range" in loggers.failure({**fine, "bad_rewards": 0.5}, configs.TINY, True)


def test_a_spec_that_cannot_be_is_rejected():
    one = jax.ShapeDtypeStruct((1,), jnp.float32)
    for changes in ({"reward_range": (0, 0)}, {"reward_range": (math.nan, 0)}, {"episode_length": 0}, {"ends_at_goal": True}):
        with pytest.raises(ValueError, match="|".join([*changes, "ends"])):
            EnvSpec(**{"observation": one, "goal_size": 1, "action_size": 1, "episode_length": 5, **changes})
    walk = Walk()
    walk.spec = "mine"
    with pytest.raises(ValueError, match="spec"):
        env_spec(walk)


def test_an_observation_has_an_array():
    state = Walk().reset(jax.random.key(0))
    check_first(state, ())
    with pytest.raises(ValueError, match="observation must have at least one array"):
        check_first(dataclasses.replace(state, obs={**state.obs, "observation": {}}), ())
