"""Physics on an NVIDIA GPU: a step of thousands of environments is one kernel, or one CUDA graph of MuJoCo Warp.

Only the state is passed in and out. `mjx.step` would pass some 170 arrays between XLA and Warp in every substep.
"""

import concurrent.futures
import copy
import threading
import warnings
import weakref
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from mjx_dher.envs.engines import Controls, Physics, check_shapes, graph
from mjx_dher.envs.engines.fused import simulation, support
from mjx_dher.envs.engines.fused.varied import NONE, Numbers
from mjx_dher.envs.engines.graph import Rows
from mjx_dher.envs.engines.variation import Variation
from mjx_dher.lookup import check_name
from mjx_dher.system import private_api
from mjx_dher.system.warp_setup import load, prepare, wp
from mjx_dher.validation import check_count

PATHS = ("auto", "fused", "graph")
_KEPT = 8  # batches to keep in memory, of the last sizes


class WarpEngine:
    """Physics on the device of the surrounding JAX program, by one of two paths.

    `fused` is the kernel of `engines.fused`. It matches MuJoCo C to single precision, and no sum depends on the order of
    threads. `graph` is MuJoCo Warp, which supports more features and is slower. The order of its sums varies. `path` and
    `note` tell which one runs, and why.

    Args:
      substeps: MuJoCo timesteps per environment step.
      path: "fused", "graph", or "auto": fused if the kernel supports the model.
      iterations: most Newton iterations of the constraint solver. Environments stop individually, usually after one or two.
        Default: 50 for `fused`, the model's for `graph`.
      ls_iterations: most steps of the solver's line search. Default: 20 for `fused`, the model's for `graph`.
      constraints: memory for constraint rows per environment. Default: all that can occur, or for `graph` with large models
        1.5 times as many as random controls cause.
      contacts: memory for contacts, with the same default. Only for `graph`.
      allow_cpu: whether to run without an NVIDIA GPU, on one thread, to compare engines.
      sensors: whether to make the object for `read_sensors` instead of `advance`. Only for `graph`.
      varied: as in `make_engine`.

    Raises:
      ValueError: JAX does not run on an NVIDIA GPU and `allow_cpu` is False, or the path does not support the model.
    """

    name = "warp"

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        path: str = "auto",
        iterations: int | None = None,
        ls_iterations: int | None = None,
        constraints: int | None = None,
        contacts: int | None = None,
        allow_cpu: bool = False,
        sensors: bool = False,
        varied: Sequence[str] = (),
    ):
        check_name("path of engine warp", path, PATHS)
        prepare()
        if not allow_cpu:
            _check_gpu()
        limits = {"iterations": iterations, "ls_iterations": ls_iterations, "constraints": constraints, "contacts": contacts}
        for name, count in limits.items():
            if count is not None:
                check_count(name, count)
        self._model, self._substeps, self._sensors = copy.copy(model), substeps, sensors
        self.allow_cpu = allow_cpu
        self._variation = Variation(model, varied)
        self._varied = [name for name in self._variation.fields if name != "dof_M0"]  # which MuJoCo Warp does not have
        self.path, self.note, rows = _choose(model, path, constraints)
        own = varied and self.path == "fused"
        self._numbers = Numbers(model, self._variation, 7 * model.nmocap + model.nu) if own else None
        self.name = "warp" if self.path == "fused" else "warp graph"  # separate names, because results differ
        if self.path == "graph":
            most_contacts, rows = graph.memory_for(model)
            defaults = (model.opt.iterations, model.opt.ls_iterations)
        else:
            most_contacts, defaults = 0, (simulation.ITERATIONS, simulation.LS_ITERATIONS)
        self._contacts, self._constraints, self._asked = contacts or most_contacts, constraints or rows, bool(constraints)
        self._model.opt.iterations, self._model.opt.ls_iterations = iterations or defaults[0], ls_iterations or defaults[1]
        self._begin()

    def _begin(self) -> None:
        self._simulations: dict[tuple[str, int], simulation.Simulation | graph.Simulation] = {}
        self._lost = 0  # contacts lost in batches that are no longer kept
        self._lock = threading.Lock()
        self._loading: list[concurrent.futures.Future[None]] | None = None
        self._call = self._jax_callable()

    def __getstate__(self) -> dict[str, Any]:
        """State of a copy or pickle, without locks, threads and device memory, which cannot be copied."""
        left_out = ("_simulations", "_lost", "_lock", "_loading", "_call")
        return {name: value for name, value in vars(self).items() if name not in left_out}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._begin()

    def _jax_callable(self) -> Any:
        """JAX function that advances a batch, and allocates its memory on the first call."""
        engine = weakref.ref(self)  # Warp never frees the function

        def advance_all(qpos: Rows, qvel: Rows, rest: Rows, inputs: Rows, qpos_out: Rows, qvel_out: Rows, rest_out: Rows):
            if (me := engine()) is None:
                raise RuntimeError("the engine of this program no longer exists; keep it as long as the program")
            me._wait()
            with me._lock:
                me._simulation(qpos.device, qpos.shape[0]).advance((qpos, qvel, rest), inputs, (qpos_out, qvel_out, rest_out))

        nq, nv, rest = self._model.nq, self._model.nv, self._model.nv + self._model.na
        rest += self._model.nsensordata if self._sensors else 0
        return wp.jax_callable(
            advance_all,
            num_outputs=3,
            graph_mode=wp.JaxCallableGraphMode.NONE,
            vmap_method="broadcast_all",
            output_dims={"qpos_out": (1, nq), "qvel_out": (1, nv), "rest_out": (1, rest)},
            module_preload_mode=wp.JaxModulePreloadMode.NONE,  # `_begin_loading` does it
        )

    def advance(self, physics: Physics, controls: Controls) -> Physics:
        qpos, qvel, rest = self._advanced(physics, controls)
        act = physics.act
        if self._model.na:
            rest, act = rest[: self._model.nv], rest[self._model.nv :]
        return Physics(qpos=qpos, qvel=qvel, warmstart=rest, act=act, factors=physics.factors)

    def read_sensors(self, physics: Physics, controls: Controls) -> jax.Array:
        """Values [nsensordata] of the model's sensors. The engine must be made with `sensors`."""
        return self._advanced(physics, controls)[2][self._model.nv + self._model.na :]

    def _advanced(self, physics: Physics, controls: Controls) -> list[jax.Array]:
        check_shapes(self._model, physics, controls, self._variation.size)
        self._begin_loading()
        rest = jnp.concatenate([physics.warmstart, physics.act]) if self._model.na else physics.warmstart
        rows = [x[None].astype(jnp.float32) for x in (physics.qpos, physics.qvel, rest)]
        private_api.reset_call_id(self._call)
        inputs = [controls.mocap.ravel(), controls.ctrl]
        if self._variation.size:
            with jax.default_matmul_precision("highest"):
                values = self._variation.values(self._variation.factors(physics.factors, jnp), jnp)
            inputs += self._numbers.row(values) if self._numbers else [values[name].ravel() for name in self._varied]
        return [x[0] for x in self._call(*rows, jnp.concatenate(inputs)[None])]

    def check(self) -> None:
        """Checks that no contacts were lost since the last call. Waits for the kernel to compile.

        Raises ValueError if the size that the engine was made with did not suffice, with a sufficient one. If the fused kernel
        had no room by default, which is rare, a warning says so. Their episodes are discarded, because the states are NaN.
        """
        self._wait()
        with self._lock:
            lost = self._lost + sum([each.overflow() for each in self._simulations.values()])
            self._lost = 0
        if not lost:
            return
        if self.path == "fused":
            fits, enough = simulation.rows_for(self._model, simulation.shared_memory()), simulation.most_rows(self._model)
            most = f"constraints={enough} are always enough" if fits == enough else "path='graph' has room for more"
            cure = f"constraints={self._constraints}; {most}"
            if not self._asked:
                warnings.warn(
                    "the fused kernel had no room for all contacts of some environments. Their states became NaN, and their"
                    f" episodes are discarded; {most}",
                    stacklevel=2,
                )
                return
        else:
            cure = f"contacts={self._contacts} and constraints={self._constraints}; try twice as many"
        raise ValueError(f"the warp engine had no room for all contacts: it was made with {cure}")

    def _begin_loading(self) -> None:
        """Compiles the kernel in a thread while XLA compiles the rest. Takes a quarter of a minute, once per machine."""
        if self._loading is None:
            pool = concurrent.futures.ThreadPoolExecutor(2)
            # Warp also needs the module of the function that JAX calls, though it has no kernel.
            self._loading = [pool.submit(lambda: self._made(1).load()), pool.submit(load, wp.get_module(__name__))]
            pool.shutdown(wait=False)

    def _wait(self) -> None:
        for loading in self._loading or ():
            loading.result()

    def _made(self, num_envs: int) -> simulation.Simulation | graph.Simulation:
        if self.path == "graph":
            sizes = self._substeps, self._contacts, self._constraints
            return graph.Simulation(self._model, num_envs, *sizes, self._sensors, self._varied)
        begins = self._numbers.begins if self._numbers else NONE
        return simulation.Simulation(self._model, num_envs, self._substeps, self._constraints, begins)

    def _simulation(self, device: Any, num_envs: int) -> simulation.Simulation | graph.Simulation:
        key = (str(device), num_envs)
        made = self._simulations.pop(key, None)
        if made is None:
            try:
                with wp.ScopedDevice(device):  # several GPUs call from one process
                    made = self._made(num_envs)
            except RuntimeError as error:
                raise _out_of_memory(error, num_envs) from error
        self._simulations[key] = made
        if len(self._simulations) > _KEPT:
            self._lost += self._simulations.pop(next(iter(self._simulations))).overflow()
        return made


