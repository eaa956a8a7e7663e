"""docs/examples/ddpg_her.py: its samplers equal the library's, and it learns Reach as the trainer does."""

import dataclasses

import ddpg_her
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mjx_dher import Config, HParams, envs, learners, make_train, rollout, samplers
from mjx_dher.types import Batch

SETTINGS = ddpg_her.Settings(
    env="reach",
    total_steps=6_400,
    num_envs=16,
    cycles_per_epoch=2,
    updates_per_cycle=40,
    batch_size=256,
    buffer_size=6_400,
    eval_episodes=32,
    hidden_size=128,
)


@pytest.mark.parametrize("name", ddpg_her.SAMPLERS)
def test_samplers_are_the_library_s(name):
    achieved, desired = jax.random.normal(jax.random.key(0), (6, 3)), jnp.zeros(3)
    for step in range(5):
        weights = ddpg_her.SAMPLERS[name](achieved, desired, step, 0.2)
        log_weights = samplers.make(name).log_weights(achieved, desired, step, HParams(epsilon=0.2))
        np.testing.assert_allclose(weights / weights.sum(), samplers.probabilities(log_weights), atol=1e-6)


class Line:
    """A reward that tells which two goals it was computed of."""

    def compute_reward(self, achieved_goal, desired_goal):
        return 1000 * achieved_goal[..., 0] + desired_goal[..., 0]


def test_transitions_and_their_goals():
    """Goal and observation t of episode e are 10 e + t, its desired goal is 900 + e. Two of the three rows are written."""
    goals = np.float32(10 * np.arange(3)[:, None, None] + np.arange(6)[None, :, None])
    episodes = ddpg_her.Episodes(goals, goals, np.float32(900 + np.arange(3)[:, None]), goals[:, :-1])
    static = ddpg_her.Static(Line(), SETTINGS._replace(her_k=3.0), None, None)
    batch = jax.jit(lambda episodes: ddpg_her.draw_batch(static, episodes, 2, jax.random.key(0), 4000))(episodes)
    start, end, goal = (np.ravel(x) for x in (batch.observation, batch.next_observation, batch.goal))
    row, hindsight = start // 10, goal < 900
    np.testing.assert_array_equal(end, start + 1)
    np.testing.assert_array_equal(np.ravel(batch.action), start)
    np.testing.assert_array_equal(batch.reward, 1000 * end + goal)
    np.testing.assert_array_equal(goal[~hindsight], 900 + row[~hindsight])
    assert np.all((goal[hindsight] >= end[hindsight]) & (goal[hindsight] <= 10 * row[hindsight] + 5))
    assert abs(hindsight.mean() - 0.75) < 0.03
    assert set(start) == {0, 1, 2, 3, 4, 10, 11, 12, 13, 14}


def test_the_buffer_is_a_ring():
    def episodes(first):
        x = first + jnp.arange(2.0)
        return ddpg_her.Episodes(x[:, None], x[:, None], x, x[:, None])

    buffer = ddpg_her.Buffer(jax.tree.map(lambda x: jnp.zeros((3, *x.shape[1:])), episodes(0)), jnp.array(0))
    for first in (1, 3, 5):
        buffer = ddpg_her.add_episodes(buffer, episodes(first))
    assert buffer.count == 6
    np.testing.assert_array_equal(buffer.episodes.desired_goal, [4, 5, 6])


def test_an_update_is_the_library_s():
    """Two updates, from parameters, targets and statistics that all differ."""
    env, settings = envs.make("reach"), SETTINGS._replace(hidden_size=16)
    hparams = HParams(gamma=settings.gamma, polyak=1 - settings.tau)
    ours = learners.make("ddpg", Config(hidden_sizes=(16, 16, 16)), rollout.env_spec(env))
    state, other = ours.init(jax.random.key(0)), ours.init(jax.random.key(1))
    norms = [norm.replace(mean=norm.mean + 0.1, var=2.0 * norm.var) for norm in (state.observation_norm, state.goal_norm)]
    state = dataclasses.replace(state, target=other.params, observation_norm=norms[0], goal_norm=norms[1])
    params, target = (ddpg_her.Networks(p.actor, p.critic) for p in (state.params, state.target))
    nets = ddpg_her.Networks(ddpg_her.MLP(16, env.action_size), ddpg_her.MLP(16, 1))
    static = ddpg_her.Static(env, settings, nets, optax.adam(settings.learning_rate))
    moments = (ddpg_her.Moments(norm.count, norm.mean, norm.var) for norm in norms)
    learner = ddpg_her.Learner(params, target, static.optimizer.init(params), *moments)
    keys = jax.random.split(jax.random.key(2), 5)
    observation, following, goal, action = (jax.random.normal(k, (64, n)) for k, n in zip(keys, (10, 10, 3, 4), strict=False))
    reward = -jax.random.bernoulli(keys[4], 0.5, (64,)).astype(jnp.float32)
    batch = ddpg_her.Batch(observation, following, goal, action, reward)
    discount, row = jnp.full(64, settings.gamma), jnp.arange(64)
    theirs = Batch(observation, following, goal, action, reward, discount=discount, row=row)

    @jax.jit
    def update(learner, state):
        updated, _ = ours.update(state, theirs, hparams)
        return ddpg_her.update(static, learner, batch), ours.update_target(updated, hparams)

    for _ in range(2):
        learner, state = update(learner, state)
    for mine, other in ((learner.params, state.params), (learner.target, state.target)):
        for a, b in zip(jax.tree.leaves([mine.actor, mine.critic]), jax.tree.leaves([other.actor, other.critic]), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def trainer_curve():
    config = Config(
        num_envs=SETTINGS.num_envs,
        cycles_per_epoch=SETTINGS.cycles_per_epoch,
        updates_per_cycle=SETTINGS.updates_per_cycle,
        target_period=1,
        batch_size=SETTINGS.batch_size,
        total_steps=SETTINGS.total_steps,
        replay_size=SETTINGS.buffer_size,
        hidden_sizes=(SETTINGS.hidden_size,) * 3,
        eval_episodes=SETTINGS.eval_episodes,
    )
    hparams = HParams(
        gamma=SETTINGS.gamma, polyak=1 - SETTINGS.tau, noise_std=SETTINGS.noise_std, her_k=SETTINGS.her_k, priority_fraction=0.0
    )
    program = make_train(envs.make("reach"), config, sampler=SETTINGS.sampler)
    state, epoch, curve = program.init(jax.random.key(0), hparams), jax.jit(program.epoch), []
    for _ in range(4):
        state, metrics = epoch(state)
        curve.append(float(metrics["success_rate"]))
    return curve


@pytest.mark.slow
def test_it_learns_reach_as_the_trainer_does():
    """Two seeds of each had means of 0.44 to 0.58.

    Mistakes in relabelling that were tried had at most 0.16: a reward for the former goal or of the transition's start, goals
    of another episode, no hindsight. Goals from before the step are learned from on Reach; the test of `draw_batch` sees them.
    """
    steps, success = zip(*ddpg_her.train(SETTINGS, report=lambda line: None), strict=True)
    theirs = trainer_curve()
    assert steps == (1_600, 3_200, 4_800, 6_400)
    assert np.mean(success) == pytest.approx(np.mean(theirs), abs=0.25), (success, theirs)
    assert success[-1] > 0.9
    assert theirs[-1] > 0.9
