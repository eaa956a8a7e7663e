"""Conformance test for environments, which tests everything that the library relies on."""

import dataclasses
import functools
import json
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import check, context, contract, mirror, rollout
from mjx_dher.testing.trial import TOLERANCE, attempt, compiled, expect, expect_range, expect_same, run
from mjx_dher.types import Env, EnvSpec

GOALS = ("achieved_goal", "desired_goal")
DERIVED = ("reward", "success")  # other fields that a goal may change
STARTS = 8  # episodes in a batch


def check_env(env: Env, seed: int = 0, tolerance: float = TOLERANCE) -> None:
    """Plays compiled episodes of random actions, and raises an error at the first violation of `types.Env`.

    - The spec agrees with the arrays (`contract.env_spec`). States keep structure, shapes and dtypes, as `lax.scan` requires.
    - Observations are float32 or uint8. Goals [G], reward [] and success [] are float32. All are finite, and success is 0 or
      1.
    - `reset` and `step` are pure. Traced or called twice, alone and under `jax.vmap`, equal arguments give equal results and
      stay unchanged.
    - Starts or goals differ between keys, and the goal is constant in an episode.
    - Actions outside [-1, 1] are accepted. Observations do not depend on the desired goal.
    - `compute_reward`, and `reached` and `goal_distance` if present, take any leading axes and are pure. `step` gives the same
      reward. Rewards of desired and of achieved goals lie in the spec's `reward_range`. An exactly achieved goal has the
      greatest reward and is reached. Distances are not negative.
    - If all rewards are at an end of the range, success is never 1 at the low end, and not always 0 at the high end. They need
      not agree at each step, because an environment may require more for a success, such as rest.
    - An episode has at least one step. States after its end (`EnvSpec.ends`) and states with `failed` are ignored.
    - `mirror`, if present, keeps shapes, types and the rewards of goals. A mirror image of a mirror image is the original, and
      observations that contain the achieved goal do so in the image. Whether the physics follows its image is not tested.
    - `with_goal`, if present, sets another desired goal, which the state keeps, and changes nothing else. A step to a state
      that reaches it differs only in reward and success: `terminal` holds for every goal, and observations do not have it.

    Args:
      env: the environment. Its `describe()` and `check()`, if present, are called at the end.
      seed: seed of starts, goals and actions.
      tolerance: largest difference between results that should be equal, relative to the larger of 1 and the value.

    Raises:
      ComponentError: names the first violation and the expectation.
    """
    spec: EnvSpec = attempt("reset", contract.env_spec, env)
    keys, actions = _draw(jax.random.key(seed), (spec.episode_length, STARTS, spec.action_size))
    play = lambda: rollout.rollout(env, lambda action, obs: action, keys, STARTS, actions)  # noqa: E731
    _check_goal_functions(env, spec.goal_size)
    attempt("an episode, traced by jax.jit,", jax.eval_shape, play)  # shapes
    states = jax.device_get(_play(env, keys, actions))  # [T+1, N, ...]
    played = _outputs(states)
    valid = _check_episodes(env, spec, played)
    actions = jax.device_get(actions)
    _check_mirror(env, jax.tree.map(lambda x: x[:-1], states.obs), actions, valid[:-1], tolerance)
    _check_alone(env, keys, actions, states, tolerance)
    if not callable(getattr(env, "with_goal", None)):
        _check_without_goal(states.obs, valid, tolerance)
    _check_rewards(env, spec, played, valid, tolerance)
    described = attempt("describe", contract.robot_interface, env)
    attempt("describe, whose entries must be JSON,", functools.partial(json.dumps, allow_nan=False), described)
    attempt("check", contract.check_steps, env)


@functools.partial(jax.jit, static_argnums=1)
def _draw(key: jax.Array, shape: tuple[int, int, int]) -> tuple[jax.Array, jax.Array]:
    """Keys of starts [N], and actions of `shape` [T, N, A]."""
    reset_key, action_key = jax.random.split(key)
    actions = jax.random.uniform(action_key, shape, jnp.float32, minval=-1.0, maxval=1.0)
    return jax.random.split(reset_key, shape[1]), actions


