"""The Shadow-hand tasks: reach with the fingertips, or turn a block, an egg or a pen in the hand.

They follow gymnasium-robotics 1.4.2 on mujoco 3.11.0. `bench/hand_model.py` writes the models (docs/fidelity.md).
"""

import functools
import itertools
import re
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.context import euclidean
from mjx_dher.envs.arm_kinematics import matrix_to_euler, quat_multiply, quat_to_matrix
from mjx_dher.envs.base import State
from mjx_dher.envs.engines import Physics, check_shape
from mjx_dher.envs.goals import Goal, Mark
from mjx_dher.envs.kinematics import Place
from mjx_dher.envs.starts import Start
from mjx_dher.envs.task import Actuators, MujocoTask
from mjx_dher.lookup import check_name
from mjx_dher.types import Array, PRNGKey

TIPS = ("fftip", "mftip", "rftip", "lftip", "thtip")
JOINTS = "??J?"  # the names of the hand's 24 joints, such as FFJ3
RESTING_PLACE = (1.01, 0.87, 0.16)  # m; approximate resting position of an object
OFFSETS = ((-0.04, -0.06, 0.0), (0.04, 0.02, 0.06))  # m; lowest and highest goal relative to the resting position
PALM_HEIGHT = 0.04  # m; a lower object fell out of the hand
ATTEMPTS = 100  # starts to draw before accepting a fallen object; none fell in 800 resets of the originals and 9,000 here
BESIDE = np.array([0.15, 0.0, 0.0])  # m; offset of the drawing of a goal without position
ROTATIONS = ("z", "parallel", "xyz")
_TURNS = (0.0, 0.5, -0.5, 1.0)  # multiples of pi
# Euler angles [24, 3], rad, of a cube with its faces parallel to the axes. A quaternion's sign follows from them.
FACES = np.pi * np.array([*itertools.product(_TURNS, (0.0,), _TURNS), *itertools.product((0.0,), (0.5, -0.5), _TURNS)])


