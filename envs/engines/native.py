"""MuJoCo's C engine on all cores of the host, called from inside compiled JAX programs."""

from __future__ import annotations

import copy
import os
import threading
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco.batch import Batch

from mjx_dher.envs.engines.base import Physics
from mjx_dher.types import Array


def usable_cores() -> int:
    """The cores that this process may run on, which a container or `taskset` can hold below those of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class NativeEngine:
    """One `jax.pure_callback` a step, whatever the number of (nested) batch axes around it.

    The results are those of a plain loop over `mj_step` at any number of threads: float64 inside, float32 between steps.
    """

    name = "native"

    def __init__(self, model: mujoco.MjModel, substeps: int, num_threads: int | None = None):
        self._model = copy.copy(model)
        # One gripper and one object: splitting the constraints into islands costs more (10 %) than it saves.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        self._substeps = substeps
        self._num_threads = num_threads or usable_cores()
        self._batches: dict[int, Batch] = {}
        self._lock = threading.Lock()  # a Batch serves one caller at a time

    def advance(self, physics: Physics, mocap_pos: Array, ctrl: Array) -> Physics:
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), physics)
        return jax.pure_callback(self._advance, shapes, physics, mocap_pos, ctrl, vmap_method="broadcast_all")

    def _advance(self, physics: Any, mocap_pos: Any, ctrl: Any) -> Physics:
        """The host side: arrays lead with the batch axes, any number of them. NumPy only: JAX calls could deadlock."""
        qpos, qvel, warmstart = (np.asarray(x) for x in (physics.qpos, physics.qvel, physics.warmstart))
        nsim = int(np.prod(qpos.shape[:-1], dtype=int))
        with self._lock:
            batch = self._batch(nsim)
            batch.bind("qpos")[:] = qpos.reshape(nsim, -1)
            batch.bind("qvel")[:] = qvel.reshape(nsim, -1)
            batch.bind("qacc_warmstart")[:] = warmstart.reshape(nsim, -1)
            batch.bind("mocap_pos")[:] = np.asarray(mocap_pos).reshape(nsim, 1, 3)
            if self._model.nu:
                batch.bind("ctrl")[:] = np.asarray(ctrl).reshape(nsim, -1)
            batch.step(nstep=self._substeps)
            return Physics(
                qpos=batch.bind("qpos").astype(np.float32).reshape(qpos.shape),
                qvel=batch.bind("qvel").astype(np.float32).reshape(qvel.shape),
                warmstart=batch.bind("qacc_warmstart").astype(np.float32).reshape(warmstart.shape),
            )

    def _batch(self, nsim: int) -> Batch:
        if nsim not in self._batches:
            self._batches[nsim] = Batch(self._model, nsim, self._num_threads)
        return self._batches[nsim]
