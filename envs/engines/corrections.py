"""Parts of MuJoCo C's timestep that MJX 3.17 lacks: terms of equality constraints, and details of implicitfast."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from mjx_dher.envs.arm_kinematics import quat_multiply
from mjx_dher.types import Array


class _Carried:
    """A body, and the degrees of freedom that move it."""

    def __init__(self, model: mujoco.MjModel, body: int):
        self.body, self._root = body, int(model.body_rootid[body])
        while body and not model.body_dofnum[body]:
            body = int(model.body_parentid[body])
        dofs = [int(model.body_dofadr[body] + model.body_dofnum[body] - 1)] if body else []
        while dofs and model.dof_parentid[dofs[-1]] >= 0:
            dofs.append(int(model.dof_parentid[dofs[-1]]))
        self._dofs = np.array(dofs, int)

    def bias(self, data: mjx.Data, point: Array) -> tuple[Array, Array]:
        """Accelerations [3] without qacc: of a point on the body, m/s^2, and of its orientation, rad/s^2."""
        # Spatial vectors (angular, linear) at the centre of mass of the whole tree.
        acceleration = data.qvel[self._dofs] @ data.cdof_dot[self._dofs]
        velocity, arm = data.cvel[self.body], point - data.subtree_com[self._root]
        omega, alpha = velocity[:3], acceleration[:3]
        at_point = velocity[3:] + jnp.cross(omega, arm)
        return acceleration[3:] + jnp.cross(alpha, arm) + jnp.cross(omega, at_point), alpha


class Equality:
    """The velocity term of an equality's acceleration, which MJX omits and MuJoCo C and Warp include.

    With the residual r, MuJoCo solves for r'' = aref, where r'' = J qacc + J' qvel. MJX 3.17 drops J' qvel: an arm that moves
    at 1 m/s then pulls its gripper aside by 1 mm in half a second.
    """

    def __init__(self, model: mujoco.MjModel, index: int):
        self._first, self._second = (_Carried(model, int(of[index])) for of in (model.eq_obj1id, model.eq_obj2id))
        self._anchors = model.eq_data[index, :6].reshape(2, 3)


class _Weld(Equality):
    """Of a body that is welded to a mocap body, which counts as at rest, with coinciding frames."""

    def bias(self, data: mjx.Data) -> Array:
        """J' qvel [6]: three rows of position in m/s^2, three of orientation in 1/s^2."""
        body = self._second.body
        position, alpha = self._second.bias(data, data.xpos[body])
        # The residual is the vector part of q^-1 p (q the body's orientation, p the target's), and q' = omega q / 2.
        omega, inverse = data.cvel[body][:3], data.xquat[body] * jnp.array([1.0, -1.0, -1.0, -1.0])
        turn = jnp.concatenate([0.25 * jnp.dot(omega, omega)[None], 0.5 * alpha])
        orientation = quat_multiply(quat_multiply(inverse, turn), data.xquat[self._first.body])[1:]
        return -jnp.concatenate([position, orientation])


class _Connect(Equality):
    """Of two bodies that are connected at a point."""

    def bias(self, data: mjx.Data) -> Array:
        """J' qvel [3] in m/s^2."""
        ends = zip((self._first, self._second), self._anchors.astype(np.float32))
        first, second = (end.bias(data, data.xpos[end.body] + data.xmat[end.body] @ anchor)[0] for end, anchor in ends)
        return first - second


def equalities_of(model: mujoco.MjModel) -> list[int | _Weld | _Connect]:
    """First rows of a model's constraints in order: equalities to correct, and numbers of other rows."""
    disabled = int(mujoco.mjtDisableBit.mjDSBL_EQUALITY) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    connect, weld = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
    if model.opt.disableflags & disabled or model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
        return []
    of_bodies = (model.eq_objtype == int(mujoco.mjtObj.mjOBJ_BODY)) & (model.eq_active0 > 0)

    def is_plain(index: int) -> bool:
        same_frame = np.allclose(model.eq_data[index, :11], [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1])
        moves = model.body_weldid[model.eq_obj2id[index]] > 0
        return bool(same_frame and moves and model.body_mocapid[model.eq_obj1id[index]] >= 0)

    rows: list[int | _Weld | _Connect] = []
    for index in np.flatnonzero(model.eq_type == connect).tolist():
        rows.append(_Connect(model, index) if of_bodies[index] else 3)
    for index in np.flatnonzero(model.eq_type == weld).tolist():
        rows.append(_Weld(model, index) if of_bodies[index] and is_plain(index) else 6)
    return rows if any(isinstance(row, Equality) for row in rows) else []


def implicit(fixed: mujoco.MjModel, alone: np.ndarray, model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes `mjx.implicit` with the parts of MuJoCo C's implicitfast that it omits.

    An actuator at its force limit adds no damping. Damping that a control scales follows the clamped control. Free bodies
    that stand alone are implicit in gyroscopic forces.

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
        blocks = mjx.full_m(model, data)[rows[:, :, None], rows[:, None, :]]
        frames = data.xmat[fixed.jnt_bodyid[alone]]
        damping = jnp.asarray(model.dof_damping)[rows]
        if fixed.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_DAMPER):
            damping = jnp.zeros_like(damping)
        armature = fixed.dof_armature[rows].astype(np.float32)
        args = (blocks, damping, armature, frames, data.qvel[rows][:, 3:], force[rows])
        shifts = jax.vmap(functools.partial(gyroscopic, float(fixed.opt.timestep)))(*args)
        data = data.replace(qfrc_smooth=data.qfrc_smooth.at[rows].add(shifts))
    return mjx.implicit(model, data)


def gyroscopic(
    timestep: float, mass: Array, damping: Array, armature: Array, frame: Array, omega: Array, force: Array
) -> Array:
    """Force [6] on a free body that makes its acceleration implicit in gyroscopic forces.

    Args:
      timestep: s.
      mass: [6, 6] of its position (world's axes) and orientation (its own axes).
      damping, armature: [6].
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
    implicit = (mass + timestep * jnp.diag(damping)).at[:, 3:].add(change)
    return -change @ jnp.linalg.solve(implicit, force)[3:]


def _skew(vector: Array) -> Array:
    """Matrix [3, 3] of the cross product with a vector."""
    return jnp.cross(vector, -jnp.eye(3))
