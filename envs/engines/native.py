"""MuJoCo C for any model, in batches on all cores of the host, called from inside compiled JAX programs: `Simulator`."""

from __future__ import annotations

import copy
import ctypes
import dataclasses
import functools
import hashlib
import math
import os
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco.batch import DATA_FIELDS, Batch

from mjx_dher.envs.engines import host_call
from mjx_dher.envs.engines.base import Controls, Physics, check_shape, check_shapes
from mjx_dher.lookup import check_name
from mjx_dher.system.limits import usable_cores
from mjx_dher.types import Array
from mjx_dher.validation import check_number


@struct.dataclass
class Data:
    """The complete state of one simulation, in MuJoCo's layout and under MuJoCo's names, float32.

    It is a whole `mjSTATE_INTEGRATION`: nothing else influences a step. Fields that a model does not use are empty. Use
    `data.replace(ctrl=...)` to set a field.
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
# What `advance` passes: fields of `Physics` by MuJoCo's names, and the controls.
_PHYSICS = {"qpos": "qpos", "qvel": "qvel", "qacc_warmstart": "warmstart", "act": "act"}
_CONTROLS = ("ctrl", "mocap_pos", "mocap_quat")


class _Views(NamedTuple):
    """A batch, and the fields that a call writes before it and reads after it: views of the batch's memory."""

    batch: Batch
    inputs: list[np.ndarray]
    outputs: list[np.ndarray]