def _outputs(state: Any) -> dict[str, Any]:
    """Named arrays of a state that the library reads, with one entry per leaf of the observation."""
    flags = {name: getattr(state, name) for name in contract.FLAGS if hasattr(state, name)}
    obs = {name: state.obs[name] for name in ("observation", *GOALS)}
    named = {**obs, "reward": state.reward, "success": state.success, **flags}
    paths = {name: jax.tree_util.tree_leaves_with_path(value) for name, value in named.items()}
    return {name + jax.tree_util.keystr(path): leaf for name, leaves in paths.items() for path, leaf in leaves}


def _check_goal_functions(env: Any, goal_size: int) -> None:
    def trace(name: str, kind: Any, leading: tuple[int, ...]) -> None:
        goals = jax.ShapeDtypeStruct((*leading, goal_size), jnp.float32)
        what = f"{name} of goals {list(goals.shape)}"
        attempt(what, jax.eval_shape, lambda a, d: check.array(what, getattr(env, name)(a, d), leading, kind), goals, goals)

    for name, kind in {"reached": jnp.bool_, "goal_distance": jnp.floating, "compute_reward": jnp.floating}.items():
        for leading in ((), (3,), (2, 3)) if hasattr(env, name) else ():
            trace(name, kind, leading)


def _play(env: Env, keys: jax.Array, actions: jax.Array) -> Any:
    """Plays N episodes to their maximum length, even if they end. The states lead with [T+1, N]."""

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
    """Checks whole episodes. Returns a mask [T+1, N] of the states that count."""
    for name, values in played.items():
        allowed = ("float32", "uint8") if name.startswith("observation") else ("float32",)
        fits = name in contract.FLAGS or values.dtype in allowed
        expect(fits, f"reset: {name} must be {' or '.join(allowed)}; it is {values.dtype}")
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
    fastest = f", or joints be faster than max_speed, {env.max_speed:g}" if hasattr(env, "max_speed") else ""
    why = f": starts or inputs may have NaN or infinite numbers{fastest}"
    expect(not failed[-1].all(), f"not every episode of random actions may end with `failed`; all of them did{why}")
    for name, values in played.items():
        fine = np.isfinite(values).all(axis=tuple(range(2, values.ndim))) | ~valid
        step = int(np.argmin(fine.all(axis=1)))
        message = f"{name} must be finite, or `failed` be True; it is not finite after {step} steps of random actions"
        expect(fine.all(), message)
    names = [name for name in played if name.startswith(("observation", *GOALS))]
    varied = any(np.any(played[name][0] != played[name][0, 0]) for name in names)
    expect(varied, f"reset must draw starts or goals with its key; {STARTS} keys gave the same")
    moved = np.any(played["desired_goal"] != played["desired_goal"][0], axis=-1) & valid
    step = int(np.argmax(moved.any(axis=1)))
    expect(not moved.any(), f"desired_goal must be constant in an episode; it changed at step {step}")
    success = played["success"][valid]
    expect(np.isin(success, (0.0, 1.0)).all(), f"success must be 0 or 1; it takes the values {np.unique(success)[:5]}")
    return valid


