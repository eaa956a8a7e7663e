"""A substep of MuJoCo Warp in fewer kernels, for models without what it then does not look for.

A kernel takes as long to start as it takes to run, up to some ten thousand environments. MuJoCo Warp's own step sums over the
bodies of a tree in a kernel a level (three times, and the arm is eleven levels deep), and looks after sites, cameras, sensors,
tendons, applied forces, gravity compensation and energy, whether or not there are any. Collisions, constraints, the solver and
the integration of positions are its own here, too.

And it finds constraints before it computes the velocities of bodies, which the weld's acceleration depends on: so they are
those of the substep before, or, in the first one of a call, of whatever the environment's memory was last used for, NaN
included. Here velocities come first, and a step depends on its arguments alone.
"""
# Not `from __future__ import annotations`: Warp reads the annotations of kernels as types.

import functools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src import collision_driver, constraint, forward, smooth, solver
from mujoco.mjx.third_party.mujoco_warp._src.types import vec10

_DISABLED = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # of the options that can be disabled, the ones that make no difference


# The library's kernels that are used here, by module. Warp compiles a module whole, and these are less than a third of theirs.
_USED = {
    forward: "_actuator_force _actuator_velocity _next_activation _next_position _next_velocity _qfrc_actuator"
    " _qfrc_actuator_gravcomp_limits",
    smooth: "_M _cacc_branch _cacc_world _cdof _cfrc _cinert _compute_body_inertial_frames _compute_body_matrices"
    " _comvel_branch _comvel_root _geom_local_to_global _kinematics_branch _site_local_to_global _transmission",
    solver: "_inertia_scale _qfrc_constraint_from_grad _solve_init_efc _update_gradient_h_incremental _zero_change_counters",
}


@functools.cache
def _set_apart() -> None:
    """Puts the kernels of each of these modules into a new one. What is not on the list stays where it is, and works."""
    for module, names in _USED.items():
        new = f"{__name__}.{module.__name__.rpartition('.')[2]}"
        for name in names.split():
            kernel = getattr(module, name)
            wp.get_module(new).options.update(kernel.module.options)
            setattr(module, name, wp.kernel(kernel.func, module=new, **kernel.options))


def make_substep(model: mujoco.MjModel, m: Any, d: Any) -> Callable[[], None]:
    """What advances `d` by a timestep: the fewer kernels where the model is one for them, else MuJoCo Warp's own step.

    Args:
      model: the compiled MJCF.
      m, d: Model and Data of MuJoCo Warp, made from it.
    """
    _set_apart()
    if needs(model, m):
        return functools.partial(_library_substep, m, d)
    last: Any = wp.array(last_below(model), dtype=int)
    springs = _springs(model)
    damped = _Damped(m, d)
    smooth._rne_cacc_world(m, d)  # gravity, as the world's acceleration: it stays

    def substep() -> None:
        _constraints(m, d, last)
        _smooth_forces(m, d, last, springs)
        smooth.factor_solve_i(m, d, d.M, d.qLD, d.qLDiagInv, d.qacc_smooth, d.qfrc_smooth)
        solver.solve(m, d)
        damped.integrate()

    return substep


def _library_substep(m: Any, d: Any) -> None:
    """MuJoCo Warp's step, with the velocities of bodies before constraints here, too."""
    forward.fwd_kinematics(m, d)
    smooth.com_vel(m, d)
    mujoco_warp.step(m, d)


def needs(model: mujoco.MjModel, m: Any) -> list[str]:
    """What the model has that the fewer kernels leave out."""
    found = {
        "an integrator other than Euler": model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER,
        "options disabled or enabled": model.opt.disableflags & ~_DISABLED or model.opt.enableflags,
        "tendons": model.ntendon,
        "flexes": model.nflex,
        "sensors": model.nsensor,
        "plugins": model.nplugin,
        "delays": m.nhistory,
        "a medium": m.has_fluid,
        "adhesion": m.flg_adhesion,
        "gravity compensation": model.body_gravcomp.any(),
        "springs of free or ball joints": model.jnt_stiffness[~_is_scalar(model)].any(),
        "springs or damping that are not linear": model.jnt_stiffnesspoly.any() or model.dof_dampingpoly.any(),
    }
    return [name for name, is_there in found.items() if is_there]


