"""The physics engines, one file each, and `make_engine`."""

import importlib.util
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import mujoco

from mjx_dher.envs.engines.base import Controls, Engine, Physics, check_state
from mjx_dher.lookup import check_name, missing_extra
from mjx_dher.spec import ENGINES

__all__ = ["Controls", "Engine", "Physics", "make_engine", "resolve_engine"]


def resolve_engine(name: str) -> str:
    """Resolves `auto`: native on a CPU, warp on a GPU if warp-lang is there, else jax. Raises ValueError for another `name`."""
    check_name("engine", name, ENGINES)
    if name != "auto":
        return name
    import jax

    if jax.default_backend() == "cpu":
        return "native"
    return "warp" if _has_warp() else "jax"


def _has_warp() -> bool:
    return importlib.util.find_spec("warp") is not None


def make_engine(name: str, model: mujoco.MjModel, substeps: int, varied: Sequence[str] = (), **options: Any) -> Engine:
    """Makes an engine that advances `model` by `substeps` timesteps per call.

    `native` supports any model without sleeping bodies, `jax` any that MJX supports, and `warp` any whose features its kernels
    support.

    Args:
      name: "native", "jax", "warp" or "auto".
      substeps: MuJoCo timesteps per environment step.
      varied: numbers of the model that differ between environments, such as "mass:box" (`variation.Variation`).
      **options: for native `num_threads`; for jax `iterations` and `ls_iterations` of the constraint solver; for warp these
        two, `constraints` (memory for rows) and `allow_cpu`.

    Raises:
      ValueError: there is no such engine or option, or the engine does not support the model or this machine.
    """
    for option in options:
        check_name(f"option of engine {resolve_engine(name)}", option, engine_options(name))
    check_state(model)
    return _constructor(name)(model, substeps=substeps, varied=varied, **options)


def engine_options(name: str) -> list[str]:
    """Names of an engine's options. Raises ValueError like `make_engine`."""
    inner = {"model", "substeps", "derived", "sensors", "varied"}
    return sorted(set(inspect.signature(_constructor(name)).parameters) - inner)


def _constructor(name: str) -> Callable[..., Engine]:
    name = resolve_engine(name)
    constructor: Callable[..., Engine]
    if name == "native":
        from mjx_dher.envs.engines.native import Simulator as constructor
    elif name == "warp":
        if not _has_warp():
            raise ValueError(missing_extra("engine warp", "warp-lang", "cuda"))
        from mjx_dher.envs.engines.warp import WarpEngine as constructor
    else:
        from mjx_dher.envs.engines.mjx import MjxEngine as constructor
    return constructor
