"""MuJoCo's C engine on all cores of the host, called from inside compiled JAX programs."""

from __future__ import annotations

import copy
import ctypes
import hashlib
import os
import threading
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from mjx_dher.config import check_number
from mjx_dher.envs.engines import host_call
from mjx_dher.envs.engines.base import Physics
from mjx_dher.types import Array


def usable_cores() -> int:
    """Returns the number of cores that this process may use, which a container or `taskset` can limit."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _drop_warnings() -> None:
    """Keeps MuJoCo from writing MUJOCO_LOG.TXT into the current folder: what blows up is marked in the state.

    A function of C is called, not one of Python, which MuJoCo's threads would have to wait for.
    """
    if os.name == "posix" and mujoco.get_mju_user_warning() is None:
        ignore = ctypes.CFUNCTYPE(None, ctypes.c_char_p)(("strlen", ctypes.CDLL(None)))
        mujoco.set_mju_user_warning(ignore)


def digest(model: mujoco.MjModel, *settings: Any) -> str:
    """Returns digits that stand for a model and numbers: engines that have them alike can stand in for one another."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes() + repr(settings).encode()).hexdigest()[:16]


class BatchedModel:
    """A model of MuJoCo C, whose states are stepped in batches by all cores: what the host does for a compiled program.

    A copy, or a pickle, has batches of its own.
    """

    def __init__(self, model: mujoco.MjModel, num_threads: int | None):
        if num_threads is not None:
            check_number("num_threads", num_threads, "[1, 4096]")
        self._model = copy.copy(model)
        # Without this flag, MuJoCo silently resets a simulation that blows up to qpos0, and nobody can notice.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._num_threads = num_threads or usable_cores()

    def _begin(self) -> None:
        self._batches: dict[int, Batch] = {}
        self._lock = threading.Lock()  # a Batch serves one caller at a time
        _drop_warnings()

    def __getstate__(self) -> dict[str, Any]:
        """Returns what a copy, or a pickle, is made of: neither locks nor batches can be copied, and both are made anew."""
        return {name: value for name, value in vars(self).items() if name not in ("_batches", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._begin()

    def _batch(self, nsim: int) -> Batch:
        if nsim not in self._batches:
            self._batches[nsim] = Batch(self._model, nsim, self._num_threads)
        return self._batches[nsim]


class NativeEngine(BatchedModel):
    """MuJoCo C behind one call of the host a step, for any number of (nested) batch axes.

    The results are those of a plain loop over `mj_step` at any number of threads: float64 inside, float32 between steps.
    """

    name = "native"

    def __init__(self, model: mujoco.MjModel, substeps: int, num_threads: int | None = None):
        super().__init__(model, num_threads)
        # One gripper and one object: splitting the constraints into islands costs more (10 %) than it saves.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        self._substeps = substeps
        # Ends of qpos, qvel, warmstart and target in a packed row; ctrl is the rest.
        self._ends = np.cumsum([model.nq, model.nv, model.nv, 7])
        self._name = f"mjx_dher_native_{digest(self._model, substeps, self._num_threads)}"
        self._begin()

    def _begin(self) -> None:
        super()._begin()
        host_call.register(self._name, self._advance)

    def advance(self, physics: Physics, target: Array, ctrl: Array) -> Physics:
        # One array in and one out, because each costs the callback some 20 microseconds.
        state = jnp.concatenate([physics.qpos, physics.qvel, physics.warmstart])
        state = host_call.call(self._name, state.shape, jnp.concatenate([state, target, ctrl]))
        qpos, qvel, warmstart = jnp.split(state, self._ends[:2].tolist())
        return Physics(qpos=qpos, qvel=qvel, warmstart=warmstart)

    def check(self) -> None:
        pass  # nothing goes wrong unnoticed

    def _advance(self, inputs: Any) -> np.ndarray:
        """Advances `inputs` [..., row] on the host."""
        rows = np.asarray(inputs).reshape(-1, inputs.shape[-1])
        qpos, qvel, warmstart, target, ctrl = np.split(rows, self._ends, axis=1)
        with self._lock:
            batch = self._batch(len(rows))
            batch.bind("qpos")[:] = qpos
            batch.bind("qvel")[:] = qvel
            batch.bind("qacc_warmstart")[:] = warmstart
            batch.bind("mocap_pos")[:, 0] = target[:, :3]
            batch.bind("mocap_quat")[:, 0] = target[:, 3:]
            if self._model.nu:
                batch.bind("ctrl")[:] = ctrl
            batch.step(nstep=self._substeps)
            state = np.concatenate([batch.bind(name) for name in ("qpos", "qvel", "qacc_warmstart")], axis=1, dtype=np.float32)
        return state.reshape(*inputs.shape[:-1], -1)
