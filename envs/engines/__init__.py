"""The physics engines, one file each, their interface, and `make_engine`."""

import importlib.util
import inspect
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax.numpy as jnp
import mujoco
from flax import struct

from mjx_dher.lookup import check_name, missing_extra
from mjx_dher.spec import ENGINES
from mjx_dher.types import Array


@struct.dataclass
class Physics:
    """State of a simulation between two steps, in MuJoCo's layout."""

    qpos: Array  # [nq]
    qvel: Array  # [nv]
    warmstart: Array  # [nv] first guess of the constraint solver (qacc_warmstart)
    act: Array  # [na] activations of actuators
    # [nsensordata] in the state of a task that observes sensors, else None. Engines ignore it and return None.
    sensors: Array | None = None
    factors: Array | None = None  # [number of `varied`] by which the model's numbers are multiplied; None for 1


@struct.dataclass
class Controls:
    """Inputs that are held during an environment step."""

    ctrl: Array  # [nu]
    mocap: Array  # [nmocap, 7] poses of mocap bodies: position, m, and orientation (w, x, y, z)


class Engine(Protocol):
    """Physics engine that advances one simulation by one environment step. `jax.vmap` makes a batch."""

    name: str

    def advance(self, physics: Physics, controls: Controls) -> Physics:
        """Physics one environment step later."""

    def check(self) -> None:
        """Raises ValueError if earlier steps were wrong in a way that their results do not show."""


class Unvaried:
    """A `variation.Variation` of nothing."""

    size = 0
    fields = ()

    def factors(self, given: Any, xp: Any) -> Any:
        """No factors, [0]."""
        return xp.ones(0, "float32")


def variation_of(model: mujoco.MjModel, names: Sequence[str]) -> Any:
    """`variation.Variation` of a model. Raises ValueError if it is invalid."""
    if isinstance(names, (list, tuple)) and not names:
        return Unvaried()
    from mjx_dher.envs.engines.variation import Variation

    return Variation(model, names)


def check_state(model: mujoco.MjModel) -> None:
    """Raises ValueError if the model has state that `Physics` does not contain."""
    if model.nhistory or model.npluginstate:
        raise ValueError("the model has delays or plugins, whose state `Physics` does not hold; use mjx_dher.envs.Simulator")
    if model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        raise ValueError('the model has sleeping bodies, whose state `Physics` does not hold; remove <flag sleep="enable"/>')


def check_shapes(model: mujoco.MjModel, physics: Physics, controls: Controls, varied: int = 0) -> None:
    """Raises ValueError if an array does not have the model's shape, or the model has more state than `Physics`."""
    check_state(model)
    for values, shapes in (
        (physics, {"qpos": (model.nq,), "qvel": (model.nv,), "warmstart": (model.nv,), "act": (model.na,)}),
        (controls, {"ctrl": (model.nu,), "mocap": (model.nmocap, 7)}),
    ):
        for name, shape in shapes.items():
            check_shape(name, getattr(values, name), shape)
    if physics.factors is not None:
        check_shape("factors", physics.factors, (varied,))


def check_shape(name: str, value: Array, shape: tuple[int, ...]) -> None:
    """Raises ValueError if the array called `name` does not have this shape."""
    if jnp.shape(value) != shape:
        raise ValueError(f"{name} has shape {list(jnp.shape(value))}; the model's is {list(shape)} (use jax.vmap for a batch)")


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

    `native` takes any model without sleeping bodies, `jax` any that MJX supports, `warp` any that its kernels support.

    Args:
      name: "native", "jax", "warp" or "auto".
      substeps: MuJoCo timesteps per environment step.
      varied: numbers of the model that differ between environments, such as "mass:box" (`variation.Variation`).
      **options: for native `num_threads`; for jax `iterations` and `ls_iterations` of the constraint solver; for warp these
        two, `constraints` and `contacts` (memory for rows), `path` ("fused", "graph" or "auto") and `allow_cpu`.

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
