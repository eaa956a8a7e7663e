"""The engine interface: the part of an environment that advances physics, and nothing else."""

from __future__ import annotations

import copy
from typing import Protocol

import mujoco
import numpy as np
from flax import struct

from mjx_dher.types import Array


@struct.dataclass
class Physics:
    """The complete state of the simulation between two steps, in MuJoCo's layout."""

    qpos: Array  # [nq]
    qvel: Array  # [nv]
    warmstart: Array  # [nv] initial guess of the constraint solver (qacc_warmstart)


def last_below(model: mujoco.MjModel) -> np.ndarray:
    """Returns each body's last descendant [nbody] int32: MuJoCo numbers depth first, so b's subtree is b to last_below[b]."""
    last = np.arange(model.nbody, dtype=np.int32)
    for body in range(model.nbody - 1, 0, -1):
        parent = model.body_parentid[body]
        last[parent] = max(last[parent], last[body])
    return last


def with_stand_ins(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy of the model in which a geom called NAME_stand_in replaces one geom of each cylinder-box contact pair.

    It replaces the box NAME if the box has a stand-in, else the cylinder NAME. Some engines have no cylinder-box contacts, or
    inaccurate ones.

    Raises:
      ValueError: neither geom of a pair has a stand-in.
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
    """Physics engine that advances `Physics` by one environment step under a fixed input."""

    name: str

    def advance(self, physics: Physics, target: Array, ctrl: Array) -> Physics:
        """Returns the physics one environment step later; the mocap body is held at `target` [7] (position, m; w, x, y, z)."""
        ...

    def check(self) -> None:
        """Raises ValueError if steps so far were wrong in a way that their results do not show."""