def _choose(model: mujoco.MjModel, path: str, constraints: int | None) -> tuple[str, str, int]:
    """Path that runs, the reason, and the rows of `fused`. Raises ValueError if the path does not support the model."""
    left_out, reason = support.unsupported(model), "as asked"
    if left_out and path != "graph":
        reason = f"the fused kernel does not support features of the model: {', '.join(left_out)}"
        if path == "fused":
            raise ValueError(f"engine warp: {reason}")
    if path != "graph" and not left_out:
        try:
            rows = constraints or simulation.rows_for(model, simulation.shared_memory())
            simulation.check_fits(model, rows)
            return "fused", "the fused kernel", rows
        except ValueError as error:
            if path == "fused":
                raise
            reason = str(error)
    if unknown := graph.unsupported(model):
        raise ValueError(f"engine warp does not support features of the model: {', '.join(unknown)}; use engine native")
    return "graph", f"MuJoCo Warp; {reason}", 0


def _out_of_memory(error: RuntimeError, num_envs: int) -> Exception:
    """MemoryError with a cure, or the error itself if it has another cause."""
    if "Failed to allocate" not in str(error):
        return error
    return MemoryError(
        f"engine warp has too little GPU memory for {num_envs} environments ({error}): use fewer num_envs or eval_episodes, or"
        " leave it more than a quarter of the memory, as XLA_PYTHON_CLIENT_MEM_FRACTION=0.5 does"
    )


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
