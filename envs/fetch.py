"""The common part of the Fetch tasks: action, observation, goals, reward and reset, as functions of (qpos, qvel).

The tasks follow gymnasium-robotics 1.4.2, version v4 of its Fetch environments, run on mujoco 3.11.0; constants named
"settled" were measured there after the environment's own set-up (docs/fidelity.md).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.arm_kinematics import Chain, integrate, matrix_to_euler, quat_to_matrix
from mjx_dher.envs.base import GoalEnv, State
from mjx_dher.envs.engines import Controls, Physics, make_engine
from mjx_dher.types import Array, EnvSpec, GoalObs, PRNGKey
from mjx_dher.validation import check_count, check_number

SUBSTEPS = 20  # physics steps of 2 ms per action: 25 actions a second
# Beyond either speed the physics has blown up.
MAX_OBJECT_SPEED = 10.0  # m/s
MAX_JOINT_SPEED = 100.0  # rad/s, or m/s for a finger
ACTION_SCALE = 0.05  # m that an action of 1 moves the target
RESET_CANDIDATES = 64  # object positions drawn at once; with probability < 1e-6, all lie too close in any task
TIMESTEP = 0.002  # s
DT = SUBSTEPS * TIMESTEP  # s; the observation gives velocities as displacements per step
POINTING_DOWN = np.array([1.0, 0.0, 1.0, 0.0], np.float32)  # the gripper's orientation (w, x, y, z), not normalized
ASSETS = Path(__file__).parent / "assets"


@dataclasses.dataclass(frozen=True)
class FetchTask:
    """The numbers that differ between tasks (all lengths in m)."""

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
        """Lowest and highest coordinates [2, 3] of the goals that a reset draws."""
        bounds = np.add(self.initial_grip_pos, self.target_offset) + self.target_range * np.array([[-1.0], [1.0]])
        if self.object_height is not None:
            bounds[:, 2] = self.object_height, self.object_height + self.max_goal_lift
        return bounds

    @property
    def object_bounds(self) -> np.ndarray:
        """Lowest and highest coordinates [2, 3] at which a reset puts the object."""
        bounds = self.initial_grip_pos + self.object_range * np.array([[-1.0], [1.0]])
        bounds[:, 2] = self.object_height
        return bounds


class FetchEnv(GoalEnv):
    """The Fetch arm and, except for reaching, an object; the goal is a position of the object (or of the gripper).

    Args:
      engine: "auto", "native", "jax" or "warp".
      reward_type: "sparse" (0 where the goal is reached, else -1) or "dense" (minus the distance).
      distance_threshold: distance, in m, below which the goal is reached.
      episode_length: steps of an episode.
      **engine_options: options of the engine; see `make_engine`.
    """

    task: ClassVar[FetchTask]
    goal_size = 3
    action_size = 4

    def __init__(
        self,
        engine: str = "auto",
        reward_type: str = "sparse",
        distance_threshold: float = 0.05,
        episode_length: int = 50,
        **engine_options: Any,
    ):
        if reward_type not in ("sparse", "dense"):
            raise ValueError(f"reward_type must be 'sparse' or 'dense'; got {reward_type!r}")
        distance_threshold, episode_length = _plain(distance_threshold), _plain(episode_length)
        check_number("distance_threshold", distance_threshold, "(0, inf)", float)
        check_count("episode_length", episode_length)
        self.reward_type = reward_type
        self.distance_threshold = distance_threshold
        self.episode_length = episode_length
        self.model = mujoco.MjModel.from_xml_path(str(ASSETS / self.task.xml))
        self.engine = make_engine(engine, self.model, SUBSTEPS, **engine_options)
        self.has_object = self.task.object_height is not None
        self.observation_size = 25 if self.has_object else 10
        self.arm = Chain(self.model, body="gripper", site="grip")
        # Two finger joints, right and left. Without actuators they are blocked: put back after every step.
        self.has_fingers = any(self.model.joint(i).name == "finger_r" for i in range(self.model.njnt))
        self.drives_fingers = self.model.nu > 0
        if self.has_fingers:
            self._finger_qpos, self._finger_qvel = _joint_slices(self.model, "finger_r", width=2)
        if self.has_object:
            self._object_qpos, self._object_qvel = _joint_slices(self.model, "object", width=7)

    @property
    def spec(self) -> EnvSpec:
        """The task's contract. Dense rewards count from -1, so distances must not exceed 1 m."""
        observation = jax.ShapeDtypeStruct((self.observation_size,), jnp.float32)
        return EnvSpec(observation, self.goal_size, self.action_size, self.episode_length, reward_range=(-1.0, 0.0))

    @property
    def goal_bounds(self) -> np.ndarray:
        """Lowest and highest coordinates [2, 3] of the goals that a reset draws."""
        return self.task.goal_bounds

    @property
    def object_bounds(self) -> np.ndarray:
        """Lowest and highest coordinates [2, 3] at which a reset puts the object."""
        return self.task.object_bounds

    def reset(self, key: PRNGKey) -> State:
        """Draws a start as in the original: settled arm, object on the table near the gripper, random goal."""
        object_key, goal_key = jax.random.split(key)
        object_qpos = self._sample_object(object_key) if self.has_object else None
        return self.init_state(object_qpos, self._sample_goal(goal_key))

    def init_state(self, object_qpos: Array | None, desired_goal: Array) -> State:
        """Returns the state at a given start, for example from a recorded episode. The arm starts as always.

        Args:
          object_qpos: [7] object position, m, and orientation (w, x, y, z); None for a task without an object.
          desired_goal: [3] m.
        """
        physics = self._start(object_qpos)
        obs = self._observe(physics, jnp.asarray(desired_goal, jnp.float32))
        return State(
            physics=physics,
            obs=obs,
            reward=jnp.zeros((), jnp.float32),
            success=self._success(obs["achieved_goal"], obs["desired_goal"]),
            step=jnp.zeros((), jnp.int32),
            failed=jnp.zeros((), bool),
        )

    def with_goal(self, state: State, goal: Array) -> State:
        """Returns the state with another desired goal, [3] m."""
        obs: GoalObs = {**state.obs, "desired_goal": jnp.asarray(goal, jnp.float32)}
        return dataclasses.replace(state, obs=obs, success=self._success(obs["achieved_goal"], obs["desired_goal"]))

    def with_object(self, state: State, position: Array) -> State:
        """Returns the state with the object at `position`, [3] m, upright and at rest."""
        upright = jnp.concatenate([jnp.asarray(position, jnp.float32), jnp.array([1.0, 0.0, 0.0, 0.0])])
        before = state.physics
        qpos, qvel = before.qpos.at[self._object_qpos].set(upright), before.qvel.at[self._object_qvel].set(0.0)
        physics = before.replace(qpos=qpos, qvel=qvel, warmstart=jnp.zeros_like(before.warmstart))
        obs = self._observe(self._at_observation(physics), state.obs["desired_goal"])
        return self.with_goal(dataclasses.replace(state, physics=physics, obs=obs), obs["desired_goal"])

    def step(self, state: State, action: Array) -> State:
        """Moves the gripper's target by 5 cm times `action[:3]` (x, y, z) and holds it for one step of 40 ms.

        `action[3]` opens and closes the fingers if actuators drive them. If the physics blows up (a value is not finite, or a
        speed above its limit), the state goes back to a start, and `failed` stays True until `reset`.
        """
        action = jnp.clip(self.check_action(action), -1.0, 1.0)
        # As in the original, targets are relative to the present places of gripper and fingers, not to earlier targets, and the
        # target's orientation lies half-way between the gripper's and straight down.
        pos, quat = self.arm.pose(self._at_observation(state.physics).qpos[self.arm.qpos])
        quat = quat + POINTING_DOWN
        target = jnp.concatenate([pos + ACTION_SCALE * action[:3], quat / jnp.linalg.norm(quat)])
        ctrl = state.physics.qpos[self._finger_qpos] + action[3] if self.drives_fingers else jnp.zeros(0)
        physics = self.engine.advance(state.physics, Controls(ctrl=ctrl, mocap=target[None]))
        if self.has_fingers and not self.drives_fingers:
            physics = dataclasses.replace(physics, qpos=physics.qpos.at[self._finger_qpos].set(0.0))
        sound = self._is_sound(physics)
        physics = jax.tree.map(lambda new, start: jnp.where(sound, new, start), physics, self._start(self._resting_place()))
        failed = state.failed | ~sound
        obs = self._observe(self._at_observation(physics), state.obs["desired_goal"])
        return State(
            physics=physics,
            obs=obs,
            reward=self.compute_reward(obs["achieved_goal"], obs["desired_goal"]),
            success=jnp.where(failed, 0.0, self._success(obs["achieved_goal"], obs["desired_goal"])),
            step=state.step + 1,
            failed=failed,
        )

    def check(self) -> None:
        self.engine.check()

    def _start(self, object_qpos: Array | None) -> Physics:
        qpos = jnp.zeros(self.model.nq, jnp.float32).at[self.arm.qpos].set(jnp.array(self.task.arm_qpos, jnp.float32))
        if self.has_object:
            qpos = qpos.at[self._object_qpos].set(jnp.asarray(object_qpos, jnp.float32))
        # Not at rest: the original's own set-up ends with the gripper at a few cm/s.
        qvel = jnp.zeros(self.model.nv, jnp.float32).at[self.arm.qvel].set(jnp.array(self.task.arm_qvel, jnp.float32))
        if self.has_fingers:
            qvel = qvel.at[self._finger_qvel].set(jnp.array(self.task.finger_qvel, jnp.float32))
        return Physics(qpos=qpos, qvel=qvel, warmstart=jnp.zeros(self.model.nv, jnp.float32), act=jnp.zeros(0, jnp.float32))

    def _resting_place(self) -> Array | None:
        """The object's qpos [7] after the physics blew up: next to the gripper, as near as a reset would put it."""
        if self.task.object_height is None:
            return None
        x, y, _ = self.task.initial_grip_pos
        return jnp.array([x, y + self.task.min_object_distance, self.task.object_height, 1.0, 0.0, 0.0, 0.0])

    def _is_sound(self, physics: Physics) -> Array:
        """Whether this can be a state of the task, []. Comparisons with NaN are false, so NaN never passes."""
        qpos, qvel = physics.qpos, physics.qvel
        sound = jnp.all(jnp.isfinite(qpos)) & jnp.all(jnp.isfinite(physics.warmstart)) & jnp.all(jnp.isfinite(qvel))
        sound &= jnp.all(jnp.abs(qvel[self.arm.qvel]) < MAX_JOINT_SPEED)
        if self.has_fingers:
            sound &= jnp.all(jnp.abs(qvel[self._finger_qvel]) < MAX_JOINT_SPEED)
        if self.has_object:
            sound &= jnp.linalg.norm(qvel[self._object_qvel][:3]) < MAX_OBJECT_SPEED
        return sound

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Returns rewards: [..., 3], [..., 3] -> [...]. Sparse: 0 within the threshold, else -1. Dense: minus the distance."""
        distance = goal_distance(achieved_goal, desired_goal)
        if self.reward_type == "dense":
            return -distance
        return -(~(distance <= self.distance_threshold)).astype(jnp.float32)  # -1, too, where the distance is NaN

    def _success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        # Strict, unlike the reward: the original differs at a distance of exactly the threshold, so we do.
        return (goal_distance(achieved_goal, desired_goal) < self.distance_threshold).astype(jnp.float32)

    def _sample_object(self, key: PRNGKey) -> Array:
        """Draws the object's qpos [7]: upright, uniform around the gripper, at least `min_object_distance` from it."""
        task = self.task
        bound = task.object_range
        offsets = jax.random.uniform(key, (RESET_CANDIDATES, 2), jnp.float32, minval=-bound, maxval=bound)
        distance = jnp.linalg.norm(offsets, axis=-1)
        # The first candidate that is far enough, or else the farthest.
        index = jnp.argmax(jnp.where(distance >= task.min_object_distance, jnp.inf, distance))
        xy = jnp.array(task.initial_grip_pos[:2]) + offsets[index]
        return jnp.concatenate([xy, jnp.array([task.object_height, 1.0, 0.0, 0.0, 0.0])])

    def _sample_goal(self, key: PRNGKey) -> Array:
        """Draws a goal [3] around the gripper plus the task's offset; with an object, at its height or (half of them) above."""
        task = self.task
        # Scaled by `uniform`, whose result XLA rounds alike wherever it computes it: reset and first step give the same goal.
        largest = jnp.array([task.target_range] * 3 + [task.max_goal_lift], jnp.float32)
        drawn = jax.random.uniform(key, (4,), jnp.float32, minval=-largest, maxval=largest)
        goal = jnp.array(task.initial_grip_pos) + drawn[:3] + jnp.array(task.target_offset)
        if task.object_height is None:
            return goal
        return goal.at[2].set(task.object_height + jnp.maximum(drawn[3], 0.0))

    def _at_observation(self, physics: Physics) -> Physics:
        """Returns the physics from which the observation after a step is computed.

        If actuators drive the fingers, the original does not recompute positions after its last substep: gripper and object are
        observed one substep (2 ms) late, while joint positions and all velocities are up to date.
        """
        if not self.drives_fingers:
            return physics
        qpos, qvel = physics.qpos, physics.qvel
        late = qpos.at[self.arm.qpos].add(-TIMESTEP * qvel[self.arm.qvel])
        if self.has_object:
            late = late.at[self._object_qpos].set(integrate(qpos[self._object_qpos], qvel[self._object_qvel], -TIMESTEP))
        return dataclasses.replace(physics, qpos=late)

    def _observe(self, physics: Physics, desired_goal: Array) -> GoalObs:
        grip_pos, grip_vel = self.arm.site_motion(physics.qpos[self.arm.qpos], physics.qvel[self.arm.qvel])
        blocked = jnp.zeros(2)
        finger_pos = physics.qpos[self._finger_qpos] if self.has_fingers else blocked
        finger_vel = physics.qvel[self._finger_qvel] if self.has_fingers else blocked
        if not self.has_object:
            observation = jnp.concatenate([grip_pos, finger_pos, grip_vel * DT, finger_vel * DT])
            return _in_float32(observation, grip_pos, desired_goal)
        object_qpos, object_qvel = physics.qpos[self._object_qpos], physics.qvel[self._object_qvel]
        observation = fetch_observation(grip_pos, grip_vel, object_qpos, object_qvel, finger_pos, finger_vel)
        return _in_float32(observation, object_qpos[:3], desired_goal)