def _check_alone(env: Any, keys: jax.Array, actions: jax.Array, states: Any, tolerance: float) -> None:
    """Compares single resets and steps with the batch's, from the same states. Also sets goals and acts out of bounds."""

    def alone(key: jax.Array, state: Any, action: jax.Array) -> Any:
        before = jax.tree.leaves(state)
        following = env.step(state, action)
        after = jax.tree.leaves(state)
        unchanged = len(before) == len(after) and all(a is b for a, b in zip(before, after))
        expect(unchanged, "step must return a new state and leave the given state unchanged; it changed it")
        return {"reset": _outputs(env.reset(key)), "step": _outputs(following)}

    at = lambda t, n: jax.tree.map(lambda x: x[t, n], states)  # noqa: E731
    program = compiled("reset and step", alone, keys[0], at(0, 0), actions[0, 0], tolerance=tolerance)
    num_steps = actions.shape[0]
    for n, t in enumerate(sorted({0, num_steps // 2, num_steps - 1})):
        batch = {"reset": _outputs(at(0, n)), "step": _outputs(at(t + 1, n))}
        what = "reset and step, alone and under jax.vmap,"
        expect_same(what, program(keys[n], at(t, n), actions[t, n]), batch, tolerance)
    beyond = program(keys[0], at(0, 0), 3.0 * np.sign(actions[0, 0]))["step"]
    for name, value in beyond.items():
        expect(np.all(np.isfinite(value)), f"step with an action of +-3: {name} must be finite; it is {value}")
    if not callable(getattr(env, "with_goal", None)):
        following = lambda state: program(keys[0], state, actions[0, 0])["step"]  # noqa: E731
        _check_goal_is_apart(following, at(0, 0), states.obs["achieved_goal"][1, 0], tolerance)
        return
    first, goals = jax.tree.map(lambda x: x[0], states), states.obs["achieved_goal"][1]  # reached after the first step
    changed = run("with_goal", jax.vmap(env.with_goal), first, goals)
    attempt("with_goal", check.kept, "with_goal", first, changed, 1)
    following = program(keys[0], jax.tree.map(lambda x: x[0], changed), actions[0, 0])["step"]
    for what, given, result, goal, allowed in (
        ("with_goal, which changes the desired goal alone,", first, _outputs(changed), goals, 0.0),
        ("step after with_goal, but for reward and success,", at(1, 0), following, goals[0], tolerance),
    ):
        own = {name: value for name, value in {**_outputs(given), "desired_goal": goal}.items() if name not in DERIVED}
        expect_same(what, {name: result[name] for name in own}, own, allowed)


def _check_goal_is_apart(step: Callable[[Any], dict[str, Any]], state: Any, goal: jax.Array, tolerance: float) -> None:
    """Checks that the observation of the next state stays the same with another desired goal [G]."""
    obs, fields = state.obs, dataclasses.is_dataclass(state)
    if not fields or type(obs) is not dict:
        return
    other = dataclasses.replace(state, obs={**obs, "desired_goal": goal})
    own, changed = step(state), step(other)
    for name in (name for name in own if name.startswith("observation")):
        same = np.allclose(own[name], changed[name], rtol=tolerance, atol=tolerance, equal_nan=True)
        expect(same, f"{name} must not depend on the desired goal, because relabelling replaces the goal alone; it does")


def _check_without_goal(obs: Any, valid: NDArray, tolerance: float) -> None:
    """Checks that observations of the states in the mask `valid` [T+1, N] have no goal that the state keeps elsewhere, too."""
    observation, achieved, desired = (jax.tree.map(lambda x: x[valid], obs[name]) for name in ("observation", *GOALS))
    if not np.ptp(desired, axis=0).any():
        return
    parts = {"desired_goal": desired, "desired_goal - achieved_goal": desired - achieved}
    for what, part in {**parts, "achieved_goal - desired_goal": achieved - desired}.items():
        places = _places(observation, part, tolerance)
        where = f"observation[{min(places, default=0)}:{min(places, default=0) + part.shape[1]}]"
        expect(not places, f"{where} must not be {what}, because relabelling replaces the goal alone; in every state, it is")


def _check_mirror(env: Any, obs: Any, actions: NDArray, valid: NDArray, tolerance: float) -> None:
    """Checks mirror images of the states in the mask `valid` [T, N]. `obs` and `actions` lead with [T, N], too."""
    try:
        mirror.own(env)
    except AttributeError:
        return
    observation, achieved, desired = (jax.tree.map(lambda x: x[valid], obs[name]) for name in ("observation", *GOALS))
    named = lambda parts: dict(zip(mirror.PARTS, parts))  # noqa: E731

    def twice(*given: Any) -> tuple[Any, Any]:
        image = mirror.of_parts(env.mirror, *given, leading=1)
        return image, env.mirror(*image)

    image, again = run("mirror", twice, observation, desired, actions[valid])
    expect_same("mirror of a mirror image", named(again), named((observation, desired, actions[valid])), tolerance)
    other, _ = run("mirror", twice, observation, achieved, actions[valid])
    rewards = [run("compute_reward", env.compute_reward, *pair) for pair in ((achieved, desired), (other[1], image[1]))]
    expect_same("compute_reward of mirrored goals", rewards[1], rewards[0], tolerance)
    lost = _places(observation, achieved, tolerance) - _places(other[0], other[1], tolerance)
    if lost and np.ptp(achieved, axis=0).any():
        where = f"[{min(lost)}:{min(lost) + achieved.shape[1]}]"
        expect(
            False, f"mirror must move observation and goal alike; observation{where} is the achieved goal, but not in the image"
        )


def _places(observation: Any, goal: NDArray, tolerance: float) -> set[int]:
    """First indices, in the observation's vectors, of G numbers that equal the goal [N, G] in all states."""
    vectors = [leaf for leaf in map(np.asarray, jax.tree.leaves(observation)) if leaf.ndim == 2]
    flat = np.concatenate([np.zeros((len(goal), 0)), *vectors], axis=1)
    if flat.shape[1] < goal.shape[1]:
        return set()
    windows = np.lib.stride_tricks.sliding_window_view(flat, goal.shape[1], axis=1)  # [N, D - G + 1, G]
    same = np.isclose(windows, goal[:, None], rtol=tolerance, atol=tolerance).all(axis=(0, 2))
    return set(np.flatnonzero(same).tolist())


def _check_rewards(env: Any, spec: EnvSpec, played: dict[str, NDArray], valid: NDArray, tolerance: float) -> None:
    """Checks the goal functions on the goals of the states in the mask `valid` [T+1, N]."""
    achieved, desired = (played[name] for name in GOALS)

    def ask(achieved: jax.Array, desired: jax.Array) -> dict[str, Any]:
        pairs = {"desired": (achieved, desired), "own": (achieved, achieved), "other": (achieved, achieved[::-1])}
        each = jax.vmap(jax.vmap(env.compute_reward))(achieved, desired)
        names = [name for name in ("compute_reward", "reached", "goal_distance") if hasattr(env, name)]
        return {"each": each, **{name: {key: getattr(env, name)(*pair) for key, pair in pairs.items()} for name in names}}

    told = jax.device_get(run("compute_reward", ask, achieved, desired))
    counted = {"desired": valid, "own": valid, "other": valid & valid[::-1]}
    rewards = told["compute_reward"]
    differs = lambda a, b: np.abs(a - b) > tolerance * np.maximum(1.0, np.abs(b))  # noqa: E731
    alone = not differs(rewards["desired"], told["each"])[valid].any()
    expect(alone, "compute_reward of a batch must be that of each of its goals; it depends on the others")
    later = np.concatenate([np.zeros_like(valid[:1]), valid[1:]])
    wrong = np.argwhere(differs(rewards["desired"], played["reward"]) & later)
    if len(wrong):
        at = tuple(wrong[0])
        right = f"compute_reward(achieved_goal, desired_goal) of the next state, {rewards['desired'][at]:g}"
        expect(False, f"the reward of step must be {right}; it is {played['reward'][at]:g}")
    of_pairs = np.concatenate([rewards[pair][mask] for pair, mask in counted.items()])
    _check_range(spec.reward_range, of_pairs)
    if not np.ptp(of_pairs):
        warnings.warn(
            f"compute_reward is {of_pairs[0] + 0.0:g} for all goals of random episodes: hindsight teaches nothing", stacklevel=2
        )
    better = (rewards["own"] < rewards["desired"])[valid]
    expect(not better.any(), "compute_reward must be greatest for a goal that is achieved exactly; another had a greater one")
    if np.isin(of_pairs, spec.reward_range).all():
        highest = (rewards["own"][valid] == spec.reward_range[1]).all()
        expect(highest, f"a sparse reward must be {spec.reward_range[1]:g} for a goal that is achieved exactly; it is not")
        _check_success(spec.reward_range, rewards["desired"][later], played["success"][later])
    if "reached" in told:
        expect(told["reached"]["own"][valid].all(), "reached must be True for a goal that is achieved exactly")
    for pair, distance in told.get("goal_distance", {}).items():
        expect_range("goal_distance", distance[counted[pair]])


def _check_range(reward_range: tuple[float, float], rewards: NDArray) -> None:
    low, high = reward_range
    least, greatest = rewards.min() + 0.0, rewards.max() + 0.0  # NaN if one is; not -0
    is_sparse = len(np.unique(rewards)) == 2
    declared = f"({least:g}, {greatest:g})" if is_sparse else "(low, high), bounds that hold everywhere, or scale the reward"
    where = f"reward_range [{low:g}, {high:g}]"
    cure = f"give the environment a `spec` (types.EnvSpec) with reward_range={declared}"
    fits = least >= low and greatest <= high
    expect(fits, f"rewards must lie in {where}; they range from {least:g} to {greatest:g}: {cure}")


def _check_success(reward_range: tuple[float, float], rewards: NDArray, success: NDArray) -> None:
    """Checks success against sparse rewards."""
    low, high = reward_range
    expect(not success[rewards == low].any(), f"success must be 0 at a sparse reward of {low:g}; it is 1")
    never = (rewards == high).any() and not success.any()
    expect(not never, f"success must be 1 if the goal is reached; it never is, though the reward is {high:g} at some steps")
