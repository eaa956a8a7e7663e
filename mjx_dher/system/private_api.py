"""All private names of MJX, MuJoCo Warp, Warp, orbax and viser that this library uses, each behind a function.

Each function documents the private names, why they are needed, and by which versions. When a newer version no longer needs a
function, tests/test_private_api.py fails and names it. Libraries are imported on the first call.

Two uses of internals stay where they are, because they are not Python names:

- `runs.loop.compile_lowered` disables XLA's pass triton-softmax-rewriter (jaxlib 0.10.2; no upstream issue known).
- envs/engines/fused/threads.py uses `wp::array_t` and `dynamic_smem_base` of Warp's C++ code (warp-lang 1.18.0; no upstream
  issue known).
"""

import contextlib
import contextvars
import functools
import importlib
import io
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from types import ModuleType, SimpleNamespace
from typing import Any


@contextlib.contextmanager
def bodies_computed_once() -> Iterator[None]:
    """Prevents XLA's CPU backend from computing each body's pose again for each of its descendants, while tracing.

    Private: `mujoco.mjx._src.scan.body_tree`, which is replaced during the block, for every thread.
    Why: XLA's fusion emitters fuse MJX's walk along the arm into one loop that repeats all ancestors for every use of them:
      0.7 s instead of 0.9 ms for the kinematics of 16 environments on 2 cores. A barrier after each level ends the fusion.
      On an AMD EPYC the emitters are off by default (2026-11-28), and barriers make no difference.
    Needed by: mujoco-mjx 3.17.0 with jaxlib 0.10.2. The same slowdown is reported, since JAX 0.7, in
      https://github.com/google-deepmind/mujoco/issues/2957 and https://github.com/jax-ml/jax/issues/33761 (both closed).
    """
    import jax
    from mujoco.mjx._src import scan

    walk = scan.body_tree

    def body_tree(model, f, *args, **kwargs):
        return walk(model, lambda *level: jax.lax.optimization_barrier(f(*level)), *args, **kwargs)

    scan.body_tree = body_tree
    try:
        yield
    finally:
        scan.body_tree = walk


def mask_of_velocity_derivative() -> contextvars.ContextVar[Any]:
    """Makes MJX multiply its derivative of forces by velocities [nv, nv] by the value of the returned variable, if it has one.

    Private: `mujoco.mjx._src.derivative.deriv_smooth_vel`, which is replaced for good. Each thread has its own value.
    Why: MuJoCo C leaves out entries of two degrees of freedom without common inertia, and MJX keeps them.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known.
    """
    from mujoco.mjx._src import derivative

    full, mask = derivative.deriv_smooth_vel, contextvars.ContextVar[Any]("mask", default=None)

    def masked(model, data):
        derivatives = full(model, data)
        return derivatives if derivatives is None or mask.get() is None else derivatives * mask.get()

    derivative.deriv_smooth_vel = masked
    return mask


def shift_reference_acceleration(data: Any, shift: Any) -> Any:
    """MJX `data` with `shift` [R] added to the reference acceleration of the first R constraint rows.

    Private: `Data._impl.efc_aref`, and that equality constraints come first.
    Why: MJX leaves J' qvel out of a weld's reference acceleration, which MuJoCo C and MuJoCo Warp include.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known; https://github.com/google-deepmind/mujoco_warp/pull/1294 added the
      term to MuJoCo Warp.
    """
    aref = data._impl.efc_aref
    return data.tree_replace({"_impl.efc_aref": aref.at[: shift.shape[0]].add(shift)})


@functools.cache
def mujoco_warp_shapes() -> SimpleNamespace:
    """MuJoCo Warp's kernel functions that find the contacts of two shapes.

    Private: all of them, in `mujoco.mjx.third_party.mujoco_warp._src.collision_primitive_core`, and that this module can be
      imported without the imports of its parent packages.
    Why: the fused kernel's contacts of boxes must match MuJoCo C, whose long algorithm MuJoCo Warp follows. Importing the
      packages takes 3.4 s, the module alone 0.3 s.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known.
    """
    import mujoco

    names = ["mjx", "mjx.third_party", "mjx.third_party.mujoco_warp", "mjx.third_party.mujoco_warp._src"]
    packages = {f"mujoco.{name}": os.path.join(mujoco.__path__[0], *name.split(".")) for name in names}
    bare = {} if "mujoco.mjx" in sys.modules else packages
    for name, folder in bare.items():
        sys.modules[name] = ModuleType(name)
        sys.modules[name].__path__ = [folder]
    try:
        core = importlib.import_module(f"{[*packages][-1]}.collision_primitive_core")
    finally:
        if bare:  # so that other code imports the complete packages
            for name in [name for name in sys.modules if f"{name}.".startswith("mujoco.mjx.")]:
                del sys.modules[name]
    used = ("box_box", "plane_cylinder", "plane_ellipsoid", "plane_sphere", "sphere_sphere", "sphere_capsule", "sphere_box")
    return SimpleNamespace(**{name: getattr(core, name) for name in (*used, "capsule_capsule", "capsule_box")})


