"""Geoms of a model that can touch, and how many contacts that can make."""

from __future__ import annotations

import mujoco
import numpy as np

_TYPES = ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH", "SDF")
# Most contacts of two geoms, in the order of MuJoCo's types; of a sphere or an ellipsoid 1, and of others that are missing 8.
_MOST = {("PLANE", "CAPSULE"): 2, ("PLANE", "CYLINDER"): 4, ("PLANE", "BOX"): 4, ("PLANE", "MESH"): 4}
_MOST |= {("CAPSULE", "CAPSULE"): 2, ("CAPSULE", "BOX"): 2}
_MANY = 50  # of height fields and signed distance fields


def type_of(model: mujoco.MjModel, geom: int) -> str:
    """A geom's type, such as "BOX"."""
    return _TYPES[int(model.geom_type[geom])]


def meeting(model: mujoco.MjModel) -> np.ndarray:
    """Pairs of geoms [n, 2] int32 that can touch without being listed: by contype and conaffinity, as in MuJoCo C."""
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return np.zeros((0, 2), np.int32)
    first, second = np.triu_indices(model.ngeom, 1)
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    meet = ((contype[first] & conaffinity[second]) | (contype[second] & conaffinity[first])) != 0
    body1, body2 = model.geom_bodyid[first], model.geom_bodyid[second]
    weld1, weld2 = model.body_weldid[body1], model.body_weldid[body2]
    meet &= weld1 != weld2
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        above1, above2 = (model.body_weldid[model.body_parentid[weld]] for weld in (weld1, weld2))
        meet &= ~((weld1 != 0) & (weld2 != 0) & ((weld1 == above2) | (weld2 == above1)))
    lower, upper = np.minimum(body1, body2), np.maximum(body1, body2)
    signature = (lower.astype(np.int64) << 16) + upper
    meet &= ~np.isin(signature, [*model.exclude_signature, *model.pair_signature])
    fixed = (weld1 == 0) & (weld2 == 0)
    pairs = np.stack([first, second], axis=1)[meet & ~fixed]
    planes = model.geom_type[pairs] <= int(mujoco.mjtGeom.mjGEOM_HFIELD)
    return pairs[~planes.all(axis=1)].astype(np.int32)


def most_contacts(model: mujoco.MjModel, geom1: int, geom2: int) -> int:
    """The most contacts that two geoms can have."""
    kind = tuple(sorted((type_of(model, geom1), type_of(model, geom2)), key=_TYPES.index))
    if "HFIELD" in kind or "SDF" in kind:
        return _MANY
    if kind in _MOST:
        return _MOST[kind]
    return 1 if "SPHERE" in kind or "ELLIPSOID" in kind else 8


def most(model: mujoco.MjModel) -> tuple[float, float]:
    """The most contacts, and the most rows of constraints, that a simulation can have."""
    if model.nflex:
        return np.inf, np.inf
    ends_dim = [(*ends, int(max(model.geom_condim[ends]))) for ends in meeting(model)]
    ends_dim += [(*ends, int(dim)) for *ends, dim in zip(model.pair_geom1, model.pair_geom2, model.pair_dim)]
    contacts = [most_contacts(model, geom1, geom2) for geom1, geom2, _ in ends_dim]
    elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    rows = [dim if elliptic or dim == 1 else 2 * dim - 2 for *_, dim in ends_dim]
    others = 6 * model.neq + model.nv + model.ntendon  # of equality constraints and friction
    limits = int(np.count_nonzero(model.jnt_limited)) + int(np.count_nonzero(model.tendon_limited))
    return sum(contacts), others + 2 * limits + sum(n * row for n, row in zip(contacts, rows))
