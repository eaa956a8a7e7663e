"""A task from a robot's MJCF: `MujocoTask`, with its controls, goals, observations and starts."""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs import probes
from mjx_dher.envs.base import GoalEnv, State
from mjx_dher.envs.controls import Actuators, Control, JointDelta, JointPosition, Mocap, Torque
from mjx_dher.envs.engines import Controls, Physics, make_engine
from mjx_dher.envs.engines.sensors import Sensors
from mjx_dher.envs.engines.variation import draw, to_ranges
from mjx_dher.envs.goals import Goal, Joints, Mark, Pose, Position, Rotation
from mjx_dher.envs.kinematics import Place
from mjx_dher.envs.observations import Entry
from mjx_dher.envs.starts import Start
from mjx_dher.types import Array, DistanceFn, EnvSpec, GoalObs, PRNGKey
from mjx_dher.validation import check_count, check_number

__all__ = [
    "Actuators",
    "Control",
    "Goal",
    "JointDelta",
    "JointPosition",
    "Joints",
    "Mocap",
    "MujocoTask",
    "Place",
    "Pose",
    "Position",
    "Rotation",
    "Start",
    "Torque",
]


class MujocoTask(GoalEnv):
    """A goal-conditioned task from a model and a few declarations. You can override every method.

    Args:
      reward_type: "sparse" (0 if the goal is reached, else -1) or "dense" (minus the distance, unbounded below).
      distance_threshold: largest distance at which the goal is reached. Default: the goal's threshold.
      episode_length: steps of an episode. Default: the class's.
      varied: lowest and highest factor of masses, friction, damping and gains, such as {"mass:box": (0.5, 2)}. Each reset draws
        the factors. A text "mass:box=0.5-2,gain:*=0.9-1.1" does, too. Default: the class's.
      **engine_options: options of the engine; see `make_engine`.

    Raises:
      ValueError: the model lacks a declared name or is unstable, or the robot cannot reach any goal.
    """

    model: Any  # MJCF (text, or a path relative to the file of the class), MjSpec or MjModel; MjModel in an instance
    control: Control | Sequence[Control] = JointPosition()
    goal: Goal
    observations: Sequence[str] = ("qpos:*", "qvel:*")
    start: Start = Start()
    hz: float = 25.0  # actions per second
    episode_length: int = 50
    varied: Mapping[str, tuple[float, float]] | str = MappingProxyType({})
    max_speed: float = 1000.0  # rad/s or m/s; the simulation has diverged if it is faster
    _sensors: Sensors | None = None

    def __init__(
        self,
        engine: str = "auto",
        reward_type: str = "sparse",
        distance_threshold: float | None = None,
        episode_length: int | None = None,
        varied: Mapping[str, tuple[float, float]] | str | None = None,
        **engine_options: Any,
    ):
        if reward_type not in ("sparse", "dense"):
            raise ValueError(f"reward_type must be 'sparse' or 'dense'; got {reward_type!r}")
        self.reward_type = reward_type
        self.episode_length = _plain(type(self).episode_length if episode_length is None else episode_length)
        check_count("episode_length", self.episode_length)
        self.name = getattr(type(self), "name", type(self).__name__)
        self.model = self.load()
        substeps = substeps_of(self.hz, self.model.opt.timestep)
        self.dt = substeps * float(self.model.opt.timestep)  # s
        self._ranges = to_ranges(self.varied if varied is None else varied)
        self.engine = make_engine(engine, self.model, substeps, varied=tuple(self._ranges), **engine_options)
        self.bind()
        self.distance_threshold = _plain(self.goal.threshold if distance_threshold is None else distance_threshold)
        check_number("distance_threshold", self.distance_threshold, "(0, inf)", float)

    def load(self) -> mujoco.MjModel:
        """Compiles the model."""
        return load_model(type(self), getattr(self, "model", None))

    def bind(self) -> None:
        """Looks up the declared names in the model, and probes the model."""
        declared = self.control if isinstance(self.control, Sequence) else (self.control,)
        self.parts = [_checked("control", part, Control).bind(self.model) for part in declared]
        self.action_size = sum(part.size for part in self.parts)
        moved = [name for part in self.parts for name in part.moved]
        if len(set(moved)) < max(1, len(moved)):
            raise ValueError(f"control must move something, and nothing twice; got {moved}")
        self.goal = _checked("goal", getattr(self, "goal", None), Goal).bind(self.model)
        self.goal_size = self.goal.size
        self.goal_distance: DistanceFn = self.goal.distance
        self.start = _checked("start", self.start, Start).bind(self.model)
        self._rest, self._hold = self.start.physics, self.start.hold
        self.rest_action = np.concatenate([part.rest(np.asarray(self._hold.ctrl)) for part in self.parts])  # keeps the start
        self._object = next((each for each in self.start.drawn if len(each.low) == 3), None)
        texts = (self.observations,) if isinstance(self.observations, str) else tuple(self.observations)
        if not texts or len(set(texts)) < len(texts):
            raise ValueError(f"observations must be one or more different names; got {texts}")
        self._entries = [Entry(self.model, text) for text in texts]
        ends = np.cumsum([0, *(entry.size for entry in self._entries)]).tolist()
        self.layout = {text: slice(*ends) for text, *ends in zip(texts, ends, ends[1:])}  # of the observation
        self.observation_size = ends[-1]
        if any(entry.reads_sensors for entry in self._entries):
            self._sensors = Sensors(self.engine.name, self.model, getattr(self.engine, "allow_cpu", False), tuple(self._ranges))
            none: Any = np.zeros(self.model.nsensordata, np.float32)
            self._rest = dataclasses.replace(self._rest, sensors=none)  # `_sensed` reads them
        check_number("max_speed", self.max_speed, "(0, inf)", float)
        rest = np.asarray(self._rest.qpos)
        probes.check_stable(self.model, rest, np.asarray(self._hold.ctrl), self.dt * self.episode_length)
        probes.check_reachable(self.model, rest, self.goal)

    @property
    def spec(self) -> EnvSpec:
        """The task's contract."""
        observation = jax.ShapeDtypeStruct((self.observation_size,), jnp.float32)
        lowest = -1.0 if self.reward_type == "sparse" else -np.inf
        return EnvSpec(observation, self.goal_size, self.action_size, self.episode_length, reward_range=(lowest, 0.0))

    @property
    def robot_interface(self) -> dict[str, Any]:
        """Controls, observation layout and joint names of its entries as JSON, for policy files."""
        layout = {name: [part.start, part.stop] for name, part in self.layout.items()}
        joints = {name: entry.joints for name, entry in zip(self.layout, self._entries) if entry.joints}
        return {"controls": [part.describe() for part in self.parts], "layout": layout, "joints": joints}

    @property
    def goal_bounds(self) -> np.ndarray | None:
        """Lowest and highest coordinates [2, 3] of goals in m, if they are positions."""
        return None if self.goal.low is None or self.goal.place is None else np.stack([self.goal.low, self.goal.high])

    @property
    def has_object(self) -> bool:
        """Whether the start has a range for a free body, which `with_object` can move."""
        return self._object is not None

    @property
    def object_bounds(self) -> np.ndarray | None:
        """Lowest and highest coordinates [2, 3] in m of the first free body after a reset."""
        return None if self._object is None else np.stack(self._object[2:])

    def goal_marks(self, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        """Marks that show a goal [G] in a configuration [nq]: balls, and bodies as ghosts."""
        return self.goal.marks(self.model, qpos, goal)

    def reset(self, key: PRNGKey) -> State:
        """Draws a start and a goal."""
        start_key, goal_key = jax.random.split(key)
        return self.first_state(self.vary(self.start_physics(start_key), key), self.sample_goal(goal_key))

    def vary(self, physics: Physics, key: PRNGKey) -> Physics:
        """The physics with factors of `varied`, drawn with the key of the reset."""
        return dataclasses.replace(physics, factors=draw(self._ranges, key)) if self._ranges else physics

    def first_state(self, physics: Physics, desired_goal: Array) -> State:
        """First state of an episode that starts from `physics`, with a goal [G]."""
        physics = self._sensed(physics)
        obs = self.observe_goal(physics, jnp.asarray(desired_goal, jnp.float32))
        return State(
            physics=physics,
            obs=obs,
            reward=jnp.zeros((), jnp.float32),
            success=self._success(obs["achieved_goal"], obs["desired_goal"]),
            step=jnp.zeros((), jnp.int32),
            failed=jnp.zeros((), bool),
        )

    def with_goal(self, state: State, goal: Array) -> State:
        """State with another desired goal [G]."""
        obs: GoalObs = {**state.obs, "desired_goal": jnp.asarray(goal, jnp.float32)}
        return dataclasses.replace(state, obs=obs, success=self._success(obs["achieved_goal"], obs["desired_goal"]))

    def step(self, state: State, action: Array) -> State:
        """Applies an action [A] for one step.

        If the simulation diverges or the action is not finite, the state returns to the start, and `failed` stays True until
        `reset`.
        """
        action = jnp.clip(self.check_action(action), -1.0, 1.0)
        physics = self.advance(state.physics, action)
        sound = self.is_sound(physics) & jnp.all(jnp.isfinite(action))  # MuJoCo C treats NaN inputs as 0
        rest = dataclasses.replace(self._rest, factors=physics.factors)
        physics = jax.tree.map(lambda new, start: jnp.where(sound, new, start), physics, rest)
        failed = state.failed | ~sound
        obs = self.observe_goal(self.observed(physics), state.obs["desired_goal"])
        return State(
            physics=physics,
            obs=obs,
            reward=self.compute_reward(obs["achieved_goal"], obs["desired_goal"]),
            success=jnp.where(failed, 0.0, self._success(obs["achieved_goal"], obs["desired_goal"])),
            step=state.step + 1,
            failed=failed,
        )

    def with_object(self, state: State, position: Array) -> State:
        """State with the start's first free body at rest at `position`, [3] in m."""
        assert self._object is not None
        at, dof, *_ = self._object
        qpos = state.physics.qpos.at[at : at + 7].set(jnp.asarray(self._rest.qpos[at : at + 7]).at[:3].set(position))
        qvel = state.physics.qvel.at[dof : dof + 6].set(0.0)
        physics = dataclasses.replace(state.physics, qpos=qpos, qvel=qvel, warmstart=jnp.zeros_like(qvel))
        physics = self._sensed(physics)
        obs = self.observe_goal(self.observed(physics), state.obs["desired_goal"])
        return self.with_goal(dataclasses.replace(state, physics=physics, obs=obs), obs["desired_goal"])

    def check(self) -> None:
        self.engine.check()
        if self._sensors:
            self._sensors.check()

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards [...] of goals [..., G]. Sparse: 0 if reached, else -1. Dense: minus the distance."""
        if self.reward_type == "dense":
            return -self.goal_distance(achieved_goal, desired_goal)
        return -(~self.reached(achieved_goal, desired_goal)).astype(jnp.float32)  # -1, too, if the distance is NaN

    def reached(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Whether goals [..., G] are reached, bool [...]."""
        return self.goal_distance(achieved_goal, desired_goal) <= self.distance_threshold

    def start_physics(self, key: PRNGKey) -> Physics:
        """Draws the physics of a start."""
        physics: Physics = dataclasses.replace(jax.tree.map(jnp.asarray, self._rest), qpos=self.start.draw(key))
        if not self.start.settle:
            return physics
        hold = jax.tree.map(jnp.asarray, self._hold)
        return jax.lax.fori_loop(0, self.start.settle, lambda _, now: self.engine.advance(now, hold), physics)

    def sample_goal(self, key: PRNGKey) -> Array:
        """Draws a goal [G]."""
        return self.goal.sample(key)

    def controls(self, physics: Physics, action: Array) -> Controls:
        """Inputs of the engine for an action [A] in [-1, 1]. Inputs without a control keep their start values."""
        controls, begin = jax.tree.map(jnp.asarray, self._hold), 0
        for part in self.parts:
            controls = part.apply(physics, action[begin : begin + part.size], controls)
            begin += part.size
        return controls

    def advance(self, physics: Physics, action: Array) -> Physics:
        """Physics one step later."""
        controls = self.controls(physics, action)
        return self._sensed(self.engine.advance(physics, controls), controls)

    def observed(self, physics: Physics) -> Physics:
        """Physics that is observed after a step. By default unchanged."""
        return physics

    def observe(self, physics: Physics) -> Array:
        """Observation [D]. `layout` has the slices of its parts."""
        return jnp.concatenate([entry(physics) for entry in self._entries])

    def achieved(self, physics: Physics) -> Array:
        """Goal [G] that a state achieves."""
        return self.goal.achieved(physics)

    def observe_goal(self, physics: Physics, desired_goal: Array) -> GoalObs:
        """Observation, achieved and desired goal in float32, even if JAX computes in 64 bits."""
        observation, achieved = self.observe(physics).astype(jnp.float32), self.achieved(physics).astype(jnp.float32)
        return GoalObs(observation=observation, achieved_goal=achieved, desired_goal=desired_goal.astype(jnp.float32))

    def is_sound(self, physics: Physics) -> Array:
        """Whether this is a possible state of the task, bool []. NaN is not."""
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(physics)]
        return jnp.all(jnp.stack(finite)) & jnp.all(jnp.abs(physics.qvel) < self.max_speed)

    def _sensed(self, physics: Physics, controls: Controls | None = None) -> Physics:
        """The physics with the sensors that the task observes, for `controls` or the start's."""
        if self._sensors is None:
            return physics
        controls = jax.tree.map(jnp.asarray, self._hold) if controls is None else controls
        return dataclasses.replace(physics, sensors=self._sensors.read(physics, controls))

    def _success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        return self.reached(achieved_goal, desired_goal).astype(jnp.float32)


