"""The engine interface: the part of an environment that advances physics, and nothing else."""

from __future__ import annotations

from typing import Protocol

from flax import struct

from mjx_dher.types import Array


@struct.dataclass
class Physics:
    """The complete state of the simulation between two steps, in MuJoCo's layout."""

    qpos: Array  # [nq]
    qvel: Array  # [nv]
    warmstart: Array  # [nv] initial guess of the constraint solver (qacc_warmstart)


class Engine(Protocol):
    """Physics engine that advances `Physics` by one environment step under a fixed input."""

    name: str

    def advance(self, physics: Physics, target: Array, ctrl: Array) -> Physics:
        """Returns the physics one environment step later; the mocap body is held at `target` [7] (position, m; w, x, y, z)."""
        ...

    def check(self) -> None:
        """Raises ValueError if steps so far were wrong in a way that their results do not show."""
