"""Hindsight: transitions whose goal is replaced by an achieved one, with the reward computed anew."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher import priorities, replay, samplers
from mjx_dher.config import HParams
from mjx_dher.context import View
from mjx_dher.priorities import Priority
from mjx_dher.replay import ReplayState, Sample
from mjx_dher.samplers import LogWeightsFn, Sampler
from mjx_dher.types import Array, Batch, PRNGKey, RewardFn

CHOOSE = 0x43686F69  # folded into a draw's key, for what chooses among transitions; no index of `jax.random.split`


def hindsight_goals(
    state: ReplayState,
    sample: Sample,
    sampler: Sampler | LogWeightsFn,
    hparams: HParams,
    key: PRNGKey,
    scores: Array | None = None,
) -> Array:
    """Chooses one achieved goal for each transition of `sample` by `sampler`; returns them as [B, G].

    A transition for which the sampler offers no goal (no weight is positive, or one is NaN or infinite) keeps its own.
    `scores` are those of the ring's episodes [E, T+1], for a sampler that wants them (`scores.of_episodes`).

    Raises:
      ValueError: its log weights are not one floating-point number for each goal of an episode.
    """
    return _choose(state, sample, sampler, hparams, key, scores)[0]


def _choose(
    state: ReplayState,
    sample: Sample,
    sampler: Sampler | LogWeightsFn,
    hparams: HParams,
    key: PRNGKey,
    scores: Array | None,
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
    score = None if scores is None else scores[sample.row]
    axes = (0, 0, 0, None, None if score is None else 0)
    log_weights = jax.vmap(weigh, in_axes=axes)(pool, sample.desired_goal, sample.step, hparams, score)
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
    n_step: int = 1,
    scores: Array | None = None,
    priority: Priority | None = None,
    view: View | None = None,
) -> Batch:
    """Draws and relabels transitions as the learner takes them, all at once; leaves lead with `shape`.

    A fraction `hparams.priority_fraction` of them is from episodes drawn by priority; `cumulative` is
    `replay.cumulative_priority(state)`. The ring must not be empty. `n_step` is what `look_ahead` takes, `scores` what
    `hindsight_goals` does. Where `priority` chooses among transitions, more are drawn and it looks at `view`, too.
    """
    number = math.prod(shape)

    def draw(count: int) -> tuple[Sample, Batch]:
        row_key, sample_key, relabel_key = jax.random.split(key, 3)
        rows = replay.draw_rows(state, row_key, count, hparams.priority_fraction, cumulative)
        sample = replay.sample(state, sample_key, count, rows)
        return sample, relabel(state, sample, sampler, compute_reward, hparams, relabel_key, scores)

    if priority is None or priority.choose is None:
        sample, batch = draw(number)
    else:
        view = View(compute_reward, hparams) if view is None else view
        candidates = draw(priorities.CANDIDATES * number)
        sample, batch = priorities.chosen(priority, jax.random.fold_in(key, CHOOSE), *candidates, number, view)
    if n_step > 1:
        batch = look_ahead(state, sample, batch, compute_reward, hparams.gamma, n_step)
    factor = hindsight_factor(sample, batch, hparams)
    batch = dataclasses.replace(batch, reward=batch.reward.astype(factor.dtype) * factor)
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), batch)


def hindsight_factor(sample: Sample, batch: Batch, hparams: HParams) -> Array:
    """Returns by what each reward [B] is multiplied: `hindsight_reward` where the goal was replaced by another, else 1.

    Lanka & Wu 2018 (ARCHER): hindsight rewards are numerically greater than real ones. Rewards here are 0 or negative, so a
    factor below 1 makes them so; all returns stay in [-1/(1-gamma), 0].
    """
    replaced = jnp.any(batch.desired_goal != sample.desired_goal, axis=-1)
    dtype = jnp.promote_types(batch.reward.dtype, jnp.float32)  # rewards may be whole numbers, the factor is none
    return jnp.where(replaced, jnp.asarray(hparams.hindsight_reward, dtype), jnp.ones(replaced.shape, dtype))


def look_ahead(
    state: ReplayState, sample: Sample, batch: Batch, compute_reward: RewardFn, gamma: Array | float, n_step: int
) -> Batch:
    """Returns the batch that `relabel` made of `sample`, with returns of up to `n_step` steps of its episodes.

    A return ends where the episode does, and where the goal is reached (a reward of 0, the most there is): what the episode
    did after that, it did for another goal. Up to there, actions are those of the policies that played (Hessel et al. 2018,
    whose multi-step returns are not corrected for that either).
    """
    last = sample.episode_goals.shape[1] - 1
    ahead = sample.step + jnp.arange(1, n_step + 1)[:, None]  # [n, B]
    achieved = sample.episode_goals[jnp.arange(sample.step.shape[0]), jnp.minimum(ahead, last)]
    rewards = jax.vmap(compute_reward, in_axes=(0, None))(achieved, batch.desired_goal)
    rewards = rewards.astype(jnp.promote_types(rewards.dtype, jnp.float32))
    going_on = jnp.cumprod((rewards < 0) & (ahead < last), axis=0)  # after the i-th step
    counted = jnp.concatenate([jnp.ones_like(going_on[:1]), going_on[:-1]])
    num_steps = jnp.sum(counted, axis=0)
    powers = jnp.asarray(gamma, rewards.dtype) ** jnp.arange(n_step, dtype=rewards.dtype)[:, None]
    return dataclasses.replace(
        batch,
        next_observation=jax.tree.map(lambda x: x[sample.row, sample.step + num_steps], state.episodes.observation),
        reward=jnp.sum(powers * counted * rewards, axis=0),
        discount=jnp.asarray(gamma, rewards.dtype) ** num_steps,
    )


def relabel(
    state: ReplayState,
    sample: Sample,
    sampler: Sampler | LogWeightsFn,
    compute_reward: RewardFn,
    hparams: HParams,
    key: PRNGKey,
    scores: Array | None = None,
) -> Batch:
    """Returns `sample` as a batch in which each transition was relabelled with probability k/(k+1), k = `hparams.her_k`.

    The reward is that of the goal achieved at the transition's end: `compute_reward(achieved at step+1, goal)`. Of `hparams`
    it reads her_k, and whatever the sampler reads; `draw_batches` reads priority_fraction and hindsight_reward, too. `scores`
    is what `hindsight_goals` takes.

    Raises:
      ValueError: the sampler's log weights are not [T+1], or the rewards not [B].
    """
    return relabel_counted(state, sample, sampler, compute_reward, hparams, key, scores)[0]


def relabel_counted(
    state: ReplayState,
    sample: Sample,
    sampler: Sampler | LogWeightsFn,
    compute_reward: RewardFn,
    hparams: HParams,
    key: PRNGKey,
    scores: Array | None = None,
) -> tuple[Batch, Array]:
    """Returns the batch that `relabel` returns, and the share [] of transitions to be relabelled that were offered no goal."""
    coin_key, goal_key = jax.random.split(key)
    batch_size = sample.step.shape[0]
    relabelled = jax.random.uniform(coin_key, (batch_size,)) < hparams.her_k / (hparams.her_k + 1.0)
    goals, offered = _choose(state, sample, sampler, hparams, goal_key, scores)
    desired_goal = jnp.where(relabelled[:, None], goals, sample.desired_goal)
    achieved_goal = sample.episode_goals[jnp.arange(batch_size), sample.step + 1]
    reward = compute_reward(achieved_goal, desired_goal)
    _check_rewards(reward, desired_goal)
    batch = Batch(
        observation=sample.observation,
        next_observation=sample.next_observation,
        desired_goal=desired_goal,
        action=sample.action,
        reward=reward,
    )
    missed = jnp.sum(relabelled & ~offered, dtype=jnp.float32)
    return batch, missed / jnp.maximum(jnp.sum(relabelled, dtype=jnp.float32), 1.0)


def _check_rewards(reward: Any, goal: Array) -> None:
    """Raises ValueError unless rewards of goals [B, G] are [B]."""
    if getattr(reward, "shape", None) != goal.shape[:1]:
        given = list(reward.shape) if hasattr(reward, "shape") else f"a {type(reward).__name__}"
        raise ValueError(
            f"compute_reward gives rewards [B] = {list(goal.shape[:1])} of goals [B, G] = {list(goal.shape)}; this one gives"
            f" {given}"
        )
