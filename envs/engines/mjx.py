"""MuJoCo MJX, the JAX implementation: runs wherever JAX runs, and is the reference for everything that is traced."""

from __future__ import annotations

import contextlib
import copy
import io
from collections.abc import Iterator

import jax
import mujoco
import numpy as np

from mjx_dher.envs.engines.base import Physics
from mjx_dher.types import Array

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints a line when the optional warp-lang is absent
    from mujoco import mjx
    from mujoco.mjx._src import scan


@contextlib.contextmanager
def _bodies_computed_once() -> Iterator[None]:
    """While tracing: keeps XLA's CPU backend from computing each body's pose anew for each of its descendants.

    Its fusion emitters (JAX 0.10) fuse MJX's walk along the arm into one loop that repeats all ancestors for every use of them:
    0.7 s instead of 0.9 ms for the kinematics of 16 environments on 2 cores. A barrier after each level ends the fusion.
    """
    walk = scan.body_tree

    def body_tree(model, f, *args, **kwargs):
        return walk(model, lambda *level: jax.lax.optimization_barrier(f(*level)), *args, **kwargs)

    scan.body_tree = body_tree
    try:
        yield
    finally:
        scan.body_tree = walk


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
        self._model = mjx.put_model(model, impl="jax")
        # NumPy leaves: constants of whatever program traces them, on whatever device it runs.
        self._data = jax.tree.map(np.asarray, mjx.make_data(model, impl="jax"))
        self._substeps = substeps

    def advance(self, physics: Physics, target: Array, ctrl: Array) -> Physics:
        def substep(_, p: Physics) -> Physics:
            data = self._data.replace(
                qpos=p.qpos,
                qvel=p.qvel,
                qacc_warmstart=p.warmstart,
                mocap_pos=target[None, :3],
                mocap_quat=target[None, 3:],
                ctrl=ctrl,
            )
            with _bodies_computed_once() if jax.default_backend() == "cpu" else contextlib.nullcontext():
                data = mjx.step(self._model, data)
            return Physics(qpos=data.qpos, qvel=data.qvel, warmstart=data.qacc_warmstart)

        with jax.default_matmul_precision("highest"):  # TF32 breaks contacts
            return jax.lax.fori_loop(0, self._substeps, substep, physics)
