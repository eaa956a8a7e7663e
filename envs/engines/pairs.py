"""Geoms of a model that can touch, and the number of possible contacts."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_dher.envs.engines.features import with_names

_TYPES = ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH", "SDF")
# Most contacts of two geoms, in the order of MuJoCo's types. Otherwise 1 with a sphere or an ellipsoid, else 8.
_MOST = {("PLANE", "CAPSULE"): 2, ("PLANE", "CYLINDER"): 4, ("PLANE", "BOX"): 4, ("PLANE", "MESH"): 4}
_MOST |= {("CAPSULE", "CAPSULE"): 2, ("CAPSULE", "BOX"): 2, ("CAPSULE", "CYLINDER"): 2}
LEAST_FRICTION = 1e-5  # MuJoCo's
# Lowest sliding friction of pyramidal (with impratio 1) and elliptic cones, by engine. A pyramid's stiffness grows as
# 1 / friction², which single precision limits: below, resting objects move.
LEAST_SLIDING = {"warp": (0.04, 0.0), "warp graph": (0.01, 0.0), "jax": (0.01, 0.001)}
_MANY = 50  # contacts of height fields and signed distance fields


def types_of(model: mujoco.MjModel, geom1: int, geom2: int) -> tuple[str, str]:
    """The types of two geoms, such as "BOX", in MuJoCo's order."""
    first, second = sorted(int(model.geom_type[geom]) for geom in (geom1, geom2))
    return _TYPES[first], _TYPES[second]


def edges_of(model: mujoco.MjModel, dims: np.ndarray) -> np.ndarray:
    """Rows of contacts, by their condim: the edges of a pyramid, or the directions of an elliptic cone."""
    elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    return np.where((dims == 1) | elliptic, dims, 2 * dims - 2)


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


class Pairs(NamedTuple):
    """Pairs of geoms that can touch, with MuJoCo's pair_* of their contacts [n, ...]."""

    geom1: np.ndarray
    geom2: np.ndarray
    dim: np.ndarray
    margin: np.ndarray
    friction: np.ndarray  # [n, 5]
    solref: np.ndarray
    solimp: np.ndarray
    solreffriction: np.ndarray


def all_pairs(model: mujoco.MjModel) -> Pairs:
    """Pairs that a model lists, and others that can touch, with parameters mixed from their geoms as in MuJoCo C."""
    touch = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    listed = [getattr(model, f"pair_{name}")[: model.npair * touch] for name in Pairs._fields]
    at = Pairs._fields.index("friction")
    listed[at] = np.maximum(listed[at], LEAST_FRICTION)
    others = meeting(model)
    if not len(others):
        return Pairs(*listed)
    priority = model.geom_priority[others]
    leads = np.stack([priority[:, 0] > priority[:, 1], priority[:, 1] > priority[:, 0]], axis=1)  # else both count
    mix = model.geom_solmix[others]
    share = mix / np.maximum(mix.sum(axis=1, keepdims=True), 1e-15)
    share[mix.sum(axis=1) < 1e-15] = 0.5
    share = np.where(leads.any(axis=1, keepdims=True), leads, share)[..., None]
    solref = model.geom_solref[others]
    blend = np.where((solref[..., :1] > 0).all(axis=1), (share * solref).sum(axis=1), solref.min(axis=1))
    led = np.where(leads[:, :1], solref[:, 0], solref[:, 1])
    counts = np.where(leads.any(axis=1, keepdims=True), leads, True)
    mixed = Pairs(
        others[:, 0],
        others[:, 1],
        np.where(counts, model.geom_condim[others], 0).max(axis=1),
        model.geom_margin[others].sum(axis=1),
        mixed_friction(model, others, model.geom_friction, np),
        np.where(leads.any(axis=1, keepdims=True), led, blend),
        (share * model.geom_solimp[others]).sum(axis=1),
        np.zeros_like(blend),
    )
    return Pairs(*(np.concatenate(both) for both in zip(listed, mixed)))


def mixed_friction(model: mujoco.MjModel, pairs: np.ndarray, friction: Any, xp: Any) -> Any:
    """Friction [n, 5] of contacts of geoms [n, 2] that have `friction` [ngeom, 3], by `xp`: NumPy or jax.numpy."""
    priority = model.geom_priority[pairs]
    counts = priority == priority.max(axis=1, keepdims=True)
    mixed = xp.where(counts[..., None], friction[pairs], -xp.inf).max(axis=1)
    return xp.maximum(mixed[:, np.array([0, 0, 1, 2, 2])], LEAST_FRICTION)


def too_slippery(model: mujoco.MjModel, engine: str) -> list[str]:
    """Contacts that slide too easily for an engine, with their geoms."""
    pairs, elliptic = all_pairs(model), model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    least, cone = LEAST_SLIDING.get(engine, (0.0, 0.0))[int(elliptic)], "elliptic cone" if elliptic else "pyramidal cone"
    if not elliptic and model.opt.impratio != 1:  # a pyramid is as steep as friction / sqrt(impratio)
        least, cone = least * np.sqrt(model.opt.impratio), f"{cone} and impratio {model.opt.impratio:g}"
    low = (pairs.dim > 1) & (pairs.friction[:, 0] < 0.999 * least)  # rounding
    if not low.any() or model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        return []
    geoms = np.unique(np.concatenate([pairs.geom1[low], pairs.geom2[low]]))
    return [with_names(f"sliding friction below {least:g} with the {cone}", model, "geom", geoms)]


def frictions(model: mujoco.MjModel, pairs: Pairs, friction: Any, xp: Any) -> dict[str, Any]:
    """Numbers [n, ...] of the fused kernel that depend on friction [n, 5], by `xp`: NumPy or jax.numpy."""
    slide, elliptic = friction[:, 0], model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    inverse = sum(model.body_invweight0[model.geom_bodyid[geom], 0] for geom in (pairs.geom1, pairs.geom2))
    edge = xp.where(elliptic | (pairs.dim == 1), 1, (1 + slide**2) * 2 * slide**2 / model.opt.impratio)
    mu = xp.where(pairs.dim == 1, 1, slide / np.sqrt(model.opt.impratio))
    return {"friction": friction[:, :3], "rolling": friction[:, 3:], "weight": inverse * edge, "mu": mu}


def most_contacts(model: mujoco.MjModel, geom1: int, geom2: int) -> int:
    """Largest number of contacts of two geoms."""
    kind = types_of(model, geom1, geom2)
    if "HFIELD" in kind or "SDF" in kind:
        return _MANY
    if kind in _MOST:
        return _MOST[kind]
    return 1 if "SPHERE" in kind or "ELLIPSOID" in kind else 8


def most(model: mujoco.MjModel) -> tuple[float, float]:
    """Largest numbers of contacts and of constraint rows of a simulation."""
    if model.nflex:
        return np.inf, np.inf
    pairs = all_pairs(model)
    contacts = [most_contacts(model, geom1, geom2) for geom1, geom2 in zip(pairs.geom1, pairs.geom2)]
    rows = edges_of(model, pairs.dim).tolist()
    others = 6 * model.neq + model.nv + model.ntendon  # of equality constraints and friction
    limits = int(np.count_nonzero(model.jnt_limited)) + int(np.count_nonzero(model.tendon_limited))
    return sum(contacts), others + 2 * limits + sum(n * row for n, row in zip(contacts, rows))
