"""Forward kinematics of any model in JAX: pose and motion of a site or body from qpos and qvel, on every engine."""

import fnmatch
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.arm_kinematics import quat_to_matrix
from mjx_dher.lookup import check_name
from mjx_dher.types import Array

FREE, BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE"))


_COUNTS = {"joint": "njnt", "actuator": "nu"}


class Numbered(str):
    """Stands for the name of an object without one. Of patterns, only "*" fits it."""

    __slots__ = ()


def names_of(model: Any, kind: str) -> list[str]:
    """Names of a model's objects of a kind ("site", "body", "joint", "key", ...). Unnamed ones get names such as "joint_2"."""
    count = getattr(model, _COUNTS.get(kind, f"n{kind}"))
    return [getattr(model, kind)(i).name or Numbered(f"{kind}_{i}") for i in range(count)]


def rounded(values: Any) -> Any:
    """Numbers for a file, to six decimals, or to six digits if they are so small that decimals would change them."""
    array = np.asarray(values, float)
    short = np.round(array, 6)
    digits = [float(f"{x:.6g}") for x in array.ravel()]
    return np.where(abs(short - array) <= 1e-3 * abs(array), short, np.reshape(digits, array.shape)).tolist()


def pick(what: str, patterns: str, *columns: Sequence[str]) -> list[int]:
    """Indices whose name in one of the columns matches a pattern, such as "j1 finger*", each once.

    They are in the order of the patterns, and for one pattern in the columns' order. A pattern without "*" and "?" counts in
    the first column that has the name. `patterns` may be one name that has spaces. Raises ValueError if no name matches a
    pattern. The message lists the names.
    """
    chosen: dict[int, None] = {}
    if not isinstance(given := patterns, str):
        raise ValueError(f"{what} must be one text, with spaces between names; got {patterns!r}")
    for pattern in [given] if any(given in names for names in columns) else given.split() or [""]:
        matches = [{i for i, name in enumerate(names) if name and _fits(name, pattern)} for names in columns]
        plain = not set(pattern) & set("*?")  # then a name of the first column comes before an equal one of the second
        fitting = next(filter(None, matches), set()) if plain else set().union(*matches)
        if not fitting:
            check_name(what, pattern, dict.fromkeys(name for names in columns for name in names if name))
        chosen |= dict.fromkeys(sorted(fitting))
    return list(chosen)


def _fits(name: str, pattern: str) -> bool:
    if isinstance(name, Numbered):
        return pattern in ("*", name)
    return fnmatch.fnmatchcase(name, pattern.replace("[", "[[]"))  # "[" is a part of names here


class Place:
    """A site or body, whose pose follows from the joints between the world and it.

    Args:
      name: "site:NAME" or "body:NAME". A plain NAME means a site if it exists, else a body.

    Raises:
      ValueError: there is no such site or body, or a mocap body moves it.
    """

    def __init__(self, model: mujoco.MjModel, name: str):
        if not isinstance(name, str):
            raise ValueError(f"a place, such as a goal's `of`, must be the name of a site or body ('site:tip'); got {name!r}")
        kind, colon, rest = name.partition(":")
        plain = [each for each in ("site", "body") if name in names_of(model, each)]
        if not colon or plain:
            kind, rest = (*plain, "body")[0], name
        check_name(f"kind of {name!r}", kind, ("site", "body"))
        names = names_of(model, kind)
        check_name(kind, rest, names)
        self.name = f"{kind}:{rest}"
        item = getattr(model, kind)(names.index(rest))
        self.body = body = int(item.bodyid[0] if kind == "site" else item.id)
        self.offset = _frame(item.pos, item.quat) if kind == "site" else _frame(np.zeros(3), np.array([1.0, 0, 0, 0]))
        self._links: list[tuple[tuple[np.ndarray, np.ndarray], list[Joint]]] = []  # frame in the parent, and joints
        while body:
            if model.body_mocapid[body] >= 0:
                raise ValueError(
                    f"{self.name} moves with the mocap body {names_of(model, 'body')[body]!r}, which is no part of the state"
                )
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            joints = [Joint(model, joint) for joint in range(first, first + count)]
            self._links.insert(0, (_frame(model.body_pos[body], model.body_quat[body]), joints))
            body = int(model.body_parentid[body])
        self.joints = [joint for _, joints in self._links for joint in joints]

    def pose(self, qpos: Array) -> tuple[Array, Array]:
        """Position [3] in m, and rotation matrix [3, 3]."""
        pos, mat = self._frames(qpos)[-1]
        return pos, mat

    def position(self, qpos: Array) -> Array:
        """Position [3] in m."""
        return self.pose(qpos)[0]

    def rotation(self, qpos: Array) -> Array:
        """First two columns of the rotation matrix, [6]."""
        return self.pose(qpos)[1][:, :2].T.ravel()

    def motion(self, qpos: Array, qvel: Array) -> tuple[Array, Array]:
        """Linear and angular velocity, [3] each in world axes, in m/s and rad/s."""
        *frames, (pos, _) = self._frames(qpos)
        if not self.joints:
            return jnp.zeros(3, jnp.float32), jnp.zeros(3, jnp.float32)
        parts = [joint.motion(mat, qvel) for joint, (_, mat) in zip(self.joints, frames, strict=True)]
        linear, angular = (jnp.stack(part) for part in zip(*parts, strict=True))
        arms = pos - jnp.stack([anchor for anchor, _ in frames])
        return jnp.sum(linear + jnp.cross(angular, arms), axis=0), jnp.sum(angular, axis=0)

    def _frames(self, qpos: Array) -> list[tuple[Array, Array]]:
        """Position and matrix of each joint, after its motion, and of the place."""
        frames = []
        pos, mat = jnp.zeros(3, jnp.float32), jnp.eye(3, dtype=jnp.float32)
        for link, joints in self._links:
            pos, mat = _join(pos, mat, link)
            for joint in joints:
                anchor, mat = joint.move(pos, mat, qpos)
                pos = anchor - _turn(mat, joint.anchor)
                frames.append((anchor, mat))
        return [*frames, _join(pos, mat, self.offset)]


