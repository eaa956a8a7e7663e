"""Whole episodes, many at once: a reset and a scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.types import Array, Env, Episode, GoalObs, PRNGKey, PyTree, Sizes, check_env_parts, check_size

# policy(inputs of one step, obs with leading [N]) -> actions [N, A]
PolicyFn = Callable[[PyTree, GoalObs], Array]
# goals to play for, of the observations of N resets -> [N, G]
GoalsFn = Callable[[GoalObs], Array]


class Outcome(NamedTuple):
    """Outcomes of episodes; all [N]."""

    success: Array  # 1.0 where the goal is reached at the last step
    reset_success: Array  # 1.0 where it was reached at the reset, before any action
    ret: Array  # undiscounted sum of rewards
    valid: Array  # whether all observations, actions and rewards are finite and the environment is not `failed`, bool
    bad_rewards: Array  # share of the episode's rewards outside [-1, 0]


def rollout(
    env: Env, policy: PolicyFn, key: PRNGKey, num_envs: int, inputs: PyTree = None, goals: GoalsFn | None = None
) -> tuple[Episode, Outcome]:
    """Plays `num_envs` episodes side by side.

    Args:
      env: an unbatched environment.
      policy: called with one step of `inputs` and the observations of all environments.
      key: of the first states; or [N], one for each.
      num_envs: episodes, N.
      inputs: further arguments of the policy, such as noise, or keys for one that draws; leaves lead with [T]. None for none.
      goals: gives the goals to play for, which `env.with_goal` sets; those of the reset where None.

    Returns:
      The episodes (leaves lead with [N]) and their outcomes.

    Raises:
      ValueError: actions that are not [N, A], inputs that do not lead with [T], something that is no environment, or states
        that are not what `types.Env` says.
    """
    check_env_parts(env)
    check_size("num_envs", num_envs)
    _check_inputs(inputs, env.episode_length)
    first = jax.vmap(env.reset)(_keys(key, num_envs))
    check_first(first, (num_envs,))
    if goals is not None:
        first = _with_goals(env, first, goals(first.obs))

    def step(state, step_inputs):
        action = policy(step_inputs, state.obs)
        if np.shape(action) != (num_envs, env.action_size):
            raise ValueError(f"the policy gives actions [N, A] = {[num_envs, env.action_size]}; got {list(np.shape(action))}")
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


def _check_inputs(inputs: PyTree, num_steps: int) -> None:
    """Raises ValueError unless the leaves of `inputs` lead with [T]."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(inputs):
        if jnp.shape(leaf)[:1] != (num_steps,):
            name, shape = jax.tree_util.keystr(path), list(jnp.shape(leaf))
            raise ValueError(f"inputs{name} must lead with [T] = [{num_steps}], one for each step; got {shape}")


def _with_goals(env: Any, first: Any, goals: Array) -> Any:
    """Returns the first states of N episodes with other goals [N, G]; raises ValueError where the environment changes more."""
    changed = jax.vmap(env.with_goal)(first, goals)
    _check_same_shapes(first, changed, "with_goal")
    return changed


def _keys(key: PRNGKey, num_envs: int) -> PRNGKey:
    """Returns `num_envs` keys, of one key or as they are given; a key that `jax.random.PRNGKey` made is two numbers."""
    one = 0 if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else 1
    return key if key.ndim > one else jax.random.split(key, num_envs)


def check_first(state: Any, leading: tuple[int, ...]) -> None:
    """Raises ValueError unless a state of `reset`, or its shapes, has what an `EnvState` has, behind the axes `leading`."""
    for name in ("obs", "reward", "success"):
        if not hasattr(state, name):
            raise ValueError(f"reset must give a state with obs, reward and success; this {type(state).__name__} has no {name}")
    for name in ("observation", "achieved_goal", "desired_goal"):
        if not isinstance(state.obs, Mapping) or name not in state.obs:
            raise ValueError(f"reset: obs must be a dict of observation, achieved_goal and desired_goal; it has no {name}")
    for name in ("reward", "success", *(["failed"] if hasattr(state, "failed") else [])):
        value = getattr(state, name)
        if not hasattr(value, "shape"):
            raise ValueError(f"reset: {name} must be a scalar, []; it is a {type(value).__name__}")
        if value.shape != leading:
            raise ValueError(f"reset: {name} must be a scalar, []; it has shape {value.shape[len(leading) :]}")
        if name == "failed" and value.dtype != bool:
            raise ValueError(f"reset: failed must be bool; it is {value.dtype}")
        if jnp.issubdtype(value.dtype, jnp.complexfloating):
            raise ValueError(f"reset: {name} must be a real number; it is {value.dtype}")
    achieved, desired = (jnp.shape(state.obs[name])[len(leading) :] for name in ("achieved_goal", "desired_goal"))
    if len(achieved) != 1 or achieved != desired:
        raise ValueError(
            f"reset: achieved_goal and desired_goal must be vectors [G]; they have shapes {achieved} and {desired}"
        )


def _check_same_shapes(before: Any, after: Any, method: str = "step") -> None:
    """Raises ValueError unless a method keeps the state's structure, shapes and types, as `lax.scan` needs."""
    old, new = (dict(jax.tree_util.tree_leaves_with_path(state)) for state in (before, after))
    structure: Any = jax.tree.structure(before)
    if structure != jax.tree.structure(after):
        differing = [jax.tree_util.keystr(path) for path in {**old, **new} if (path in old) != (path in new)]
        raise ValueError(
            f"reset and {method} must give states of one structure; only one has {', '.join(differing) or 'its type'}"
        )
    for path, leaf in old.items():
        kept, changed = ((jnp.shape(x)[1:], jnp.result_type(x)) for x in (leaf, new[path]))
        if kept != changed:
            raise ValueError(
                f"{method} must keep shapes and types; the state's {jax.tree_util.keystr(path)} is {kept[1]}{list(kept[0])} and"
                f" becomes {changed[1]}{list(changed[0])}"
            )


def check_steps(env: Env) -> None:
    """Calls `env.check()`, where the environment has one: it raises if steps so far were silently wrong."""
    if (check := getattr(env, "check", None)) is not None:
        check()


def env_sizes(env: Env) -> Sizes:
    """Returns the sizes of an environment's observation, goal and action, without running it.

    Raises:
      ValueError: the observation is not a single vector.
    """
    template = episode_template(env)
    return Sizes(template.observation.shape[-1], template.desired_goal.shape[-1], env.action_size)


def episode_template(env: Env) -> Episode:
    """Returns the shapes and types of one episode of `env`, without running it.

    Raises:
      ValueError: the observation is not a single vector, or `env` is no environment.
    """
    check_env_parts(env)
    first = jax.eval_shape(env.reset, jax.random.key(0))
    check_first(first, ())
    obs = first.obs
    observation = obs["observation"]
    if not (hasattr(observation, "shape") and len(observation.shape) == 1):
        raise ValueError(f"the learner takes observations of one vector [D]; this environment gives {observation}")

    def repeat(x: Any, times: int) -> Any:
        return jax.ShapeDtypeStruct((times, *x.shape), x.dtype)

    num_steps = env.episode_length
    return Episode(
        observation=repeat(observation, num_steps + 1),
        achieved_goal=repeat(obs["achieved_goal"], num_steps + 1),
        desired_goal=obs["desired_goal"],
        action=repeat(jax.ShapeDtypeStruct((env.action_size,), jnp.float32), num_steps),
    )
