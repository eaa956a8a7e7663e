"""Hindsight relabelling: replaces goals by achieved ones and recomputes the rewards."""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_dher import check, priorities, replay, samplers
from mjx_dher.config import HParams
from mjx_dher.context import Context
from mjx_dher.priorities import Priority, PriorityFn
from mjx_dher.replay import Cumulative, Pool, ReplayState, Sample
from mjx_dher.samplers import LogWeightsFn, Sampler
from mjx_dher.types import Array, Batch, PRNGKey
from mjx_dher.validation import check_count

_CHOOSE = 0x43686F69  # folded into the key that chooses among transitions; no index of `jax.random.split`


class Hindsight(NamedTuple):
    """Hindsight goals, one per transition."""

    goals: Array  # [B, G]
    offered: Array  # [B] whether the sampler offered a goal, bool; else `goals` has the transition's own


def hindsight_goals(sample: Sample, sampler: Sampler | LogWeightsFn, hparams: HParams, key: PRNGKey) -> Hindsight:
    """Draws an achieved goal for each transition. `relabel` has first given the sampler the environment's goal distance.

    Args:
      sample: transitions [B]. Samplers that use goals of other episodes need `sample.pool` (see `add_pool`).
      sampler: a `Sampler`, or a function like `Sampler.log_weights`.

    Raises:
      ValueError: log weights are not floats [T+1], or `sample` lacks a field that the sampler needs.
    """
    sampler = samplers.make(sampler)
    batch_size = sample.step.shape[0]
    goals, length = sample.episode_goals, sample.length
    if sampler.cross_episode:
        if sample.pool is None:
            raise ValueError("pool is missing: this sampler uses goals of other episodes (relabel.add_pool)")
        goals, length = _from_pool(sampler, sample, hparams)
    weigh = functools.partial(samplers.weigh, sampler)
    axes = (0, 0, 0, None, 0 if sample.ends else None)
    last = length if sample.ends else None
    log_weights = jax.vmap(weigh, in_axes=axes)(goals, sample.desired_goal, sample.step, hparams, last)
    index = samplers.draw(key, log_weights)
    offered = index < goals.shape[1]
    chosen = goals[jnp.arange(batch_size), index]
    return Hindsight(jnp.where(offered[:, None], chosen, sample.desired_goal), offered)


def _from_pool(sampler: Sampler, sample: Sample, hparams: HParams) -> Pool:
    """Goals and lengths of other episodes, or of the transition's own if the traced `cross_episode` is False."""
    pool = sample.pool
    assert pool is not None
    if not callable(sampler.cross_episode):
        return pool
    own, crosses = Pool(sample.episode_goals, sample.length), sampler.cross_episode(hparams)
    return jax.tree.map(lambda other, own: jnp.where(crosses, other, own), pool, own)


def _keys(key: PRNGKey) -> tuple[PRNGKey, PRNGKey, PRNGKey]:
    """Keys for the relabelling coin, for goals of other episodes, and for the choice among goals."""
    coin_key, goal_key = jax.random.split(key)
    pool_key, draw_key = jax.random.split(goal_key)
    return coin_key, pool_key, draw_key


def add_pool(ring: ReplayState, sample: Sample, sampler: Sampler | LogWeightsFn | str, key: PRNGKey) -> Sample:
    """Adds goals of other episodes to a sample, if the sampler uses them. Pass the same `key` to `relabel`."""
    if not samplers.make(sampler).cross_episode:
        return sample
    return dataclasses.replace(sample, pool=replay.sample_pool(ring, _keys(key)[1], sample.step.shape[0]))


class Relabelled(NamedTuple):
    """A relabelled batch, and the fraction of transitions chosen for relabelling that were offered no goal."""

    batch: Batch
    no_goal_share: Array  # []


def relabel(sample: Sample, sampler: Sampler | LogWeightsFn, context: Context, key: PRNGKey) -> Relabelled:
    """Relabels each transition with probability k/(k+1), where k is `hparams.her_k` and may be infinite.

    Rewards are recomputed for the goal achieved at the end of the transition. The discount is gamma, or 0 if no future
    follows: after a failure, and after reaching the goal if that ends the episode.

    Args:
      sample: transitions [B], with the fields that `hindsight_goals` needs.
      sampler: a `Sampler`, or a function like `Sampler.log_weights`.
      context: reward function, goal distance and numbers (her_k, gamma and those of the sampler), from `context.of_env` or
        such as `Context(compute_reward, HParams())`.

    Raises:
      ValueError: log weights are not [T+1], or rewards are not [B].
    """
    hparams = context.hparams
    coin_key, _, goal_key = _keys(key)
    batch_size = sample.step.shape[0]
    k = jnp.asarray(hparams.her_k, jnp.float32)
    share = jnp.where(jnp.isinf(k), 1.0, k / (k + 1.0))
    relabelled = jax.random.uniform(coin_key, (batch_size,), jnp.float32) < share
    sampler = samplers.of_distance(samplers.make(sampler), context.goal_distance)
    hindsight = hindsight_goals(sample, sampler, hparams, goal_key)
    desired_goal = jnp.where(relabelled[:, None], hindsight.goals, sample.desired_goal)
    achieved_goal = sample.episode_goals[jnp.arange(batch_size), sample.step + 1]
    reward = context.compute_reward(achieved_goal, desired_goal)
    terminal = sample.terminal
    if context.ends_at_goal:
        terminal |= context.reached(achieved_goal, desired_goal)
    batch = Batch(
        observation=sample.observation,
        next_observation=sample.next_observation,
        desired_goal=desired_goal,
        action=sample.action,
        reward=check.array("compute_reward: rewards [B]", reward, (batch_size,), jnp.number),
        discount=jnp.where(terminal, 0.0, jnp.asarray(hparams.gamma, jnp.float32)),
        row=sample.row,
        hindsight_goal=jnp.where(hindsight.offered[:, None], hindsight.goals, achieved_goal),
    )
    missed = jnp.sum(relabelled & ~hindsight.offered, dtype=jnp.float32)
    return Relabelled(batch, missed / jnp.maximum(jnp.sum(relabelled, dtype=jnp.float32), 1.0))


