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
    """A copy of the model in which boxes meet, in place of each cylinder that they are paired with, the sphere on its body.

    For engines that have no contact of a cylinder with a box, or a worse one.

    Raises:
      ValueError: the body has no sphere, or more than one.
    """
    model = copy.copy(model)
    sphere, cylinder, box = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("SPHERE", "CYLINDER", "BOX"))
    kinds = model.geom_type
    for ends, others in ((model.pair_geom1, model.pair_geom2), (model.pair_geom2, model.pair_geom1)):
        for pair in np.flatnonzero((kinds[ends] == cylinder) & (kinds[others] == box)):
            spheres = np.flatnonzero((model.geom_bodyid == model.geom_bodyid[ends[pair]]) & (kinds == sphere))
            if len(spheres) != 1:
                name = model.geom(ends[pair]).name
                raise ValueError(f"geom {name!r}, a cylinder, needs one sphere beside it to stand in for it")
            ends[pair] = spheres[0]
    return model


class Engine(Protocol):
    """Advances `Physics` by one environment step under a fixed input."""

    name: str

    def advance(self, physics: Physics, target: Array, ctrl: Array) -> Physics:
        """One environment step later; meanwhile the mocap body is held at `target` [7] (position, m, and w, x, y, z)."""
        ...

    def check(self) -> None:
        """Raises ValueError where the steps so far were not what they should be and their results do not show it."""
