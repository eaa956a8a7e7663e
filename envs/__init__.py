"""Goal-conditioned environments: `make`, `list_envs`, and `Simulator` for any MuJoCo model."""

import functools
import importlib
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mjx_dher.components import COMPONENTS, load
from mjx_dher.lookup import check_name

if TYPE_CHECKING:
    from mjx_dher.envs.base import GoalEnv, State
    from mjx_dher.envs.engines.native import Simulator

__all__ = ["GoalEnv", "Simulator", "State", "list_envs", "make"]


def list_envs() -> tuple[str, ...]:
    """Names of the built-in environments."""
    return tuple(sorted(COMPONENTS["env"]))


def make(name: str, /, engine: str = "auto", **overrides: Any) -> "GoalEnv":
    """Makes an environment.

    Args:
      name: a name from `list_envs()`, or the "module:attribute" of a class or function that makes an environment.
      engine: "native" (MuJoCo C on the host's cores), "warp" (a kernel for NVIDIA GPUs), "jax" (MJX) or "auto" (native on a
        CPU, warp on an NVIDIA GPU, else jax). It is passed on if the constructor has this argument.
      **overrides: arguments of the constructor, such as `episode_length` or `reward_type`, and of wrappers: `action_filter`,
        `action_delay`, `obs_noise` and `frame_stack` (`envs.wrappers`).

    Raises:
      ValueError: the environment, module, attribute or engine does not exist (the message suggests the nearest), an argument
        is out of range, the constructor takes no engine, or its result is not an environment.
    """
    constructor = load("env", name)
    _check_kind(name, constructor)
    own = inspect.signature(constructor).parameters  # the constructor's arguments take precedence
    wrapped = {key: overrides.pop(key) for key in _WRAPPERS if key in overrides and key not in own}
    if takes_engine(constructor):
        overrides["engine"] = engine
    elif engine != "auto":
        raise ValueError(f"engine must be auto for env {name!r}, which takes no engine; got {engine!r}")
    _check_arguments(name, constructor, overrides)
    try:
        env = constructor(**overrides)
    except ValueError:
        raise
    except (Exception, SystemExit) as error:
        kind = "" if isinstance(error, TypeError) else f"{type(error).__name__}: "
        raise ValueError(f"env {name!r} cannot be made: {kind}{error}") from error
    _check_members(name, env, ("action_size", "episode_length", *_METHODS))
    for key, value in wrapped.items():
        env = getattr(importlib.import_module("mjx_dher.envs.wrappers"), _WRAPPERS[key])(env, value)
    return env


def _check_kind(name: str, constructor: Any) -> None:
    """Raises ValueError unless it is a Python function, or a class with an environment's methods. Calls nothing."""
    if inspect.isclass(constructor):
        _check_members(name, constructor, _METHODS)
    elif not (inspect.isfunction(constructor) or isinstance(constructor, functools.partial)):
        raise ValueError(f"env {name!r} must be a class or Python function that makes an environment; it is {constructor!r}")


def _check_members(name: str, env: Any, members: tuple[str, ...]) -> None:
    if missing := [member for member in members if not hasattr(env, member)]:
        raise ValueError(f"env {name!r} is not an environment: it has no {', '.join(missing)} (see mjx_dher.types.Env)")


def _check_arguments(name: str, constructor: Callable[..., Any], overrides: dict[str, Any]) -> None:
    """Raises ValueError for an argument that neither the constructor nor its engine takes. The message lists the valid ones."""
    parameters = inspect.signature(constructor).parameters
    named = [
        key for key, parameter in parameters.items() if parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
    ]
    if len(named) < len(parameters):  # **options go to the engine
        if name not in COMPONENTS["env"] and "engine_options" not in parameters:
            return
        from mjx_dher.envs.engines import engine_options

        named += [key for key in engine_options(overrides["engine"]) if key not in named]
    for key in overrides:
        check_name(f"argument of env {name}", key, [*named, *_WRAPPERS])


_METHODS = ("reset", "step", "compute_reward")  # of types.Env
# Wrappers by argument, the innermost first.
_WRAPPERS = {
    "action_filter": "ActionFilter",
    "action_delay": "ActionDelay",
    "obs_noise": "ObservationNoise",
    "frame_stack": "FrameStack",
}


def takes_engine(env: str | Callable[..., Any]) -> bool:
    """Whether the constructor of an environment, or of the one of this name, has the argument `engine`."""
    constructor = load("env", env)
    parameters = inspect.signature(constructor).parameters
    if "engine" in parameters or not any(one.kind is one.VAR_KEYWORD for one in parameters.values()):
        return "engine" in parameters
    bases = constructor.__mro__[1:-1] if inspect.isclass(constructor) else ()  # to which a class passes its **options
    return not bases or any("engine" in inspect.signature(base).parameters for base in bases)


def __getattr__(name: str) -> Any:
    if name in ("GoalEnv", "State"):
        return getattr(importlib.import_module("mjx_dher.envs.base"), name)
    if name == "Simulator":
        return importlib.import_module("mjx_dher.envs.engines.native").Simulator
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
