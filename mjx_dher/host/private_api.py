"""Private names of MJX, MuJoCo Warp, Warp and orbax: every one that this library uses, behind a function each.

Each function says which names are private, why they are needed, and which versions need them. tests/test_private_api.py
fails, naming the function to delete, once a newer version does without. The libraries are imported on the first call.

Two dependencies on internals stay where they are used, because they are not names of Python:

- `trainer.compile_lowered` disables the pass triton-softmax-rewriter of XLA (jaxlib 0.10.2; no upstream issue known).
- hopper/kernels.cu uses `wp::array_t` and `dynamic_smem_base` of Warp's C++ code, and numbers lanes in the order in which Warp
  flattens the axes of `jax.vmap` (warp-lang 1.18.0; no upstream issue known).
"""

from __future__ import annotations

import contextlib
import functools
import io
import logging
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any


@contextlib.contextmanager
def bodies_computed_once() -> Iterator[None]:
    """Keeps XLA's CPU backend, while tracing, from computing each body's pose anew for each of its descendants.

    Private: `mujoco.mjx._src.scan.body_tree`, which is replaced meanwhile, for every thread.
    Why: XLA's fusion emitters fuse MJX's walk along the arm into one loop that repeats all ancestors for every use of them:
      0.7 s instead of 0.9 ms for the kinematics of 16 environments on 2 cores. A barrier after each level ends the fusion.
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


def shift_reference_acceleration(data: Any, shift: Any) -> Any:
    """Returns `data` of MJX with `shift` [R] added to the reference acceleration of the first R constraint rows.

    Private: `Data._impl.efc_aref`, and that equality constraints come first.
    Why: MJX leaves J' qvel out of a weld's reference acceleration, which MuJoCo C and MuJoCo Warp put in.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known; https://github.com/google-deepmind/mujoco_warp/pull/1294 added the
      term to MuJoCo Warp.
    """
    aref = data._impl.efc_aref
    return data.tree_replace({"_impl.efc_aref": aref.at[: shift.shape[0]].add(shift)})


@functools.cache
def mujoco_warp() -> Any:
    """Returns MuJoCo Warp as MJX brings it.

    Private: `mujoco.mjx.third_party`.
    Why: MJX works with this version, whereas the separate package mujoco-warp need not match MuJoCo's.
    Needed by: mujoco-mjx 3.17.0, which does not depend on mujoco-warp. No upstream issue known.
    """
    with contextlib.redirect_stdout(io.StringIO()):  # MJX prints a line while it looks for Warp
        from mujoco.mjx.third_party import mujoco_warp
    return mujoco_warp


def vec10() -> Any:
    """Returns the Warp type of a body's inertia about its tree's centre of mass.

    Private: `mujoco_warp._src.types.vec10`.
    Why: kernels that read or write `Data.cinert` and `Data.crb` must declare it.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known.
    """
    from mujoco.mjx.third_party.mujoco_warp._src import types

    return types.vec10


@functools.cache
def mujoco_warp_shapes() -> SimpleNamespace:
    """Returns the functions of MuJoCo Warp's kernels that find the contacts of two shapes.

    Private: both, in `mujoco_warp._src.collision_primitive_core`.
    Why: the fused kernel's contacts of boxes are to be those of MuJoCo C, whose long algorithm MuJoCo Warp follows.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known.
    """
    from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive_core as core

    return SimpleNamespace(box_box=core.box_box, plane_cylinder=core.plane_cylinder)


@functools.cache
def move_mujoco_warp_kernels() -> None:
    """Moves the kernels of MuJoCo Warp that `warp_substep` launches into modules of their own.

    The move is global: every other user of MJX's MuJoCo Warp in this process launches the moved kernels, too. They compute the
    same; kernels that are not listed stay where they are.

    Private: the kernels below, `Kernel.func`, `Kernel.options` and `Module.options`.
    Why: Warp compiles a module whole, and the kernels below are less than a third of theirs.
    Needed by: mujoco-mjx 3.17.0 with warp-lang 1.18.0.
      https://github.com/google-deepmind/mujoco_warp/pull/682 (open) would give costly kernels modules of their own.
    """
    import warp as wp

    for source, names in mujoco_warp_kernels_to_move().items():
        target = f"{__name__}.{source.__name__.rpartition('.')[2]}"
        for name in names:
            kernel = getattr(source, name)
            wp.get_module(target).options.update(kernel.module.options)
            setattr(source, name, wp.kernel(kernel.func, module=target, **kernel.options))


def mujoco_warp_kernels_to_move() -> dict[Any, list[str]]:
    """Returns the names of the kernels that `move_mujoco_warp_kernels` moves, by the Python module that holds them."""
    from mujoco.mjx.third_party.mujoco_warp._src import forward, smooth, solver

    names = {
        forward: "_actuator_force _actuator_velocity _next_activation _next_position _next_velocity _qfrc_actuator"
        " _qfrc_actuator_gravcomp_limits",
        smooth: "_M _cacc_branch _cacc_world _cdof _cfrc _cinert _compute_body_inertial_frames _compute_body_matrices"
        " _comvel_branch _comvel_root _geom_local_to_global _kinematics_branch _site_local_to_global _transmission",
        solver: "_inertia_scale _qfrc_constraint_from_grad _solve_init_efc _update_gradient_h_incremental"
        " _zero_change_counters",
    }
    return {module: listed.split() for module, listed in names.items()}


@functools.cache
def mujoco_warp_parts() -> SimpleNamespace:
    """Returns the kernels and functions inside MuJoCo Warp's step that `warp_substep` composes anew; moves kernels first.

    Private: all of them, in `mujoco_warp._src.forward` and `mujoco_warp._src.smooth`.
    Why: MuJoCo Warp's step launches more than twice as many kernels as these models need, and computes constraints before the
      velocities that a weld's reference acceleration depends on.
    Needed by: mujoco-mjx 3.17.0. No upstream issue known; the order matters since
      https://github.com/google-deepmind/mujoco_warp/pull/1294.
    """
    from mujoco.mjx.third_party.mujoco_warp._src import forward, smooth

    move_mujoco_warp_kernels()
    return SimpleNamespace(
        # kernels
        actuator_velocity=forward._actuator_velocity,
        cdof=smooth._cdof,
        cinert=smooth._cinert,
        mass=smooth._M,
        # functions
        advance=forward._advance,
        factor_solve=smooth.factor_solve_i,
        rne_cacc_forward=smooth._rne_cacc_forward,
        rne_cacc_world=smooth._rne_cacc_world,
        rne_cfrc=smooth._rne_cfrc,
    )


def reset_call_id(callable_: Any) -> None:
    """Numbers the next trace of a `warp.jax_callable` as its first.

    Private: `FfiCallable.call_id`.
    Why: Warp writes the number of the trace into the program. JAX then finds no compiled program that it has kept.
    Needed by: warp-lang 1.18.0. No upstream issue known.
    """
    callable_.call_id = 0


def array_checkpointer() -> Any:
    """Returns an orbax checkpointer that writes a folder for each array; silences orbax's log.

    Private: nothing by its name, but `PyTreeCheckpointHandler(use_ocdbt=False)` and the logger `absl` belong to orbax's older
      interface, which https://github.com/google/orbax/issues/1624 (open) is to replace.
    Why: the process keeps some memory of every checkpoint in orbax's other format, OCDBT (docs/reliability.md).
    Needed by: orbax-checkpoint 0.12.8. No upstream issue known for the memory.
    """
    import orbax.checkpoint

    logging.getLogger("absl").setLevel(logging.CRITICAL)  # orbax warns at every checkpoint in the older format
    return orbax.checkpoint.Checkpointer(orbax.checkpoint.PyTreeCheckpointHandler(use_ocdbt=False))
