"""Physics on an NVIDIA GPU: one kernel, written in Warp, takes a whole step of thousands of environments.

Only the state goes in and out; `mjx.step` would pass some 170 arrays from Warp to XLA and back every substep.
"""
# Not `from __future__ import annotations`: Warp reads the annotations of `advance_all` as types.

import concurrent.futures
import copy
import threading
import weakref
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from mjx_dher.envs.engines.base import Controls, Physics, check_shapes
from mjx_dher.envs.engines.fused import simulation, support
from mjx_dher.system import private_api
from mjx_dher.system.warp_setup import load, prepare, wp
from mjx_dher.validation import check_count


class WarpEngine:
    """The kernel of `engines.fused` on the device of the JAX program around it.

    It follows MuJoCo C to the rounding of single precision, the cylinder of Slide's puck included. No sum depends on the order
    in which threads finish.

    Args:
      model: the compiled MJCF; `fused.support.unsupported` lists the features that it must not have.
      substeps: MuJoCo timesteps an environment step.
      iterations: maximum Newton iterations of the constraint solver; each environment stops by itself, most after one or two.
      ls_iterations: maximum steps of the solver's line search.
      constraints: constraint rows that fit into memory in each environment; by default all that can occur.
      allow_cpu: whether to run without an NVIDIA GPU, on one thread: for comparing engines, not for training.

    Raises:
      ValueError: JAX does not run on an NVIDIA GPU, and `allow_cpu` is False; or the kernel does not support the model.
    """

    name = "warp"

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        iterations: int = simulation.ITERATIONS,
        ls_iterations: int = simulation.LS_ITERATIONS,
        constraints: int | None = None,
        allow_cpu: bool = False,
    ):
        prepare()
        if not allow_cpu:
            _check_gpu()
        if left_out := support.unsupported(model):
            raise ValueError(f"engine warp does not support features of the model: {', '.join(left_out)}; use engine native")
        self.most_constraints = simulation.most_rows(model)
        self._constraints = self.most_constraints if constraints is None else constraints
        for name, count in {
            "iterations": iterations,
            "ls_iterations": ls_iterations,
            "constraints": self._constraints,
        }.items():
            check_count(name, count)
        self._model = copy.copy(model)
        self._model.opt.iterations, self._model.opt.ls_iterations = iterations, ls_iterations
        self._substeps = substeps
        self._simulations: dict[tuple[str, int], simulation.Simulation] = {}
        self._lock = threading.Lock()
        self._loading: list[concurrent.futures.Future[None]] | None = None
        self._call = self._jax_callable()

    def __getstate__(self) -> dict[str, Any]:
        """The state of a copy or pickle, without locks, threads and device memory, which cannot be copied."""
        left_out = ("_simulations", "_lock", "_loading", "_call")
        return {name: value for name, value in vars(self).items() if name not in left_out}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _simulations={}, _lock=threading.Lock(), _loading=None)
        self._call = self._jax_callable()

    def _jax_callable(self) -> Any:
        """Makes a JAX function that advances a batch and allocates the batch's memory on its first call."""
        engine = weakref.ref(self)  # Warp keeps the function for ever

        def advance_all(
            qpos: wp.array2d(dtype=float),  # type: ignore[valid-type]
            qvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
            warmstart: wp.array2d(dtype=float),  # type: ignore[valid-type]
            inputs: wp.array2d(dtype=float),  # type: ignore[valid-type]
            qpos_out: wp.array2d(dtype=float),  # type: ignore[valid-type]
            qvel_out: wp.array2d(dtype=float),  # type: ignore[valid-type]
            warmstart_out: wp.array2d(dtype=float),  # type: ignore[valid-type]
        ):
            if (me := engine()) is None:
                raise RuntimeError("the engine that this program calls no longer exists; keep it for as long as the program")
            me._wait()
            with me._lock:
                me._simulation(qpos.device, qpos.shape[0]).advance(
                    (qpos, qvel, warmstart), inputs, (qpos_out, qvel_out, warmstart_out)
                )

        nq, nv = self._model.nq, self._model.nv
        return wp.jax_callable(
            advance_all,
            num_outputs=3,
            graph_mode=wp.JaxCallableGraphMode.NONE,
            vmap_method="broadcast_all",
            output_dims={"qpos_out": (1, nq), "qvel_out": (1, nv), "warmstart_out": (1, nv)},
            module_preload_mode=wp.JaxModulePreloadMode.NONE,  # `_begin_loading` does it
        )

    def advance(self, physics: Physics, controls: Controls) -> Physics:
        check_shapes(self._model, physics, controls)
        self._begin_loading()
        rows = [x[None].astype(jnp.float32) for x in (physics.qpos, physics.qvel, physics.warmstart)]
        private_api.reset_call_id(self._call)
        qpos, qvel, warmstart = self._call(*rows, jnp.concatenate([controls.mocap.ravel(), controls.ctrl])[None])
        return Physics(qpos=qpos[0], qvel=qvel[0], warmstart=warmstart[0], act=physics.act)

    def check(self) -> None:
        """Checks that no contacts were lost since the last call; waits for the kernel to compile.

        Raises:
          ValueError: memory did not suffice; the message names the size that always suffices.
        """
        self._wait()
        with self._lock:
            lost = sum([each.overflow() for each in self._simulations.values()])
        if lost:
            raise ValueError(
                f"the warp engine left out contacts that there was no room for: it was made with"
                f" constraints={self._constraints}; constraints={self.most_constraints} are always enough"
            )

    def _begin_loading(self) -> None:
        """Compiles the kernel in a thread while XLA compiles the rest: a quarter of a minute, once a machine."""
        if self._loading is None:
            pool = concurrent.futures.ThreadPoolExecutor(2)
            # Warp wants the module of the function that JAX calls, too, though there is no kernel in it.
            self._loading = [pool.submit(self._made(1).load), pool.submit(load, wp.get_module(__name__))]
            pool.shutdown(wait=False)

    def _wait(self) -> None:
        for loading in self._loading or ():
            loading.result()

    def _made(self, num_envs: int) -> simulation.Simulation:
        return simulation.Simulation(self._model, num_envs, self._substeps, self._constraints)

    def _simulation(self, device: Any, num_envs: int) -> simulation.Simulation:
        key = (str(device), num_envs)
        if key not in self._simulations:
            with wp.ScopedDevice(device):  # several GPUs call from one process
                self._simulations[key] = self._made(num_envs)
        return self._simulations[key]


def _check_gpu() -> None:
    if jax.default_backend() not in ("gpu", "cuda"):
        raise ValueError(
            f"engine warp needs JAX on an NVIDIA GPU, and JAX runs on {jax.default_backend()} here:"
            ' pip install -e ".[cuda]" on a machine that has one, or use engine native or jax'
        )
    if not wp.is_cuda_available():
        raise ValueError(
            f"engine warp: Warp {wp.config.version} cannot use this machine's NVIDIA driver, though JAX can; a newer driver"
            " helps (https://nvidia.github.io/warp names the oldest), or engine jax"
        )