@contextlib.contextmanager
def drawing_with(backend: str) -> Iterator[None]:
    """Makes a new `mujoco.Renderer` draw with "egl", "osmesa" or "glfw" during the block. Other names change nothing.

    Private: `GLContext` of the module `gl_context` that `mujoco.Renderer` uses, which is replaced during the block.
    Why: MuJoCo reads MUJOCO_GL when it is first imported, possibly by other code, and otherwise draws with glfw, which needs a
      screen.
    Needed by: mujoco 3.17.0. No upstream issue known.
    """
    import mujoco

    module = sys.modules[mujoco.Renderer.__module__].gl_context
    chosen = module.GLContext
    if backend in ("egl", "osmesa", "glfw"):
        module.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext
    try:
        yield
    finally:
        module.GLContext = chosen


@functools.cache
def mujoco_warp() -> Any:
    """MJX's copy of MuJoCo Warp.

    Private: `mujoco.mjx.third_party.mujoco_warp`.
    Why: MJX calls each substep separately, with some 170 arrays that XLA passes in and out. The engine calls the step in
      a CUDA graph instead. The separate package is another version, and needs another Warp.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known.
    """
    with contextlib.redirect_stdout(io.StringIO()):  # MJX may print a line
        return importlib.import_module("mujoco.mjx.third_party.mujoco_warp")


def overflow_of_memory() -> int:
    """Bits of MuJoCo Warp's `Data.overflow` for contacts or rows without memory.

    Private: `mujoco.mjx.third_party.mujoco_warp._src.types.OverflowType`.
    Why: other bits report a solver at its iteration limit, or sensors.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known.
    """
    kinds = importlib.import_module("mujoco.mjx.third_party.mujoco_warp._src.types").OverflowType
    names = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "HFIELD", "NVMAX", "EPA_HORIZON")
    return int(sum(int(kinds[name]) for name in names))


def reset_call_id(callable_: Any) -> None:
    """Numbers the next trace of a `warp.jax_callable` as its first.

    Private: `FfiCallable.call_id`.
    Why: Warp writes the number of the trace into the program, so JAX finds no cached program.
    Needed by: warp-lang 1.18.0. No upstream issue known.
    """
    callable_.call_id = 0


def array_checkpointer() -> Any:
    """Orbax checkpointer, which reads checkpoints of version 0.2.0 and before.

    Private: nothing by name, but `PyTreeCheckpointHandler` belongs to orbax's older interface.
    Why: older folders stay readable.
    Needed by: orbax-checkpoint 0.12.8. https://github.com/google/orbax/issues/1624 (open) will replace the interface.
    """
    import jax
    import orbax.checkpoint

    alone: dict[str, Any] = {}
    if jax.process_count() > 1:  # otherwise orbax would make all processes wait for each other
        own = jax.process_index()
        options = orbax.checkpoint.options.MultiprocessingOptions(primary_host=own, active_processes={own})
        alone = {"multiprocessing_options": options}
    handler = orbax.checkpoint.PyTreeCheckpointHandler(**alone)
    return orbax.checkpoint.Checkpointer(handler, **alone)


@contextlib.contextmanager
def viser_served_with(adapt: Callable[[Mapping[str, Any]], Mapping[str, Any]]) -> Iterator[None]:
    """Makes a viser server that starts during the block use the options that `adapt` makes from viser's.

    Private: that viser calls `websockets.asyncio.server.serve` by this name, replaced for every thread during the block.
    Why: viser has no option for a check of requests, a limit of clients or a log.
    Needed by: viser 1.1.1. No upstream issue known.
    """
    from websockets.asyncio import server

    serve = server.serve
    server.serve = lambda *args, **own: serve(*args, **adapt(own))  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


def viser_control_id(control: Any) -> str:
    """Id by which browsers name a viser control.

    Private: `_impl.uuid`.
    Why: viser sets any attribute of a control to any value from a browser, before it calls any handler.
    Needed by: viser 1.1.1. No upstream issue known.
    """
    return str(control._impl.uuid)
