"""Hindsight: transitions whose goal is replaced by an achieved one, with the reward computed anew."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp

from mjx_dher import replay, samplers
from mjx_dher.config import HParams
from mjx_dher.replay import ReplayState, Sample
from mjx_dher.samplers import LogWeightsFn, Sampler
from mjx_dher.types import Array, Batch, PRNGKey, RewardFn


def hindsight_goals(
    state: ReplayState, sample: Sample, sampler: Sampler | LogWeightsFn, hparams: HParams, key: PRNGKey
) -> Array:
    """Chooses one achieved goal for each transition of `sample` by `sampler`; returns them as [B, G].

    A transition for which the sampler offers no goal (no weight is positive, or one is NaN or infinite) keeps its own.

    Raises:
      ValueError: its log weights are not one floating-point number for each goal of an episode.
    """
    return _choose(state, sample, sampler, hparams, key)[0]


def _choose(
    state: ReplayState, sample: Sample, sampler: Sampler | LogWeightsFn, hparams: HParams, key: PRNGKey
) -> tuple[Array, Array]:
    """Returns the goals [B, G] of `hindsight_goals`, and whether the sampler offered one [B]."""
    sampler = samplers.make(sampler)
    pool_key, draw_key = jax.random.split(key)
    batch_size = sample.step.shape[0]
    pool = sample.episode_goals
    if sampler.cross_episode:
        other = replay.sample_episode_goals(state, pool_key, batch_size)
        pool = jnp.where(sampler.cross_episode(hparams), other, pool) if callable(sampler.cross_episode) else other
    weigh = functools.partial(samplers.weigh, sampler)
    log_weights = jax.vmap(weigh, in_axes=(0, 0, 0, None))(pool, sample.desired_goal, sample.step, hparams)
    index = samplers.draw(draw_key, log_weights)
    offered = index < pool.shape[1]
    return jnp.where(offered[:, None], pool[jnp.arange(batch_size), index], sample.desired_goal), offered


def draw_batches(
    state: ReplayState,
    key: PRNGKey,
    shape: tuple[int, ...],
    sampler: Sampler | LogWeightsFn,
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
    sampler: Sampler | LogWeightsFn,
    compute_reward: RewardFn,
    hparams: HParams,
    key: PRNGKey,
) -> Batch:
    """Returns `sample` as a batch in which each transition was relabelled with probability k/(k+1), k = `hparams.her_k`.

    The reward is that of the goal achieved at the transition's end: `compute_reward(achieved at step+1, goal)`. Of `hparams`
    it reads her_k, and whatever the sampler reads; `draw_batches` reads priority_fraction, too.

    Raises:
      ValueError: the sampler's log weights are not [T+1], or the rewards not [B].
    """
    return relabel_counted(state, sample, sampler, compute_reward, hparams, key)[0]


def relabel_counted(
    state: ReplayState,
    sample: Sample,
    sampler: Sampler | LogWeightsFn,
    compute_reward: RewardFn,
    hparams: HParams,
    key: PRNGKey,
) -> tuple[Batch, Array]:
    """Returns the batch that `relabel` returns, and the share [] of transitions to be relabelled that were offered no goal."""
    coin_key, goal_key = jax.random.split(key)
    batch_size = sample.step.shape[0]
    relabelled = jax.random.uniform(coin_key, (batch_size,)) < hparams.her_k / (hparams.her_k + 1.0)
    goals, offered = _choose(state, sample, sampler, hparams, goal_key)
    desired_goal = jnp.where(relabelled[:, None], goals, sample.desired_goal)
    achieved_goal = sample.episode_goals[jnp.arange(batch_size), sample.step + 1]
    reward = compute_reward(achieved_goal, desired_goal)
    if getattr(reward, "shape", None) != (batch_size,):
        given = list(reward.shape) if hasattr(reward, "shape") else f"a {type(reward).__name__}"
        raise ValueError(
            f"compute_reward gives rewards [B] = [{batch_size}] of goals [B, G] = {list(desired_goal.shape)}; this one gives"
            f" {given}"
        )
    batch = Batch(
        observation=sample.observation,
        next_observation=sample.next_observation,
        desired_goal=desired_goal,
        action=sample.action,
        reward=reward,
    )
    missed = jnp.sum(relabelled & ~offered, dtype=jnp.float32)
    return batch, missed / jnp.maximum(jnp.sum(relabelled, dtype=jnp.float32), 1.0)
