"""A conformance test for environments: it tries everything that the library relies on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import rollout
from mjx_dher.types import Env

OBS = ("observation", "achieved_goal", "desired_goal")
STARTS = 8  # number of episodes in a batch


class EnvError(ValueError):
    """Error of an environment; the message says what is wrong and what is expected."""


def check_env(env: Env, seed: int = 0, tolerance: float = 1e-3) -> None:
    """Plays `env` with random actions and raises at the first violation of what the library relies on.

    - `action_size`, `episode_length` and, if present, `observation_size` and `goal_size` are positive integers that agree with
      the arrays. `reset`, `step` and `compute_reward` are methods.
    - A state is a pytree of arrays. Its `obs` has observation [D], achieved_goal [G] and desired_goal [G]; reward and success
      are []. All are float32 and finite, and success is 0 or 1. `failed`, if present, is [] and bool.
    - `step` keeps the state's structure, shapes and dtypes, as `lax.scan` requires, and does not modify its argument.
    - `reset` and `step` are pure: the same arguments give the same results, alone and under `jax.jit` and `jax.vmap`.
    - Starts or goals differ from key to key, and the goal is constant in an episode.
    - Actions outside [-1, 1] are accepted.
    - `with_goal`, if present, gives a first state another desired goal, which it keeps, and changes neither observation nor
      achieved goal.
    - `compute_reward` takes any leading axes and gives the same reward as `step`. It lies in [-1, 0], because the learner's
      targets are clipped to [-1/(1-gamma), 0], and it is greatest for a goal that is achieved exactly.
    - If all rewards are -1 or 0, success is never 1 at a reward of -1, and not 0 at every reward of 0. They need not agree at
      each step: an environment may require more for a success, such as rest.

    Steps after a state with `failed` are ignored.

    Args:
      env: the environment. Its method `check()`, if present, is called at the end.
      seed: seed of starts, goals and actions.
      tolerance: largest difference between results that should be equal, relative to the larger of 1 and the value.

    Raises:
      EnvError: names the first violation and what is expected.
    """
    _check_attributes(env)
    reset_key, action_key = jax.random.split(jax.random.key(seed))
    keys = jax.random.split(reset_key, STARTS)
    actions = jax.random.uniform(
        action_key, (env.episode_length, STARTS, env.action_size), jnp.float32, minval=-1.0, maxval=1.0
    )
    first = _check_single(env, keys[0], actions[0, 0], tolerance)
    states = _play(env, keys, actions)
    played = jax.device_get(_outputs(states))  # [T+1, N, ...]
    valid = ~np.broadcast_to(played.get("failed", False), played["reward"].shape)
    _check_episodes(played, valid)
    _check_against_play(env, keys, actions, states, tolerance)
    _check_with_goal(env, keys, tolerance)
    beyond = "step with an action of +-3"
    _check_state(env, _attempt(beyond, env.step, first, 3.0 * jnp.sign(actions[0, 0])), beyond)
    _check_reward(env, played, valid, tolerance)
    _check_success(played, valid)
    rollout.check_steps(env)


def _attempt(what: str, function: Callable[..., Any], *args: Any) -> Any:
    """Calls `function`; an error of any kind becomes an EnvError that says what was tried."""
    try:
        return function(*args)
    except Exception as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        raise EnvError(f"{what} raises {type(error).__name__}: {reason}") from error


def _check_attributes(env: Env) -> None:
    for name in ("action_size", "episode_length", "observation_size", "goal_size"):
        optional = name in ("observation_size", "goal_size")
        if not hasattr(env, name) and optional:
            continue
        value = getattr(env, name, None)
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise EnvError(f"{name} must be an integer of at least 1; it is {value!r}")
    for name in ("reset", "step", "compute_reward"):
        if not callable(getattr(env, name, None)):
            raise EnvError(f"{name} must be a method; it is {getattr(env, name, None)!r}")


def _check_single(env: Env, key: jax.Array, action: jax.Array, tolerance: float) -> Any:
    """Checks one reset and one step, called twice and traced; returns the first state."""
    first = _attempt("reset", env.reset, key)
    _check_state(env, first, "reset")
    second = _check_step(env, first, action)
    _check_scan(env, key)
    _check_reward_shapes(env, len(first.obs["achieved_goal"]))
    _check_same("reset, called twice with the same key", _attempt("reset", env.reset, key), first, tolerance)
    again = _attempt("step", env.step, first, action)
    _check_same("step, called twice with the same state and action", again, second, tolerance)
    return first


def _outputs(state: Any) -> dict[str, Any]:
    """Returns the arrays of a state that the library reads, by name."""
    optional = {"failed": state.failed} if hasattr(state, "failed") else {}
    return {**{name: state.obs[name] for name in OBS}, "reward": state.reward, "success": state.success, **optional}


def _check_state(env: Env, state: Any, source: str) -> None:
    """Raises EnvError unless a state that `source` returned has the right parts, shapes, dtypes and values."""
    _check_structure(state, source)
    for name, value in _outputs(state).items():
        _check_output(name, value, source)
    _check_sizes(env, {name: len(state.obs[name]) for name in OBS}, source)
    if float(state.success) not in (0.0, 1.0):
        raise EnvError(f"{source}: success must be 0 or 1; it is {float(state.success):g}")


def _check_structure(state: Any, source: str) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if not isinstance(leaf, (jax.Array, np.ndarray, np.generic, bool, int, float)):
            part = f"its leaf {jax.tree_util.keystr(path)}" if path else "it"
            raise EnvError(
                f"{source} must return a pytree of arrays, such as a flax.struct.dataclass; {part} is a {type(leaf).__name__}"
            )
    for name in ("obs", "reward", "success"):
        if not hasattr(state, name):
            raise EnvError(f"{source} must return a state with obs, reward and success; it has no {name}")
    for name in OBS:
        if name not in state.obs:
            raise EnvError(f"{source}: obs must have {', '.join(OBS)}; it has no {name}")


def _check_output(name: str, value: Any, source: str) -> None:
    ndim, kind = (1, "one vector") if name in OBS else (0, "a scalar, []")
    expected = "bool" if name == "failed" else "float32"
    if not jax.tree_util.all_leaves([value]):
        raise EnvError(f"{source}: {name} must be one array; it is a {type(value).__name__}")
    shape, dtype = jnp.shape(value), jnp.result_type(value)
    if len(shape) != ndim:
        raise EnvError(f"{source}: {name} must be {kind}; it has shape {shape}")
    if dtype != expected:
        raise EnvError(f"{source}: {name} must be {expected}; it is {dtype}")
    if not np.all(np.isfinite(value)):
        raise EnvError(f"{source}: {name} must be finite; it is {np.asarray(value)}")


def _check_sizes(env: Env, sizes: dict[str, int], source: str) -> None:
    for name, attribute in (("observation", "observation_size"), ("achieved_goal", "goal_size")):
        expected = getattr(env, attribute, sizes[name])
        if sizes[name] != expected:
            raise EnvError(f"{source}: {name} must have {attribute} = {expected} values; it has {sizes[name]}")
    goal_size, size = sizes["achieved_goal"], sizes["desired_goal"]
    if size != goal_size:
        raise EnvError(f"{source}: desired_goal must be as long as achieved_goal, {goal_size}; it is {size}")


def _check_step(env: Env, state: Any, action: jax.Array) -> Any:
    """Checks one step, and that it does not modify `state`; returns the next state."""
    leaves = jax.tree.leaves(state)
    kept = [_plain(leaf).copy() for leaf in leaves]
    following = _attempt("step", env.step, state, action)
    unchanged = len(leaves) == len(jax.tree.leaves(state)) and all(
        np.array_equal(before, _plain(after), equal_nan=before.dtype.kind == "f")
        for before, after in zip(kept, jax.tree.leaves(state))
    )
    if not unchanged:
        raise EnvError("step must return a new state and leave the given state unchanged; it changed it")
    _check_state(env, following, "step")
    return following


def _plain(leaf: Any) -> NDArray:
    if jnp.issubdtype(jnp.result_type(leaf), jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def _check_scan(env: Env, key: jax.Array) -> None:
    """Raises EnvError unless the states of `reset` and `step` have the same structure, shapes and dtypes."""
    first = _attempt("reset, traced by jax.jit,", jax.eval_shape, env.reset, key)
    action = jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    following = _attempt("step, traced by jax.jit,", jax.eval_shape, env.step, first, action)
    before, after = (dict(jax.tree_util.tree_leaves_with_path(state)) for state in (first, following))
    structure: Any = jax.tree.structure(first)
    if structure != jax.tree.structure(following):
        differing = [jax.tree_util.keystr(path) for path in {**before, **after} if (path in before) != (path in after)]
        reason = f"only one of them has {', '.join(differing)}" if differing else "their types or static fields differ"
        raise EnvError(f"reset and step must return states of one structure, for lax.scan; {reason}")
    for path, leaf in before.items():
        old, new = (f"{x.dtype}{list(x.shape)}" for x in (leaf, after[path]))
        if old != new:
            name = jax.tree_util.keystr(path)
            raise EnvError(f"step must keep shapes and dtypes, for lax.scan; the state's {name} is {old} and becomes {new}")


def _check_reward_shapes(env: Env, goal_size: int) -> None:
    for leading in ((), (3,), (2, 3)):
        goals = jax.ShapeDtypeStruct((*leading, goal_size), jnp.float32)
        what = f"compute_reward of goals {list(goals.shape)}"
        reward = _attempt(what, jax.eval_shape, env.compute_reward, goals, goals)
        if reward.shape != leading:
            raise EnvError(f"{what} must be {list(leading)}; it is {list(reward.shape)}")
        if reward.dtype != jnp.float32:
            raise EnvError(f"compute_reward must be float32; it is {reward.dtype}")


def _check_same(what: str, state: Any, expected: Any, tolerance: float) -> None:
    actual = _outputs(state)
    for name, value in _outputs(expected).items():
        a, b = np.asarray(actual[name], np.float32), np.asarray(value, np.float32)
        difference = np.abs(a - b)
        if not np.all(difference <= tolerance * np.maximum(1.0, np.abs(b))):
            raise EnvError(f"{what}, must give the same result; {name} differs by {difference.max():.3g}")


def _play(env: Env, keys: jax.Array, actions: jax.Array) -> Any:
    """Plays N whole episodes and returns their states [T+1, N, ...]."""

    @jax.jit
    def play(keys: jax.Array, actions: jax.Array) -> Any:
        def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
            following = jax.vmap(env.step)(state, action)
            return following, following

        first = jax.vmap(env.reset)(keys)
        _, later = jax.lax.scan(step, first, actions)
        return jax.tree.map(lambda start, rest: jnp.concatenate([start[None], rest]), first, later)

    return _attempt("an episode under jax.jit, jax.vmap and lax.scan", play, keys, actions)


def _check_episodes(played: dict[str, NDArray], valid: NDArray) -> None:
    if not valid[-1].any():
        raise EnvError("not every episode of random actions may end with `failed`; all of them did")
    for name, values in played.items():
        fine = np.isfinite(values).all(axis=tuple(range(2, values.ndim))) | ~valid
        if not fine.all():
            step = int(np.argmin(fine.all(axis=1)))
            raise EnvError(f"{name} must be finite, or `failed` be True; it is not finite after {step} steps of random actions")
    if all(np.all(played[name][0] == played[name][0, 0]) for name in OBS):
        raise EnvError(f"reset must draw starts or goals with its key; {played['reward'].shape[1]} keys gave the same")
    moved = np.any(played["desired_goal"] != played["desired_goal"][0], axis=-1) & valid
    if moved.any():
        step = int(np.argmax(moved.any(axis=1)))
        raise EnvError(f"desired_goal must be constant in an episode; it changed at step {step}")


def _check_against_play(env: Env, keys: jax.Array, actions: jax.Array, states: Any, tolerance: float) -> None:
    """Compares single, uncompiled resets and steps with those of the batch, from the same states."""
    num_steps = actions.shape[0]
    at = lambda t, n: jax.tree.map(lambda x: x[t, n], states)  # noqa: E731
    for n, t in enumerate(sorted({0, num_steps // 2, num_steps - 1})):
        start, following = _attempt("reset", env.reset, keys[n]), _attempt("step", env.step, at(t, n), actions[t, n])
        _check_same("reset, alone and under jax.jit and jax.vmap", start, at(0, n), tolerance)
        _check_same("step, alone and under jax.jit and jax.vmap", following, at(t + 1, n), tolerance)


def _check_with_goal(env: Any, keys: jax.Array, tolerance: float) -> None:
    """Checks that `with_goal`, where there is one, sets the goal of a first state and no more, for good."""
    if not hasattr(env, "with_goal"):
        return
    first, other = env.reset(keys[0]), env.reset(keys[1])
    goal = other.obs["desired_goal"]
    changed = _attempt("with_goal", env.with_goal, first, goal)
    _check_state(env, changed, "with_goal")
    following = _attempt("step after with_goal", env.step, changed, jnp.zeros(env.action_size))
    for name, state, told in (("with_goal", changed, "gives"), ("step after with_goal", following, "has")):
        if not np.array_equal(state.obs["desired_goal"], goal):
            raise EnvError(f"{name}: desired_goal must be the goal that was handed in; the state {told} another")
    for name in ("observation", "achieved_goal"):
        if not np.allclose(changed.obs[name], first.obs[name], rtol=tolerance, atol=tolerance):
            raise EnvError(f"with_goal must change the desired goal alone; it changed {name}")


def _check_reward(env: Env, played: dict[str, NDArray], valid: NDArray, tolerance: float) -> None:
    achieved, desired = played["achieved_goal"], played["desired_goal"]
    reward = jax.jit(env.compute_reward)
    batched = np.asarray(reward(achieved, desired))
    single = np.asarray(jax.jit(jax.vmap(jax.vmap(env.compute_reward)))(achieved, desired))
    differs = lambda a, b: np.abs(a - b) > tolerance * np.maximum(1.0, np.abs(b))  # noqa: E731
    if differs(batched, single).any():
        raise EnvError("compute_reward of a batch must be that of each of its goals; it depends on the others")
    later = valid[1:]
    wrong = differs(batched, played["reward"])[1:] & later
    if wrong.any():
        t, n = np.argwhere(wrong)[0]
        raise EnvError(
            f"the reward of step must be compute_reward(achieved_goal, desired_goal) of the next state, {batched[t + 1, n]:g};"
            f" it is {played['reward'][t + 1, n]:g}"
        )
    rewards = batched[1:][later]
    if rewards.min() < -1.0 or rewards.max() > 0.0:
        raise EnvError(
            f"rewards must lie in [-1, 0], as the learner's targets do; they range from {rewards.min():g} to {rewards.max():g}"
        )
    if np.any((np.asarray(reward(achieved, achieved)) < batched)[1:] & later):
        raise EnvError("compute_reward must be greatest for a goal that is achieved exactly; another had a greater one")


def _check_success(played: dict[str, NDArray], valid: NDArray) -> None:
    success = played["success"][1:][valid[1:]]
    if not np.isin(success, (0.0, 1.0)).all():
        raise EnvError(f"success must be 0 or 1; it takes the values {np.unique(success)[:5]}")
    reward = played["reward"][1:][valid[1:]]
    if not np.isin(reward, (-1.0, 0.0)).all():
        return
    if np.any((reward == -1.0) & (success == 1.0)):
        raise EnvError("success must be 0 where a sparse reward is -1; it is 1")
    if np.any(reward == 0.0) and not np.any(success == 1.0):
        raise EnvError("success must be 1 where the goal is reached; it never is, though the sparse reward is 0 at some steps")