class ObjectPose(Goal):
    """Position in m and orientation of the object, a quaternion (w, x, y, z): [7].

    The distance is an angle in rad, from 0 to 2 pi. As in the original the sign counts: q and -q are a full turn apart. If the
    position counts, `reach` m are worth `threshold` rad, and the larger of the two is the distance.

    Args:
      rotation: distribution of orientations. "z": any angle about the vertical. "parallel": one of 24 with the faces parallel
        to the axes, then any angle about the vertical. "xyz": any angle about any axis.
      positions: whether the position counts.
      reach: largest distance of the positions at which the goal is reached, m.
      ignores_z: whether the third Euler angle is ignored, as for the pen.
    """

    size = 7
    threshold = 0.1
    unit = "rad"

    def __init__(self, rotation: str, positions: bool = False, reach: float = 0.01, ignores_z: bool = False):
        check_name("rotation", rotation, ROTATIONS)
        self.rotation, self.positions, self.reach, self.ignores_z = rotation, positions, reach, ignores_z

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = super().bind(model)
        bound.place = Place(model, "body:object")
        if self.positions:
            bound.low, bound.high = np.add(RESTING_PLACE, OFFSETS).astype(np.float32)
        bound.qpos = slice(int(model.joint("object").qposadr[0]), int(model.joint("object").qposadr[0]) + 7)
        return bound

    def achieved(self, physics: Physics) -> Array:
        pose = physics.qpos[self.qpos]
        # With the sign that `distances` gives it, so that each state reaches its own goal.
        return pose.at[3:].set(_from_euler(_euler(pose[3:]))) if self.ignores_z else pose

    def sample(self, key: PRNGKey) -> Array:
        """Draws a goal for an object that came to rest at `RESTING_PLACE`."""
        place_key, key = jax.random.split(key)
        low, high = (self.low, self.high) if self.positions else (jnp.float32(RESTING_PLACE),) * 2
        return jnp.concatenate([jax.random.uniform(place_key, (3,), jnp.float32, low, high), draw_rotation(key, self.rotation)])

    def distances(self, achieved: Array, desired: Array) -> tuple[Array, Array]:
        """Distances of the positions in m (0 if they do not count), and of the orientations in rad."""
        quat, other = achieved[..., 3:], desired[..., 3:]
        if self.ignores_z:
            quat = _from_euler(jnp.concatenate([_euler(quat)[..., :2], _euler(other)[..., 2:]], axis=-1))
        # Of unit quaternions half the angle apart; exact for small angles, unlike an arc cosine.
        angle = 4.0 * jnp.arctan2(euclidean(quat, other), euclidean(quat, -other))
        return (euclidean(achieved[..., :3], desired[..., :3]) if self.positions else jnp.zeros_like(angle)), angle

    def distance(self, achieved: Array, desired: Array) -> Array:
        apart, angle = self.distances(achieved, desired)
        return jnp.maximum(angle, apart * (self.threshold / self.reach)) if self.positions else angle

    def checked(self, goal: Any) -> Array:
        """Goal [7] with a unit quaternion.

        Raises:
          ValueError: wrong shape or, outside `jit`, a quaternion of length 0 or not finite, which gives NaN inside `jit`.
        """
        goal = jnp.asarray(goal, jnp.float32)
        check_shape("desired_goal", goal, (self.size,))
        length = _norm(goal[3:])
        if not isinstance(goal, jax.core.Tracer) and not 0 < np.linalg.norm(np.asarray(goal)[3:]) < np.inf:
            raise ValueError(f"desired_goal must end with a quaternion of finite length, more than 0; got {np.asarray(goal)}")
        return jnp.concatenate([goal[:3], jnp.where(jnp.abs(length - 1.0) < 1e-5, goal[3:], goal[3:] / length)])

    def turned(self, goal: Array, quat: Array) -> Array:
        """The goal with another orientation [4], in the sign (q or -q) that is nearer to the goal's."""
        return jnp.concatenate([goal[:3], jnp.where(jnp.sum(goal[3:] * quat) < 0.0, -quat, quat)])

    def marks(self, model: mujoco.MjModel, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        assert self.place is not None
        beside = np.zeros(3) if self.positions else BESIDE
        return [(self.place.body, np.asarray(goal[:3], float) + beside, np.asarray(goal[3:], float))]

    qpos: slice


class Fingertips(Goal):
    """Positions of the five fingertips, [15] in m. As in the original they are seen one timestep late."""

    size = 15
    threshold = 0.01  # m
    distance = staticmethod(euclidean)

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = super().bind(model)
        bound.tips, bound.timestep = [Place(model, f"site:{name}") for name in TIPS], model.opt.timestep
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_kinematics(model, data)
        bound.first = np.array([data.site(name).xpos for name in TIPS], np.float32)
        bound.meeting = np.array(data.body("palm").xpos + np.array([0.0, -0.09, 0.05]), np.float32)
        return bound

    def achieved(self, physics: Physics) -> Array:
        # Its hinges' positions advance by the new velocity, and a start is at rest.
        before = physics.qpos - self.timestep * physics.qvel
        return jnp.concatenate([tip.position(before) for tip in self.tips])

    def sample(self, key: PRNGKey) -> Array:
        """Draws a point above the palm where the thumb and another finger meet. With probability 0.1, all fingers stay."""
        finger_key, place_key, stay_key = jax.random.split(key, 3)
        finger = jax.random.randint(finger_key, (), 0, len(TIPS) - 1)
        meeting = (self.meeting + 0.005 * jax.random.normal(place_key, (3,), jnp.float32))[None]
        way = meeting - self.first
        meets = (jnp.arange(len(TIPS)) == finger) | (jnp.arange(len(TIPS)) == len(TIPS) - 1)
        goal = jnp.where(meets[:, None], meeting - 0.005 * way / _norm(way)[:, None], self.first)
        return jnp.where(jax.random.uniform(stay_key) < 0.1, self.first, goal).ravel()

    def marks(self, model: mujoco.MjModel, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        return [(-1, place, np.array([1.0, 0.0, 0.0, 0.0])) for place in np.reshape(np.asarray(goal, float), (-1, 3))]

    tips: list[Place]
    timestep: float
    first: np.ndarray  # [5, 3] m, of the fingertips at the start
    meeting: np.ndarray  # [3] m


class Drop(Start):
    """Drops the object into the hand, where it comes to rest in ten steps of the middle action.

    Args:
      rotation: distribution of its orientation, as in `ObjectPose`, or None for the model's orientation.
    """

    def __init__(self, rotation: str | None):
        place, spread = np.array([1.0, 0.87, 0.2]), 0.015  # m; three standard deviations
        super().__init__("start", {"object": (place - spread, place + spread)}, settle=10)
        self.rotation = rotation

    def draw(self, key: PRNGKey) -> Array:
        place_key, key = jax.random.split(key)
        at, qpos = self.drawn[0].qpos, jnp.asarray(self.physics.qpos)
        qpos = qpos.at[at : at + 3].add(0.005 * jax.random.normal(place_key, (3,), jnp.float32))
        if self.rotation is None:
            return qpos
        quat = quat_multiply(qpos[at + 3 : at + 7], draw_rotation(key, self.rotation))
        return qpos.at[at + 3 : at + 7].set(quat / _norm(quat))


class HandTask(MujocoTask):
    """The Shadow hand, whose action moves 20 servos: -1 and 1 are the ends of their ranges."""

    control = Actuators()
    _strict = True
    observations: tuple[str, ...] = (f"qpos:{JOINTS}", f"qvel:{JOINTS}")

    def init_state(self, qpos: Array, desired_goal: Array, qvel: Array | None = None) -> State:
        """State at a given start, for example from a recorded episode.

        Args:
          qpos: [24] joint angles in rad, followed by an object's [7] position in m and orientation (w, x, y, z) of any length.
          qvel: [24] rad/s, followed by an object's [6] velocity. Default: at rest.

        Raises:
          ValueError: an array has another shape or, outside `jit`, a quaternion has length 0.
        """
        start: Physics = jax.tree.map(jnp.asarray, self._rest)
        moving = jnp.zeros_like(start.qvel) if qvel is None else jnp.asarray(qvel, jnp.float32)
        qpos = jnp.asarray(qpos, jnp.float32)
        check_shape("qpos", qpos, start.qpos.shape)
        check_shape("qvel", moving, start.qvel.shape)
        rotation = qpos[27:]  # empty without an object
        qpos = jnp.concatenate([qpos[:27], rotation / jnp.maximum(_norm(rotation), 1e-12)])
        return self.first_state(start.replace(qpos=qpos, qvel=moving), desired_goal)  # type: ignore[attr-defined]


class HandReach(HandTask):
    """HandReach-v3: bring the tips of the thumb and another finger together, and leave the others where they are."""

    name = "hand_reach"
    model = "assets/hand/reach.xml"
    goal = Fingertips()
    start = Start("start")
    observations = (*HandTask.observations, *(f"site:{name}" for name in TIPS))
    describe = MujocoTask.describe  # `observe` keeps the layout

    def observe(self, physics: Physics) -> Array:
        return super().observe(physics).at[-self.goal_size :].set(self.achieved(physics))


class ManipulateTask(HandTask):
    """The hand and an object. The goal is a pose of the object. A task names a model, a goal and a start."""

    episode_length = 100
    observations = (*HandTask.observations, "qvel:object", "qpos:object")
    goal: ObjectPose
    describe = MujocoTask.describe  # `reached` keeps the goal

    def start_physics(self, key: PRNGKey) -> Physics:
        """Drops the object into the hand, and again if it falls out."""

        def fell(drop: tuple[Array, Physics]) -> Array:
            return (drop[0] < ATTEMPTS) & ~(drop[1].qpos[self.goal.qpos][2] > PALM_HEIGHT)

        def again(drop: tuple[Array, Physics]) -> tuple[Array, Physics]:
            return drop[0] + 1, MujocoTask.start_physics(self, jax.random.fold_in(key, drop[0]))

        none: Physics = jax.tree.map(jnp.zeros_like, jax.tree.map(jnp.asarray, self._rest))
        return jax.lax.while_loop(fell, again, (jnp.zeros((), jnp.int32), none))[1]

    def reset(self, key: PRNGKey) -> State:
        start_key, goal_key = jax.random.split(key)
        physics = self.vary(self.start_physics(start_key), key)
        moved = self.achieved(physics)[:3] - jnp.float32(RESTING_PLACE)
        return self.first_state(physics, self.sample_goal(goal_key).at[:3].add(moved))

    def first_state(self, physics: Physics, desired_goal: Array) -> State:
        return super().first_state(physics, self.goal.checked(desired_goal))

    def with_goal(self, state: State, goal: Array) -> State:
        return super().with_goal(state, self.goal.checked(goal))

    def reached(self, achieved_goal: Array, desired_goal: Array) -> Array:
        return self.goal_distance(achieved_goal, desired_goal) < self.distance_threshold

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards [...] of goals [..., 7]. Dense: minus the angle in rad, and minus ten times the positions' distance in m."""
        if self.reward_type == "dense":
            apart, angle = self.goal.distances(achieved_goal, desired_goal)
            return -(10.0 * apart + angle)
        return super().compute_reward(achieved_goal, desired_goal)


def _task(name: str, rotation: str, text: str, **goal: Any) -> type[ManipulateTask]:
    """Class of the task HandManipulate`name` of gymnasium-robotics. Objects start with random rotations, except the pen."""
    words = re.findall(r"[A-Z]+[a-z]*", name)
    fields: dict[str, Any] = {"name": "_".join(words).lower(), "model": f"assets/hand/{words[0].lower()}.xml"}
    fields |= {"goal": ObjectPose(rotation, **goal), "start": Drop(None if words[0] == "Pen" else rotation)}
    return type(name, (ManipulateTask,), {**fields, "__doc__": f"HandManipulate{name}-v1: {text}.", "__module__": __name__})


BlockRotateZ = _task("BlockRotateZ", "z", "turn a block about the vertical")
BlockRotateParallel = _task("BlockRotateParallel", "parallel", "turn a block to another face, and about the vertical")
BlockRotateXYZ = _task("BlockRotateXYZ", "xyz", "turn a block to any orientation")
Block = _task("Block", "xyz", "bring a block to any orientation, and to a position", positions=True)
EggRotate = _task("EggRotate", "xyz", "turn an egg to any orientation")
Egg = _task("Egg", "xyz", "bring an egg to any orientation, and to a position", positions=True)
PenRotate = _task("PenRotate", "xyz", "turn a pen to any direction", ignores_z=True)
_PEN: dict[str, Any] = {"positions": True, "reach": 0.05, "ignores_z": True}
Pen = _task("Pen", "xyz", "bring a pen to any direction, and to a position", **_PEN)


def draw_rotation(key: PRNGKey, kind: str) -> Array:
    """Draws a unit quaternion [4] (w, x, y, z), with w >= 0 for "z" and "xyz". `ObjectPose` documents the kinds."""
    angle_key, key = jax.random.split(key)
    half = jax.random.uniform(angle_key, (), jnp.float32, -0.5 * jnp.pi, 0.5 * jnp.pi)
    axis = jax.random.uniform(key, (3,), jnp.float32, -1.0, 1.0) if kind == "xyz" else jnp.array([0.0, 0.0, 1.0])
    axis = axis / jnp.maximum(_norm(axis), 1e-6)
    quat = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])
    if kind == "parallel":
        quat = quat_multiply(quat, _from_euler(jnp.asarray(FACES, jnp.float32)[jax.random.randint(key, (), 0, len(FACES))]))
    return quat / _norm(quat)


@functools.partial(jnp.vectorize, signature="(e)->(q)")
def _from_euler(angles: Array) -> Array:
    """Quaternions [..., 4] of turns by angles [..., 3] in rad about x, the new y, then the new z. The sign follows too."""
    (a, b, c), (x, y, z) = jnp.cos(0.5 * angles), jnp.sin(0.5 * angles)
    return jnp.stack([a * b * c - x * y * z, x * b * c + a * y * z, a * y * c - x * b * z, a * b * z + x * y * c])


@functools.partial(jnp.vectorize, signature="(q)->(e)")
def _euler(quat: Array) -> Array:
    """Euler angles [..., 3] in rad of quaternions [..., 4]."""
    return matrix_to_euler(quat_to_matrix(quat))


def _norm(vector: Array) -> Array:
    """Length over the last axis. A sum, because a dot product would use the learner's precision on a GPU."""
    return jnp.sqrt(jnp.sum(jnp.square(vector), axis=-1))