class Simulator:
    """MuJoCo C as pure functions of a state. They take no batch: use `jax.vmap`.

    `step` does what `mujoco.mj_step` does, in float64 on any number of threads; between calls everything is float32. However
    many `vmap`s are around it, a call is one call of the host, which steps all simulations on its threads. Gradients do not
    pass through it. Copies and unpickled simulators have separate threads and memory.

    `step` and `forward` take the whole state, `Data`. `advance` takes the few arrays that an engine needs (`Physics` and
    `Controls`) and leaves the rest of the state at the model's defaults: this is the engine `native`.

    Args:
      model: any model without sleeping bodies and inter-process communication; it is copied.
      derived: names of further fields of MjData, such as "xpos" or "sensordata", which `step` and `forward` return in
        `Data.derived`.
      substeps: calls of `mj_step` a step.
      num_threads: threads that step the simulations; by default one a core.

    Raises:
      ValueError: no model, a field that does not exist, a number out of range, or a model that cannot be stepped in batches.
    """

    name = "native"

    def __init__(
        self, model: mujoco.MjModel, derived: Sequence[str] = (), substeps: int = 1, num_threads: int | None = None
    ) -> None:
        if not isinstance(model, mujoco.MjModel):
            raise ValueError(f"model must be a mujoco.MjModel; got a {type(model).__name__}")
        if isinstance(derived, str):
            raise ValueError(f"derived must be a list of names; got {derived!r}")
        check_number("substeps", substeps, "[1, 1000000]")
        if num_threads is not None:
            check_number("num_threads", num_threads, "[1, 4096]")
        for name in derived:
            check_name("derived", name, sorted(set(DATA_FIELDS) - set(_STATE)))
        self._model = copy.copy(model)
        # Without this flag, MuJoCo silently resets a simulation that blows up to qpos0.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._substeps, self._derived = substeps, tuple(dict.fromkeys(derived))
        self._num_threads = num_threads or usable_cores()
        self._name = f"mjx_dher_native_{_digest(self._model, substeps, self._num_threads, self._derived)}"
        batch = Batch(self._model, 1, 1)
        self._shapes = {name: batch.bind(name).shape[1:] for name in (*_STATE, *self._derived)}
        self._begin()

    def _begin(self) -> None:
        self._batches: dict[tuple[bool, int], _Views] = {}
        self._lock = threading.Lock()  # a Batch serves one caller at a time
        _drop_warnings()
        for function in ("step", "forward", "advance"):
            host_call.register(f"{self._name}_{function}", functools.partial(self._on_host, function))

    def __getstate__(self) -> dict[str, Any]:
        """The state of a copy or pickle, without locks and batches, which cannot be copied."""
        return {name: value for name, value in vars(self).items() if name not in ("_batches", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._begin()

    def make_data(self, keyframe: int | str | None = None) -> Data:
        """Returns the state after a reset, to the model's defaults or to a keyframe, with its derived fields.

        Raises:
          ValueError: the model has no such keyframe.
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
        return self._data({name: jnp.asarray(value, jnp.float32) for name, value in values.items()})

    def step(self, data: Data, ctrl: Array | None = None) -> Data:
        """Returns the state `substeps` timesteps later, under `ctrl` [nu] if it is given.

        As with `mj_step`, derived fields describe the state before the last timestep; `forward` makes them current. A
        simulation that blows up is not reset: its numbers are no longer finite.

        Raises:
          ValueError: a field has another shape than the model's.
        """
        if ctrl is not None and isinstance(data, Data):
            data = dataclasses.replace(data, ctrl=ctrl)
        return self._update("step", data)

    def forward(self, data: Data) -> Data:
        """Returns `data` with its derived fields recomputed, as `mj_forward` does.

        Raises:
          ValueError: a field has another shape than the model's.
        """
        return self._update("forward", data)

    def advance(self, physics: Physics, controls: Controls) -> Physics:
        check_shapes(self._model, physics, controls)
        values = {name: getattr(physics, field) for name, field in _PHYSICS.items()}
        pos, quat = controls.mocap[:, :3], controls.mocap[:, 3:]
        after = self._call("advance", {**values, "ctrl": controls.ctrl, "mocap_pos": pos, "mocap_quat": quat})
        return Physics(**{field: after[name] for name, field in _PHYSICS.items()})

    def check(self) -> None:
        pass  # nothing goes wrong unnoticed

    def _update(self, function: str, data: Data) -> Data:
        if not isinstance(data, Data):
            raise ValueError(f"data must be a Data, as make_data gives it; got a {type(data).__name__}")
        values = {name: getattr(data, name) for name in _STATE}
        for name, value in values.items():
            check_shape(name, value, self._shapes[name])
        return self._data(self._call(function, values))

    def _data(self, values: dict[str, Array]) -> Data:
        return Data(**{name: values[name] for name in _STATE}, derived={name: values[name] for name in self._derived})

    def _fields(self, function: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Returns the names of the fields that a function takes and returns, in the order of a packed row."""
        if function == "advance":
            return (*_PHYSICS, *_CONTROLS), tuple(_PHYSICS)
        return _STATE, (*_STATE, *self._derived)

    def _call(self, function: str, values: dict[str, Array]) -> dict[str, Array]:
        """Calls a function of the host: one array in and one out, because each costs the call some 20 microseconds."""
        inputs, outputs = self._fields(function)
        row = jnp.concatenate([jnp.ravel(jnp.asarray(values[name], jnp.float32)) for name in inputs])
        ends = np.cumsum([math.prod(self._shapes[name]) for name in outputs]).tolist()
        parts = jnp.split(host_call.call(f"{self._name}_{function}", (ends[-1],), row), ends[:-1])
        return {name: part.reshape(self._shapes[name]) for name, part in zip(outputs, parts, strict=True)}

    def _on_host(self, function: str, packed: Any) -> np.ndarray:
        """Computes a function for `packed` [..., row]."""
        rows = np.asarray(packed).reshape(-1, packed.shape[-1])
        with self._lock:
            batch, inputs, outputs = self._views(function, len(rows))
            begin = 0
            for view in inputs:
                end = begin + math.prod(view.shape[1:])
                view[...] = rows[:, begin:end].reshape(view.shape)
                begin = end
            if function == "forward":
                batch.forward()
            else:
                batch.step(nstep=self._substeps)
            with np.errstate(over="ignore"):  # of a simulation that blew up
                columns = [view.reshape(len(rows), -1) for view in outputs]
                result = np.concatenate(columns, axis=1, dtype=np.float32)
        return result.reshape(*packed.shape[:-1], -1)

    def _views(self, function: str, nsim: int) -> _Views:
        key = function == "advance", nsim  # what `advance` does not write must stay as it was made: it has its own batches
        if key not in self._batches:
            batch = Batch(self._model, nsim, self._num_threads)
            inputs, outputs = (
                [batch.bind(name) for name in names if math.prod(self._shapes[name])] for names in self._fields(function)
            )
            self._batches[key] = _Views(batch, inputs, outputs)
        return self._batches[key]


def _drop_warnings() -> None:
    """Keeps MuJoCo from writing MUJOCO_LOG.TXT into the current folder: a simulation that blows up shows in its state.

    The callback is a function of C. MuJoCo's threads would have to wait for one of Python.
    """
    if os.name == "posix" and mujoco.get_mju_user_warning() is None:
        ignore = ctypes.CFUNCTYPE(None, ctypes.c_char_p)(("strlen", ctypes.CDLL(None)))
        mujoco.set_mju_user_warning(ignore)


def _digest(model: mujoco.MjModel, *settings: Any) -> str:
    """Returns digits that stand for a model and its settings: simulators with the same digits are interchangeable."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes() + repr(settings).encode()).hexdigest()[:16]
