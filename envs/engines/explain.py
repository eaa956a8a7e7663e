"""Support of a model by the engines: reasons against it, and fixes."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco

from mjx_dher.envs.engines import make_engine

_NATIVE = "use engine native"
# Fixes in the MJCF, by words of the reason.
_CURES = {
    "integrator": 'integrator="Euler"',
    "disable springs": "set stiffness and damping to 0 in place of the flags",
    "noslip": 'noslip_iterations="0"',
    "solver": 'solver="Newton"',
    "without nativeccd": '<flag nativeccd="disable"/>',
    "with nativeccd": '<flag nativeccd="enable"/>',
    "stand_in": "add the geom that it names",
}


class Verdict(NamedTuple):
    """Whether an engine supports a model."""

    engine: str  # native, jax, warp fused or warp graph
    reason: str  # "" if it does
    cure: str


def explain(model: mujoco.MjModel) -> list[Verdict]:
    """Tries every engine, and both paths of warp, on a model. Without a GPU, warp is tried on the CPU."""
    return [
        _verdict(model, "native", "mjx_dher.envs.Simulator, or MuJoCo itself"),
        _verdict(model, "jax", _NATIVE),
        _verdict(model, "warp", "engine warp takes the path graph", path="fused", allow_cpu=True),
        _verdict(model, "warp", _NATIVE, path="graph", allow_cpu=True),
    ]


def _verdict(model: mujoco.MjModel, engine: str, otherwise: str, **options: Any) -> Verdict:
    name = f"{engine} {options['path']}" if options else engine
    try:
        make_engine(engine, model, 1, **options)
    except ValueError as error:
        reason, _, cure = str(error).partition("; ")
        if cure and cure != _NATIVE:
            return Verdict(name, reason, cure)
        cures = [cure for words, cure in _CURES.items() if words in reason]
        return Verdict(name, reason, "; or ".join([*cures, otherwise]))
    return Verdict(name, "", "")
