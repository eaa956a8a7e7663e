"""Parts of MuJoCo C's timestep that MJX 3.17 lacks: terms of equality constraints, and details of implicitfast."""

import functools
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from mjx_dher.envs.arm_kinematics import quat_multiply
from mjx_dher.system import private_api
from mjx_dher.types import Array

_MASK = private_api.mask_of_velocity_derivative()  # here, because only one thread can import this module


class _Frame:
    """A frame on a body, and the degrees of freedom that move it."""

    def __init__(self, model: mujoco.MjModel, body: int, position: np.ndarray, quat: np.ndarray):
        self._body, self._root = body, int(model.body_rootid[body])
        self._position, self._quat = position.astype(np.float32), quat.astype(np.float32)
        while body and not model.body_dofnum[body]:
            body = int(model.body_parentid[body])
        dofs = [int(model.body_dofadr[body] + model.body_dofnum[body] - 1)] if body else []
        while dofs and model.dof_parentid[dofs[-1]] >= 0:
            dofs.append(int(model.dof_parentid[dofs[-1]]))
        self._dofs = np.array(dofs, int)

    def quat(self, data: mjx.Data) -> Array:
        """Orientation [4] (w, x, y, z)."""
        return quat_multiply(data.xquat[self._body], jnp.asarray(self._quat, data.xquat.dtype))

    def omega(self, data: mjx.Data) -> Array:
        """Angular velocity [3], rad/s."""
        return data.cvel[self._body][:3]

    def bias(self, data: mjx.Data) -> tuple[Array, Array]:
        """Accelerations [3] without qacc: of the frame's origin, m/s^2, and of its orientation, rad/s^2."""
        if not len(self._dofs):  # of the world, or of a mocap body, which counts as at rest
            return jnp.zeros(3), jnp.zeros(3)
        # Spatial vectors (angular, linear) at the centre of mass of the whole tree.
        acceleration = data.qvel[self._dofs] @ data.cdof_dot[self._dofs]
        point = data.xpos[self._body] + data.xmat[self._body] @ self._position
        velocity, arm = data.cvel[self._body], point - data.subtree_com[self._root]
        omega, alpha = velocity[:3], acceleration[:3]
        at_point = velocity[3:] + jnp.cross(omega, arm)
        return acceleration[3:] + jnp.cross(alpha, arm) + jnp.cross(omega, at_point), alpha


def _frames(model: mujoco.MjModel, index: int) -> tuple[_Frame, _Frame]:
    """Frames that an equality holds together. A connect uses only their origins."""
    ids, numbers, identity = (int(model.eq_obj1id[index]), int(model.eq_obj2id[index])), model.eq_data[index], np.eye(4)[0]
    if model.eq_objtype[index] == int(mujoco.mjtObj.mjOBJ_SITE):
        first, second = (_Frame(model, int(model.site_bodyid[i]), model.site_pos[i], model.site_quat[i]) for i in ids)
    elif model.eq_type[index] == int(mujoco.mjtEq.mjEQ_CONNECT):
        first, second = (_Frame(model, body, at, identity) for body, at in zip(ids, (numbers[:3], numbers[3:6])))
    else:  # a weld has the second body's anchor first
        first = _Frame(model, ids[0], numbers[3:6], numbers[6:10])
        second = _Frame(model, ids[1], numbers[:3], identity)
    return first, second


class Equality:
    """The velocity term of an equality's acceleration, which MJX omits and MuJoCo C and Warp include.

    With the residual r, MuJoCo solves for r'' = aref, where r'' = J qacc + J' qvel. MJX 3.17 drops J' qvel: an arm that moves
    at 1 m/s then pulls its gripper aside by 1 mm in half a second.
    """

    def __init__(self, model: mujoco.MjModel, index: int):
        self._first, self._second = _frames(model, index)
        self._is_weld = bool(model.eq_type[index] == int(mujoco.mjtEq.mjEQ_WELD))
        self._torquescale = float(model.eq_data[index, 10])

    def bias(self, data: mjx.Data) -> Array:
        """J' qvel [3] of a connect, in m/s^2, or [6] of a weld: three more rows of orientation, in 1/s^2."""
        (first, alpha_first), (second, alpha_second) = self._first.bias(data), self._second.bias(data)
        if not self._is_weld:
            return first - second
        # The residual is the vector part of q^-1 p (p the first frame's orientation, q the second's); q' = omega q / 2.
        ours, theirs = self._first.omega(data), self._second.omega(data)
        speed, alpha = ours - theirs, alpha_first - alpha_second + jnp.cross(ours, theirs)
        turn = jnp.concatenate([-0.25 * jnp.dot(speed, speed)[None], 0.5 * alpha])
        inverse = self._second.quat(data) * jnp.array([1.0, -1.0, -1.0, -1.0])
        orientation = quat_multiply(quat_multiply(inverse, turn), self._first.quat(data))[1:]
        return jnp.concatenate([first - second, self._torquescale * orientation])


