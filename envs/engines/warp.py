"""MuJoCo Warp, the CUDA implementation that MJX brings: thousands of environments on one NVIDIA GPU.

One call advances the whole batch by all substeps of an environment step, in a CUDA graph that is captured once for each number
of environments. Only the state goes in and out; `mjx.step` would pass some 170 arrays from Warp to XLA and back every substep.
"""
# Not `from __future__ import annotations`: Warp reads the annotations of `advance_all` as types.

import concurrent.futures
import copy
import threading
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.config import check_count
from mjx_dher.envs.engines.base import Physics, with_stand_ins
from mjx_dher.envs.engines.fused import simulation as fused_simulation
from mjx_dher.envs.engines.warp_substep import make_substep
from mjx_dher.host import private_api
from mjx_dher.host.warp_setup import prepare, wp
from mjx_dher.types import Array

mujoco_warp = private_api.mujoco_warp()

# Maximum number of contacts between two geoms, by their kinds.
_MAX_CONTACTS = {
    frozenset(("PLANE", "BOX")): 4,
    frozenset(("PLANE", "CYLINDER")): 4,
    frozenset(("SPHERE", "BOX")): 1,
    frozenset(("BOX",)): 8,
}
_OVERFLOWS = ("NEFC", "BROADPHASE", "NARROWPHASE", "CCD", "EPA_HORIZON")  # overflows that lose contacts or constraints


