"""A task from a robot's MJCF: `MujocoTask`, with its controls, goals, observations and starts."""

import copy
import dataclasses
import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs import probes
from mjx_dher.envs.base import State
from mjx_dher.envs.controls import Actuators, Control, JointDelta, JointPosition, Mocap, Torque
from mjx_dher.envs.engines import Controls, Physics
from mjx_dher.envs.engines.features import check_inputs
from mjx_dher.envs.goals import Goal, Joints, Mark, Pose, Position, Rotation
from mjx_dher.envs.kinematics import Place
from mjx_dher.envs.observations import Entry, Sensors
from mjx_dher.envs.simulated import SimulatedTask
from mjx_dher.envs.starts import Start
from mjx_dher.lookup import hint
from mjx_dher.types import Array, PRNGKey
from mjx_dher.validation import check_number

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


# Values that are no fields of a task, and what to set instead.
_ELSEWHERE = {
    **dict.fromkeys(("threshold", "distance_threshold"), "the goal's threshold"),
    **dict.fromkeys(("observation_size", "layout"), "observations"),
    **{"dt": "hz", "frame_skip": "hz", "goal_size": "goal", "rest_action": "start"},
    **{"action_size": "control", "ctrl": "control", "obs": "observations", "reward_range": "spec"},
}


