"""Named entries of an observation, and sensors, which some of them read."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.engines import Controls, Physics
from mjx_dher.envs.kinematics import Place, names_of, pick
from mjx_dher.lookup import check_name
from mjx_dher.types import Array

KINDS = ("site", "body", "rot", "vel", "angvel", "qpos", "qvel", "sensor")


class Entry:
    """One entry, or a difference "A - B" of entries. Maps physics to numbers [size]. Raises ValueError if the kind, site, body
    or joint does not exist, or the sizes of a difference are unequal.
    """

    def __init__(self, model: mujoco.MjModel, text: str):
        if not isinstance(text, str):
            raise ValueError(f"an observation must be a name, such as 'qpos:*'; got {text!r}")
        names = {name for kind in ("site", "body", "joint", "sensor") for name in names_of(model, kind)}
        whole = text.partition(":")[2] in names  # which may have " - "
        self._parts = [_Part(model, part.strip()) for part in ([text] if whole else text.split(" - "))]
        sizes = [part.size for part in self._parts]
        if len(set(sizes)) > 1:
            raise ValueError(f"observation {text!r} must subtract entries of equal sizes; got {sizes}")
        self.size = sizes[0]
        self.joints = next((part.names for part in self._parts if part.kind in ("qpos", "qvel")), ())  # of its numbers
        self.sensors = next((part.names for part in self._parts if part.kind == "sensor"), ())

    def __call__(self, physics: Physics) -> Array:
        value, *others = [part(physics) for part in self._parts]
        for other in others:
            value = value - other
        return value


class _Part:
    names: Sequence[str] = ()

    def __init__(self, model: mujoco.MjModel, text: str):
        self.kind, _, name = text.partition(":")
        check_name(f"kind of observation {text!r}", self.kind, KINDS)
        if self.kind in ("qpos", "qvel"):
            joints = pick("joint", name, names := names_of(model, "joint"))
            self.names = [str(names[joint]) for joint in joints]
            self.index = np.concatenate([_indices(model, joint, self.kind) for joint in joints])
            self.size = len(self.index)
        elif self.kind == "sensor":
            chosen = pick("sensor", name, names := names_of(model, "sensor"))
            sensors = [model.sensor(i) for i in chosen]
            if clocks := [str(names[i]) for i in chosen if model.sensor_type[i] == int(mujoco.mjtSensor.mjSENS_CLOCK)]:
                raise ValueError(f"observation {text!r}: sensor {clocks[0]!r} is a clock, and a state has no time")
            self.names = [str(names[i]) for i in chosen]
            self.index = np.concatenate([sensor.adr[0] + np.arange(sensor.dim[0]) for sensor in sensors])
            self.size = len(self.index)
        else:
            self.place = Place(model, text if self.kind in ("site", "body") else name)
            self.size = 6 if self.kind == "rot" else 3

    def __call__(self, physics: Physics) -> Array:
        if self.kind in ("qpos", "qvel"):
            return getattr(physics, self.kind)[self.index]
        if self.kind == "sensor":
            return physics.sensors[self.index]  # type: ignore[index]
        if self.kind in ("vel", "angvel"):
            return self.place.motion(physics.qpos, physics.qvel)[self.kind == "angvel"]
        return self.place.rotation(physics.qpos) if self.kind == "rot" else self.place.position(physics.qpos)


def _indices(model: mujoco.MjModel, joint: int, kind: str) -> np.ndarray:
    """Indices of a joint in qpos or qvel."""
    entry = model.joint(joint)
    start, size = (entry.qposadr, len(entry.qpos0)) if kind == "qpos" else (entry.dofadr, len(entry.damping))
    return start[0] + np.arange(size)


class Sensors:
    """Sensors of a model on any engine, as `mj_forward` computes them for the current state and inputs.

    Args:
      engine: "native", "jax", "warp" or "warp graph". MuJoCo Warp reads them for both paths of warp.
      varied: as in `make_engine`.
      **options: the engine's options. Used are `num_threads` of native and `allow_cpu` of warp.

    Raises:
      ValueError: the implementation does not support the model.
    """

    def __init__(self, engine: str, model: mujoco.MjModel, varied: Sequence[str] = (), **options: Any):
        self._reader: Any
        if engine == "native":
            from mjx_dher.envs.engines.native import Simulator

            self._reader = Simulator(model, derived=("sensordata",), num_threads=options.get("num_threads"), varied=varied)
            self._rest = jax.device_get(self._reader.make_data())
        elif engine == "jax":
            from mjx_dher.envs.engines.mjx import MjxEngine

            self._reader = MjxEngine(model, 1, sensors=True, varied=varied)
        else:
            from mjx_dher.envs.engines.warp import WarpEngine

            self._reader = WarpEngine(
                model, 0, path="graph", allow_cpu=options.get("allow_cpu", False), sensors=True, varied=varied
            )

    def read(self, physics: Physics, controls: Controls) -> Array:
        """Values [nsensordata] of all sensors, in the model's order."""
        if not hasattr(self, "_rest"):
            return self._reader.read_sensors(physics, controls)
        state = {"qpos": physics.qpos, "qvel": physics.qvel, "act": physics.act, "qacc_warmstart": physics.warmstart}
        mocap = {"mocap_pos": controls.mocap[:, :3], "mocap_quat": controls.mocap[:, 3:]}
        varied = {} if physics.factors is None else {"factors": physics.factors}
        data = jax.tree.map(jnp.asarray, self._rest).replace(ctrl=controls.ctrl, **varied, **state, **mocap)
        return self._reader.forward(data).derived["sensordata"]

    def check(self) -> None:
        """Raises ValueError if contacts were left out, like `Engine.check`."""
        self._reader.check()
