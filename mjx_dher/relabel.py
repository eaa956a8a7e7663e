"""Hindsight: transitions whose goal is replaced by an achieved one, with the reward computed anew."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from mjx_dher import replay, samplers
from mjx_dher.config import HParams
from mjx_dher.replay import ReplayState, Sample
from mjx_dher.samplers import Sampler
from mjx_dher.types import Array, Batch, Episode, PRNGKey, RewardFn


def hindsight_goals(state: ReplayState, sample: Sample, sampler: Sampler, hparams: HParams, key: PRNGKey) -> Array:
    """[B, G] one achieved goal for each transition of `sample`, chosen by `sampler`.

    Raises:
      ValueError: its log weights are not one for each goal of an episode.
    """
    pool_key, draw_key = jax.random.split(key)
    batch_size = sample.step.shape[0]
    pool = sample.episode_goals
    if sampler.whole_ring:
        elsewhere = replay.sample_episode_goals(state, pool_key, batch_size)
        pool = jnp.where(sampler.whole_ring(hparams), elsewhere, pool) if callable(sampler.whole_ring) else elsewhere
    log_weights = jax.vmap(sampler.log_weights, in_axes=(0, 0, 0, None))(pool, sample.desired_goal, sample.step, hparams)
    if log_weights.shape != pool.shape[:2]:
        raise ValueError(f"a sampler gives log weights [T+1] = [{pool.shape[1]}]; this one gives {list(log_weights.shape[1:])}")
    index = samplers.draw(draw_key, log_weights)
    return pool[jnp.arange(batch_size), index]


def is_eventful(episodes: Episode, compute_reward: RewardFn) -> Array:
    """[N] whether an episode's last achieved goal, as a goal, was not yet reached at its start.

    Where it was, all hindsight goals are much the same, reached from the first step on, and say nothing of how to reach any.
    Asking the environment's own (sparse) reward needs no scale and no threshold. Cf. the filter for misleading samples of
    Manela & Biess 2021 and the energy-based prioritization of Zhao & Tresp 2018.
    """
    return compute_reward(episodes.achieved_goal[:, 0], episodes.achieved_goal[:, -1]) < 0


def draw_batches(
    state: ReplayState,
    key: PRNGKey,
    shape: tuple[int, ...],
    sampler: Sampler,
    compute_reward: RewardFn,
    hparams: HParams,
    counts: Array,
) -> Batch:
    """Transitions as the learner takes them, drawn and relabelled all at once; leaves lead with `shape`.

    A share `hparams.eventful_share` of them is from eventful episodes; `counts` is `replay.count_eventful(state)`. The ring
    must not be empty.
    """
    row_key, sample_key, relabel_key = jax.random.split(key, 3)
    number = math.prod(shape)
    rows = replay.draw_rows(state, row_key, number, hparams.eventful_share, counts)
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
    """`sample` as a batch in which each transition was relabelled with probability k/(k+1), k = `hparams.her_k`.

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
