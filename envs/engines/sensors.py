"""Reads a model's sensors on every engine, as computed by `mj_forward` for the current state and inputs."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from mjx_dher.envs.engines import Controls, Physics
from mjx_dher.types import Array


class Sensors:
    """Sensors of a model, read by an engine's implementation.

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