def _is_scalar(model: mujoco.MjModel) -> np.ndarray:
    """[njnt] whether a joint is one coordinate."""
    return np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))


def _springs(model: mujoco.MjModel) -> tuple[Any, Any, Any]:
    """[nv] each: stiffness (0 but for joints of one coordinate), that coordinate's place in qpos, and where it is at rest."""
    stiffness, place, rest = np.zeros(model.nv, np.float32), np.zeros(model.nv, np.int32), np.zeros(model.nv, np.float32)
    joints = np.flatnonzero(_is_scalar(model))
    dofs = model.jnt_dofadr[joints]
    stiffness[dofs], place[dofs] = model.jnt_stiffness[joints], model.jnt_qposadr[joints]
    rest[dofs] = model.qpos_spring[place[dofs]]
    return wp.array(stiffness, dtype=float), wp.array(place, dtype=int), wp.array(rest, dtype=float)


def last_below(model: mujoco.MjModel) -> np.ndarray:
    """[nbody] int32: body b and those below it are b ... last_below[b], because MuJoCo numbers them depth first."""
    last = np.arange(model.nbody, dtype=np.int32)
    for body in range(model.nbody - 1, 0, -1):
        parent = model.body_parentid[body]
        last[parent] = max(last[parent], last[body])
    return last


def _constraints(m: Any, d: Any, last: Any) -> None:
    """All that follows from positions and velocities: frames, inertias, contacts and constraints."""
    bodies = (d.nworld, m.nbody)
    smooth.kinematics(m, d)
    wp.launch(_subtree_com, dim=bodies, inputs=[last, m.body_mass, m.body_subtreemass, d.xipos], outputs=[d.subtree_com])
    inputs = [m.body_rootid, m.body_mass, m.body_inertia, d.xipos, d.ximat, d.subtree_com]
    wp.launch(smooth._cinert, dim=bodies, inputs=inputs, outputs=[d.cinert])
    inputs = [m.body_rootid, m.jnt_type, m.jnt_dofadr, m.jnt_bodyid, d.xmat, d.xanchor, d.xaxis, d.subtree_com]
    wp.launch(smooth._cdof, dim=(d.nworld, m.njnt), inputs=inputs, outputs=[d.cdof])
    wp.launch(_composite_inertia, dim=bodies, inputs=[last, d.cinert], outputs=[d.crb])
    d.M.zero_()
    inputs = [m.dof_bodyid, m.dof_parentid, m.dof_armature, m.M_rownnz, m.M_rowadr, d.cdof, d.crb]
    wp.launch(smooth._M, dim=(d.nworld, m.nv), inputs=inputs, outputs=[d.M])
    smooth.com_vel(m, d)
    collision_driver.collision(m, d)
    constraint.make_constraint(m, d)


def _smooth_forces(m: Any, d: Any, last: Any, springs: tuple[Any, Any, Any]) -> None:
    """All forces but those of constraints, as `d.qfrc_smooth`."""
    if m.nactuator:
        smooth.transmission(m, d)
        inputs = [d.qvel, d.moment_rownnz, d.moment_rowadr, d.moment_colind, d.actuator_moment]
        wp.launch(forward._actuator_velocity, dim=(d.nworld, m.nactuator), inputs=inputs, outputs=[d.actuator_velocity])
        forward.fwd_actuation(m, d)
    smooth._rne_cacc_forward(m, d)
    smooth._rne_cfrc(m, d)
    inputs = [last, m.dof_bodyid, m.dof_damping, *springs, d.qpos, d.qvel, d.cdof, d.cfrc_int, d.qfrc_actuator]
    wp.launch(_forces, dim=(d.nworld, m.nv), inputs=inputs, outputs=[d.qfrc_smooth])


