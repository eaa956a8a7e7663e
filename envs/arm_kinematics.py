"""Kinematics of an arm: pose and velocity of the gripper, free joints and rotations."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.types import Array


class Chain:
    """Kinematic chain from the world to `body`, whose bodies each have one hinge or are fixed to their parent.

    Args:
      body: name of the last body.
      site: name of a site on that body.

    Raises:
      ValueError: a body of the chain has a joint other than one hinge through its origin.
    """

    def __init__(self, model: mujoco.MjModel, body: str, site: str):
        links: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]] = []
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
            links.insert(0, (model.body_pos[index], model.body_quat[index], axis))
            index = int(model.body_parentid[index])
        # The joints are adjacent, because a body's only child with a hinge comes right after it.
        self.qpos = slice(int(model.jnt_qposadr[joints[0]]), int(model.jnt_qposadr[joints[0]]) + len(joints))
        self.qvel = slice(int(model.jnt_dofadr[joints[0]]), int(model.jnt_dofadr[joints[0]]) + len(joints))

        # J joints divide the chain into S = J + 1 segments, each in the frame behind the joint before it.
        unit = np.array([1.0, 0.0, 0.0, 0.0])
        quat, offset = unit, np.zeros(3)
        offsets: list[np.ndarray] = []
        axes: list[np.ndarray] = []
        still: list[np.ndarray] = []
        turned: list[np.ndarray] = []
        for link_pos, link_quat, axis in links:
            offset = offset + _rotated(quat, link_pos)
            quat = _right(link_quat) @ quat
            if axis is not None:
                offsets.append(offset)
                axes.append(_rotated(quat, axis))
                still.append(_right(quat))
                turned.append(_right(_right(np.array([0.0, *axis])) @ quat))
                quat, offset = unit, np.zeros(3)
        at_site = offset + _rotated(quat, model.site_pos[model.site(site).id])
        # A segment's orientation [4] is cos(half the angle) `still` + sin(half the angle) `turned`, times the previous one.
        self._still, self._turned = _float32(still), _float32(turned)  # [J, 4, 4]
        self._axes = _float32(axes)  # [J, 3] of the joints, each in the frame of the segment before
        self._to_body = _float32([*offsets, offset])  # [S, 3] from a segment's start to its end; and
        self._to_site = _float32([*offsets, at_site])  # the same, where the last one ends at the site
        self._at_body = _float32(_right(quat))  # [4, 4] from the last segment's orientation to the body's
        self._before = np.tri(len(joints) + 1, len(joints), -1, dtype=np.float32)  # [S, J] 1 where the joint turns the segment

    def pose(self, angles: Array) -> tuple[Array, Array]:
        """Position [3] in m, and orientation [4] (w, x, y, z), of the body at joint angles [J] in rad."""
        quats = self._orientations(angles)
        pos = [jnp.sum(x) for x in _rotate(quats, self._to_body)]
        return jnp.stack(pos), jnp.sum(self._at_body * quats[-1][None], axis=-1)

    def site_motion(self, angles: Array, rates: Array) -> tuple[Array, Array]:
        """Position [3] in m, and velocity [3] in m/s, of the site at joint angles [J] in rad and rates [J] in rad/s."""
        quats = self._orientations(angles)
        segments = _rotate(quats, self._to_site)
        axes = _rotate(quats[:-1], self._axes)
        angular = [jnp.sum(self._before * (rates * x)[None], axis=-1) for x in axes]  # [S] each, rad/s of the segments
        return jnp.stack([jnp.sum(x) for x in segments]), jnp.stack([jnp.sum(x) for x in _cross(angular, segments)])

    def _orientations(self, angles: Array) -> Array:
        """Orientations [S, 4] of the segments in the world frame.

        Sums replace dot products here and elsewhere, because dot products would use the learner's precision on a GPU.
        """
        half = 0.5 * angles[:, None, None]
        steps = jnp.cos(half) * self._still + jnp.sin(half) * self._turned  # [J, 4, 4]
        quats = [jnp.array([1.0, 0.0, 0.0, 0.0])]
        for index in range(steps.shape[0]):
            quats.append(jnp.sum(steps[index] * quats[-1][None], axis=-1))
        return jnp.stack(quats)


# Separate coordinates compile faster than arrays that are split and stacked again.
_Vectors = Sequence[Array]  # x, y and z, each [S]


def _rotate(quats: Array, vectors: np.ndarray) -> _Vectors:
    """Rotates `vectors` [S, 3] by the unit quaternions `quats` [S, 4] (w, x, y, z)."""
    w, *axis = (quats[:, index] for index in range(4))
    vector = list(vectors.T)
    twice = [2 * x for x in _cross(axis, vector)]
    return [x + w * y + z for x, y, z in zip(vector, twice, _cross(axis, twice))]


def _cross(a: _Vectors, b: _Vectors) -> _Vectors:
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def _rotated(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotates `vector` [3] by the unit quaternion `quat` [4] (w, x, y, z): q v q*."""
    conjugate = quat * np.array([1.0, -1.0, -1.0, -1.0])
    return (_right(conjugate) @ _right(np.array([0.0, *vector])) @ quat)[1:]


def _right(quat: np.ndarray) -> np.ndarray:
    """Matrix [4, 4] such that `_right(q) @ p` is the product p q of quaternions (w, x, y, z)."""
    w, x, y, z = quat
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def _float32(values: Any) -> np.ndarray:
    return np.array(values, np.float32)


def quat_multiply(a: Array, b: Array) -> Array:
    """Rotation b followed by a, as quaternions [4] (w, x, y, z)."""
    # A sum, because a dot product would use the learner's precision on a GPU.
    w = a[0] * b[0] - jnp.sum(a[1:] * b[1:])
    return jnp.concatenate([w[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])


def quat_to_matrix(quat: Array) -> Array:
    """Rotation matrix [3, 3] of a quaternion [4] (w, x, y, z) of any length except 0."""
    w, x, y, z = quat / jnp.linalg.norm(quat)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_euler(matrix: Array) -> Array:
    """Euler angles (a, b, c) in rad of a rotation matrix [3, 3] = Rx(a) Ry(b) Rz(c), as in gymnasium-robotics.

    If b is a right angle, a and c turn about the same axis, and a is set to 0.
    """
    cos_b = jnp.hypot(matrix[2, 2], matrix[1, 2])
    regular = cos_b > 4 * np.finfo(np.float32).eps
    a = jnp.where(regular, jnp.arctan2(-matrix[1, 2], matrix[2, 2]), 0.0)
    b = jnp.arctan2(matrix[0, 2], cos_b)
    c = jnp.where(regular, jnp.arctan2(-matrix[0, 1], matrix[0, 0]), jnp.arctan2(matrix[1, 0], matrix[1, 1]))
    return jnp.stack([a, b, c])


def integrate(qpos: Array, qvel: Array, dt: float) -> Array:
    """Coordinates [7] of a free joint after `dt` s at velocity [6], integrated as in MuJoCo."""
    half_angle = 0.5 * dt * jnp.linalg.norm(qvel[3:])
    x, y, z = 0.5 * dt * qvel[3:] * jnp.sinc(half_angle / jnp.pi)  # axis times sin of half the angle
    turn = jnp.stack([jnp.cos(half_angle), x, y, z])
    return jnp.concatenate([qpos[:3] + dt * qvel[:3], quat_multiply(qpos[3:], turn)])
