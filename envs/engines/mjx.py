"""MuJoCo MJX, the JAX implementation: runs wherever JAX runs, and is the reference for everything that is traced."""

from __future__ import annotations

import contextlib
import copy
import io

import jax
import mujoco
import numpy as np

from mjx_dher.envs.engines.base import Physics
from mjx_dher.types import Array

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints a line when the optional warp-lang is absent
    from mujoco import mjx


class MjxEngine:
    """MJX with impl="jax".

    The constraint solver is a while loop that runs, under `vmap`, until the slowest environment has converged; so its
    iterations are capped. tests/test_engines.py states what the cap costs against MuJoCo C.
    """

    name = "jax"

    def __init__(self, model: mujoco.MjModel, substeps: int, iterations: int = 4, ls_iterations: int = 5):
        model = copy.copy(model)
        model.opt.iterations = iterations
        model.opt.ls_iterations = ls_iterations
        try:
            self._model = mjx.put_model(model, impl="jax")
        except NotImplementedError as error:  # slide: a cylinder against boxes
            raise ValueError(f"engine jax cannot simulate this task ({error}); engine native can") from error
        # NumPy leaves: constants of whatever program traces them, on whatever device it runs.
        self._data = jax.tree.map(np.asarray, mjx.make_data(model, impl="jax"))
        self._substeps = substeps

    def advance(self, physics: Physics, mocap_pos: Array, ctrl: Array) -> Physics:
        def substep(_, p: Physics) -> Physics:
            data = self._data.replace(
                qpos=p.qpos, qvel=p.qvel, qacc_warmstart=p.warmstart, mocap_pos=mocap_pos[None], ctrl=ctrl
            )
            data = mjx.step(self._model, data)
            return Physics(qpos=data.qpos, qvel=data.qvel, warmstart=data.qacc_warmstart)

        with jax.default_matmul_precision("highest"):  # TF32 breaks contacts
            return jax.lax.fori_loop(0, self._substeps, substep, physics)
