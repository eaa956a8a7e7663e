"""Tasks whose physics an engine advances: steps, rewards and goals. Subclasses add a model, controls and observations."""

import abc
import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.config import plain
from mjx_dher.envs.base import GoalEnv, State
from mjx_dher.envs.engines import Controls, Physics, check_shape, make_engine
from mjx_dher.types import Array, DistanceFn, EnvSpec, GoalObs, PRNGKey
from mjx_dher.validation import check_count, check_number

# Methods that `describe` describes, with its entries that are left out if a class replaces a method and not `describe`.
_DESCRIBED = {
    **{name: ["controls"] for name in ("controls", "advance", "step")},
    **{name: ["layout", "joints", "sensors"] for name in ("observe", "observed")},
    "observe_goal": ["layout", "joints", "sensors", "goal"],
    **{name: ["goal"] for name in ("achieved", "sample_goal", "goal_distance", "reached")},
}


class Range(NamedTuple):
    """Range of a free body's or a joint's start."""

    qpos: int  # first index in qpos
    qvel: int  # first index in qvel
    low: np.ndarray  # [3] of a free body, [1] of a joint
    high: np.ndarray


class SimulatedTask(GoalEnv):
    """A goal-conditioned task on a physics engine.

    Args:
      reward_type: "sparse" (0 if the goal is reached, else -1) or "dense" (minus the distance, unbounded below).
      distance_threshold: largest distance at which the goal is reached. Default: the goal's threshold.
      episode_length: steps of an episode. Default: the class's.
      varied: lowest and highest factor of masses, friction, damping and gains, such as {"mass:box": (0.5, 2)}. Each reset draws
        the factors. A text "mass:box=0.5-2,gain:*=0.9-1.1" does, too. Default: the class's.
      **engine_options: options of the engine; see `make_engine`.
    """

    model: Any  # MjModel in an instance
    hz: float = 25.0  # actions per second
    episode_length: int = 50
    varied: Mapping[str, tuple[float, float]] | str = MappingProxyType({})
    threshold: float  # default of `distance_threshold`; `bind` may set it
    goal_distance: DistanceFn
    _strict = False  # whether success, unlike the reward, needs less than the threshold, as in the Fetch and hand originals
    _object: Range | None = None  # of the free body that `with_object` moves
    _rest: Physics  # start, and state after a divergence

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
        self.episode_length = plain(type(self).episode_length if episode_length is None else episode_length)
        check_count("episode_length", self.episode_length)
        self.name = getattr(type(self), "name", type(self).__name__)
        self.model = self.load()
        substeps = substeps_of(self.hz, self.model.opt.timestep)
        self.dt = substeps * float(self.model.opt.timestep)  # s
        self._ranges = _ranges_of(self.varied if varied is None else varied)
        self._engine_options = engine_options
        self.engine = make_engine(engine, self.model, substeps, varied=tuple(self._ranges), **engine_options)
        if self._ranges:
            from mjx_dher.envs.engines.variation import check_friction

            check_friction(self.model, self._ranges, self.engine.name)
        self._asked = plain(distance_threshold)
        if self._asked is not None:
            check_number("distance_threshold", self._asked, "(0, inf)", float)
        self.bind()
        self.distance_threshold = plain(self.threshold) if self._asked is None else self._asked
        check_number("distance_threshold", self.distance_threshold, "(0, inf)", float)
        self.check_own()

    @abc.abstractmethod
    def load(self) -> mujoco.MjModel:
        """Compiles the model."""

    @abc.abstractmethod
    def bind(self) -> None:
        """Looks up names in the model, and sets the sizes."""

    @abc.abstractmethod
    def controls(self, physics: Physics, action: Array) -> Controls:
        """Inputs of the engine for an action [A] in [-1, 1]."""

    @abc.abstractmethod
    def observe(self, physics: Physics) -> Array:
        """Observation [D]."""

    @abc.abstractmethod
    def achieved(self, physics: Physics) -> Array:
        """Goal [G] that a state achieves."""

    @abc.abstractmethod
    def is_sound(self, physics: Physics) -> Array:
        """Whether this is a possible state of the task, bool []. NaN is not."""

    def check_own(self) -> None:
        """Finds the observation's size if a subclass or mixin replaces `observe`, and checks an own `achieved`."""
        owners = type(self).__mro__
        base = owners[owners.index(SimulatedTask) - 1]  # MujocoTask or FetchEnv
        own = [name for name in ("observe", "achieved", "spec") if getattr(type(self), name) is not getattr(base, name)]
        if "observe" in own and (shape := self._shape_of("observe")) is not None:
            if "spec" not in own and len(shape) != 1:
                raise ValueError(f"observe must return a vector; got shape {list(shape)}")
            self.observation_size = shape[0] if len(shape) == 1 else self.observation_size
        if "achieved" in own and (shape := self._shape_of("achieved")) not in (None, (self.goal_size,)):
            raise ValueError(f"achieved must return a goal [{self.goal_size}]; got shape {list(shape)}")

    def _shape_of(self, method: str) -> tuple[int, ...] | None:
        """Shape of a method's result for the start, or None if it uses an attribute that a constructor sets later."""
        try:
            rest: Physics = self.vary(jax.tree.map(jnp.asarray, self._rest), jax.random.key(0))
            given = jax.eval_shape(getattr(self, method), rest)
        except AttributeError:
            return None
        if not hasattr(given, "shape"):
            raise ValueError(f"{method} must return an array; got a {type(given).__name__}")
        return tuple(given.shape)

    @property
    def _own(self) -> list[str]:
        """Methods of `_DESCRIBED` that a subclass or mixin replaces, and its `describe` does not."""
        owners = type(self).__mro__
        at = lambda name: next((i for i, owner in enumerate(owners) if name in vars(owner)), len(owners))  # noqa: E731
        return [name for name in _DESCRIBED if at(name) < at("describe")]

    def describe(self) -> dict[str, Any]:
        """Entries of `robot_interface`, as JSON. By default none."""
        return {}

    @property
    def robot_interface(self) -> dict[str, Any]:
        """Entries of `describe`, for policy files. Those that own methods may contradict are left out, and "own" has these
        methods.
        """
        lost = {entry for name in self._own for entry in _DESCRIBED[name]}
        kept = {name: value for name, value in self.describe().items() if name not in lost}
        return kept | ({"own": self._own} if self._own else {})

    @property
    def spec(self) -> EnvSpec:
        """The task's contract."""
        observation = jax.ShapeDtypeStruct((self.observation_size,), jnp.float32)
        lowest = -1.0 if self.reward_type == "sparse" else -np.inf
        return EnvSpec(observation, self.goal_size, self.action_size, self.episode_length, reward_range=(lowest, 0.0))

    @property
    def has_object(self) -> bool:
        """Whether the start has a range for a free body, which `with_object` can move."""
        return self._object is not None

    @property
    def object_bounds(self) -> np.ndarray | None:
        """Lowest and highest coordinates [2, 3] in m of the first free body after a reset."""
        return None if self._object is None else np.stack(self._object[2:])

    def object_position(self, state: State) -> Array:
        """Position [3] in m of the free body that `with_object` moves."""
        assert self._object is not None
        return state.physics.qpos[self._object[0] : self._object[0] + 3]

    def vary(self, physics: Physics, key: PRNGKey) -> Physics:
        """The physics with factors of `varied`, drawn with the key of the reset."""
        if not self._ranges:
            return physics
        from mjx_dher.envs.engines.variation import draw

        return dataclasses.replace(physics, factors=draw(self._ranges, key))

    def first_state(self, physics: Physics, desired_goal: Array) -> State:
        """First state of an episode from `physics`, with a goal [G]. If it has diverged, it is like a state from `step`.
        Outside `jit`, raises ValueError if a free or ball joint has a quaternion of length 0.
        """
        check_shape("desired_goal", desired_goal, (self.goal_size,))
        if not isinstance(physics.qpos, jax.core.Tracer):
            kinds, starts, qpos = self.model.jnt_type, self.model.jnt_qposadr, np.asarray(physics.qpos)
            for at in (starts + 3 * (kinds == 0))[kinds < 2]:  # kind 0 is a free joint, 1 a ball joint
                if not np.linalg.norm(quat := qpos[at : at + 4]):
                    raise ValueError(f"qpos[{at}:{at + 4}] must be a quaternion of a length above 0; got {quat}")
        physics = self._sensed(physics)
        sound = self.is_sound(physics)
        physics = self._or_rest(physics, sound)
        obs = self.observe_goal(physics, jnp.asarray(desired_goal, jnp.float32))
        success = jnp.where(sound, self._success(obs["achieved_goal"], obs["desired_goal"]), 0.0)
        return State(physics=physics, obs=obs, reward=jnp.float32(0), success=success, step=jnp.int32(0), failed=~sound)

    def with_goal(self, state: State, goal: Array) -> State:
        """State with another desired goal [G]."""
        check_shape("desired_goal", goal, (self.goal_size,))
        obs: GoalObs = {**state.obs, "desired_goal": jnp.asarray(goal, jnp.float32)}
        success = jnp.where(state.failed, 0.0, self._success(obs["achieved_goal"], obs["desired_goal"]))
        return dataclasses.replace(state, obs=obs, success=success)

    def step(self, state: State, action: Array) -> State:
        """Applies an action [A] for one step.

        If the simulation diverges or the action is not finite, the state returns to the start, and `failed` stays True until
        `reset`.
        """
        action = self.check_action(action)
        physics = self.advance(state.physics, jnp.clip(action, -1.0, 1.0))
        sound = self.is_sound(physics) & jnp.all(jnp.isfinite(action))  # MuJoCo C treats NaN inputs as 0
        physics = self._or_rest(physics, sound)
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
        check_shape("position", position, (3,))
        at, dof, *_ = self._object
        qpos = state.physics.qpos.at[at : at + 7].set(jnp.asarray(self._rest.qpos[at : at + 7]).at[:3].set(position))
        qvel = state.physics.qvel.at[dof : dof + 6].set(0.0)
        physics = self._sensed(dataclasses.replace(state.physics, qpos=qpos, qvel=qvel, warmstart=jnp.zeros_like(qvel)))
        obs = self.observe_goal(self.observed(physics), state.obs["desired_goal"])
        return self.with_goal(dataclasses.replace(state, physics=physics, obs=obs), obs["desired_goal"])

    def check(self) -> None:
        self.engine.check()

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards [...] of goals [..., G]. Sparse: 0 if reached, else -1. Dense: minus the distance."""
        if self.reward_type == "dense":
            return -self.goal_distance(achieved_goal, desired_goal)
        return -(~self.reached(achieved_goal, desired_goal)).astype(jnp.float32)  # -1, too, if the distance is NaN

    def reached(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Whether goals [..., G] are reached, bool [...]."""
        return self.goal_distance(achieved_goal, desired_goal) <= self.distance_threshold

    def advance(self, physics: Physics, action: Array) -> Physics:
        """Physics one step later."""
        controls = self.controls(physics, action)
        return self._sensed(self.engine.advance(physics, controls), controls)

    def _or_rest(self, physics: Physics, sound: Array) -> Physics:
        """The physics if it is sound, else the start's."""
        rest = dataclasses.replace(self._rest, factors=physics.factors)
        return jax.tree.map(lambda new, start: jnp.where(sound, new, start), physics, rest)

    def observed(self, physics: Physics) -> Physics:
        """Physics that is observed after a step. By default unchanged."""
        return physics

    def observe_goal(self, physics: Physics, desired_goal: Array) -> GoalObs:
        """Observation, achieved and desired goal in float32, even if JAX computes in 64 bits."""
        observation, achieved = self.observe(physics).astype(jnp.float32), self.achieved(physics).astype(jnp.float32)
        return GoalObs(observation=observation, achieved_goal=achieved, desired_goal=desired_goal.astype(jnp.float32))

    def _sensed(self, physics: Physics, controls: Controls | None = None) -> Physics:
        """The physics with the sensors that the task observes, for `controls` or the start's. By default none."""
        return physics

    def _success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        if self._strict:
            return (self.goal_distance(achieved_goal, desired_goal) < self.distance_threshold).astype(jnp.float32)
        return self.reached(achieved_goal, desired_goal).astype(jnp.float32)


def _ranges_of(varied: Any) -> dict[str, tuple[float, float]]:
    """`variation.to_ranges` of `varied`. Raises ValueError if it is invalid."""
    if isinstance(varied, Mapping) and not varied:
        return {}
    from mjx_dher.envs.engines.variation import to_ranges

    return to_ranges(varied)


def substeps_of(hz: float, timestep: float) -> int:
    """Timesteps of the model per action. Raises ValueError if `hz` does not give a whole number."""
    check_number("hz", hz, "(0, inf)", float)
    check_number("timestep of the model", timestep, "(0, inf)", float)
    substeps = round(1 / (hz * timestep))
    if substeps < 1 or abs(substeps * timestep * hz - 1) > 1e-6:
        nearest = sorted({float(f"{1 / (n * timestep):.9g}") for n in (max(substeps - 1, 1), max(substeps, 1), substeps + 1)})
        raise ValueError(f"hz must make a whole number of the model's timesteps of {timestep:g} s; got {hz}, near {nearest}")
    return substeps
