"""Entries of an observation, by name."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from mjx_dher.envs.controls import pick
from mjx_dher.envs.engines import Physics
from mjx_dher.envs.kinematics import Place, names_of
from mjx_dher.lookup import check_name
from mjx_dher.types import Array

Term = Callable[[Physics], Array]  # one entry

_AT = ("qpos", "qvel")
_OF = {"rot": lambda place, p: place.rotation(p.qpos), "vel": lambda place, p: place.motion(p.qpos, p.qvel)[0]}
_OF["angvel"] = lambda place, p: place.motion(p.qpos, p.qvel)[1]
_OF |= {kind: lambda place, p: place.position(p.qpos) for kind in ("site", "body")}


def term(model: mujoco.MjModel, text: str) -> Term:
    """Looks up one entry of an observation, or a difference "A - B" of two.

    Raises:
      ValueError: the kind, or the site, body or joint, does not exist; or A and B have different sizes.
    """
    if " - " in text:
        first, second = (term(model, part) for part in text.split(" - ", 1))
        return lambda physics: _minus(text, first(physics), second(physics))
    kind, _, name = text.strip().partition(":")
    check_name(f"kind of observation {text!r}", kind, (*_OF, *_AT))
    if kind in _OF:
        place = Place(model, text.strip() if kind in ("site", "body") else name)
        return lambda physics: _OF[kind](place, physics)
    index = np.concatenate([_entries(model, joint, kind) for joint in pick("joint", name, names_of(model, "joint"))])
    return lambda physics: getattr(physics, kind)[index]


def _minus(text: str, first: Array, second: Array) -> Array:
    if first.shape != second.shape:
        raise ValueError(f"observation {text!r} subtracts {second.shape[0]} numbers from {first.shape[0]}")
    return first - second


def _entries(model: mujoco.MjModel, joint: int, kind: str) -> np.ndarray:
    """Indices of a joint in qpos or qvel."""
    entry = model.joint(joint)
    return (entry.qposadr if kind == "qpos" else entry.dofadr)[0] + np.arange(
        len(entry.qpos0 if kind == "qpos" else entry.damping)
    )