class MujocoTask(SimulatedTask):
    """A goal-conditioned task from a model and a few declarations. You can override every method.

    Arguments are as in `SimulatedTask`.

    Raises:
      ValueError: the model lacks a declared name or is unstable, or the robot cannot reach any goal.
    """

    model: Any  # MJCF (text, or a path relative to the file of the class), MjSpec or MjModel; MjModel in an instance
    control: Control | Sequence[Control] = JointPosition()
    goal: Goal
    observations: Sequence[str] = ("qpos:*", "qvel:*")
    start: Start = Start()
    max_speed: float = 1000.0  # rad/s or m/s; the simulation has diverged if it is faster
    _sensors: Sensors | None = None

    def load(self) -> mujoco.MjModel:
        return load_model(type(self), getattr(self, "model", None))

    def bind(self) -> None:
        """Looks up the declared names in the model, and probes the model."""
        check_inputs(self.model)
        if not callable(self.controls):
            raise ValueError(f"controls is a method of a task; the field is control; got controls = {self.controls!r}")
        _check_names(type(self))
        declared = self.control if isinstance(self.control, (list, tuple)) else (self.control,)
        self.parts = [_bound("control", part, Control, self.model) for part in declared]
        for part in self.parts:
            _check_has("control", part, Control, "size", "apply")
        self.action_size = sum(part.size for part in self.parts)
        moved = [name for part in self.parts for name in part.moved]
        if len(set(moved)) < len(moved) or not self.action_size:
            raise ValueError(f"control must move something, and nothing twice; got {moved}")
        goal = copy.copy(_checked("goal", getattr(self, "goal", None), Goal))
        if self._asked is not None:
            goal.threshold = self._asked
        self.goal = _bound("goal", goal, Goal, self.model)
        _check_has("goal", self.goal, Goal, "size", "threshold", "achieved", "sample", "distance")
        self.goal_size, self.threshold = self.goal.size, self.goal.threshold
        if not hasattr(type(self), "goal_distance"):
            self.goal_distance = self.goal.distance
        self.start = _bound("start", self.start, Start, self.model)
        self._rest, self._hold = self.start.physics, self.start.hold
        self.rest_action = np.asarray(self._rest_of(self._hold.ctrl))  # keeps the start
        self._object = next((each for each in self.start.drawn if len(each.low) == 3), None)
        given = self.observations
        texts = (given,) if isinstance(given, str) else tuple(given) if isinstance(given, Sequence) else ()
        if not texts or len(set(texts)) < len(texts):
            raise ValueError(f"observations must be one or more different names; got {given!r}")
        self._entries = [Entry(self.model, text) for text in texts]
        ends = np.cumsum([0, *(entry.size for entry in self._entries)]).tolist()
        self.layout = {text: slice(*ends) for text, *ends in zip(texts, ends, ends[1:])}  # of the observation
        self.observation_size = ends[-1]
        if any(entry.sensors for entry in self._entries):
            self._sensors = Sensors(self.engine.name, self.model, tuple(self._ranges), **self._engine_options)
            none: Any = np.zeros(self.model.nsensordata, np.float32)
            self._rest = dataclasses.replace(self._rest, sensors=none)  # `_sensed` reads them
        check_number("max_speed", self.max_speed, "(0, inf)", float)
        rest = np.asarray(self._rest.qpos)
        probes.check_stable(self.model, rest, np.asarray(self._hold.ctrl), self.dt * self.episode_length)
        probes.check_overlaps(self.model, rest, self.start.drawn)
        probes.check_reachable(self.model, rest, self.goal)

    def describe(self) -> dict[str, Any]:
        """Controls, goal, observation layout, and names of joints and sensors of its entries, as JSON."""
        entries = list(zip(self.layout, self._entries))
        return {
            "controls": [part.describe() for part in self.parts],
            "goal": self.goal.describe(),
            "layout": {name: [part.start, part.stop] for name, part in self.layout.items()},
            "joints": {name: entry.joints for name, entry in entries if entry.joints},
            "sensors": {name: entry.sensors for name, entry in entries if entry.sensors},
        }

    @property
    def goal_bounds(self) -> np.ndarray | None:
        """Lowest and highest coordinates [2, 3] of goals in m, if they are positions."""
        return None if self.goal.low is None or self.goal.place is None else np.stack([self.goal.low, self.goal.high])

    def goal_marks(self, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        """Marks that show a goal [G] in a configuration [nq]: balls, and bodies as ghosts."""
        return self.goal.marks(self.model, qpos, goal)

    def reset(self, key: PRNGKey) -> State:
        """Draws a start and a goal."""
        start_key, goal_key = jax.random.split(key)
        return self.first_state(self.vary(self.start_physics(start_key), key), self.sample_goal(goal_key))

    def check(self) -> None:
        super().check()
        if self._sensors:
            self._sensors.check()

    def start_physics(self, key: PRNGKey) -> Physics:
        """Draws the physics of a start."""
        rest: Physics = jax.tree.map(jnp.asarray, self._rest)
        physics, hold = self._held(dataclasses.replace(rest, qpos=self.start.draw(key), sensors=None))
        return jax.lax.fori_loop(0, self.start.settle, lambda _, now: self.engine.advance(now, hold), physics)

    def _held(self, physics: Physics) -> tuple[Physics, Controls]:
        """A drawn start with activations, and inputs that hold it."""
        physics, hold = self.start.held(physics)
        drawn = {each.qpos for each in self.start.drawn}
        for part in self.parts:  # the mocap target of a body that was drawn is at the body
            if isinstance(part, Mocap) and any(joint.qpos in drawn for joint in part.place.joints):
                hold = part.apply(physics, jnp.zeros(part.size, jnp.float32), hold)
        return physics, hold

    def rest_of(self, physics: Physics, measured: bool = False) -> Array:
        """Action [A] that holds a start, or a robot at `measured` positions."""
        return self._rest_of(self.start.inputs_at(physics.qpos) if measured else self._held(physics)[1].ctrl)

    def _rest_of(self, ctrl: Array) -> Array:
        return jnp.concatenate([part.rest(jnp.asarray(ctrl)) for part in self.parts])

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

    def observe(self, physics: Physics) -> Array:
        """Observation [D]. `layout` has the slices of its parts."""
        return jnp.concatenate([entry(physics) for entry in self._entries])

    def achieved(self, physics: Physics) -> Array:
        return self.goal.achieved(physics)

    def advance(self, physics: Physics, action: Array) -> Physics:
        controls = self.controls(physics, action)
        following = self.engine.advance(physics, controls)
        finite = jnp.all(jnp.isfinite(controls.ctrl)) & jnp.all(jnp.isfinite(controls.mocap))
        # MuJoCo C treats NaN inputs as 0. Here the step fails, as after a NaN action.
        following = dataclasses.replace(following, qvel=jnp.where(finite, following.qvel, jnp.nan))
        return self._sensed(following, controls)

    def is_sound(self, physics: Physics) -> Array:
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(physics)]
        return jnp.all(jnp.stack(finite)) & jnp.all(jnp.abs(physics.qvel) < self.max_speed)

    def _sensed(self, physics: Physics, controls: Controls | None = None) -> Physics:
        if self._sensors is None:
            return physics
        controls = self._held(physics)[1] if controls is None else controls
        return dataclasses.replace(physics, sensors=self._sensors.read(physics, controls))


