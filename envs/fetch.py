"""The Fetch tasks: reach, push, pick and place, slide. All parts are functions of (qpos, qvel).

The tasks follow version v4 of the Fetch environments in gymnasium-robotics 1.4.2 on mujoco 3.11.0. Constants named "settled"
were measured there after the environment's set-up (docs/fidelity.md).
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.context import euclidean
from mjx_dher.envs.arm_kinematics import Chain, integrate, matrix_to_euler, quat_to_matrix
from mjx_dher.envs.base import State
from mjx_dher.envs.engines import Controls, Physics, check_shape
from mjx_dher.envs.simulated import Range, SimulatedTask
from mjx_dher.types import Array, EnvSpec, MirrorFn, PRNGKey

SUBSTEPS = 20  # physics steps of 2 ms per action: 25 actions a second
# Above either speed the simulation has diverged.
MAX_OBJECT_SPEED = 10.0  # m/s
MAX_JOINT_SPEED = 100.0  # rad/s, or m/s for a finger
ACTION_SCALE = 0.05  # m that an action of 1 moves the target
RESET_CANDIDATES = 64  # object positions drawn per reset; all are too close with probability < 1e-6
TIMESTEP = 0.002  # s
DT = SUBSTEPS * TIMESTEP  # s; observed velocities are displacements per step
POINTING_DOWN = np.array([1.0, 0.0, 1.0, 0.0], np.float32)  # the gripper's orientation (w, x, y, z), not normalized
ASSETS = Path(__file__).parent / "assets"

# Entries of the observation, and how many numbers each has. Velocities are displacements per step.
_WITH_OBJECT = {
    **{"grip_pos": 3, "object_pos": 3, "object_pos - grip_pos": 3, "finger_pos": 2, "object_euler": 3},
    **{"object_vel - grip_vel": 3, "object_angvel": 3, "grip_vel": 3, "finger_vel": 2},
}
_WITHOUT_OBJECT = {name: _WITH_OBJECT[name] for name in ("grip_pos", "finger_pos", "grip_vel", "finger_vel")}


@dataclasses.dataclass(frozen=True)
class FetchTask:
    """Numbers that differ between tasks. Lengths are in m."""

    xml: str  # file in envs/assets
    arm_qpos: tuple[float, ...]  # [7] settled, rad, shoulder to wrist
    arm_qvel: tuple[float, ...]  # [7] settled, rad/s
    initial_grip_pos: tuple[float, float, float]  # settled; object and goal are drawn around it
    target_range: float  # the goal lies within this of the gripper plus target_offset, along each axis
    target_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    object_height: float | None = None  # settled height of the object's centre, and of goals on the table; None: no object
    object_range: float = 0.15  # the object starts within this of the gripper, along x and along y
    min_object_distance: float = 0.1  # and at least this far from it in the plane
    max_goal_lift: float = 0.0  # half of all goals are lifted by up to this
    finger_qvel: tuple[float, float] = (0.0, 0.0)  # settled, m/s, right and left; for fingers with joints

    @property
    def goal_bounds(self) -> np.ndarray:
        """Lowest and highest coordinates [2, 3] of a reset's goals."""
        bounds = np.add(self.initial_grip_pos, self.target_offset) + self.target_range * np.array([[-1.0], [1.0]])
        if self.object_height is not None:
            bounds[:, 2] = self.object_height, self.object_height + self.max_goal_lift
        return bounds

    @property
    def object_bounds(self) -> np.ndarray:
        """Lowest and highest coordinates [2, 3] of the object after a reset."""
        bounds = self.initial_grip_pos + self.object_range * np.array([[-1.0], [1.0]])
        bounds[:, 2] = self.object_height
        return bounds