def _in_float32(observation: Array, achieved_goal: Array, desired_goal: Array) -> GoalObs:
    """Converts an observation to float32, also if JAX computes in 64 bits."""
    observation, achieved_goal, desired_goal = (x.astype(jnp.float32) for x in (observation, achieved_goal, desired_goal))
    return GoalObs(observation=observation, achieved_goal=achieved_goal, desired_goal=desired_goal)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def goal_distance(achieved_goal: Array, desired_goal: Array) -> Array:
    """Returns Euclidean distances, m: [..., G], [..., G] -> [...]."""
    return jnp.linalg.norm(achieved_goal - desired_goal, axis=-1)


def fetch_observation(
    grip_pos: Array, grip_vel: Array, object_qpos: Array, object_qvel: Array, finger_pos: Array, finger_vel: Array
) -> Array:
    """Returns the original's observation vector [25].

    0-2 grip position, 3-5 object position, 6-8 object minus grip, 9-10 finger positions (right, left), 11-13 object Euler
    angles, 14-16 object velocity minus grip velocity, 17-19 object angular velocity (world axes), 20-22 grip velocity,
    23-24 finger velocities. Positions in m, angles in rad, velocities as displacement per step (x 0.04 s).

    Args:
      grip_pos, grip_vel: [3] m, m/s.
      object_qpos: [7] position and quaternion (w, x, y, z).
      object_qvel: [6] linear velocity in world axes, angular velocity in the object's own axes (MuJoCo's free joint).
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
    """Returns the slices of qpos and qvel that hold `width` coordinates from `joint` on (7 and 6 for a free joint)."""
    qpos, qvel = int(model.joint(joint).qposadr[0]), int(model.joint(joint).dofadr[0])
    return slice(qpos, qpos + width), slice(qvel, qvel + (6 if width == 7 else width))