def load_model(task: type, model: Any) -> mujoco.MjModel:
    """Compiles the MJCF of a task class. A path is relative to the file of the class. Raises ValueError if there is no such
    file, or MuJoCo rejects it.
    """
    try:
        if isinstance(model, mujoco.MjModel):
            return copy.copy(model)
        if isinstance(model, mujoco.MjSpec):
            return model.compile()
        if isinstance(model, str) and model.lstrip().startswith("<"):
            return mujoco.MjModel.from_xml_string(model)
        if isinstance(model, (str, Path)):
            return mujoco.MjModel.from_xml_path(str(_folder(task) / model))
    except ValueError as error:
        raise ValueError(f"model of {task.__name__}: {error}") from error
    raise ValueError(f"model of {task.__name__} must be an MJCF (path or text), MjSpec or MjModel; got {model!r}")


def _folder(task: type) -> Path:
    """Folder of the file that declares a task's model, or the current one if there is no file, as in a notebook."""
    owner = next((base for base in task.__mro__ if "model" in vars(base)), task)
    try:
        return Path(inspect.getfile(owner)).parent
    except (TypeError, OSError):
        return Path()


def substeps_of(hz: float, timestep: float) -> int:
    """Timesteps of the model per action. Raises ValueError if `hz` does not give a whole number."""
    check_number("hz", hz, "(0, inf)", float)
    substeps = round(1 / (hz * timestep))
    if substeps < 1 or abs(substeps * timestep * hz - 1) > 1e-6:
        nearest = sorted({round(1 / (n * timestep), 4) for n in (max(substeps - 1, 1), max(substeps, 1), substeps + 1)})
        raise ValueError(f"hz must make a whole number of the model's timesteps of {timestep:g} s; got {hz}, near {nearest}")
    return substeps


def _checked(field: str, value: Any, kind: type) -> Any:
    """Returns `value`. Raises ValueError if it is of another kind."""
    if not isinstance(value, kind):
        raise ValueError(f"{field} must be a {kind.__name__} object; got {value!r}")
    return value


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
