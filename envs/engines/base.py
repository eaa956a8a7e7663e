"""What an engine is: the part that advances physics, and nothing else."""

from __future__ import annotations

from typing import Protocol

from flax import struct

from mjx_dher.types import Array


@struct.dataclass
class Physics:
    """The whole state of the simulation between two steps, in MuJoCo's layout."""

    qpos: Array  # [nq]
    qvel: Array  # [nv]
    warmstart: Array  # [nv] the constraint solver's first guess (qacc_warmstart)


class Engine(Protocol):
    """Advances `Physics` by one environment step under a fixed input."""

    name: str

    def advance(self, physics: Physics, target: Array, ctrl: Array) -> Physics:
        """One environment step later; meanwhile the mocap body is held at `target` [7] (position, m, and w, x, y, z)."""
        ...

    def check(self) -> None:
        """Raises ValueError where the steps so far were not what they should be and their results do not show it."""
