"""Goal types. Each defines size, distance, threshold, sampling range, and the goal that a state achieves."""

import copy
from collections.abc import Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.context import euclidean
from mjx_dher.envs.arm_kinematics import quat_to_matrix
from mjx_dher.envs.engines import Physics
from mjx_dher.envs.kinematics import HINGE, SLIDE, Place, names_of, pick, rounded
from mjx_dher.types import Array, PRNGKey
from mjx_dher.validation import check_number

Mark = tuple[int, np.ndarray, np.ndarray]  # body (-1: a ball), its position [3], m, and orientation [4] (w, x, y, z)
Bounds = Sequence[float]
_UNIT = np.array([1.0, 0.0, 0.0, 0.0])


class Goal:
    """Base class of goals."""

    size: int  # G
    threshold: float  # largest distance at which the goal is reached
    low: Any = None  # lowest and highest goals to draw or drag to, [G] or [3]
    high: Any = None
    place: Place | None = None  # the site or body of the goal
    unit: str = "m"  # of distances: "m", "rad" or "" for another one

    def bind(self, model: mujoco.MjModel) -> Self:
        """Copy for `model`. Raises ValueError for a name that the model lacks, or invalid bounds."""
        if hasattr(self, "threshold"):  # else a subclass sets it later
            check_number("threshold of the goal", self.threshold, "(0, inf)", float)
        return copy.copy(self)

    def achieved(self, physics: Physics) -> Array:
        """Goal [G] that a state achieves."""
        raise NotImplementedError

    def sample(self, key: PRNGKey) -> Array:
        """Draws a goal [G]."""
        raise NotImplementedError

    distance: Any  # (achieved [..., G], desired [..., G]) -> [...]

    def describe(self) -> dict[str, Any]:
        """Kind, site, body or joints, bounds and thresholds, as JSON."""
        about: dict[str, Any] = {"kind": type(self).__name__, "threshold": float(self.threshold)}
        if self.place is not None:
            about["of"] = self.place.name
        ends = {name: getattr(self, name) for name in ("low", "high")}
        return about | {name: rounded(end) for name, end in ends.items() if end is not None}

    def marks(self, model: mujoco.MjModel, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        """Marks that show a goal: balls, and bodies as ghosts. By default none.

        Args:
          qpos: coordinates [nq].
        """
        return []


class Position(Goal):
    """Position of a site or body, [3] in m.

    Args:
      of: "site:NAME" or "body:NAME".
      low, high: lowest and highest coordinates [3] of goals, m.
      threshold: m.
    """

    size = 3
    distance = staticmethod(euclidean)

    def __init__(self, of: str, low: Bounds, high: Bounds, threshold: float = 0.05):
        self.of, self.low, self.high, self.threshold = of, low, high, threshold

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = super().bind(model)
        bound.place = Place(model, self.of)
        bound.low, bound.high = box(f"goal {bound.place.name}", 3, (self.low, self.high))
        return bound

    def achieved(self, physics: Physics) -> Array:
        return self.place.position(physics.qpos)  # type: ignore[union-attr]

    def sample(self, key: PRNGKey) -> Array:
        return jax.random.uniform(key, (3,), jnp.float32, self.low, self.high)

    def marks(self, model: mujoco.MjModel, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        return [(-1, np.asarray(goal[:3]), _UNIT)]


class Rotation(Goal):
    """Orientation of a site or body: the first two columns of its rotation matrix, [6]. The distance is an angle in rad.

    Args:
      of: "site:NAME" or "body:NAME".
      axis: axis [3] in the world about which goals turn, from the world's orientation, or None for any orientation.
      threshold: rad.
    """

    size = 6
    unit = "rad"

    def __init__(self, of: str, axis: Bounds | None = None, threshold: float = 0.1):
        self.of, self.axis, self.threshold = of, axis, threshold

    def bind(self, model: mujoco.MjModel) -> Self:
        check_number("threshold of the goal, rad,", self.threshold, "(0, 3.14]", float)  # distances are at most pi
        bound = super().bind(model)
        bound.place = Place(model, self.of)
        if self.axis is not None:
            box("axis of the goal", 3, (self.axis, self.axis))
            axis = np.array(self.axis, float)
            if not axis.any():
                raise ValueError(f"axis of the goal must have a length; got {self.axis}")
            axis /= np.abs(axis).max()
            bound.axis = np.array(axis / np.linalg.norm(axis), np.float32).tolist()
        return bound

    def achieved(self, physics: Physics) -> Array:
        return self.place.rotation(physics.qpos)  # type: ignore[union-attr]

    def sample(self, key: PRNGKey) -> Array:
        if self.axis is None:
            quat = jax.random.normal(key, (4,), jnp.float32)
        else:
            half = jax.random.uniform(key, (), jnp.float32, -0.5 * jnp.pi, 0.5 * jnp.pi)
            quat = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * np.asarray(self.axis, np.float32)])
        return quat_to_matrix(quat)[:, :2].T.ravel()

    def describe(self) -> dict[str, Any]:
        return super().describe() | ({} if self.axis is None else {"axis": np.round(self.axis, 6).tolist()})

    def turned(self, goal: Array, quat: Array) -> Array:
        """The goal for which the body has the orientation `quat` [4] (w, x, y, z)."""
        assert self.place is not None
        return (quat_to_matrix(quat) @ self.place.offset[1])[:, :2].T.ravel()

    @staticmethod
    def distance(achieved: Array, desired: Array) -> Array:
        # The matrices' difference has the norm sqrt(8) sin(angle / 2), which is exact for small angles, unlike a cosine.
        squares = [jnp.sum(jnp.square(a - b), axis=-1) for a, b in zip(_columns(achieved), _columns(desired), strict=True)]
        return 2.0 * jnp.arcsin(jnp.minimum(jnp.sqrt(sum(squares) / 8.0), 1.0))

    def marks(self, model: mujoco.MjModel, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        assert self.place is not None
        here = np.asarray(self.place.position(jnp.asarray(qpos, jnp.float32)))
        return [_ghost(self.place, here, goal)]


class Pose(Goal):
    """Position and orientation of a site or body, [3 + 6]. Both thresholds must be met.

    The distance is in m: the larger of the distance of the positions, and the angle times `threshold / angle` m per rad.

    Args:
      of, low, high, threshold: as in `Position`.
      axis, angle: as `axis` and `threshold` in `Rotation`.
    """

    size = 9

    def __init__(
        self, of: str, low: Bounds, high: Bounds, threshold: float = 0.05, axis: Bounds | None = None, angle: float = 0.1
    ):
        self.position, self.rotation = Position(of, low, high, threshold), Rotation(of, axis, angle)
        self.threshold = threshold

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = super().bind(model)
        bound.position, bound.rotation = self.position.bind(model), self.rotation.bind(model)
        bound.place, bound.low, bound.high = bound.position.place, bound.position.low, bound.position.high
        return bound

    def achieved(self, physics: Physics) -> Array:
        return jnp.concatenate([self.position.achieved(physics), self.rotation.achieved(physics)])

    def sample(self, key: PRNGKey) -> Array:
        position_key, rotation_key = jax.random.split(key)
        return jnp.concatenate([self.position.sample(position_key), self.rotation.sample(rotation_key)])

    def describe(self) -> dict[str, Any]:
        turn = self.rotation.describe()
        return super().describe() | {"angle": turn["threshold"]} | {name: turn[name] for name in ("axis",) if name in turn}

    def turned(self, goal: Array, quat: Array) -> Array:
        """The goal at the same position for which the body has the orientation `quat` [4] (w, x, y, z)."""
        return jnp.concatenate([goal[:3], self.rotation.turned(goal[3:], quat)])

    def distance(self, achieved: Array, desired: Array) -> Array:
        angle = Rotation.distance(achieved[..., 3:], desired[..., 3:])
        return jnp.maximum(euclidean(achieved[..., :3], desired[..., :3]), self.threshold / self.rotation.threshold * angle)

    def marks(self, model: mujoco.MjModel, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        assert self.place is not None
        return [(-1, np.asarray(goal[:3]), _UNIT), _ghost(self.place, goal[:3], goal[3:])]


class Joints(Goal):
    """Positions of hinges and slides, [number of joints]. The distance is the largest difference of a joint, in rad or m.

    Args:
      names: names of joints, separated by spaces; "*" and "?" match any characters.
      low, high: lowest and highest positions of goals. Default: the joints' ranges.
      threshold: rad or m.
    """

    unit = ""

    def __init__(self, names: str = "*", low: Bounds | None = None, high: Bounds | None = None, threshold: float = 0.1):
        self.names, self.low, self.high, self.threshold = names, low, high, threshold

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = super().bind(model)
        names = [name if model.jnt_type[i] in (HINGE, SLIDE) else "" for i, name in enumerate(names_of(model, "joint"))]
        bound.joints = pick("joint of the goal", self.names, names)
        bound.moved = [str(names[joint]) for joint in bound.joints]
        bound.qpos, bound.size = model.jnt_qposadr[bound.joints], len(bound.joints)
        limits = model.jnt_range[bound.joints].T.copy()
        unlimited = ~model.jnt_limited[bound.joints].astype(bool)
        if (self.low is None or self.high is None) and unlimited.any():
            raise ValueError(f"goal: joint {names[bound.joints[int(np.argmax(unlimited))]]!r} has no range; pass low and high")
        limits[:, unlimited] = [[-mujoco.mjMAXVAL], [mujoco.mjMAXVAL]]
        low, high = (limit if end is None else end for limit, end in zip(limits, (self.low, self.high)))
        bound.low, bound.high = box("goal", bound.size, (low, high))
        for i in np.flatnonzero((bound.low < limits[0] - 1e-6) | (bound.high > limits[1] + 1e-6))[:1]:
            raise ValueError(
                f"goal: joint {names[bound.joints[i]]!r} reaches {limits[0, i]:g} to {limits[1, i]:g}; the goals go from"
                f" {bound.low[i]:g} to {bound.high[i]:g}"
            )
        return bound

    def achieved(self, physics: Physics) -> Array:
        return physics.qpos[self.qpos]

    def sample(self, key: PRNGKey) -> Array:
        return jax.random.uniform(key, (self.size,), jnp.float32, self.low, self.high)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"joints": self.moved}

    @staticmethod
    def distance(achieved: Array, desired: Array) -> Array:
        return jnp.max(jnp.abs(achieved - desired), axis=-1)

    def marks(self, model: mujoco.MjModel, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        data.qpos[self.qpos] = goal
        mujoco.mj_kinematics(model, data)
        own = {int(model.jnt_bodyid[joint]) for joint in self.joints}
        moved = set[int]()
        for body in range(1, model.nbody):  # parents come first
            if body in own or int(model.body_parentid[body]) in moved:
                moved.add(body)
        return [(body, data.xpos[body].copy(), data.xquat[body].copy()) for body in sorted(moved)]

    joints: list[int]
    moved: list[str]  # names of `joints`
    qpos: np.ndarray


def box(what: str, size: int, ends: Any) -> np.ndarray:
    """Converts bounds, low and high, to float32 [2, size]. Raises ValueError unless they are finite and low <= high."""
    try:
        with np.errstate(over="ignore"):
            low, high = array = np.array(ends, np.float32).reshape(2, size)
    except (TypeError, ValueError):
        low, high = array = np.full((2, size), np.nan)
    if not np.isfinite(array).all() or np.any(low > high):
        raise ValueError(f"{what}: low and high must be {size} finite numbers each, low <= high; got {ends}")
    return array


def _ghost(place: Place, pos: np.ndarray, columns: np.ndarray) -> Mark:
    """Body of a site or body at `pos` [3], with the first two columns [6] of its rotation matrix."""
    first, second = np.reshape(np.asarray(columns, float), (2, 3))
    mat = np.stack([first, second, np.cross(first, second)], axis=1) @ place.offset[1].T
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, mat.ravel())
    return place.body, np.asarray(pos, float) - mat @ place.offset[0], quat


def _columns(goal: Array) -> tuple[Array, Array, Array]:
    first, second = goal[..., :3], goal[..., 3:]
    return first, second, jnp.cross(first, second)
