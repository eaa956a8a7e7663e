"""MuJoCo Warp's substep in fewer kernels, for models without the features that this substep leaves out.

Up to some ten thousand environments, a kernel takes as long to start as to run. MuJoCo Warp's own step sums over a tree's
bodies in one kernel per level (three times, and the arm is eleven levels deep). It also launches kernels for sites, cameras,
sensors, tendons, applied forces, gravity compensation and energy that the model does not have. Collisions, constraints, the
solver and the integration of positions are MuJoCo Warp's here, too.

MuJoCo Warp also computes constraints before the velocities of bodies, on which the weld's acceleration depends. It uses the
velocities of the substep before or, in the first substep of a call, those that its memory last held, NaN included. Here
velocities come first, and a step depends on its arguments alone.
"""
# Not `from __future__ import annotations`: Warp reads the annotations of kernels as types.

import functools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from mjx_dher.envs.engines.base import last_below
from mjx_dher.host import private_api
from mjx_dher.host.warp_setup import wp

mujoco_warp = private_api.mujoco_warp()
vec10 = private_api.vec10()

_DISABLED = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # flags that make no difference to the fewer kernels


def make_substep(model: mujoco.MjModel, m: Any, d: Any) -> Callable[[], None]:
    """Returns a function that advances `d` by a timestep: in fewer kernels if the model allows it, else by MuJoCo Warp's step.

    Args:
      model: the compiled MJCF.
      m, d: Model and Data of MuJoCo Warp, made from `model`.
    """
    parts = private_api.mujoco_warp_parts()
    if unsupported_features(model, m):
        return functools.partial(_library_substep, m, d)
    last: Any = wp.array(last_below(model), dtype=int)
    springs = _springs(model)
    damped = _Damped(m, d)
    parts.rne_cacc_world(m, d)  # gravity, as the world's acceleration, which stays

    def substep() -> None:
        _constraints(m, d, last)
        _smooth_forces(m, d, last, springs)
        parts.factor_solve(m, d, d.M, d.qLD, d.qLDiagInv, d.qacc_smooth, d.qfrc_smooth)
        mujoco_warp.solve(m, d)
        damped.integrate()

    return substep


def _library_substep(m: Any, d: Any) -> None:
    """Computes MuJoCo Warp's step, with the velocities of bodies before constraints."""
    mujoco_warp.fwd_kinematics(m, d)
    mujoco_warp.com_vel(m, d)
    mujoco_warp.step(m, d)


def unsupported_features(model: mujoco.MjModel, m: Any) -> list[str]:
    """Returns the names of the features of the model that the fewer kernels leave out."""
    features = {
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
    return [name for name, used in features.items() if used]


def _is_scalar(model: mujoco.MjModel) -> np.ndarray:
    """Returns a mask [njnt] of joints that have one coordinate."""
    return np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))


def _springs(model: mujoco.MjModel) -> tuple[Any, Any, Any]:
    """Returns stiffness (0 except for joints of one coordinate), index in qpos and rest position, [nv] each."""
    stiffness, index, rest = np.zeros(model.nv, np.float32), np.zeros(model.nv, np.int32), np.zeros(model.nv, np.float32)
    joints = np.flatnonzero(_is_scalar(model))
    dofs = model.jnt_dofadr[joints]
    stiffness[dofs], index[dofs] = model.jnt_stiffness[joints], model.jnt_qposadr[joints]
    rest[dofs] = model.qpos_spring[index[dofs]]
    return wp.array(stiffness, dtype=float), wp.array(index, dtype=int), wp.array(rest, dtype=float)