class WarpEngine:
    """MuJoCo Warp on the device of the JAX program around it.

    Sums depend on the order in which threads finish: two runs agree to rounding, not bit for bit.

    Args:
      model: the compiled MJCF, with exactly one mocap body.
      substeps: MuJoCo timesteps an environment step.
      iterations: maximum Newton iterations of the constraint solver; by default 8, since the slowest environment of the batch
        sets the pace, and 50 with `fused`, where each stops by itself.
      ls_iterations: maximum steps of the solver's line search; by default 8, and 20 with `fused`.
      contacts: contacts per environment (a mean over the batch) that fit into memory; by default, all that can occur.
      constraints: constraint rows that fit into memory in each environment; by default, all that can occur, and up to 96 with
        `fused`.
      fused: whether one kernel of this library takes the whole step instead of MuJoCo Warp's many. It follows MuJoCo C to
        rounding, the puck's cylinder included, its sums do not depend on the order of threads, and it has memory for all
        contacts (`contacts` cannot be set). Not yet as fast (docs/design.md).
      allow_cpu: whether to run without an NVIDIA GPU, on one thread: for comparing engines, not for training.

    Raises:
      ValueError: JAX does not run on an NVIDIA GPU, and `allow_cpu` is False; or the model has what `fused` leaves out.
    """

    name = "warp"

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        iterations: int | None = None,
        ls_iterations: int | None = None,
        contacts: int | None = None,
        constraints: int | None = None,
        fused: bool = False,
        allow_cpu: bool = False,
    ):
        _check_counts(iterations=iterations, ls_iterations=ls_iterations, contacts=contacts, constraints=constraints)
        if not allow_cpu:
            _check_gpu()
        if fused:
            _check_fused(model, contacts)
        self._fused = fused
        self._model = copy.copy(model) if fused else with_stand_ins(model)
        self._model.opt.iterations = iterations or (fused_simulation.ITERATIONS if fused else 8)
        self._model.opt.ls_iterations = ls_iterations or (fused_simulation.LS_ITERATIONS if fused else 8)
        # Box-box contacts are analytic, as in MuJoCo C, not from the general convex algorithm.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        self._substeps = substeps
        self.most_contacts, self.most_constraints = fused_simulation.capacities(model) if fused else capacities(self._model)
        self._contacts = contacts or self.most_contacts
        self._constraints = constraints or (
            min(fused_simulation.ROWS, self.most_constraints) if fused else self.most_constraints
        )
        self._simulations: dict[tuple[str, int], Any] = {}
        self._lock = threading.Lock()
        self._loading: concurrent.futures.Future[None] | None = None
        self._call = self._jax_callable()

    def __getstate__(self) -> dict[str, Any]:
        """Returns what a copy, or a pickle, is made of: a lock, a thread and the device's memory cannot be copied."""
        made_anew = ("_simulations", "_lock", "_loading", "_call")
        return {name: value for name, value in vars(self).items() if name not in made_anew}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _simulations={}, _lock=threading.Lock(), _loading=None)
        self._call = self._jax_callable()

    def _jax_callable(self) -> Any:
        """Returns a function of JAX that advances a batch; it makes the batch's memory when it first runs."""

        def advance_all(
            qpos: wp.array2d(dtype=float),  # type: ignore[valid-type]
            qvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
            warmstart: wp.array2d(dtype=float),  # type: ignore[valid-type]
            inputs: wp.array2d(dtype=float),  # type: ignore[valid-type]
            qpos_out: wp.array2d(dtype=float),  # type: ignore[valid-type]
            qvel_out: wp.array2d(dtype=float),  # type: ignore[valid-type]
            warmstart_out: wp.array2d(dtype=float),  # type: ignore[valid-type]
        ):
            self._wait()
            with self._lock:
                simulation = self._simulation(qpos.device, qpos.shape[0])
                simulation.advance((qpos, qvel, warmstart), inputs, (qpos_out, qvel_out, warmstart_out))

        nq, nv = self._model.nq, self._model.nv
        return wp.jax_callable(
            advance_all,
            num_outputs=3,
            graph_mode=wp.JaxCallableGraphMode.NONE,  # `_Simulation` captures one graph for all buffers
            vmap_method="broadcast_all",
            output_dims={"qpos_out": (1, nq), "qvel_out": (1, nv), "warmstart_out": (1, nv)},
            module_preload_mode=wp.JaxModulePreloadMode.NONE,  # `_load` does it; two at once would clash
        )

    def advance(self, physics: Physics, target: Array, ctrl: Array) -> Physics:
        self._begin_loading()
        rows = [x[None].astype(jnp.float32) for x in (physics.qpos, physics.qvel, physics.warmstart)]
        private_api.reset_call_id(self._call)
        qpos, qvel, warmstart = self._call(*rows, jnp.concatenate([target, ctrl])[None])
        return Physics(qpos=qpos[0], qvel=qvel[0], warmstart=warmstart[0])

    def check(self) -> None:
        """Checks that no contacts or constraints were lost since the last call; waits for kernels to compile.

        Raises:
          ValueError: memory did not suffice; the message names what was lost and the sizes that always suffice.
        """
        lost = 0
        self._wait()
        with self._lock:
            for simulation in self._simulations.values():
                lost |= simulation.overflow()
        if lost and self._fused:
            raise ValueError(
                f"the warp engine left out contacts that there was no room for: it was made with"
                f" constraints={self._constraints}; constraints={self.most_constraints} are always enough"
            )
        names = [name for name in _OVERFLOWS if lost & int(mujoco_warp.OverflowType[name])]
        if names:
            raise ValueError(
                f"the warp engine lost contacts or constraints ({', '.join(names).lower()}): it was made with"
                f" contacts={self._contacts} and constraints={self._constraints}; contacts={self.most_contacts} and"
                f" constraints={self.most_constraints} are always enough"
            )

    def _begin_loading(self) -> None:
        """Compiles the kernels in a thread while XLA compiles the rest: most of a minute, once a machine."""
        if self._loading is None:
            pool = concurrent.futures.ThreadPoolExecutor(1)
            self._loading = pool.submit(self._load)
            pool.shutdown(wait=False)

    def _load(self) -> None:
        prepare()
        if self._fused:
            fused_simulation.load(self._model, self._constraints)
            return
        _Simulation(self._model, 1, 1, self._contacts, self._constraints).run()
        wp.synchronize()

    def _wait(self) -> None:
        if self._loading is not None:
            self._loading.result()

    def _simulation(self, device: Any, num_envs: int) -> Any:
        key = (str(device), num_envs)
        if key not in self._simulations:
            self._simulations[key] = (
                fused_simulation.FusedSimulation(self._model, num_envs, self._substeps, rows=self._constraints)
                if self._fused
                else _Simulation(self._model, num_envs, self._substeps, self._contacts, self._constraints)
            )
        return self._simulations[key]


