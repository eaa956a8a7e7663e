"""Goal-conditioned environments: `make` one by name, `register` your own, `list_envs`."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mjx_dher.config import check_name

if TYPE_CHECKING:
    from mjx_dher.envs.base import GoalEnv, State

__all__ = ["GoalEnv", "State", "list_envs", "make", "register"]

# name -> the constructor, or "module:attribute" where importing it can wait (this module must stay cheap to import)
_REGISTRY: dict[str, Callable[..., Any] | str] = {
    "push": "mjx_dher.envs.push:Push",
    "pick_and_place": "mjx_dher.envs.pick_and_place:PickAndPlace",
    "slide": "mjx_dher.envs.slide:Slide",
    "reach": "mjx_dher.envs.reach:Reach",
}


def list_envs() -> tuple[str, ...]:
    """The names that `make` takes."""
    return tuple(sorted(_REGISTRY))


def register(name: str, constructor: Callable[..., Any] | str) -> None:
    """Makes an environment available to `make` and to the command line.

    Args:
      name: how it will be called.
      constructor: called with the keyword arguments of `make`, it returns a `GoalEnv`; or "module:attribute" naming one.

    Raises:
      ValueError: the name is taken, or `constructor` is neither of the two.
    """
    if name in _REGISTRY:
        raise ValueError(f"environment {name!r} is already registered")
    if not (callable(constructor) or (isinstance(constructor, str) and constructor.count(":") == 1)):
        raise ValueError(f"constructor must be callable or 'module:attribute'; got {constructor!r}")
    _REGISTRY[name] = constructor


def make(name: str, engine: str = "auto", **overrides: Any) -> GoalEnv:
    """The environment called `name`.

    Args:
      name: one of `list_envs()`.
      engine: "native" (MuJoCo C on the host's cores), "jax" (MJX) or "auto" (native on CPU, else jax).
      **overrides: arguments of the environment's constructor, such as `episode_length` or `reward_type`.

    Raises:
      ValueError: no such environment or engine (the message names the nearest), or an argument out of range.
    """
    check_name("env", name, list_envs())
    constructor = _REGISTRY[name]
    if isinstance(constructor, str):
        module, attribute = constructor.split(":")
        constructor = getattr(importlib.import_module(module), attribute)
    return constructor(engine=engine, **overrides)


def __getattr__(name: str) -> Any:
    if name in ("GoalEnv", "State"):
        return getattr(importlib.import_module("mjx_dher.envs.base"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
