"""What an engine is: the part that advances physics, and nothing else."""

from __future__ import annotations

import copy
from typing import Protocol

import mujoco
import numpy as np
from flax import struct

from mjx_dher.types import Array


@struct.dataclass
class Physics:
    """The whole state of the simulation between two steps, in MuJoCo's layout."""

    qpos: Array  # [nq]
    qvel: Array  # [nv]
    warmstart: Array  # [nv] the constraint solver's first guess (qacc_warmstart)


def with_stand_ins(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model without contacts of a cylinder with a box: one of the two gives way to the geom called NAME_stand_in.

    The box's takes its place if there is one, else the cylinder's. For engines that have no such contact, or a worse one.

    Raises:
      ValueError: neither has one.
    """
    model = copy.copy(model)
    cylinder, box = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("CYLINDER", "BOX"))
    names = [model.geom(i).name for i in range(model.ngeom)]
    for ends, others in ((model.pair_geom1, model.pair_geom2), (model.pair_geom2, model.pair_geom1)):
        for pair in np.flatnonzero((model.geom_type[ends] == cylinder) & (model.geom_type[others] == box)):
            for side in (others, ends):
                stand_in = f"{names[side[pair]]}_stand_in"
                if stand_in in names:
                    side[pair] = names.index(stand_in)
                    break
            else:
                both = f"{names[ends[pair]]!r}, a cylinder, and {names[others[pair]]!r}, a box,"
                raise ValueError(f"geoms {both} meet; one of them needs another to stand in for it, called NAME_stand_in")
    return model


class Engine(Protocol):
    """Advances `Physics` by one environment step under a fixed input."""

    name: str

    def advance(self, physics: Physics, target: Array, ctrl: Array) -> Physics:
        """One environment step later; meanwhile the mocap body is held at `target` [7] (position, m, and w, x, y, z)."""
        ...

    def check(self) -> None:
        """Raises ValueError where the steps so far were not what they should be and their results do not show it."""