def load_model(task: type, model: Any) -> mujoco.MjModel:
    """Compiles the MJCF of a task class. A path is relative to the file of the class. Raises ValueError if there is no such
    file, MuJoCo rejects it, or a number is NaN.
    """
    compiled = _compile(task, model)
    fields = [(name, getattr(part, name)) for part in (compiled, compiled.opt) for name in dir(part) if name[0] != "_"]
    if bad := [name for name, value in fields if isinstance(value, float | np.ndarray) and np.isnan(value).any()]:
        raise ValueError(f"model of {task.__name__} has NaN in {', '.join(bad)}")
    return compiled


def _compile(task: type, model: Any) -> mujoco.MjModel:
    try:
        if isinstance(model, mujoco.MjModel):
            return copy.copy(model)
        if isinstance(model, mujoco.MjSpec):
            return model.compile()
        if isinstance(model, str) and model.lstrip().startswith("<"):
            return mujoco.MjModel.from_xml_string(model)
        if isinstance(model, (str, Path)):
            path = _folder(task) / model
            if path.is_dir():  # MuJoCo would call it an empty file, and warn of its size
                raise ValueError(f"{str(model)!r} is the folder {path}, not an MJCF file")
            return mujoco.MjModel.from_xml_path(str(path))
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


def _check_names(task: type) -> None:
    """Raises ValueError if a task class has a value under an argument's or result's name, or under nearly a field's name, or a
    function under nearly the name of a method that it does not have.
    """
    annotated = SimulatedTask.__annotations__ | MujocoTask.__annotations__
    fields = [name for name in annotated if name[0] != "_" and name not in ("threshold", "goal_distance")]
    arguments = inspect.signature(SimulatedTask).parameters.keys() - fields
    owners = task.__mro__[: task.__mro__.index(MujocoTask)]
    methods = {name for name in dir(MujocoTask) if name[0] != "_" and callable(getattr(MujocoTask, name))} | {"goal_distance"}
    kept = methods - {name for owner in owners for name in vars(owner)}  # from the base class
    kinds = {"control": Control, "goal": Goal, "start": Start}
    left = {field: kind for field, kind in kinds.items() if not any(field in vars(owner) for owner in owners)}
    for owner in owners:
        if elsewhere := sorted(vars(owner).keys() & _ELSEWHERE.keys()):
            raise ValueError(f"{owner.__name__}.{elsewhere[0]} is no field of a task; set {_ELSEWHERE[elsewhere[0]]} instead")
        for name in vars(owner).keys() - fields - vars(MujocoTask).keys() - methods:
            if callable(vars(owner)[name]) and name[0] != "_" and (near := hint(name, kept, cutoff=0.9)):
                raise ValueError(f"{owner.__name__}.{name} is no method of a task{near}")
            if field := next((field for field, kind in left.items() if isinstance(vars(owner)[name], kind)), None):
                raise ValueError(f"{owner.__name__}.{name} is no field of a task; set {field} instead")
            near = hint(name, fields, cutoff=0.85)
            if name in arguments or (near and not callable(vars(owner)[name])):
                kind = "an argument of a task and not a field" if name in arguments else "no field of a task"
                raise ValueError(f"{owner.__name__}.{name} is {kind}{near}; fields are {', '.join(fields)}")


def _checked(field: str, value: Any, kind: type) -> Any:
    """Returns `value`. Raises ValueError if it is of another kind."""
    if not isinstance(value, kind):
        raise ValueError(f"{field} must be a {kind.__name__} object; got {value!r}")
    return value


def _bound(field: str, value: Any, kind: type, model: mujoco.MjModel) -> Any:
    """The bound value. Raises ValueError if it, or what its `bind` returns, is of another kind."""
    name = f"what bind of {field} {type(value).__name__} returns"
    return _checked(name, _checked(field, value, kind).bind(model), kind)


def _check_has(field: str, value: Any, kind: type, *names: str) -> None:
    """Raises ValueError if a control or goal lacks one of the names, or has only the empty method of `kind`, its base class."""
    lacks = lambda name: getattr(getattr(value, name), "__func__", 0) is getattr(kind, name, None)  # noqa: E731
    if lacking := [name for name in names if not hasattr(value, name) or lacks(name)]:
        raise ValueError(
            f"{field} {type(value).__name__} needs {' and '.join(lacking)}, as {kind.__module__}.{kind.__name__} says"
        )