def equalities_of(model: mujoco.MjModel) -> list[int | Equality]:
    """First rows of a model's constraints in order: equalities to correct, and numbers of other rows.

    MJX's RK4 calls `mjx.forward` for its inner stages, so nothing is corrected there, and a warning says so.
    """
    disabled = int(mujoco.mjtDisableBit.mjDSBL_EQUALITY) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    rows: list[int | Equality] = []
    if not model.opt.disableflags & disabled:
        for kind, size in ((mujoco.mjtEq.mjEQ_CONNECT, 3), (mujoco.mjtEq.mjEQ_WELD, 6)):
            for index in np.flatnonzero(model.eq_type == int(kind)).tolist():
                rows.append(Equality(model, index) if model.eq_active0[index] else size)
    if not any(isinstance(row, Equality) for row in rows):
        return []
    if model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
        warnings.warn("engine jax ignores the velocity term of connects and welds with the integrator RK4", stacklevel=3)
        return []
    return rows


def implicit(fixed: mujoco.MjModel, alone: np.ndarray, model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes `mjx.implicit` with the parts of MuJoCo C's implicitfast that it omits.

    An actuator at its force limit adds no damping. Damping that a control scales follows the clamped control. Gyroscopic
    forces of free bodies on their own are implicit. Velocities act only on degrees of freedom with common inertia.

    Args:
      fixed: MuJoCo's form of the model.
      alone: joints of free bodies that stand alone.
    """
    if fixed.actuator_forcelimited.any():
        low, high = jnp.asarray(model.actuator_forcerange).T
        within = (low < data.actuator_force) & (data.actuator_force < high)
        damped = within | ~fixed.actuator_forcelimited.astype(bool)
        gain, bias = (jnp.asarray(x).at[:, 2].multiply(damped) for x in (model.actuator_gainprm, model.actuator_biasprm))
        model = model.replace(actuator_gainprm=gain, actuator_biasprm=bias)
    if fixed.actuator_ctrllimited.any() and not fixed.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL):
        limits = np.where(fixed.actuator_ctrllimited[:, None], fixed.actuator_ctrlrange, [-np.inf, np.inf])
        data = data.replace(ctrl=jnp.clip(data.ctrl, *limits.T.astype(np.float32)))
    if len(alone):
        rows = fixed.jnt_dofadr[alone][:, None] + np.arange(6)
        force = data.qfrc_smooth + data.qfrc_constraint
        pairs = rows[:, :, None], rows[:, None, :]
        blocks, slopes = mjx.full_m(model, data)[pairs], mjx.deriv_smooth_vel(model, data)[pairs]
        frames = data.xmat[fixed.jnt_bodyid[alone]]
        armature = fixed.dof_armature[rows].astype(np.float32)
        args = (blocks, slopes, armature, frames, data.qvel[rows][:, 3:], force[rows])
        shifts = jax.vmap(functools.partial(gyroscopic, float(fixed.opt.timestep)))(*args)
        data = data.replace(qfrc_smooth=data.qfrc_smooth.at[rows].add(shifts))
    token = _MASK.set(in_common(fixed))
    try:
        return mjx.implicit(model, data)
    finally:
        _MASK.reset(token)


def in_common(model: mujoco.MjModel) -> np.ndarray:
    """Pairs of degrees of freedom [nv, nv] that have common inertia in MuJoCo C: 1, else 0.

    One of them moves the other's body, and they are not two slides or hinges of a body whose inertia is diagonal. Those of a
    free joint count as well.
    """
    rows = np.repeat(np.arange(model.nv), model.M_rownnz)
    common = np.zeros((model.nv, model.nv), np.float32)
    common[rows, model.M_colind] = common[model.M_colind, rows] = 1
    for start in model.jnt_dofadr[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)]:
        common[start : start + 6, start : start + 6] = 1
    return common


def gyroscopic(timestep: float, mass: Array, slope: Array, armature: Array, frame: Array, omega: Array, force: Array) -> Array:
    """Force [6] on a free body that makes its acceleration implicit in gyroscopic forces.

    Args:
      timestep: s.
      mass: [6, 6] of its position (world's axes) and orientation (its own axes).
      slope: [6, 6] derivative of the smooth forces on it by its velocity.
      armature: [6].
      frame: [3, 3] its orientation.
      omega: [3] rad/s in its own axes.
      force: [6] on it.
    """
    turn, inertia = _skew(omega), mass[3:, 3:] - jnp.diag(armature[3:])
    lever = -frame.T @ mass[:3, 3:]  # the cross matrix of its mass times the offset of its centre
    # Derivatives of the inertial forces of both kinds by omega.
    linear = frame @ (lever @ turn - 2.0 * turn @ lever)
    angular = turn @ inertia - _skew(inertia @ omega)
    change = timestep * jnp.concatenate([linear, angular])
    implicit = (mass - timestep * slope).at[:, 3:].add(change)
    return -change @ jnp.linalg.solve(implicit, force)[3:]


def _skew(vector: Array) -> Array:
    """Matrix [3, 3] of the cross product with a vector."""
    return jnp.cross(vector, -jnp.eye(3))
