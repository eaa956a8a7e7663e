"""The engine interface, the part of an environment that advances physics."""

from collections.abc import Sequence
from typing import Any, Protocol

import jax.numpy as jnp
import mujoco
from flax import struct

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
