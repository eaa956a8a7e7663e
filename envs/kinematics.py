"""Where the gripper is, as a function of the arm's joint angles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.types import Array


class Chain:
    """The bodies from the world to `body`, of which each has a hinge or is fixed to its parent.

    Args:
      model: the compiled MJCF.
      body: the last body's name.
      site: a site on that body.

    Raises:
      ValueError: a body on the way moves other than by one hinge through its origin.
    """

    def __init__(self, model: mujoco.MjModel, body: str, site: str):
        self._links: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]] = []
        joints: list[int] = []
        index = int(model.body(body).id)
        while index:
            axis = None
            count, joint = int(model.body_jntnum[index]), int(model.body_jntadr[index])
            if count:
                if count > 1 or int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_HINGE) or model.jnt_pos[joint].any():
                    raise ValueError(f"body {model.body(index).name!r} must have one hinge through its origin, or no joint")
                joints.insert(0, joint)
                axis = model.jnt_axis[joint]
            self._links.insert(0, (model.body_pos[index], model.body_quat[index], axis))
            index = int(model.body_parentid[index])
        self._site = model.site_pos[model.site(site).id]
        # The joints sit next to one another, because a body's only child with a hinge comes right after it.
        self.qpos = slice(int(model.jnt_qposadr[joints[0]]), int(model.jnt_qposadr[joints[0]]) + len(joints))
        self.qvel = slice(int(model.jnt_dofadr[joints[0]]), int(model.jnt_dofadr[joints[0]]) + len(joints))

    def pose(self, angles: Array) -> tuple[Array, Array]:
        """Position [3], m, and orientation [4] (w, x, y, z) of the body at joint angles [J], rad."""
        pos, quat, _, _ = self._walk(angles)
        return pos, quat

    def site_motion(self, angles: Array, rates: Array) -> tuple[Array, Array]:
        """Position [3], m, and velocity [3], m/s, of the site at joint angles [J], rad, and their rates [J], rad/s."""
        pos, quat, anchors, axes = self._walk(angles)
        site = pos + rotate(quat, jnp.asarray(self._site, jnp.float32))
        return site, jnp.sum(rates[:, None] * jnp.cross(axes, site[None] - anchors), axis=0)

    def _walk(self, angles: Array) -> tuple[Array, Array, Array, Array]:
        """Position [3] and orientation [4] of the body; places and axes [J, 3] of the joints; all in the world's frame."""
        pos, quat = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0])
        anchors: list[Array] = []
        axes: list[Array] = []
        for link_pos, link_quat, axis in self._links:
            pos = pos + rotate(quat, jnp.asarray(link_pos, jnp.float32))
            if (link_quat != (1, 0, 0, 0)).any():
                quat = quat_multiply(quat, jnp.asarray(link_quat, jnp.float32))
            if axis is not None:
                half = 0.5 * angles[len(axes)]
                anchors.append(pos)
                axes.append(rotate(quat, jnp.asarray(axis, jnp.float32)))
                turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * jnp.asarray(axis, jnp.float32)])
                quat = quat_multiply(quat, turn)
            # Left to itself, XLA on a CPU fuses the whole walk into one loop that computes every link anew for each use.
            pos, quat = jax.lax.optimization_barrier((pos, quat))
        return pos, quat, jnp.stack(anchors), jnp.stack(axes)


def quat_multiply(a: Array, b: Array) -> Array:
    """The rotation b followed by a, as quaternions [4] (w, x, y, z)."""
    # A sum, not a dot product, whose precision on a GPU would be the learner's.
    w = a[0] * b[0] - jnp.sum(a[1:] * b[1:])
    return jnp.concatenate([w[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])


def rotate(quat: Array, vector: Array) -> Array:
    """`vector` [3] turned by the unit quaternion `quat` [4] (w, x, y, z)."""
    twice = 2 * jnp.cross(quat[1:], vector)
    return vector + quat[0] * twice + jnp.cross(quat[1:], twice)
