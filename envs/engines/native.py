"""MuJoCo C for any model, in batches on all cores of the host, called from compiled JAX programs: `Simulator`."""

import contextvars
import copy
import hashlib
import math
import threading
import time
import warnings
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from mjx_dher.envs.engines import Controls, Physics, check_shapes, host_call, variation_of
from mjx_dher.envs.engines.batches import EXACT, FULL, UNTIMED, Choice, Rows, residue
from mjx_dher.envs.engines.fields import LATE, STATE, Data, Layout, derived_fields
from mjx_dher.system.machine import usable_cores
from mjx_dher.types import Array
from mjx_dher.validation import check_number

# Inputs of `advance`: fields of `Physics` by MuJoCo's names, and the controls.
_PHYSICS = {"qpos": "qpos", "qvel": "qvel", "act": "act", "qacc_warmstart": "warmstart"}
_CONTROLS = ("ctrl", "mocap_pos", "mocap_quat")


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
      varied: masses, friction, damping and gains that differ between simulations, such as "mass:box"
        (`variation.Variation`). The state has their factors.

    Raises:
      ValueError: an argument is invalid, a field does not exist, or the model cannot be stepped in batches.
    """

    name = "native"

    def __init__(
        self,
        model: mujoco.MjModel,
        derived: Sequence[str] = (),
        substeps: int = 1,
        num_threads: int | None = None,
        varied: Sequence[str] = (),
    ) -> None:
        if not isinstance(model, mujoco.MjModel):
            raise ValueError(f"model must be a mujoco.MjModel; got a {type(model).__name__}")
        check_number("substeps", substeps, "[1, 1000000]")
        if num_threads is not None:
            check_number("num_threads", num_threads, "[1, 4096]")
        self._model = copy.copy(model)
        # Without this flag, MuJoCo silently resets a diverged simulation to qpos0.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._substeps, self._derived = substeps, derived_fields(derived, STATE)
        if "energy" in self._derived:
            self._model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        self._num_threads, self._variation = num_threads or usable_cores(), variation_of(model, varied)
        self._name = f"mjx_dher_native_{_digest(self._model, substeps, self._num_threads, self._derived, *varied)}"
        batch = Batch(self._model, 1, 1)
        self._shapes: dict[str, tuple[int, ...]] = {"residue": (2, 1 + model.nhistory)}
        self._shapes |= {name: batch.bind(name).shape[1:] for name in STATE}
        self._shapes["factors"] = (self._variation.size,)
        self._shapes |= {name: batch.bind(name).shape[1:] for name in self._derived}
        self._layout = Layout(tuple(self._shapes.items()), self._derived)
        self._begin()

    def _begin(self) -> None:
        # `advance` has separate batches, because its other fields must stay at defaults.
        self._batches = {whole: Choice(self._num_threads) for whole in (True, False)}
        self._lock = threading.Lock()  # a Batch is not thread-safe
        self._quiet = contextvars.copy_context()  # without warnings about the numbers of diverged simulations
        self._quiet.run(np.seterr, over="ignore", invalid="ignore")
        self._lost, self._warned = 0, False  # timesteps that left out contacts since the last `check`
        for function, method in (("step", self._on_step), ("forward", self._on_forward), ("advance", self._on_advance)):
            host_call.register(f"{self._name}_{function}", method)

    def __getstate__(self) -> dict[str, Any]:
        """State of a copy or pickle, without locks and batches, which cannot be copied."""
        return {
            name: value for name, value in vars(self).items() if name not in ("_batches", "_lock", "_quiet", "_lost", "_warned")
        }

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
        self._note_lost(sum(data.warning[kind].number - 1 for kind in FULL))
        for compute in dict.fromkeys(LATE[name] for name in self._derived if name in LATE):
            compute(self._model, data)
        values = {name: np.ravel(getattr(data, name)) for name in (*STATE, *self._derived)}
        values["residue"] = residue(np.concatenate([values[name] for name in EXACT])).ravel()
        values["factors"] = np.ones(self._variation.size)
        row = np.concatenate([values[name] for name in self._shapes])
        return Data(jnp.asarray(row, jnp.float32), self._layout)

    def step(self, data: Data, ctrl: Array | None = None) -> Data:
        """State `substeps` timesteps later, under `ctrl` [nu] if given.

        As in `mj_step`, derived fields describe the state before the last timestep; `forward` updates them. A simulation that
        diverges is not reset: its numbers are no longer finite, nor are they under a control that is NaN or above 1e10.

        Raises:
          ValueError: a field does not have the model's shape.
        """
        if ctrl is not None and isinstance(data, Data):
            data = data.replace(ctrl=ctrl)
        return self._update("step", data)

    def forward(self, data: Data) -> Data:
        """`data` with updated derived fields, as in `mj_forward`.

        Raises:
          ValueError: a field does not have the model's shape.
        """
        return self._update("forward", data)

    def advance(self, physics: Physics, controls: Controls) -> Physics:
        check_shapes(self._model, physics, controls, self._variation.size)
        inputs = [*(getattr(physics, field) for field in _PHYSICS.values()), controls.ctrl]
        inputs += [controls.mocap[:, :3], controls.mocap[:, 3:], self._variation.factors(physics.factors, jnp)]
        # One array in and one out, because each costs some microseconds.
        row = jnp.concatenate([jnp.ravel(jnp.asarray(value, jnp.float32)) for value in inputs])
        ends = np.cumsum([math.prod(self._shapes[name]) for name in _PHYSICS]).tolist()
        parts = jnp.split(host_call.call(f"{self._name}_advance", (ends[-1],), row), ends[:-1])
        return Physics(**dict(zip(_PHYSICS.values(), parts, strict=True)), factors=physics.factors)

    def check(self) -> None:
        """Raises ValueError if contacts since the last call did not fit into the model's memory."""
        with self._lock:
            lost, self._lost = self._lost, 0
        if lost:
            raise ValueError(_lost_contacts(self._model, lost))

    def _update(self, function: str, data: Data) -> Data:
        if not isinstance(data, Data):
            raise ValueError(f"data must be a Data from make_data; got a {type(data).__name__}")
        if data.layout != self._layout or jnp.shape(data.row)[-1:] != (self._layout.size,):
            raise ValueError("data has other fields than this simulator's make_data gives")
        row = host_call.call(f"{self._name}_{function}", jnp.shape(data.row), data.row)
        return Data(row, self._layout)

    def _on_step(self, rows: np.ndarray, results: np.ndarray) -> None:
        self._on_host("step", rows, results)

    def _on_forward(self, rows: np.ndarray, results: np.ndarray) -> None:
        self._on_host("forward", rows, results)

    def _on_advance(self, rows: np.ndarray, results: np.ndarray) -> None:
        self._on_host("advance", rows, results)

    def _on_host(self, function: str, rows: np.ndarray, results: np.ndarray) -> None:
        """Computes a function for `rows` [..., n] into `results` [..., m]."""
        if rows.ndim != 2:
            rows, results = rows.reshape(-1, rows.shape[-1]), results.reshape(-1, results.shape[-1])
        with self._lock:
            self._quiet.run(self._compute, function, rows, results)

    def _compute(self, function: str, rows: np.ndarray, results: np.ndarray) -> None:
        begun = time.perf_counter()
        whole = function != "advance"
        chosen = self._batches[whole].choose(len(rows), self._made, whole)
        chosen.write(rows)
        with UNTIMED:
            if function == "forward":
                chosen.batch.forward()
            else:
                chosen.batch.step(nstep=self._substeps)
        lost, bad = chosen.read_warnings()
        if lost:
            self._note_lost(lost)
        chosen.read(results)
        if len(bad):  # MuJoCo takes 0 for all controls if one is NaN or too large, and only warns
            results[bad] = math.nan
        seconds = time.perf_counter() - begun
        if chosen.seconds:  # a call that waited for other processes does not count
            seconds = min(seconds, 1.1 * chosen.seconds)
        chosen.seconds = seconds

    def _made(self, nsim: int, num_threads: int, whole: bool) -> Rows:
        """Makes a batch for `advance`, or for functions of the whole state."""
        derived, digits = (self._derived, math.prod(self._shapes["residue"])) if whole else ((), 0)
        batch = Batch(self._model, nsim, num_threads, persistent=any(name in LATE for name in derived))
        inputs = STATE if whole else (*_PHYSICS, *_CONTROLS)
        return Rows(batch, inputs, STATE if whole else tuple(_PHYSICS), derived, digits, self._variation)

    def _note_lost(self, lost: int) -> None:
        """Counts timesteps that left out contacts, and warns the first time."""
        self._lost += lost
        if lost and not self._warned:
            self._warned = True
            warnings.warn(_lost_contacts(self._model, lost), stacklevel=2)


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