class _Damped:
    """MuJoCo's Euler integrator: velocities by the force at their end as far as damping goes, then positions."""

    def __init__(self, m: Any, d: Any):
        self._m, self._d = m, d
        self._mass, self._factor = wp.empty_like(d.M), wp.empty_like(d.qLD)
        self._diagonal, self._qacc = wp.empty((d.nworld, m.nv), dtype=float), wp.empty((d.nworld, m.nv), dtype=float)

    def integrate(self) -> None:
        m, d = self._m, self._d
        inputs = [m.opt.timestep, m.dof_damping, m.M_rownnz, m.M_rowadr, d.M]
        wp.launch(_damped_mass, dim=(d.nworld, m.nv), inputs=inputs, outputs=[self._mass])
        smooth.factor_solve_i(m, d, self._mass, self._factor, self._diagonal, self._qacc, d.efc.Ma)
        forward._advance(m, d, self._qacc)


@wp.kernel
def _subtree_com(
    last: wp.array(dtype=int),  # type: ignore[valid-type]
    mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
    subtree_mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
    xipos: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
    subtree_com: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
):
    """Where the centre of mass is of each body and those below it."""
    world, body = wp.tid()  # type: ignore[misc]
    row = world % mass.shape[0]
    total = wp.vec3(0.0)
    for other in range(body, last[body] + 1):
        total += xipos[world, other] * mass[row, other]
    all_mass = subtree_mass[world % subtree_mass.shape[0], body]
    if all_mass != 0.0:
        total = total / all_mass
    subtree_com[world, body] = total


@wp.kernel
def _composite_inertia(
    last: wp.array(dtype=int),  # type: ignore[valid-type]
    cinert: wp.array2d(dtype=vec10),  # type: ignore[valid-type]
    crb: wp.array2d(dtype=vec10),  # type: ignore[valid-type]
):
    """The inertia of each body with those below it as one."""
    world, body = wp.tid()  # type: ignore[misc]
    if body == 0:
        return
    total = vec10()
    for other in range(body, last[body] + 1):
        total += cinert[world, other]
    crb[world, body] = total


@wp.kernel
def _forces(
    last: wp.array(dtype=int),  # type: ignore[valid-type]
    dof_body: wp.array(dtype=int),  # type: ignore[valid-type]
    damping: wp.array2d(dtype=float),  # type: ignore[valid-type]
    stiffness: wp.array(dtype=float),  # type: ignore[valid-type]
    place: wp.array(dtype=int),  # type: ignore[valid-type]
    rest: wp.array(dtype=float),  # type: ignore[valid-type]
    qpos: wp.array2d(dtype=float),  # type: ignore[valid-type]
    qvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
    cdof: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
    cfrc: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
    actuators: wp.array2d(dtype=float),  # type: ignore[valid-type]
    force: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
    """Of springs, damping and actuators, less what gravity and motion ask for: `cfrc` of the body and of those below it."""
    world, dof = wp.tid()  # type: ignore[misc]
    body = dof_body[dof]
    total = wp.spatial_vector()
    for other in range(body, last[body] + 1):
        total += cfrc[world, other]
    spring = stiffness[dof] * (rest[dof] - qpos[world, place[dof]])
    damper = -damping[world % damping.shape[0], dof] * qvel[world, dof]
    force[world, dof] = spring + damper - wp.dot(cdof[world, dof], total) + actuators[world, dof]


@wp.kernel
def _damped_mass(
    timestep: wp.array(dtype=float),  # type: ignore[valid-type]
    damping: wp.array2d(dtype=float),  # type: ignore[valid-type]
    rownnz: wp.array(dtype=int),  # type: ignore[valid-type]
    rowadr: wp.array(dtype=int),  # type: ignore[valid-type]
    mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
    damped: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
    """The mass matrix, with the timestep times the damping on its diagonal, which ends each row."""
    world, dof = wp.tid()  # type: ignore[misc]
    begin = rowadr[dof]
    end = begin + rownnz[dof]
    for i in range(begin, end):
        damped[world, i] = mass[world, i]
    damped[world, end - 1] += timestep[world % timestep.shape[0]] * damping[world % damping.shape[0], dof]
