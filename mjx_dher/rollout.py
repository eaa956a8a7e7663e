"""Whole episodes, many at once: a reset and a scan."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_dher.types import Array, Env, Episode, GoalObs, PRNGKey, PyTree

# policy(inputs of one step, obs with leading [N]) -> actions [N, A]
PolicyFn = Callable[[PyTree, GoalObs], Array]


class Outcome(NamedTuple):
    """Outcomes of episodes; all [N]."""

    success: Array  # 1.0 where the goal is reached at the last step
    reset_success: Array  # 1.0 where it was reached at the reset, before any action
    ret: Array  # undiscounted sum of rewards
    valid: Array  # whether all observations, actions and rewards are finite and the environment is not `failed`, bool


def rollout(env: Env, policy: PolicyFn, key: PRNGKey, num_envs: int, inputs: PyTree = None) -> tuple[Episode, Outcome]:
    """Plays `num_envs` episodes side by side.

    Args:
      env: an unbatched environment.
      policy: called with one step of `inputs` and the observations of all environments.
      key: of the first states.
      num_envs: episodes, N.
      inputs: further arguments of the policy, such as noise; leaves lead with [T]. None for none.

    Returns:
      The episodes (leaves lead with [N]) and their outcomes.
    """
    first = jax.vmap(env.reset)(jax.random.split(key, num_envs))

    def step(state, step_inputs):
        action = policy(step_inputs, state.obs)
        following = jax.vmap(env.step)(state, action)
        played = (state.obs["observation"], state.obs["achieved_goal"], action, following.reward)
        return following, played

    last, (observation, achieved_goal, action, reward) = jax.lax.scan(step, first, inputs, length=env.episode_length)

    def whole(steps, end):  # [T, N, ...] and [N, ...] -> [N, T+1, ...]
        return jnp.moveaxis(jnp.concatenate([steps, end[None]]), 0, 1)

    episodes = Episode(
        observation=jax.tree.map(whole, observation, last.obs["observation"]),
        achieved_goal=whole(achieved_goal, last.obs["achieved_goal"]),
        desired_goal=first.obs["desired_goal"],
        action=jnp.moveaxis(action, 0, 1),
    )
    arrays = (episodes.observation, episodes.achieved_goal, episodes.desired_goal, episodes.action, jnp.moveaxis(reward, 0, 1))
    valid = ~jnp.broadcast_to(getattr(last, "failed", False), (num_envs,))
    for leaf in jax.tree.leaves(arrays):
        valid &= jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim)))
    ret = jnp.sum(reward, axis=0)
    return episodes, Outcome(success=jnp.where(valid, last.success, 0.0), reset_success=first.success, ret=ret, valid=valid)


def check_steps(env: Env) -> None:
    """Calls `env.check()`, where the environment has one: it raises if steps so far were silently wrong."""
    if (check := getattr(env, "check", None)) is not None:
        check()
