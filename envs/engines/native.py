"""MuJoCo C for any model, in batches on all cores of the host, called from compiled JAX programs: `Simulator`."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import math
import threading
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco.batch import Batch

from mjx_dher.envs.engines import host_call
from mjx_dher.envs.engines.base import Controls, Physics, check_shape, check_shapes
from mjx_dher.envs.engines.fields import LATE, derived_fields
from mjx_dher.system.limits import usable_cores
from mjx_dher.types import Array
from mjx_dher.validation import check_number


@struct.dataclass
class Data:
    """Complete state of one simulation, in MuJoCo's layout and with MuJoCo's names, float32.

    It is a whole `mjSTATE_INTEGRATION`, so nothing else influences a step. Fields that a model does not use are empty. Use
    `data.replace(ctrl=...)` to set a field.
    """

    time: Array  # [] s; `residue` has the digits that float32 omits
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
    residue: Array  # [2, 1 + nhistory] digits of `time` and `history` that float32 omits; 0 if you set those
    derived: dict[str, Array]  # requested fields of MjData, with their shapes


_STATE = tuple(name for name in Data.__dataclass_fields__ if name not in ("residue", "derived"))
_EXACT = ("time", "history")  # float64 between steps too, because a float32 time would stop advancing
# Inputs of `advance`: fields of `Physics` by MuJoCo's names, and the controls.
_PHYSICS = {"qpos": "qpos", "qvel": "qvel", "qacc_warmstart": "warmstart", "act": "act"}
_CONTROLS = ("ctrl", "mocap_pos", "mocap_quat")


_FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]
_KEPT = 8  # batches to keep, of the last sizes


class _Views(NamedTuple):
    """A batch, and views of its memory for the fields that a call writes and reads."""

    batch: Batch
    inputs: list[np.ndarray]
    outputs: list[np.ndarray]
    exact: list[np.ndarray]  # views of `_EXACT`, each [nsim, n]; empty for `advance`


class Simulator:
    """MuJoCo C as pure functions of one state. Use `jax.vmap` for a batch.

    `step` computes `mujoco.mj_step` in float64 on any number of threads. Between calls, everything is float32. Any number of
    `vmap`s make one call of the host, which steps all simulations on its threads. There are no gradients. Copies and unpickled
    simulators have separate threads and memory.

    `step` and `forward` take the whole state, `Data`. `advance` is the engine `native`: it takes only `Physics` and
    `Controls`, and leaves the rest of the state at the model's defaults.

    Args:
      model: any model without sleeping bodies and inter-process communication. It is copied.
      derived: names of other fields of MjData, such as "xpos" or "sensordata", to return in `Data.derived`.
      substeps: calls of `mj_step` per step.
      num_threads: number of threads. Default: one per core.

    Raises:
      ValueError: an argument is invalid, a field does not exist, or the model cannot be stepped in batches.
    """

    name = "native"

    def __init__(
        self, model: mujoco.MjModel, derived: Sequence[str] = (), substeps: int = 1, num_threads: int | None = None
    ) -> None:
        if not isinstance(model, mujoco.MjModel):
            raise ValueError(f"model must be a mujoco.MjModel; got a {type(model).__name__}")
        check_number("substeps", substeps, "[1, 1000000]")
        if num_threads is not None:
            check_number("num_threads", num_threads, "[1, 4096]")
        self._model = copy.copy(model)
        # Without this flag, MuJoCo silently resets a diverged simulation to qpos0.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._substeps, self._derived = substeps, derived_fields(derived, _STATE)
        if "energy" in self._derived:
            self._model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        self._num_threads = num_threads or usable_cores()
        self._name = f"mjx_dher_native_{_digest(self._model, substeps, self._num_threads, self._derived)}"
        batch = Batch(self._model, 1, 1)
        self._shapes = {name: batch.bind(name).shape[1:] for name in (*_STATE, *self._derived)}
        self._shapes["residue"] = (2, 1 + model.nhistory)
        self._begin()

    def _begin(self) -> None:
        self._batches: dict[tuple[bool, int], _Views] = {}
        self._lock = threading.Lock()  # a Batch is not thread-safe
        self._lost, self._warned = 0, False  # timesteps that left out contacts since the last `check`
        for function, method in (("step", self._on_step), ("forward", self._on_forward), ("advance", self._on_advance)):
            host_call.register(f"{self._name}_{function}", method)

    def __getstate__(self) -> dict[str, Any]:
        """State of a copy or pickle, without locks and batches, which cannot be copied."""
        return {name: value for name, value in vars(self).items() if name not in ("_batches", "_lock", "_lost", "_warned")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._begin()

    def make_data(self, keyframe: int | str | None = None) -> Data:
        """State after a reset to the model's defaults or to a keyframe, with its derived fields.

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
        for warning in data.warning:
            warning.number = 1
        mujoco.mj_forward(self._model, data)
        self._note_lost(sum(data.warning[kind].number - 1 for kind in _FULL))
        for compute in self._late():
            compute(self._model, data)
        values = {name: np.asarray(getattr(data, name)).reshape(self._shapes[name]) for name in (*_STATE, *self._derived)}
        values["residue"] = _residue(np.concatenate([values[name].ravel() for name in _EXACT]))
        return self._data({name: jnp.asarray(value, jnp.float32) for name, value in values.items()})

    def step(self, data: Data, ctrl: Array | None = None) -> Data:
        """State `substeps` timesteps later, under `ctrl` [nu] if given.

        As in `mj_step`, derived fields describe the state before the last timestep; `forward` updates them. A simulation that
        diverges is not reset: its numbers are no longer finite.

        Raises:
          ValueError: a field does not have the model's shape.
        """
        if ctrl is not None and isinstance(data, Data):
            data = dataclasses.replace(data, ctrl=ctrl)
        return self._update("step", data)

    def forward(self, data: Data) -> Data:
        """`data` with updated derived fields, as in `mj_forward`.

        Raises:
          ValueError: a field does not have the model's shape.
        """
        return self._update("forward", data)

    def advance(self, physics: Physics, controls: Controls) -> Physics:
        check_shapes(self._model, physics, controls)
        values = {name: getattr(physics, field) for name, field in _PHYSICS.items()}
        pos, quat = controls.mocap[:, :3], controls.mocap[:, 3:]
        after = self._call("advance", {**values, "ctrl": controls.ctrl, "mocap_pos": pos, "mocap_quat": quat})
        return Physics(**{field: after[name] for name, field in _PHYSICS.items()})

    def check(self) -> None:
        """Raises ValueError if contacts since the last call did not fit into the model's memory."""
        with self._lock:
            lost, self._lost = self._lost, 0
        if lost:
            raise ValueError(_lost_contacts(self._model, lost))

    def _update(self, function: str, data: Data) -> Data:
        if not isinstance(data, Data):
            raise ValueError(f"data must be a Data from make_data; got a {type(data).__name__}")
        values = {name: getattr(data, name) for name in (*_STATE, "residue")}
        for name, value in values.items():
            check_shape(name, value, self._shapes[name])
        return self._data(self._call(function, values))

    def _data(self, values: dict[str, Array]) -> Data:
        state = {name: values[name] for name in (*_STATE, "residue")}
        return Data(**state, derived={name: values[name] for name in self._derived})

    def _late(self) -> list[Any]:
        return list(dict.fromkeys(LATE[name] for name in self._derived if name in LATE))

    def _fields(self, function: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the fields that a function takes and returns, in the order of a packed row."""
        if function == "advance":
            return (*_PHYSICS, *_CONTROLS), tuple(_PHYSICS)
        return (*_STATE, "residue"), (*_STATE, *self._derived, "residue")

    def _call(self, function: str, values: dict[str, Array]) -> dict[str, Array]:
        """Calls a function of the host, with one array in and one out, because each costs some 20 microseconds."""
        inputs, outputs = self._fields(function)
        row = jnp.concatenate([jnp.ravel(jnp.asarray(values[name], jnp.float32)) for name in inputs])
        ends = np.cumsum([math.prod(self._shapes[name]) for name in outputs]).tolist()
        parts = jnp.split(host_call.call(f"{self._name}_{function}", (ends[-1],), row), ends[:-1])
        return {name: part.reshape(self._shapes[name]) for name, part in zip(outputs, parts, strict=True)}

    def _on_step(self, packed: Any) -> np.ndarray:
        return self._on_host("step", packed)

    def _on_forward(self, packed: Any) -> np.ndarray:
        return self._on_host("forward", packed)

    def _on_advance(self, packed: Any) -> np.ndarray:
        return self._on_host("advance", packed)

    def _on_host(self, function: str, packed: Any) -> np.ndarray:
        """Computes a function for `packed` [..., row]."""
        rows = np.asarray(packed).reshape(-1, packed.shape[-1])
        with self._lock, np.errstate(over="ignore", invalid="ignore"):  # from diverged simulations
            views = self._views(function, len(rows))
            begin = 0
            for view in views.inputs:
                end = begin + math.prod(view.shape[1:])
                view[...] = rows[:, begin:end].reshape(view.shape)
                begin = end
            _add(views.exact, rows[:, begin:])
            if function == "forward":
                views.batch.forward()
            else:
                views.batch.step(nstep=self._substeps)
            self._note_lost(int((views.batch.warning[:, _FULL, 1] - 1).sum()))
            views.batch.warning[..., 1] = 1
            columns = [view.reshape(len(rows), -1) for view in self._results(function, views)]
            result = np.concatenate(columns, axis=1, dtype=np.float32)
        return result.reshape(*packed.shape[:-1], -1)

    def _results(self, function: str, views: _Views) -> list[np.ndarray]:
        """Fields that a function returns, each [nsim, ...]."""
        outputs = list(views.outputs)
        if views.exact:
            outputs.append(_residue(np.concatenate(views.exact, axis=1)))
        late = [name for name in self._derived if name in LATE and math.prod(self._shapes[name])]
        if function == "advance" or not late:
            return outputs
        functions, data = self._late(), mujoco.MjData(self._model)
        names = [name for name in self._fields(function)[1] if math.prod(self._shapes[name])]
        filled = {name: np.empty((views.batch.nsim, *self._shapes[name])) for name in late}
        for index in range(views.batch.nsim):
            views.batch.get_data(index, data)
            for compute in functions:
                compute(self._model, data)
            for name in late:
                filled[name][index] = getattr(data, name)
        return [filled.get(name, output) for name, output in zip(names, outputs, strict=True)]

    def _note_lost(self, lost: int) -> None:
        """Counts timesteps that left out contacts, and warns the first time."""
        self._lost += lost
        if lost and not self._warned:
            self._warned = True
            warnings.warn(_lost_contacts(self._model, lost), stacklevel=2)

    def _views(self, function: str, nsim: int) -> _Views:
        key = function == "advance", nsim  # `advance` has separate batches, because its other fields must stay at defaults
        views = self._batches.pop(key, None) or self._made(function, nsim)
        self._batches[key] = views
        if len(self._batches) > _KEPT:
            del self._batches[next(iter(self._batches))]
        return views

    def _made(self, function: str, nsim: int) -> _Views:
        persistent = function != "advance" and bool(self._late())
        batch = Batch(self._model, nsim, self._num_threads, persistent)
        batch.warning[..., 1] = 1  # MuJoCo writes MUJOCO_LOG.TXT when a number of warnings leaves 0
        inputs, outputs = (
            [batch.bind(name) for name in names if name != "residue" and math.prod(self._shapes[name])]
            for names in self._fields(function)
        )
        exact = [] if function == "advance" else [batch.bind(name).reshape(nsim, -1) for name in _EXACT]
        return _Views(batch, inputs, outputs, exact)


def _residue(values: np.ndarray) -> np.ndarray:
    """Parts of `values` [..., n] that float32 omits, as two float32 numbers [..., 2, n]."""
    first = values - values.astype(np.float32)
    return np.stack([first, first - first.astype(np.float32)], axis=-2)


def _add(exact: list[np.ndarray], residue: np.ndarray) -> None:
    """Adds `residue` [nsim, 2 n] to the fields [nsim, n in total] whose values it belongs to."""
    parts = residue.reshape(len(residue), 2, -1).astype(np.float64).sum(axis=1) if exact else residue
    for view in exact:
        part, parts = parts[:, : view.shape[1]], parts[:, view.shape[1] :]
        whole = view + part
        view[...] = np.where(whole.astype(np.float32) == view, whole, view)


def _lost_contacts(model: mujoco.MjModel, lost: int) -> str:
    return (
        f"MuJoCo left out contacts or other constraints {lost} times, because the model's memory is too small"
        f' ({model.narena:,} bytes): give it more, such as <size memory="{max(1, 4 * model.narena // 2**20)}M"/>'
    )


def _digest(model: mujoco.MjModel, *settings: Any) -> str:
    """Digest of a model and its settings. Simulators with the same digest are interchangeable."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes() + repr(settings).encode()).hexdigest()[:16]