def _constraints(m: Any, d: Any, last: Any) -> None:
    """Computes frames, inertias, velocities, contacts and constraints from the state."""
    parts = private_api.mujoco_warp_parts()
    bodies = (d.nworld, m.nbody)
    mujoco_warp.kinematics(m, d)
    wp.launch(_subtree_com, dim=bodies, inputs=[last, m.body_mass, m.body_subtreemass, d.xipos], outputs=[d.subtree_com])
    inputs = [m.body_rootid, m.body_mass, m.body_inertia, d.xipos, d.ximat, d.subtree_com]
    wp.launch(parts.cinert, dim=bodies, inputs=inputs, outputs=[d.cinert])
    inputs = [m.body_rootid, m.jnt_type, m.jnt_dofadr, m.jnt_bodyid, d.xmat, d.xanchor, d.xaxis, d.subtree_com]
    wp.launch(parts.cdof, dim=(d.nworld, m.njnt), inputs=inputs, outputs=[d.cdof])
    wp.launch(_composite_inertia, dim=bodies, inputs=[last, d.cinert], outputs=[d.crb])
    d.M.zero_()
    inputs = [m.dof_bodyid, m.dof_parentid, m.dof_armature, m.M_rownnz, m.M_rowadr, d.cdof, d.crb]
    wp.launch(parts.mass, dim=(d.nworld, m.nv), inputs=inputs, outputs=[d.M])
    mujoco_warp.com_vel(m, d)
    mujoco_warp.collision(m, d)
    mujoco_warp.make_constraint(m, d)


def _smooth_forces(m: Any, d: Any, last: Any, springs: tuple[Any, Any, Any]) -> None:
    """Computes all forces except those of constraints, as `d.qfrc_smooth`."""
    parts = private_api.mujoco_warp_parts()
    if m.nactuator:
        mujoco_warp.transmission(m, d)
        inputs = [d.qvel, d.moment_rownnz, d.moment_rowadr, d.moment_colind, d.actuator_moment]
        wp.launch(parts.actuator_velocity, dim=(d.nworld, m.nactuator), inputs=inputs, outputs=[d.actuator_velocity])
        mujoco_warp.fwd_actuation(m, d)
    parts.rne_cacc_forward(m, d)
    parts.rne_cfrc(m, d)
    inputs = [last, m.dof_bodyid, m.dof_damping, *springs, d.qpos, d.qvel, d.cdof, d.cfrc_int, d.qfrc_actuator]
    wp.launch(_forces, dim=(d.nworld, m.nv), inputs=inputs, outputs=[d.qfrc_smooth])


class _Damped:
    """MuJoCo's Euler integrator: velocities implicitly in damping, then positions."""

    def __init__(self, m: Any, d: Any):
        self._m, self._d = m, d
        self._mass, self._factor = wp.empty_like(d.M), wp.empty_like(d.qLD)
        self._diagonal, self._qacc = wp.empty((d.nworld, m.nv), dtype=float), wp.empty((d.nworld, m.nv), dtype=float)

    def integrate(self) -> None:
        m, d, parts = self._m, self._d, private_api.mujoco_warp_parts()
        inputs = [m.opt.timestep, m.dof_damping, m.M_rownnz, m.M_rowadr, d.M]
        wp.launch(_damped_mass, dim=(d.nworld, m.nv), inputs=inputs, outputs=[self._mass])
        parts.factor_solve(m, d, self._mass, self._factor, self._diagonal, self._qacc, d.efc.Ma)
        parts.advance(m, d, self._qacc)


@wp.kernel
def _subtree_com(
    last: wp.array(dtype=int),  # type: ignore[valid-type]
    mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
    subtree_mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
    xipos: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
    subtree_com: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
):
    """Computes the centre of mass of each body with its descendants."""
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
    """Computes the composite inertia of each body with its descendants."""
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
    """Computes the sum of spring, damping and actuator forces, less `cfrc` summed over the body and its descendants."""
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
    """Computes the mass matrix plus the timestep times the damping on its diagonal, which ends each row."""
    world, dof = wp.tid()  # type: ignore[misc]
    begin = rowadr[dof]
    end = begin + rownnz[dof]
    for i in range(begin, end):
        damped[world, i] = mass[world, i]
    damped[world, end - 1] += timestep[world % timestep.shape[0]] * damping[world % damping.shape[0], dof]
