"""Rollouts of many whole episodes: a reset and a scan."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import check, context
from mjx_dher.contract import FLAGS, check_first, check_with_goal, env_spec
from mjx_dher.types import Array, Env, EnvSpec, Episode, GoalObs, PRNGKey, PyTree, check_size, with_key, without_key

# policy(inputs of one step, obs with leading [N]) -> actions [N, A]
PolicyFn = Callable[[PyTree, GoalObs], Array]
# goals to play for, of the observations of N resets -> [N, G]
GoalsFn = Callable[[GoalObs], Array]


class Outcome(NamedTuple):
    """Outcomes of episodes, each [N]."""

    success: Array  # 1.0 if the goal is reached at the last step
    reset_success: Array  # 1.0 if it was reached at the reset, before any action
    ret: Array  # undiscounted sum of rewards
    valid: Array  # whether all numbers are finite, no state is `failed`, and the first has not ended, bool
    bad_rewards: Array  # fraction of rewards outside the reward range
    length: Array  # steps that were played, int32


class _Playing(NamedTuple):
    """Loop state of a rollout."""

    state: PyTree  # of the environments
    over: Array  # [N] whether the episode has ended, bool
    length: Array  # [N] int32
    failed: Array  # [N] whether a state so far is `failed`, or the first has ended, bool


def rollout(
    env: Env,
    policy: PolicyFn,
    key: PRNGKey,
    num_envs: int,
    inputs: PyTree = None,
    goals: GoalsFn | None = None,
    spec: EnvSpec | None = None,
) -> tuple[Episode, Outcome]:
    """Plays episodes in parallel. An episode that ends early keeps its last state until the others have ended.

    Args:
      env: an unbatched environment.
      policy: function of one step of `inputs` and the observations of all environments, which returns actions [N, A].
      key: random key, or keys [N], of the initial states.
      num_envs: number of episodes N.
      inputs: other inputs of the policy, such as noise or keys; leaves lead with [T].
      goals: function from the initial observations to goals [N, G], which `env.with_goal` sets. Default: the resets' own.
      spec: `contract.env_spec` of `env`, if it is known. It takes a trace of `env`.

    Returns:
      The episodes (leaves lead with [N]) and their outcomes.

    Raises:
      ValueError: actions are not [N, A], inputs do not lead with [T], `env` is not an environment, or its states violate
        `types.Env` or its spec.
    """
    return record_rollout(env, policy, key, num_envs, lambda state: (), inputs, goals, spec)[:2]


def record_rollout(
    env: Env,
    policy: PolicyFn,
    key: PRNGKey,
    num_envs: int,
    record: Callable[[Any], PyTree],
    inputs: PyTree = None,
    goals: GoalsFn | None = None,
    spec: EnvSpec | None = None,
) -> tuple[Episode, Outcome, PyTree]:
    """Plays episodes like `rollout`, and also returns `record(state)` of all states; leaves lead with [N, T+1].

    Arguments other than `record` are as in `rollout`.
    """
    spec = env_spec(env) if spec is None else spec
    check_size("num_envs", num_envs)
    _check_inputs(inputs, spec.episode_length)
    first = jax.vmap(env.reset)(_keys(key, num_envs))
    check_first(first, (num_envs,))
    if goals is not None:
        first = _with_goals(env, first, goals(first.obs))

    def step(playing: _Playing, step_inputs: PyTree) -> tuple[_Playing, tuple[Any, ...]]:
        following, played = _step(env, spec, policy, playing, step_inputs)
        return following, (*played, record(playing.state))

    none = jnp.zeros(num_envs, bool)
    unusable = functools.reduce(jnp.logical_or, (getattr(first, flag, none) for flag in FLAGS))  # no start may have a flag
    start = _Playing(first, none, jnp.zeros(num_envs, jnp.int32), unusable)
    end, played = jax.lax.scan(step, start, inputs, length=spec.episode_length)
    (observation, achieved_goal, action, reward, recorded), last = played, end.state

    episodes = Episode(
        observation=jax.tree.map(_whole, observation, last.obs["observation"]),
        achieved_goal=_whole(achieved_goal, last.obs["achieved_goal"]),
        desired_goal=first.obs["desired_goal"],
        action=jnp.moveaxis(action, 0, 1),
        length=end.length,
        terminal=jnp.broadcast_to(getattr(last, "terminal", False), (num_envs,)),
    )
    valid = ~end.failed & _is_finite((episodes, jnp.moveaxis(reward, 0, 1)))
    outcome = Outcome(
        success=jnp.where(valid, last.success, 0.0),
        reset_success=jnp.where(valid, first.success, 0.0),
        ret=jnp.sum(reward, axis=0),
        valid=valid,
        bad_rewards=_bad_rewards(spec, reward, end.length),
        length=end.length,
    )
    return episodes, outcome, jax.tree.map(_whole, recorded, record(last))


def _step(env: Env, spec: EnvSpec, policy: PolicyFn, playing: _Playing, inputs: PyTree) -> tuple[_Playing, tuple[Any, ...]]:
    """One step of all episodes, and its observation, achieved goal, action and reward, each [N, ...]."""
    state, num_envs = playing.state, playing.over.shape[0]
    action = policy(inputs, state.obs)
    if np.shape(action) != (num_envs, env.action_size):
        raise ValueError(f"policy must return actions [N, A] = {[num_envs, env.action_size]}; got {list(np.shape(action))}")
    action = jnp.asarray(action, jnp.float32)  # an own learner's may have 64 bits
    following = jax.vmap(env.step)(state, action)
    check.kept("step", state, following, leading=1)
    reward = following.reward
    if spec.ends:
        following = where_each(playing.over, state, following)
        action, reward = (where_each(playing.over, jnp.zeros_like(x), x) for x in (action, reward))
    played = (state.obs["observation"], state.obs["achieved_goal"], action, reward)
    length = playing.length + (~playing.over).astype(jnp.int32)
    terminated, done = ended(env, spec, following)
    failed = playing.failed | getattr(following, "failed", False)
    return _Playing(following, playing.over | terminated | done, length, failed), played


def _whole(steps: Array, end: Array) -> Array:
    """Joins arrays of T steps [T, N, ...] and of the last state [N, ...] to [N, T+1, ...]."""
    return jnp.moveaxis(jnp.concatenate([steps, end[None]]), 0, 1)


def _is_finite(arrays: PyTree) -> Array:
    """Whether all floats of each episode are finite, bool [N]; leaves lead with [N]."""
    floats = [leaf for leaf in jax.tree.leaves(arrays) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return functools.reduce(jnp.logical_and, (jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim))) for leaf in floats))


def _bad_rewards(spec: EnvSpec, reward: Array, length: Array) -> Array:
    """Fraction [N] of the played rewards [T, N] outside the reward range."""
    low, high = spec.reward_range
    bad = (reward < low) | (reward > high)
    if not spec.ends:
        return jnp.mean(bad, axis=0, dtype=jnp.float32)
    played = jnp.arange(spec.episode_length)[:, None] < length[None]
    return jnp.sum(bad & played, axis=0, dtype=jnp.float32) / length.astype(jnp.float32)


def ended(env: Any, spec: EnvSpec, state: Any) -> tuple[Array, Array]:
    """Whether episodes have ended, as two bool [...]: terminated, because no future follows, and ended for another reason."""
    none = jnp.zeros(state.reward.shape, bool)
    terminated = none | getattr(state, "terminal", False)
    if spec.ends_at_goal:
        terminated |= context.reached_fn(env)(state.obs["achieved_goal"], state.obs["desired_goal"])
    return terminated, (none | getattr(state, "done", False)) & ~terminated


def where_each(condition: Array, yes: PyTree, no: PyTree) -> PyTree:
    """Selects `yes` or `no` by `condition` [N]; leaves lead with [N]."""

    def select(a: Array, b: Array) -> Array:
        old, new = map(without_key, (a, b))
        return with_key(jnp.where(condition.reshape(-1, *(1,) * (old.ndim - 1)), old, new), a)

    return jax.tree.map(select, yes, no)


def _check_inputs(inputs: PyTree, num_steps: int) -> None:
    """Raises ValueError unless the leaves of `inputs` lead with [T]."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(inputs):
        if jnp.shape(leaf)[:1] != (num_steps,):
            name, shape = jax.tree_util.keystr(path), list(jnp.shape(leaf))
            raise ValueError(f"inputs{name} must lead with [T] = [{num_steps}], one for each step; got {shape}")


def _with_goals(env: Any, first: Any, goals: Array) -> Any:
    """Initial states of N episodes with other goals [N, G]."""
    check_with_goal(env)
    changed = jax.vmap(env.with_goal)(first, goals)
    check.kept("with_goal", first, changed, leading=1)
    return changed


def _keys(key: PRNGKey, num_envs: int) -> PRNGKey:
    """Splits one key, or keeps `num_envs` given ones."""
    are_many = without_key(key).ndim > 1  # the data of one key are one vector
    if are_many and len(key) != num_envs:
        raise ValueError(f"key must be one key or [{num_envs}], one for each environment; got [{len(key)}]")
    return key if are_many else jax.random.split(key, num_envs)
