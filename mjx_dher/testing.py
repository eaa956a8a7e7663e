"""A check for authors of environments: all that this library relies on, tried out on one.

In a test:

    from mjx_dher.testing import check_env

    check_env(MyTask())
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import trainer
from mjx_dher.types import Env

OBS = ("observation", "achieved_goal", "desired_goal")
STARTS = 8  # episodes side by side


class EnvError(ValueError):
    """What is wrong with an environment, and what is expected."""


def check_env(env: Env, seed: int = 0, tolerance: float = 1e-3) -> None:
    """Plays `env` with random actions and raises at the first thing that the library relies on and that does not hold.

    - `action_size`, `episode_length` and, where they are there, `observation_size` and `goal_size` are counts that agree with
      the arrays; `reset`, `step` and `compute_reward` are there.
    - A state is a pytree of arrays. Its `obs` has observation [D], achieved_goal [G] and desired_goal [G]; reward and success
      are []. All are float32 and finite, and success is 0 or 1. `failed`, where there is one, is [] and bool.
    - `step` keeps the state's structure, shapes and dtypes, so that `lax.scan` takes it, and leaves the state it was given as
      it was.
    - `reset` and `step` are pure: the same arguments give the same results, alone and under `jax.jit` and `jax.vmap`.
    - Starts or goals differ from key to key, and the goal stays the same for an episode.
    - Actions outside [-1, 1] are accepted.
    - `compute_reward` takes any leading axes, gives the reward that `step` gave, lies in [-1, 0] (the learner's targets are
      clipped to [-1/(1-gamma), 0]), and is nowhere greater than for a goal that is achieved exactly.
    - Where all rewards are -1 or 0, success is never 1 at a reward of -1, nor 0 at every reward of 0. Whether it agrees at
      each step is not asked: an environment may want more for a success, such as rest.

    What an episode does after its state said `failed` is not looked at.

    Args:
      env: the environment. `check()`, where it has one, is called at the end.
      seed: of starts, goals and actions.
      tolerance: by how much results that should be the same may differ, relative to the larger of 1 and the value.

    Raises:
      EnvError: names the first thing that is wrong, and what is expected.
    """
    _check_attributes(env)
    reset_key, action_key = jax.random.split(jax.random.key(seed))
    keys = jax.random.split(reset_key, STARTS)
    actions = jax.random.uniform(action_key, (env.episode_length, STARTS, env.action_size), minval=-1.0, maxval=1.0)
    first = _attempt("reset", env.reset, keys[0])
    _check_state(env, first, "reset")
    second = _check_step(env, first, actions[0, 0])
    _check_scan(env, keys[0])
    _check_reward_shapes(env, len(first.obs["achieved_goal"]))
    _check_same("reset, called twice with the same key", _attempt("reset", env.reset, keys[0]), first, tolerance)
    again = _attempt("step", env.step, first, actions[0, 0])
    _check_same("step, called twice with the same state and action", again, second, tolerance)
    states = _play(env, keys, actions)
    played = jax.device_get(_seen(states))  # [T+1, N, ...]
    valid = ~np.broadcast_to(played.get("failed", False), played["reward"].shape)
    _check_episodes(played, valid)
    _check_against_play(env, keys, actions, states, tolerance)
    beyond = "step with an action of +-3"
    _check_state(env, _attempt(beyond, env.step, first, 3.0 * jnp.sign(actions[0, 0])), beyond)
    _check_reward(env, played, valid, tolerance)
    _check_success(played, valid)
    trainer.check_steps(env)


def _attempt(what: str, function: Callable[..., Any], *args: Any) -> Any:
    """What `function` gives; an error of any kind becomes one that says what was tried."""
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


def _seen(state: Any) -> dict[str, Any]:
    """What the library reads of a state, by name."""
    optional = {"failed": state.failed} if hasattr(state, "failed") else {}
    return {**{name: state.obs[name] for name in OBS}, "reward": state.reward, "success": state.success, **optional}


def _check_state(env: Env, state: Any, by: str) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if not isinstance(leaf, (jax.Array, np.ndarray, np.generic, bool, int, float)):
            where = f"its leaf {jax.tree_util.keystr(path)}" if path else "it"
            raise EnvError(
                f"{by} must give a pytree of arrays, such as a flax.struct.dataclass; {where} is a {type(leaf).__name__}"
            )
    for name in ("obs", "reward", "success"):
        if not hasattr(state, name):
            raise EnvError(f"{by} must give a state with obs, reward and success; it has no {name}")
    for name in OBS:
        if name not in state.obs:
            raise EnvError(f"{by}: obs must have {', '.join(OBS)}; it has no {name}")
    for name, value in _seen(state).items():
        if not jax.tree_util.all_leaves([value]):
            raise EnvError(f"{by}: {name} must be one array; it is a {type(value).__name__}")
        shape, dtype = jnp.shape(value), jnp.result_type(value)
        if len(shape) != (name in OBS):
            raise EnvError(f"{by}: {name} must be {'one vector' if name in OBS else 'a scalar, []'}; it has shape {shape}")
        if dtype != ("bool" if name == "failed" else "float32"):
            raise EnvError(f"{by}: {name} must be {'bool' if name == 'failed' else 'float32'}; it is {dtype}")
        if not np.all(np.isfinite(value)):
            raise EnvError(f"{by}: {name} must be finite; it is {np.asarray(value)}")
    _check_sizes(env, {name: len(state.obs[name]) for name in OBS}, by)
    if float(state.success) not in (0.0, 1.0):
        raise EnvError(f"{by}: success must be 0 or 1; it is {float(state.success):g}")


def _check_sizes(env: Env, found: dict[str, int], by: str) -> None:
    for name, attribute in (("observation", "observation_size"), ("achieved_goal", "goal_size")):
        size = getattr(env, attribute, found[name])
        if found[name] != size:
            raise EnvError(f"{by}: {name} must have {attribute} = {size} values; it has {found[name]}")
    if found["desired_goal"] != found["achieved_goal"]:
        raise EnvError(
            f"{by}: desired_goal must be as long as achieved_goal, {found['achieved_goal']}; it is {found['desired_goal']}"
        )


def _check_step(env: Env, state: Any, action: jax.Array) -> Any:
    leaves = jax.tree.leaves(state)
    kept = [_plain(leaf).copy() for leaf in leaves]
    following = _attempt("step", env.step, state, action)
    unchanged = len(leaves) == len(jax.tree.leaves(state)) and all(
        np.array_equal(before, _plain(after), equal_nan=before.dtype.kind == "f")
        for before, after in zip(kept, jax.tree.leaves(state))
    )
    if not unchanged:
        raise EnvError("step must leave the state that it is given as it is, and make a new one; it changed it")
    _check_state(env, following, "step")
    return following


def _plain(leaf: Any) -> NDArray:
    if jnp.issubdtype(jnp.result_type(leaf), jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def _check_scan(env: Env, key: jax.Array) -> None:
    """Whether reset's and step's states have one structure."""
    first = _attempt("reset, traced by jax.jit,", jax.eval_shape, env.reset, key)
    action = jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    following = _attempt("step, traced by jax.jit,", jax.eval_shape, env.step, first, action)
    before, after = (dict(jax.tree_util.tree_leaves_with_path(state)) for state in (first, following))
    structure: Any = jax.tree.structure(first)
    if structure != jax.tree.structure(following):
        differing = [jax.tree_util.keystr(path) for path in {**before, **after} if (path in before) != (path in after)]
        found = f"only one of them has {', '.join(differing)}" if differing else "their types or static fields differ"
        raise EnvError(f"reset and step must give states of one structure, for lax.scan; {found}")
    for path, leaf in before.items():
        old, new = (f"{x.dtype}{list(x.shape)}" for x in (leaf, after[path]))
        if old != new:
            name = jax.tree_util.keystr(path)
            raise EnvError(f"step must keep shapes and dtypes, for lax.scan; the state's {name} is {old} and becomes {new}")


def _check_reward_shapes(env: Env, goal_size: int) -> None:
    for leading in ((), (3,), (2, 3)):
        goals = jax.ShapeDtypeStruct((*leading, goal_size), jnp.float32)
        what = f"compute_reward of goals {list(goals.shape)}"
        found = _attempt(what, jax.eval_shape, env.compute_reward, goals, goals)
        if found.shape != leading:
            raise EnvError(f"{what} must be {list(leading)}; it is {list(found.shape)}")
        if found.dtype != jnp.float32:
            raise EnvError(f"compute_reward must be float32; it is {found.dtype}")


def _check_same(what: str, found: Any, expected: Any, tolerance: float) -> None:
    got, wanted = _seen(found), _seen(expected)
    for name, value in wanted.items():
        a, b = np.asarray(got[name], np.float32), np.asarray(value, np.float32)
        difference = np.abs(a - b)
        if not np.all(difference <= tolerance * np.maximum(1.0, np.abs(b))):
            raise EnvError(f"{what}, must give the same result; {name} differs by {difference.max():.3g}")


def _play(env: Env, keys: jax.Array, actions: jax.Array) -> Any:
    """The states [T+1, N] of N whole episodes."""

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
        raise EnvError("every episode of random actions said `failed`")
    for name, values in played.items():
        fine = np.isfinite(values).all(axis=tuple(range(2, values.ndim))) | ~valid
        if not fine.all():
            step = int(np.argmin(fine.all(axis=1)))
            raise EnvError(f"{name} must be finite, or the state say `failed`; it is not after {step} steps of random actions")
    if all(np.all(played[name][0] == played[name][0, 0]) for name in OBS):
        raise EnvError(f"reset must draw starts or goals with its key; {played['reward'].shape[1]} keys gave the same")
    moved = np.any(played["desired_goal"] != played["desired_goal"][0], axis=-1) & valid
    if moved.any():
        raise EnvError(
            f"desired_goal must stay the same for an episode; it changed at step {int(np.argmax(moved.any(axis=1)))}"
        )


def _check_against_play(env: Env, keys: jax.Array, actions: jax.Array, states: Any, tolerance: float) -> None:
    """Single resets and steps, not compiled, against those of the batch, from the same states."""
    num_steps = actions.shape[0]
    at = lambda t, n: jax.tree.map(lambda x: x[t, n], states)  # noqa: E731
    for n, t in enumerate(sorted({0, num_steps // 2, num_steps - 1})):
        start, following = _attempt("reset", env.reset, keys[n]), _attempt("step", env.step, at(t, n), actions[t, n])
        _check_same("reset, alone and under jax.jit and jax.vmap", start, at(0, n), tolerance)
        _check_same("step, alone and under jax.jit and jax.vmap", following, at(t + 1, n), tolerance)


def _check_reward(env: Env, played: dict[str, NDArray], valid: NDArray, tolerance: float) -> None:
    achieved, desired = played["achieved_goal"], played["desired_goal"]
    reward = jax.jit(env.compute_reward)
    batched = np.asarray(reward(achieved, desired))
    single = np.asarray(jax.jit(jax.vmap(jax.vmap(env.compute_reward)))(achieved, desired))
    differs = lambda a, b: np.abs(a - b) > tolerance * np.maximum(1.0, np.abs(b))  # noqa: E731
    if differs(batched, single).any():
        raise EnvError("compute_reward of many goals must be that of each; it depends on the others")
    later = valid[1:]
    wrong = differs(batched, played["reward"])[1:] & later
    if wrong.any():
        t, n = np.argwhere(wrong)[0]
        raise EnvError(
            f"step must give compute_reward(achieved_goal, desired_goal) of the state it leads to, {batched[t + 1, n]:g};"
            f" it gave {played['reward'][t + 1, n]:g}"
        )
    rewards = batched[1:][later]
    if rewards.min() < -1.0 or rewards.max() > 0.0:
        raise EnvError(
            f"rewards must lie in [-1, 0], as the learner's targets do; they reach from {rewards.min():g} to {rewards.max():g}"
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
