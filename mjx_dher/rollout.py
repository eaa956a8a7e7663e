"""Whole episodes, many at once: a reset and a scan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

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
    bad_rewards: Array  # share of the episode's rewards outside [-1, 0]


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

    Raises:
      ValueError: actions that are not [N, A], or states whose shapes are not what `types.Env` says.
    """
    first = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    _check_state(first, num_envs)

    def step(state, step_inputs):
        action = policy(step_inputs, state.obs)
        if jnp.shape(action) != (num_envs, env.action_size):
            raise ValueError(f"the policy gives actions [N, A] = {[num_envs, env.action_size]}; got {list(jnp.shape(action))}")
        following = jax.vmap(env.step)(state, action)
        _check_same_shapes(state, following)
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
    return episodes, Outcome(
        success=jnp.where(valid, last.success, 0.0),
        reset_success=first.success,
        ret=jnp.sum(reward, axis=0),
        valid=valid,
        bad_rewards=jnp.mean((reward < -1.0) | (reward > 0.0), axis=0, dtype=jnp.float32),
    )


def _check_state(state: Any, num_envs: int) -> None:
    """Raises ValueError unless N states, as `reset` gives them, have one reward, one success and goals of one size each."""
    for name in ("reward", "success"):
        shape = jnp.shape(getattr(state, name))
        if shape != (num_envs,):
            raise ValueError(f"reset: {name} must be a scalar, []; it has shape {shape[1:]}")
    achieved, desired = (jnp.shape(state.obs[name])[1:] for name in ("achieved_goal", "desired_goal"))
    if len(achieved) != 1 or achieved != desired:
        raise ValueError(
            f"reset: achieved_goal and desired_goal must be vectors [G]; they have shapes {achieved} and {desired}"
        )


def _check_same_shapes(before: Any, after: Any) -> None:
    """Raises ValueError unless `step` keeps the state's structure, shapes and types, as `lax.scan` needs."""
    old, new = (dict(jax.tree_util.tree_leaves_with_path(state)) for state in (before, after))
    structure: Any = jax.tree.structure(before)
    if structure != jax.tree.structure(after):
        differing = [jax.tree_util.keystr(path) for path in {**old, **new} if (path in old) != (path in new)]
        raise ValueError(f"reset and step must give states of one structure; only one has {', '.join(differing) or 'its type'}")
    for path, leaf in old.items():
        kept, changed = ((jnp.shape(x)[1:], jnp.result_type(x)) for x in (leaf, new[path]))
        if kept != changed:
            raise ValueError(
                f"step must keep shapes and types; the state's {jax.tree_util.keystr(path)} is {kept[1]}{list(kept[0])} and"
                f" becomes {changed[1]}{list(changed[0])}"
            )


def check_steps(env: Env) -> None:
    """Calls `env.check()`, where the environment has one: it raises if steps so far were silently wrong."""
    if (check := getattr(env, "check", None)) is not None:
        check()