class FetchEnv(SimulatedTask):
    """The Fetch arm and, except for Reach, an object. The goal is a position of the object (or of the gripper).

    Arguments are as in `SimulatedTask`, and the threshold is 0.05 m. Dense rewards must lie in [-1, 0], so distances must not
    exceed 1 m.
    """

    task: ClassVar[FetchTask]
    action_size, goal_size = 4, 3
    threshold = 0.05  # m
    _strict = True
    goal_distance = staticmethod(euclidean)

    def load(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_path(str(ASSETS / self.task.xml))

    def bind(self) -> None:
        """Looks up arm, fingers and object. These models need no probes."""
        has_object = self.task.object_height is not None
        self._entries = _WITH_OBJECT if has_object else _WITHOUT_OBJECT
        self.observation_size = sum(self._entries.values())
        self.arm = Chain(self.model, body="gripper", site="grip")
        qpos, qvel = np.zeros(self.model.nq, np.float32), np.zeros(self.model.nv, np.float32)
        # Not at rest: the original's set-up ends with the gripper at a few cm/s.
        qpos[self.arm.qpos], qvel[self.arm.qvel] = self.task.arm_qpos, self.task.arm_qvel
        # Two finger joints, right and left. Without actuators they are reset after every step.
        self.has_fingers = any(self.model.joint(i).name == "finger_r" for i in range(self.model.njnt))
        self.drives_fingers = self.model.nu > 0
        if self.has_fingers:
            self._finger_qpos, self._finger_qvel = _joint_slices(self.model, "finger_r", width=2)
            qvel[self._finger_qvel] = self.task.finger_qvel
        if has_object:
            self._object_qpos, self._object_qvel = _joint_slices(self.model, "object", width=7)
            self._object = Range(self._object_qpos.start, self._object_qvel.start, *self.task.object_bounds)
            # After a divergence the object is next to the gripper, as near as a reset would put it.
            x, y, _ = self.task.initial_grip_pos
            qpos[self._object_qpos] = x, y + self.task.min_object_distance, self.task.object_height, 1.0, 0.0, 0.0, 0.0
        self._rest: Any = Physics(qpos, qvel, warmstart=np.zeros_like(qvel), act=np.zeros(0, np.float32))  # type: ignore[arg-type]

    @property
    def goal_bounds(self) -> np.ndarray:
        """Lowest and highest coordinates [2, 3] of goals in m."""
        return self.task.goal_bounds.astype(np.float32)

    @property
    def mirror(self) -> MirrorFn:
        """Image at the vertical plane along x through the gripper's start."""
        from mjx_dher import mirror  # only runs with mirror images need it

        return functools.partial(mirror.across_y, self._entries, self.task.initial_grip_pos[1])

    def describe(self) -> dict[str, Any]:
        ends = np.cumsum([0, *self._entries.values()]).tolist()
        fingers = {"kind": "JointDelta", "moves": ["finger_r", "finger_l"] if self.drives_fingers else [], "scale": 1.0}
        controls = [{"kind": "Mocap", "moves": ["gripper"], "scale": ACTION_SCALE, "size": 3}, {**fingers, "size": 1}]
        layout = {name: [begin, end] for name, begin, end in zip(self._entries, ends, ends[1:])}
        return {"controls": controls, "layout": layout, "joints": {"finger_pos": ["finger_r", "finger_l"]}}

    @property
    def spec(self) -> EnvSpec:
        return dataclasses.replace(super().spec, reward_range=(-1.0, 0.0))

    def init_state(self, object_qpos: Array | None, desired_goal: Array) -> State:
        """State at a given start, for example from a recorded episode. The arm starts as always.

        Args:
          object_qpos: position [3] in m and orientation [4] (w, x, y, z) of the object, or None for a task without object.
          desired_goal: goal [3] in m.

        Raises:
          ValueError: an array has another shape or, outside `jit`, a quaternion has length 0.
        """
        physics: Physics = jax.tree.map(jnp.asarray, self._rest)
        if object_qpos is not None:
            check_shape("object_qpos", object_qpos, (7,))
            qpos = physics.qpos.at[self._object_qpos].set(jnp.asarray(object_qpos, jnp.float32))
            physics = dataclasses.replace(physics, qpos=qpos)
        return self.first_state(physics, desired_goal)

    def reset(self, key: PRNGKey) -> State:
        """Draws a start as in the original: settled arm, object on the table near the gripper, random goal."""
        object_key, goal_key = jax.random.split(key)
        object_qpos = self._sample_object(object_key) if self.has_object else None
        state = self.init_state(object_qpos, self.sample_goal(goal_key))
        return dataclasses.replace(state, physics=self.vary(state.physics, key))

    def controls(self, physics: Physics, action: Array) -> Controls:
        """Moves the gripper's target by 5 cm times `action[:3]` (x, y, z).

        `action[3]` opens and closes the fingers if actuators drive them. As in the original, targets are relative to the
        current positions of gripper and fingers. The target's orientation lies half-way between the gripper's and straight
        down.
        """
        pos, quat = self.arm.pose(self.observed(physics).qpos[self.arm.qpos])
        quat = quat + POINTING_DOWN
        target = jnp.concatenate([pos + ACTION_SCALE * action[:3], quat / jnp.linalg.norm(quat)])
        ctrl = physics.qpos[self._finger_qpos] + action[3] if self.drives_fingers else jnp.zeros(0)
        return Controls(ctrl=ctrl, mocap=target[None])

    def advance(self, physics: Physics, action: Array) -> Physics:
        physics = super().advance(physics, action)
        if not self.has_fingers or self.drives_fingers:
            return physics
        return dataclasses.replace(physics, qpos=physics.qpos.at[self._finger_qpos].set(0.0))

    def is_sound(self, physics: Physics) -> Array:
        qpos, qvel = physics.qpos, physics.qvel
        sound = jnp.all(jnp.isfinite(qpos)) & jnp.all(jnp.isfinite(physics.warmstart)) & jnp.all(jnp.isfinite(qvel))
        sound &= jnp.all(jnp.abs(qvel[self.arm.qvel]) < MAX_JOINT_SPEED)
        if self.has_fingers:
            sound &= jnp.all(jnp.abs(qvel[self._finger_qvel]) < MAX_JOINT_SPEED)
        if self.has_object:
            sound &= jnp.linalg.norm(qvel[self._object_qvel][:3]) < MAX_OBJECT_SPEED
        return sound

    def _sample_object(self, key: PRNGKey) -> Array:
        """Draws the object's qpos [7]: upright, uniform around the gripper, at least `min_object_distance` away."""
        task = self.task
        bound = task.object_range
        offsets = jax.random.uniform(key, (RESET_CANDIDATES, 2), jnp.float32, minval=-bound, maxval=bound)
        distance = jnp.linalg.norm(offsets, axis=-1)
        # The first candidate that is far enough, or else the farthest.
        index = jnp.argmax(jnp.where(distance >= task.min_object_distance, jnp.inf, distance))
        xy = jnp.array(task.initial_grip_pos[:2]) + offsets[index]
        return jnp.concatenate([xy, jnp.array([task.object_height, 1.0, 0.0, 0.0, 0.0])])

    def sample_goal(self, key: PRNGKey) -> Array:
        """Draws a goal [3] around the gripper plus the task's offset. With an object, half of the goals lie above it."""
        task = self.task
        # Scaled by `uniform`, which XLA rounds equally everywhere, so reset and first step have the same goal.
        largest = jnp.array([task.target_range] * 3 + [task.max_goal_lift], jnp.float32)
        drawn = jax.random.uniform(key, (4,), jnp.float32, minval=-largest, maxval=largest)
        goal = jnp.array(task.initial_grip_pos) + drawn[:3] + jnp.array(task.target_offset)
        if task.object_height is None:
            return goal
        return goal.at[2].set(task.object_height + jnp.maximum(drawn[3], 0.0))

    def observed(self, physics: Physics) -> Physics:
        """Physics from which the observation after a step is computed.

        If actuators drive the fingers, the original does not recompute positions after its last substep. Gripper and object
        are then observed one substep (2 ms) late, while joint positions and all velocities are current.
        """
        if not self.drives_fingers:
            return physics
        qpos, qvel = physics.qpos, physics.qvel
        late = qpos.at[self.arm.qpos].add(-TIMESTEP * qvel[self.arm.qvel])
        if self.has_object:
            late = late.at[self._object_qpos].set(integrate(qpos[self._object_qpos], qvel[self._object_qvel], -TIMESTEP))
        return dataclasses.replace(physics, qpos=late)

    def observe(self, physics: Physics) -> Array:
        grip_pos, grip_vel = self.arm.site_motion(physics.qpos[self.arm.qpos], physics.qvel[self.arm.qvel])
        blocked = jnp.zeros(2)
        finger_pos = physics.qpos[self._finger_qpos] if self.has_fingers else blocked
        finger_vel = physics.qvel[self._finger_qvel] if self.has_fingers else blocked
        if not self.has_object:
            return jnp.concatenate([grip_pos, finger_pos, grip_vel * DT, finger_vel * DT])
        object_qpos, object_qvel = physics.qpos[self._object_qpos], physics.qvel[self._object_qvel]
        return fetch_observation(grip_pos, grip_vel, object_qpos, object_qvel, finger_pos, finger_vel)

    def achieved(self, physics: Physics) -> Array:
        if self.has_object:
            return physics.qpos[self._object_qpos][:3]
        return self.arm.site_motion(physics.qpos[self.arm.qpos], physics.qvel[self.arm.qvel])[0]


def fetch_observation(
    grip_pos: Array, grip_vel: Array, object_qpos: Array, object_qvel: Array, finger_pos: Array, finger_vel: Array
) -> Array:
    """Observation vector [25] of the original.

    0-2 grip position, 3-5 object position, 6-8 object minus grip, 9-10 finger positions (right, left), 11-13 object Euler
    angles, 14-16 object velocity minus grip velocity, 17-19 object angular velocity (world axes), 20-22 grip velocity, 23-24
    finger velocities. Positions in m, angles in rad, velocities as displacement per step (x 0.04 s).

    Args:
      grip_pos, grip_vel: [3] m, m/s.
      object_qpos: [7] position and quaternion (w, x, y, z).
      object_qvel: [6] linear velocity in world axes, angular velocity in the object's axes (MuJoCo's free joint).
      finger_pos, finger_vel: [2] right, left; m, m/s.
    """
    rotation = quat_to_matrix(object_qpos[3:])
    object_pos, object_vel = object_qpos[:3], object_qvel[:3]
    return jnp.concatenate(
        [
            grip_pos,
            object_pos,
            object_pos - grip_pos,
            finger_pos,
            matrix_to_euler(rotation),
            (object_vel - grip_vel) * DT,
            jnp.sum(rotation * object_qvel[None, 3:], axis=-1) * DT,
            grip_vel * DT,
            finger_vel * DT,
        ]
    )


def _joint_slices(model: mujoco.MjModel, joint: str, width: int) -> tuple[slice, slice]:
    """Slices of qpos and qvel that hold `width` coordinates from `joint` on (7 and 6 for a free joint)."""
    qpos, qvel = int(model.joint(joint).qposadr[0]), int(model.joint(joint).dofadr[0])
    return slice(qpos, qpos + width), slice(qvel, qvel + (6 if width == 7 else width))


class Reach(FetchEnv):
    """FetchReach: the goal is a position of the grip point, up to 15 cm away along each axis. The observation is [10]."""

    name = "reach"
    keeps_mirror = True
    task = FetchTask(
        xml="reach.xml",
        arm_qpos=(0.00969146345, -0.825628071, -0.00312048482, 1.4438479, 0.00263934828, 0.953287132, 0.0058733811),
        arm_qvel=(0.000743176, 0.00594367, -0.00138399, -0.000864239, 0.00109662, -0.00279652, -0.000919709),
        initial_grip_pos=(1.3418334, 0.74910102, 0.53473344),
        target_range=0.15,
    )


class Push(FetchEnv):
    """FetchPush: the goal lies on the table, up to 15 cm from the gripper along x and y."""

    name = "push"
    keeps_mirror = True
    task = FetchTask(
        xml="push.xml",
        arm_qpos=(0.0116377772, -0.580433428, -0.00457914917, 1.42152997, 0.00145336833, 0.690240166, 0.00724187328),
        arm_qvel=(0.00379832, -0.0436523, -0.00313292, 0.109691, 0.00269572, 0.0891523, 0.00103944),
        initial_grip_pos=(1.3631267, 0.7490998, 0.41601148),
        object_height=0.42489222,
        object_range=0.15,
        target_range=0.15,
    )


class PickAndPlace(FetchEnv):
    """FetchPickAndPlace: like Push, but `action[3]` moves the fingers, and half of the goals lie up to 45 cm higher."""

    name = "pick_and_place"
    keeps_mirror = True
    task = FetchTask(
        xml="pick_and_place.xml",
        arm_qpos=(0.00969037654, -0.825628108, -0.00311989443, 1.44384795, 0.00264075557, 0.953287094, 0.00587191243),
        arm_qvel=(0.000744743, 0.00594378, -0.0013853, -0.000864291, 0.00109634, -0.00279653, -0.000918971),
        initial_grip_pos=(1.3419341, 0.7491005, 0.53473306),
        target_range=0.15,
        object_height=0.42489222,
        max_goal_lift=0.45,
    )


class Slide(FetchEnv):
    """FetchSlide: a puck on a slippery table. The goal lies up to 30 cm around a point 40 cm ahead of the gripper."""

    name = "slide"
    keeps_mirror = True
    task = FetchTask(
        xml="slide.xml",
        arm_qpos=(0.0133685885, -0.575905496, -0.005929734, 1.4139215, -1.28234476e-06, 0.682503565, 0.00871218759),
        arm_qvel=(0.00697181, -0.0504703, -0.00531813, 0.120123, 0.00142379, 0.116102, 0.00411597),
        initial_grip_pos=(1.0132714, 0.7491539, 0.4155006),
        target_range=0.3,
        target_offset=(0.4, 0.0, 0.0),
        object_height=0.41999957,
        object_range=0.1,
        finger_qvel=(3.60453e-06, 0.00245563),
    )