class _Simulation:
    """The memory of `num_envs` environments on Warp's current device, and the graph that advances them."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, substeps: int, contacts: int, constraints: int):
        self._model = mujoco_warp.put_model(model)
        self._model.opt.warn_overflow = 0  # a kernel that prints would stop all others
        self._data = mujoco_warp.make_data(model, nworld=num_envs, naconmax=num_envs * contacts, njmax=constraints)
        self._substep, self._substeps = make_substep(model, self._model, self._data), substeps
        self._graph: Any = None
        self._inputs = wp.zeros((num_envs, 7 + model.nu), dtype=float)

    def advance(self, state: tuple[Any, Any, Any], inputs: Any, result: tuple[Any, Any, Any]) -> None:
        data = self._data
        held = (data.qpos, data.qvel, data.qacc_warmstart)
        for array, given in zip(held, state):
            wp.copy(array, given)
        wp.copy(self._inputs, inputs)
        if not wp.get_device().is_cuda:
            self.run()
        else:
            if self._graph is None:
                with wp.ScopedCapture() as capture:
                    self.run()
                self._graph = capture.graph
            wp.capture_launch(self._graph)
        for taken, array in zip(result, held):
            wp.copy(taken, array)

    def run(self) -> None:
        data = self._data
        num_envs = data.nworld
        wp.launch(_set_inputs, dim=num_envs, inputs=[self._inputs], outputs=[data.mocap_pos, data.mocap_quat, data.ctrl])
        for _ in range(self._substeps):
            self._substep()

    def overflow(self) -> int:
        """Returns the kinds of overflow since the last call, as a mask."""
        mask = int(np.bitwise_or.reduce(self._data.overflow.numpy()))
        self._data.overflow.zero_()
        return mask


@wp.kernel
def _set_inputs(
    inputs: wp.array2d(dtype=float),  # type: ignore[valid-type]
    mocap_pos: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
    mocap_quat: wp.array2d(dtype=wp.quat),  # type: ignore[valid-type]
    ctrl: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
    world = wp.tid()
    mocap_pos[world, 0] = wp.vec3(inputs[world, 0], inputs[world, 1], inputs[world, 2])
    mocap_quat[world, 0] = wp.quat(inputs[world, 3], inputs[world, 4], inputs[world, 5], inputs[world, 6])
    for i in range(ctrl.shape[1]):
        ctrl[world, i] = inputs[world, 7 + i]


def _check_counts(**counts: int | None) -> None:
    for name, count in counts.items():
        if count is not None:
            check_count(name, count)


def _check_gpu() -> None:
    if jax.default_backend() not in ("gpu", "cuda") or not wp.is_cuda_available():
        raise ValueError(
            f"engine warp needs JAX on an NVIDIA GPU, and JAX runs on {jax.default_backend()} here:"
            ' pip install -e ".[cuda]" on a machine that has one, or use engine native or jax'
        )


def _check_fused(model: mujoco.MjModel, contacts: int | None) -> None:
    if contacts is not None:
        raise ValueError("contacts cannot be set with fused=True, which has memory for all that can occur")
    left_out = fused_simulation.unsupported(model)
    if left_out:
        raise ValueError(f"fused=True leaves out what the model has: {', '.join(left_out)}; make the engine without it")


def capacities(model: mujoco.MjModel) -> tuple[int, int]:
    """Returns the maximum numbers of contacts and of constraint rows in one environment, if all pairs touch at once.

    Raises:
      ValueError: the number of contacts of a pair of geoms is not known.
    """
    contacts, rows = 0, 6 * model.neq + 2 * int(np.count_nonzero(model.jnt_limited))
    for geom1, geom2, dim in zip(model.pair_geom1, model.pair_geom2, model.pair_dim):
        kinds = frozenset(mujoco.mjtGeom(int(model.geom_type[geom])).name[len("mjGEOM_") :] for geom in (geom1, geom2))
        if kinds not in _MAX_CONTACTS:
            raise ValueError(f"no bound on the contacts between {' and '.join(sorted(kinds)).lower()}")
        contacts += _MAX_CONTACTS[kinds]
        rows += _MAX_CONTACTS[kinds] * (1 if dim == 1 else 2 * (int(dim) - 1))  # pyramidal cones
    return contacts, rows
