"""Contract of an environment: its spec, and checks of the states from `reset` and `step`. Runs no environment."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher.config import plain
from mjx_dher.types import Env, EnvSpec, Episode, check_size
from mjx_dher.validation import check_number

STEP_SECONDS = 0.04  # s, of an environment without `dt`
FLAGS = ("failed", "done", "terminal")  # optional fields of a state, [] bool


def env_spec(env: Env) -> EnvSpec:
    """Spec of an environment: its `spec`, or one derived from its attributes and arrays. The environment is traced, not run.
    Raises ValueError if `env` is not an environment, or its spec disagrees with its arrays. The message names the field.
    """
    return spec_and_template(env)[0]


def spec_and_template(env: Env) -> tuple[EnvSpec, Episode]:
    """`env_spec` and `episode_template`, from one trace of `env`."""
    check_env_parts(env)
    first = jax.eval_shape(env.reset, jax.random.key(0))
    check_first(first, ())
    observation, goal_size = first.obs["observation"], first.obs["achieved_goal"].shape[0]
    sizes = {"goal_size": goal_size, "action_size": env.action_size, "episode_length": env.episode_length}
    own = getattr(env, "spec", None)
    spec = EnvSpec(observation=observation, **sizes) if own is None else own
    if not isinstance(spec, EnvSpec):
        raise ValueError(f"spec of an environment must be an EnvSpec; it is {spec!r}")
    for name, value in {**sizes, "observation": observation}.items():
        given, needed = (jax.tree.map(_say, x) for x in (getattr(spec, name), value))
        if given != needed:
            raise ValueError(f"spec: {name} must be {needed}, as the environment has it; got {given}")
    flags = [name for name in ("done", "terminal") if hasattr(first, name)]
    if flags and not spec.ends:
        raise ValueError(f"spec: ends must be True, because the environment's state has {flags[0]}; got False")
    if spec.ends and not flags and not spec.ends_at_goal:
        raise ValueError("spec: ends must be False if a reset has no done or terminal, unless ends_at_goal; got True")

    def repeat(x: Any, times: int) -> Any:
        return jax.ShapeDtypeStruct((times, *x.shape), x.dtype)

    num_steps = spec.episode_length
    template = Episode(
        observation=jax.tree.map(lambda x: repeat(x, num_steps + 1), first.obs["observation"]),
        achieved_goal=repeat(first.obs["achieved_goal"], num_steps + 1),
        desired_goal=first.obs["desired_goal"],
        action=repeat(jax.ShapeDtypeStruct((env.action_size,), jnp.float32), num_steps),
    )
    return spec, template.filled()


def _say(leaf: Any) -> Any:
    return leaf if hasattr(leaf, "item") or not hasattr(leaf, "shape") else f"{leaf.dtype}{list(leaf.shape)}"


def episode_template(env: Env) -> Episode:
    """Shapes and dtypes of one episode, without running `env`. Raises ValueError if `env` is not an environment."""
    return spec_and_template(env)[1]


def check_env_parts(env: Any) -> None:
    """Raises ValueError unless `env` has the methods and the two sizes of an `Env`."""
    if isinstance(env, type):
        raise ValueError(f"an environment is an object, not a class: {env.__name__}(...) instead of {env.__name__}")
    for name in ("reset", "step", "compute_reward"):
        if not callable(getattr(env, name, None)):
            raise ValueError(f"an environment has reset, step and compute_reward; {env!r} has no {name}")
    for name in ("action_size", "episode_length"):
        check_size(name, getattr(env, name, None))
    step_seconds(env)


def step_seconds(env: Any) -> float:
    """Seconds per step of `env`: its `dt`, or 0.04. Raises ValueError if `dt` is out of range."""
    dt = plain(getattr(env, "dt", STEP_SECONDS))
    check_number("dt", dt, "(0, 3600]", float)
    return float(dt)


def robot_interface(env: Any) -> dict[str, Any]:
    """Seconds per step, and a task's controls and observation layout, as JSON."""
    return {"dt": round(step_seconds(env), 9), **getattr(env, "robot_interface", {})}


def check_first(state: Any, leading: tuple[int, ...]) -> None:
    """Raises ValueError unless a state from `reset`, or its shapes, has the fields of `EnvState` after the axes `leading`."""
    for name in ("obs", "reward", "success"):
        if not hasattr(state, name):
            raise ValueError(f"reset must give a state with obs, reward and success; this {type(state).__name__} has no {name}")
    for name in ("observation", "achieved_goal", "desired_goal"):
        if not isinstance(state.obs, Mapping) or name not in state.obs:
            raise ValueError(f"reset: obs must be a dict of observation, achieved_goal and desired_goal; it has no {name}")
    for name in ("reward", "success", *(flag for flag in FLAGS if hasattr(state, flag))):
        value = getattr(state, name)
        if not hasattr(value, "shape"):
            raise ValueError(f"reset: {name} must be a scalar, []; it is a {type(value).__name__}")
        if value.shape != leading:
            raise ValueError(f"reset: {name} must be a scalar, []; it has shape {value.shape[len(leading) :]}")
        if name in FLAGS and value.dtype != bool:
            raise ValueError(f"reset: {name} must be bool; it is {value.dtype}")
        if jnp.issubdtype(value.dtype, jnp.complexfloating):
            raise ValueError(f"reset: {name} must be a real number; it is {value.dtype}")
    achieved, desired = (jnp.shape(state.obs[name])[len(leading) :] for name in ("achieved_goal", "desired_goal"))
    if len(achieved) != 1 or achieved != desired:
        raise ValueError(f"reset: achieved_goal and desired_goal must be vectors [G]; they are {achieved} and {desired}")
    leaves = jax.tree.leaves(state.obs["observation"])
    if not leaves or any(0 in jnp.shape(leaf) for leaf in leaves):
        raise ValueError(f"reset: observation must have at least one array, and none that is empty; it is {leaves}")


def check_with_goal(env: Any) -> None:
    """Raises ValueError if the environment's goals cannot be set."""
    if not callable(getattr(env, "with_goal", None)):
        raise ValueError(f"a goal generator needs an environment with with_goal(state, goal) -> state; {env!r} has none")


def check_steps(env: Env) -> None:
    """Calls `env.check()` if it exists. It raises ValueError if steps so far were silently wrong."""
    if (check := getattr(env, "check", None)) is not None:
        check()
