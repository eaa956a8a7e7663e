"""A conformance test for environments: it tries everything that the library relies on."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import check, context, contract, rollout
from mjx_dher.testing.trial import TOLERANCE, attempt, expect
from mjx_dher.types import Env, EnvSpec

GOALS = ("achieved_goal", "desired_goal")
STARTS = 8  # episodes in a batch


def check_env(env: Env, seed: int = 0, tolerance: float = TOLERANCE) -> None:
    """Plays `env` with random actions and raises at the first violation of `types.Env`.

    - The spec agrees with the arrays (`contract.env_spec`). States keep structure, shapes and dtypes, as `lax.scan` requires.
    - Observations are float32 or uint8. Goals [G], reward [] and success [] are float32. All are finite; success is 0 or 1.
    - `reset` and `step` are pure: the same arguments give the same results, alone and under `jax.jit` and `jax.vmap`, and stay
      unchanged.
    - Starts or goals differ from key to key, and the goal is constant in an episode.
    - Actions outside [-1, 1] are accepted.
    - `compute_reward`, and `reached` and `goal_distance` if present, take any leading axes. `step` gives the same reward. It
      lies in the spec's `reward_range`, and it is greatest for a goal that is achieved exactly.
    - If all rewards are at an end of the range, success is never 1 at the low end, and not 0 at every reward of the high end.
      They need not agree at each step: an environment may require more for a success, such as rest.
    - An episode has one step or more. With `EnvSpec.ends`, states after its end are ignored, as are those with `failed`.
    - `with_goal`, if present, gives a first state another desired goal, which it keeps, and changes nothing else.

    Args:
      env: the environment. Its method `check()`, if present, is called at the end.
      seed: seed of starts, goals and actions.
      tolerance: largest difference between results that should be equal, relative to the larger of 1 and the value.

    Raises:
      ComponentError: names the first violation and what is expected.
    """
    spec: EnvSpec = attempt("reset", contract.env_spec, env)
    reset_key, action_key = jax.random.split(jax.random.key(seed))
    keys = jax.random.split(reset_key, STARTS)
    shape = (spec.episode_length, STARTS, spec.action_size)
    actions = jax.random.uniform(action_key, shape, jnp.float32, minval=-1.0, maxval=1.0)
    play = lambda: rollout.rollout(env, lambda action, obs: action, keys, STARTS, actions)  # noqa: E731
    attempt("an episode, traced by jax.jit,", jax.eval_shape, play)  # shapes
    first = _check_single(env, keys[0], actions[0, 0], tolerance)
    _check_goal_functions(env, spec.goal_size)
    states = _play(env, keys, actions)
    played = jax.device_get(_outputs(states))  # [T+1, N, ...]
    valid = _check_episodes(env, spec, played)
    _check_against_play(env, keys, actions, states, tolerance)
    _check_with_goal(env, keys, tolerance)
    beyond = "step with an action of +-3"
    _check_state(attempt(beyond, env.step, first, 3.0 * jnp.sign(actions[0, 0])), beyond)
    _check_reward(env, spec, played, valid, tolerance)
    contract.check_steps(env)


def _outputs(state: Any) -> dict[str, Any]:
    """The arrays of a state that the library reads, by name; each leaf of the observation has its own."""
    flags = {name: getattr(state, name) for name in contract.FLAGS if hasattr(state, name)}
    obs = {name: state.obs[name] for name in ("observation", *GOALS)}
    named = {**obs, "reward": state.reward, "success": state.success, **flags}
    paths = {name: jax.tree_util.tree_leaves_with_path(value) for name, value in named.items()}
    return {name + jax.tree_util.keystr(path): leaf for name, leaves in paths.items() for path, leaf in leaves}


def _check_state(state: Any, source: str) -> None:
    """Checks dtypes and values of a state that `source` returned."""
    for name, value in _outputs(state).items():
        if name not in contract.FLAGS:
            allowed = ("float32", "uint8") if name.startswith("observation") else ("float32",)
            dtype = str(jnp.result_type(value))
            expect(dtype in allowed, f"{source}: {name} must be {' or '.join(allowed)}; it is {dtype}")
        expect(np.all(np.isfinite(value)), f"{source}: {name} must be finite; it is {np.asarray(value)}")
    expect(float(state.success) in (0.0, 1.0), f"{source}: success must be 0 or 1; it is {float(state.success):g}")


def _check_single(env: Env, key: jax.Array, action: jax.Array, tolerance: float) -> Any:
    """Checks one reset and one step, called twice; returns the first state."""
    first = attempt("reset", env.reset, key)
    _check_state(first, "reset")
    leaves = jax.tree.leaves(first)
    second = attempt("step", env.step, first, action)
    kept = jax.tree.leaves(first)
    unchanged = len(kept) == len(leaves) and all(a is b for a, b in zip(leaves, kept))
    expect(unchanged, "step must return a new state and leave the given state unchanged; it changed it")
    _check_state(second, "step")
    _check_same("reset, called twice with the same key", attempt("reset", env.reset, key), first, tolerance)
    again = attempt("step", env.step, first, action)
    _check_same("step, called twice with the same state and action", again, second, tolerance)
    return first


def _check_goal_functions(env: Any, goal_size: int) -> None:
    def trace(name: str, kind: Any, leading: tuple[int, ...]) -> None:
        goals = jnp.zeros((*leading, goal_size))
        what = f"{name} of goals {list(goals.shape)}"
        attempt(what, jax.eval_shape, lambda a, d: check.array(what, getattr(env, name)(a, d), leading, kind), goals, goals)

    for name, kind in {"compute_reward": jnp.floating, "reached": jnp.bool_, "goal_distance": jnp.floating}.items():
        for leading in ((), (3,), (2, 3)) if hasattr(env, name) else ():
            trace(name, kind, leading)


def _check_same(what: str, state: Any, expected: Any, tolerance: float) -> None:
    actual = _outputs(state)
    for name, value in _outputs(expected).items():
        a, b = np.asarray(actual[name], np.float32), np.asarray(value, np.float32)
        difference = np.abs(a - b)
        same = np.all(difference <= tolerance * np.maximum(1.0, np.abs(b)))
        expect(same, f"{what}, must give the same result; {name} differs by {difference.max():.3g}")


def _play(env: Env, keys: jax.Array, actions: jax.Array) -> Any:
    """Plays N episodes to their maximum length, whether they end or not; their states lead with [T+1, N]."""

    @jax.jit
    def play(keys: jax.Array, actions: jax.Array) -> Any:
        def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
            following = jax.vmap(env.step)(state, action)
            return following, following

        first = jax.vmap(env.reset)(keys)
        _, later = jax.lax.scan(step, first, actions)
        return jax.tree.map(lambda start, rest: jnp.concatenate([start[None], rest]), first, later)

    return attempt("an episode under jax.jit, jax.vmap and lax.scan", play, keys, actions)


def _check_episodes(env: Any, spec: EnvSpec, played: dict[str, NDArray]) -> NDArray:
    """Checks whole episodes; returns which of their states [T+1, N] count."""
    none = np.zeros(played["reward"].shape, bool)
    failed = np.logical_or.accumulate(played.get("failed", none))
    ended = played.get("done", none) | played.get("terminal", none)
    expect(not ended[0].any(), "reset: done and terminal must be False: an episode has one step or more")
    if spec.ends_at_goal:
        reached = np.asarray(context.reached_fn(env)(*(jnp.asarray(played[name]) for name in GOALS)))
        expect(not reached[0].all(), "reset must draw goals that are not reached yet, because reaching one ends the episode")
        ended = ended | reached
    over = np.logical_or.accumulate(np.concatenate([none[:1], ended[:-1]]))
    valid = ~failed & ~over
    expect(not failed[-1].all(), "not every episode of random actions may end with `failed`; all of them did")
    for name, values in played.items():
        fine = np.isfinite(values).all(axis=tuple(range(2, values.ndim))) | ~valid
        step = int(np.argmin(fine.all(axis=1)))
        message = f"{name} must be finite, or `failed` be True; it is not finite after {step} steps of random actions"
        expect(fine.all(), message)
    varied = any(
        np.any(values[0] != values[0, 0]) for name, values in played.items() if name.startswith(("observation", *GOALS))
    )
    expect(varied, f"reset must draw starts or goals with its key; {STARTS} keys gave the same")
    moved = np.any(played["desired_goal"] != played["desired_goal"][0], axis=-1) & valid
    step = int(np.argmax(moved.any(axis=1)))
    expect(not moved.any(), f"desired_goal must be constant in an episode; it changed at step {step}")
    success = played["success"][valid]
    expect(np.isin(success, (0.0, 1.0)).all(), f"success must be 0 or 1; it takes the values {np.unique(success)[:5]}")
    return valid


def _check_against_play(env: Env, keys: jax.Array, actions: jax.Array, states: Any, tolerance: float) -> None:
    """Compares single, uncompiled resets and steps with those of the batch, from the same states."""
    num_steps = actions.shape[0]
    at = lambda t, n: jax.tree.map(lambda x: x[t, n], states)  # noqa: E731
    for n, t in enumerate(sorted({0, num_steps // 2, num_steps - 1})):
        start, following = attempt("reset", env.reset, keys[n]), attempt("step", env.step, at(t, n), actions[t, n])
        _check_same("reset, alone and under jax.jit and jax.vmap", start, at(0, n), tolerance)
        _check_same("step, alone and under jax.jit and jax.vmap", following, at(t + 1, n), tolerance)


def _check_with_goal(env: Any, keys: jax.Array, tolerance: float) -> None:
    if not hasattr(env, "with_goal"):
        return
    first, goal = env.reset(keys[0]), env.reset(keys[1]).obs["desired_goal"]
    changed = attempt("with_goal", env.with_goal, first, goal)
    _check_state(changed, "with_goal")
    following = attempt("step after with_goal", env.step, changed, jnp.zeros(env.action_size))
    for name, state in (("with_goal", changed), ("step after with_goal", following)):
        expect(np.array_equal(state.obs["desired_goal"], goal), f"{name}: desired_goal must be the goal that was handed in")
    before, after = _outputs(first), _outputs(changed)
    for name in before.keys() - {"desired_goal", "reward", "success"}:
        same = np.allclose(after[name], before[name], rtol=tolerance, atol=tolerance)
        expect(same, f"with_goal must change the desired goal alone; it changed {name}")


def _check_reward(env: Env, spec: EnvSpec, played: dict[str, NDArray], valid: NDArray, tolerance: float) -> None:
    achieved, desired = (played[name] for name in GOALS)
    reward = jax.jit(env.compute_reward)
    batched = np.asarray(reward(achieved, desired))
    single = np.asarray(jax.jit(jax.vmap(jax.vmap(env.compute_reward)))(achieved, desired))
    differs = lambda a, b: np.abs(a - b) > tolerance * np.maximum(1.0, np.abs(b))  # noqa: E731
    alone = not differs(batched, single).any()
    expect(alone, "compute_reward of a batch must be that of each of its goals; it depends on the others")
    later = valid[1:]
    wrong = np.argwhere(differs(batched, played["reward"])[1:] & later)
    if len(wrong):
        t, n = wrong[0] + (1, 0)
        right = f"compute_reward(achieved_goal, desired_goal) of the next state, {batched[t, n]:g}"
        expect(False, f"the reward of step must be {right}; it is {played['reward'][t, n]:g}")
    rewards, success = batched[1:][later], played["success"][1:][later]
    low, high = spec.reward_range
    given = f"{rewards.min():g} to {rewards.max():g}"
    inside = rewards.min() >= low and rewards.max() <= high
    expect(inside, f"rewards must lie in reward_range [{low:g}, {high:g}]; they range from {given}")
    better = (np.asarray(reward(achieved, achieved)) < batched)[1:] & later
    expect(not better.any(), "compute_reward must be greatest for a goal that is achieved exactly; another had a greater one")
    if np.isin(rewards, (low, high)).all():
        expect(not success[rewards == low].any(), f"success must be 0 at a sparse reward of {low:g}; it is 1")
        never = (rewards == high).any() and not success.any()
        expect(not never, f"success must be 1 if the goal is reached; it never is, though the reward is {high:g} at some steps")