class Joint:
    """A joint, and how it moves its frame."""

    def __init__(self, model: mujoco.MjModel, index: int):
        self.kind = int(model.jnt_type[index])
        self.qpos, self.qvel = int(model.jnt_qposadr[index]), int(model.jnt_dofadr[index])
        self.axis, self.anchor = np.float32(model.jnt_axis[index]), np.float32(model.jnt_pos[index])
        self.reference = np.float32(model.qpos0[self.qpos])
        self._across = np.cross(self.axis, np.eye(3)).T.astype(np.float32)  # `_across @ v` is the axis times v

    def move(self, pos: Array, mat: Array, qpos: Array) -> tuple[Array, Array]:
        """Anchor [3] of the joint, and the matrix [3, 3] behind it, from the frame `pos`, `mat` before it."""
        at = self.qpos
        if self.kind == FREE:
            return qpos[at : at + 3], quat_to_matrix(qpos[at + 3 : at + 7])
        pos = pos + _turn(mat, self.anchor)
        if self.kind == BALL:
            return pos, _times(mat, quat_to_matrix(qpos[at : at + 4]))
        moved = qpos[at] - self.reference
        if self.kind == SLIDE:
            return pos + _turn(mat, self.axis) * moved, mat
        turn = jnp.sin(moved) * self._across + (1.0 - jnp.cos(moved)) * (self._across @ self._across)
        return pos, mat + _times(mat, turn)

    def motion(self, mat: Array, qvel: Array) -> tuple[Array, Array]:
        """Linear and angular velocity [3] that the joint adds at its anchor."""
        still, at = jnp.zeros(3, jnp.float32), self.qvel
        if self.kind == FREE:
            return qvel[at : at + 3], _turn(mat, qvel[at + 3 : at + 6])
        if self.kind == BALL:
            return still, _turn(mat, qvel[at : at + 3])
        along = _turn(mat, self.axis) * qvel[at]
        return (along, still) if self.kind == SLIDE else (still, along)


def to_quat(mat: Array) -> Array:
    """Quaternion [4] (w, x, y, z) of a rotation matrix [3, 3]."""
    trace = mat[0, 0] + mat[1, 1] + mat[2, 2]
    squares = 1.0 + jnp.stack([trace, *(2.0 * mat[i, i] - trace for i in range(3))])
    skew = [mat[2, 1] - mat[1, 2], mat[0, 2] - mat[2, 0], mat[1, 0] - mat[0, 1]]
    same = [mat[1, 0] + mat[0, 1], mat[0, 2] + mat[2, 0], mat[2, 1] + mat[1, 2]]
    rows = [[squares[0], *skew], [skew[0], squares[1], same[0], same[1]]]
    rows += [[skew[1], same[0], squares[2], same[2]], [skew[2], same[1], same[2], squares[3]]]
    quat = jnp.stack([jnp.stack(row) for row in rows])[jnp.argmax(squares)]
    return quat / jnp.sqrt(jnp.sum(jnp.square(quat)))


def _frame(pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, quat)
    return np.array(pos, np.float32), mat.reshape(3, 3).astype(np.float32)


def _join(pos: Array, mat: Array, frame: tuple[np.ndarray, np.ndarray]) -> tuple[Array, Array]:
    """World pose of a frame given in another one."""
    return pos + _turn(mat, frame[0]), mat if (frame[1] == np.eye(3)).all() else _times(mat, frame[1])


# Sums, because dot products would use the learner's precision on a GPU.
def _turn(mat: Array, vector: Any) -> Array:
    return jnp.sum(mat * vector[None], axis=-1)


def _times(a: Array, b: Any) -> Array:
    return jnp.sum(a[:, :, None] * b[None], axis=1)