def draw_batches(
    ring: ReplayState,
    key: PRNGKey,
    shape: tuple[int, ...],
    sampler: Sampler | LogWeightsFn,
    context: Context,
    weights: Cumulative,
    n_step: int = 1,
    priority: Priority | PriorityFn | str | None = None,
) -> Batch:
    """Draws and relabels transitions for the learner.

    Args:
      ring: the replay ring. It must not be empty.
      shape: leading axes of the batch's leaves.
      sampler: a `Sampler`, or a function like `Sampler.log_weights`.
      context: reward function and numbers. Its `hparams.priority_fraction` is the fraction drawn by priority.
      weights: `replay.cumulative(ring)`.
      n_step: steps of a return (`look_ahead`).
      priority: priority. If it chooses among transitions, `priority.candidates` are drawn for each.
    """
    check_count("n_step", n_step)
    number, sampler = math.prod(shape), samplers.make(sampler)
    priority = None if priority is None else priorities.whole(priorities.make(priority))

    def draw(count: int) -> tuple[Sample, Batch]:
        row_key, sample_key, relabel_key = jax.random.split(key, 3)
        rows = replay.draw_rows(ring, row_key, count, context.hparams.priority_fraction, weights)
        sample = replay.sample(ring, sample_key, count, rows)
        sample = add_pool(ring, sample, sampler, relabel_key)
        return sample, relabel(sample, sampler, context, relabel_key).batch

    if priority is None or priority.choose is None:
        sample, batch = draw(number)
    else:
        candidates = draw(priority.candidates * number)
        sample, batch = priorities.choose(priority, jax.random.fold_in(key, _CHOOSE), *candidates, number, context)
    if n_step > 1:
        batch = look_ahead(ring, sample, batch, context, n_step)
    factor = hindsight_factor(sample, batch, context.hparams)
    batch = dataclasses.replace(batch, reward=batch.reward.astype(factor.dtype) * factor)
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), batch)


def hindsight_factor(sample: Sample, batch: Batch, hparams: HParams) -> Array:
    """Reward factor, shape [B]: `hindsight_reward` if the goal was replaced by another, else 1.

    In ARCHER (Lanka & Wu 2018), hindsight rewards are greater than real ones. A factor below 1 makes negative rewards greater
    and keeps all returns in their bounds.
    """
    replaced = jnp.any(batch.desired_goal != sample.desired_goal, axis=-1)
    dtype = jnp.promote_types(batch.reward.dtype, jnp.float32)  # rewards may be integers
    return jnp.where(replaced, jnp.asarray(hparams.hindsight_reward, dtype), jnp.ones(replaced.shape, dtype))


def look_ahead(ring: ReplayState, sample: Sample, batch: Batch, context: Context, n_step: int) -> Batch:
    """Extends a relabelled batch to returns of several steps.

    A return stops at the end of the episode, or when the goal is reached, because later actions aimed at another goal. As in
    Hessel et al. 2018, returns are not corrected for older policies.
    """
    last = sample.length if sample.ends else sample.episode_goals.shape[1] - 1
    ahead = sample.step + jnp.arange(1, n_step + 1)[:, None]  # [n, B]
    achieved = sample.episode_goals[jnp.arange(sample.step.shape[0]), jnp.minimum(ahead, last)]
    goals = jnp.broadcast_to(batch.desired_goal, achieved.shape)
    rewards = context.compute_reward(achieved, goals)
    rewards = rewards.astype(jnp.promote_types(rewards.dtype, jnp.float32))
    reached = context.reached(achieved, goals)
    goes_on = jnp.cumprod(~reached & (ahead < last), axis=0)  # after the i-th step
    counted = jnp.concatenate([jnp.ones_like(goes_on[:1]), goes_on[:-1]])
    num_steps = jnp.sum(counted, axis=0)
    gamma = jnp.asarray(context.hparams.gamma, rewards.dtype)
    powers = gamma ** jnp.arange(n_step, dtype=rewards.dtype)[:, None]
    end = jnp.minimum(sample.step + num_steps, last)
    ended_at_goal = jnp.any(reached & (counted > 0), axis=0) if context.ends_at_goal else False
    terminal = ring.episodes.terminal[sample.row] & (end == last)
    return dataclasses.replace(
        batch,
        next_observation=jax.tree.map(lambda x: x[sample.row, end], ring.episodes.observation),
        reward=jnp.sum(powers * counted * rewards, axis=0),
        discount=jnp.where(terminal | ended_at_goal, 0.0, gamma**num_steps),
    )
