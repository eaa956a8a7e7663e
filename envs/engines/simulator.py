"""Any MuJoCo model, stepped by MuJoCo C in batches on all cores, from inside compiled JAX programs: `Simulator`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco.batch import DATA_FIELDS

from mjx_dher.config import check_number
from mjx_dher.envs.engines import host_call
from mjx_dher.envs.engines.native import BatchedModel, digest
from mjx_dher.lookup import check_name
from mjx_dher.types import Array


@struct.dataclass
class Data:
    """The complete state of one simulation, in MuJoCo's layout and under MuJoCo's names, float32; empty where a model has none.

    A whole `mjSTATE_INTEGRATION`: nothing that a step depends on is anywhere else. `data.replace(ctrl=...)` sets a field.
    """

    time: Array  # [] s
    qpos: Array  # [nq]
    qvel: Array  # [nv]
    act: Array  # [na]
    history: Array  # [nhistory] of delayed actuators and sensors
    qacc_warmstart: Array  # [nv]
    ctrl: Array  # [nu]
    qfrc_applied: Array  # [nv]
    xfrc_applied: Array  # [nbody, 6]
    eq_active: Array  # [neq] 1 or 0
    mocap_pos: Array  # [nmocap, 3]
    mocap_quat: Array  # [nmocap, 4]
    userdata: Array  # [nuserdata]
    plugin_state: Array  # [npluginstate]
    derived: dict[str, Array]  # the fields of MjData that the simulator was asked for, with their shapes there


_STATE = tuple(name for name in Data.__dataclass_fields__ if name != "derived")


class Simulator(BatchedModel):
    """MuJoCo C for a model of one's own as pure functions of `Data`, which take no batch: use `jax.vmap`.

    `step` does what `mujoco.mj_step` does, in float64; between calls everything is float32. However many `vmap`s are around
    it, a call is one call of the host, which steps all simulations on its threads. Gradients do not pass through it.

    Args:
      model: any model, but one with sleeping bodies or inter-process communication; it is copied.
      derived: names of further fields of MjData, such as "xpos" or "sensordata", which each call returns in `Data.derived`.
      substeps: calls of `mj_step` a step.
      num_threads: that step the simulations; one a core where None.

    Raises:
      ValueError: no model, a field that cannot be had, a number out of range, or a model that cannot be stepped in batches.
    """

    def __init__(
        self, model: mujoco.MjModel, derived: Sequence[str] = (), substeps: int = 1, num_threads: int | None = None
    ) -> None:
        if not isinstance(model, mujoco.MjModel):
            raise ValueError(f"model must be a mujoco.MjModel; got a {type(model).__name__}")
        if isinstance(derived, str):
            raise ValueError(f"derived must be a list of names; got {derived!r}")
        check_number("substeps", substeps, "[1, 1000000]")
        for name in derived:
            check_name("derived", name, sorted(set(DATA_FIELDS) - set(_STATE)))
        super().__init__(model, num_threads)
        self._substeps, self._derived = substeps, tuple(dict.fromkeys(derived))
        self._name = f"mjx_dher_simulator_{digest(self._model, substeps, self._num_threads, self._derived)}"
        self._begin()
        batch = self._batch(1)
        self._shapes = {name: batch.bind(name).shape[1:] for name in (*_STATE, *self._derived)}
        self._sizes = [int(np.prod(shape)) for shape in self._shapes.values()]  # of the parts of a row

    def _begin(self) -> None:
        super()._begin()
        host_call.register(f"{self._name}_step", self._step)
        host_call.register(f"{self._name}_forward", self._forward)

    def make_data(self, keyframe: int | str | None = None) -> Data:
        """Returns the state after a reset, to the model's defaults or to a keyframe, with what is derived from it.

        Raises:
          ValueError: there is no such keyframe.
        """
        data = mujoco.MjData(self._model)
        if keyframe is None:
            mujoco.mj_resetData(self._model, data)
        else:
            try:
                key = self._model.key(keyframe).id
            except (KeyError, IndexError, TypeError) as error:
                raise ValueError(f"keyframe {keyframe!r} is none of the model's {self._model.nkey}; {error}") from error
            mujoco.mj_resetDataKeyframe(self._model, data, key)
        mujoco.mj_forward(self._model, data)
        values = {name: np.asarray(getattr(data, name)).reshape(shape) for name, shape in self._shapes.items()}
        return self._pack({name: jnp.asarray(value, jnp.float32) for name, value in values.items()})

    def step(self, data: Data, ctrl: Array | None = None) -> Data:
        """Returns the state `substeps` timesteps later, under `ctrl` [nu] where it is given.

        As with `mj_step`, what is derived describes the state before the last timestep; `forward` makes it current. A
        simulation that blows up is not reset: its numbers are no longer finite.

        Raises:
          ValueError: a field of another shape than the model's.
        """
        if ctrl is not None and isinstance(data, Data):
            data = dataclasses.replace(data, ctrl=ctrl)
        return self._call("step", data)

    def forward(self, data: Data) -> Data:
        """Returns `data` with all that is derived from it computed anew, as `mj_forward` does.

        Raises:
          ValueError: a field of another shape than the model's.
        """
        return self._call("forward", data)

    def _call(self, function: str, data: Data) -> Data:
        if not isinstance(data, Data):
            raise ValueError(f"data must be a Data, as make_data gives it; got a {type(data).__name__}")
        for name in _STATE:
            shape = jnp.shape(getattr(data, name))
            if shape != self._shapes[name]:
                raise ValueError(
                    f"{name} has shape {list(shape)}; the model's is {list(self._shapes[name])} (use jax.vmap for a batch)"
                )
        row = jnp.concatenate([jnp.ravel(jnp.asarray(getattr(data, name), jnp.float32)) for name in _STATE])
        result = host_call.call(f"{self._name}_{function}", (sum(self._sizes),), row)
        parts = jnp.split(result, np.cumsum(self._sizes)[:-1].tolist())
        return self._pack({name: x.reshape(shape) for (name, shape), x in zip(self._shapes.items(), parts, strict=True)})

    def _pack(self, values: dict[str, Array]) -> Data:
        return Data(**{name: values[name] for name in _STATE}, derived={name: values[name] for name in self._derived})

    def _step(self, inputs: Any) -> np.ndarray:
        return self._on_host(inputs, lambda batch: batch.step(nstep=self._substeps))

    def _forward(self, inputs: Any) -> np.ndarray:
        return self._on_host(inputs, lambda batch: batch.forward())

    def _on_host(self, inputs: Any, run: Any) -> np.ndarray:
        """Runs a call of the batch from `inputs` [..., row]; returns states and what is derived from them."""
        rows = np.asarray(inputs).reshape(-1, inputs.shape[-1])
        ends = np.cumsum(self._sizes[: len(_STATE) - 1])
        with self._lock:
            batch = self._batch(len(rows))
            for name, values in zip(_STATE, np.split(rows, ends, axis=1), strict=True):
                batch.bind(name)[...] = values.reshape(len(rows), *self._shapes[name])
            fields = [batch.bind(name) for name in self._shapes]  # bound before the call, which fills them
            run(batch)
            with np.errstate(over="ignore"):  # of what blew up
                columns = [x.reshape(len(rows), size) for x, size in zip(fields, self._sizes, strict=True)]
                result = np.concatenate(columns, axis=1, dtype=np.float32)
        return result.reshape(*inputs.shape[:-1], -1)
