"""Hindsight: transitions whose goal is replaced by an achieved one, with the reward computed anew."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from mjx_dher import replay, samplers
from mjx_dher.config import HParams
from mjx_dher.replay import ReplayState, Sample
from mjx_dher.samplers import Sampler
from mjx_dher.types import Array, Batch, PRNGKey, RewardFn


def hindsight_goals(state: ReplayState, sample: Sample, sampler: Sampler, hparams: HParams, key: PRNGKey) -> Array:
    """Chooses one achieved goal for each transition of `sample` by `sampler`; returns them as [B, G].

    Raises:
      ValueError: its log weights are not one for each goal of an episode.
    """
    pool_key, draw_key = jax.random.split(key)
    batch_size = sample.step.shape[0]
    pool = sample.episode_goals
    if sampler.cross_episode:
        other = replay.sample_episode_goals(state, pool_key, batch_size)
        pool = jnp.where(sampler.cross_episode(hparams), other, pool) if callable(sampler.cross_episode) else other
    log_weights = jax.vmap(sampler.log_weights, in_axes=(0, 0, 0, None))(pool, sample.desired_goal, sample.step, hparams)
    if log_weights.shape != pool.shape[:2]:
        raise ValueError(f"a sampler gives log weights [T+1] = [{pool.shape[1]}]; this one gives {list(log_weights.shape[1:])}")
    index = samplers.draw(draw_key, log_weights)
    return pool[jnp.arange(batch_size), index]


def draw_batches(
    state: ReplayState,
    key: PRNGKey,
    shape: tuple[int, ...],
    sampler: Sampler,
    compute_reward: RewardFn,
    hparams: HParams,
    cumulative: Array,
) -> Batch:
    """Draws and relabels transitions as the learner takes them, all at once; leaves lead with `shape`.

    A fraction `hparams.priority_fraction` of them is from episodes drawn by priority; `cumulative` is
    `replay.cumulative_priority(state)`. The ring must not be empty.
    """
    row_key, sample_key, relabel_key = jax.random.split(key, 3)
    number = math.prod(shape)
    rows = replay.draw_rows(state, row_key, number, hparams.priority_fraction, cumulative)
    sample = replay.sample(state, sample_key, number, rows)
    batch = relabel(state, sample, sampler, compute_reward, hparams, relabel_key)
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), batch)


def relabel(
    state: ReplayState,
    sample: Sample,
    sampler: Sampler,
    compute_reward: RewardFn,
    hparams: HParams,
    key: PRNGKey,
) -> Batch:
    """Returns `sample` as a batch in which each transition was relabelled with probability k/(k+1), k = `hparams.her_k`.

    The reward is that of the goal achieved at the transition's end: `compute_reward(achieved at step+1, goal)`.
    """
    coin_key, goal_key = jax.random.split(key)
    batch_size = sample.step.shape[0]
    relabelled = jax.random.uniform(coin_key, (batch_size,)) < hparams.her_k / (hparams.her_k + 1.0)
    goals = hindsight_goals(state, sample, sampler, hparams, goal_key)
    desired_goal = jnp.where(relabelled[:, None], goals, sample.desired_goal)
    achieved_goal = sample.episode_goals[jnp.arange(batch_size), sample.step + 1]
    return Batch(
        observation=sample.observation,
        next_observation=sample.next_observation,
        desired_goal=desired_goal,
        action=sample.action,
        reward=compute_reward(achieved_goal, desired_goal),
    )
