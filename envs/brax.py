"""Environments with Brax's interface: Brax itself, MuJoCo Playground and JaxGCRL. None is imported."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher.context import euclidean
from mjx_dher.types import Array, DistanceFn, EnvSpec, GoalObs, PRNGKey, PyTree
from mjx_dher.validation import check_count, check_number

Part = Callable[[Any], Array]  # state of the other environment -> vector
_WRAPPERS = ("AutoResetWrapper", "VmapWrapper", "EpisodeWrapper")  # ends of names; the last one is done after some steps


@struct.dataclass
class BraxState:
    """State of the inner environment, with a goal."""

    inner: PyTree
    obs: GoalObs
    reward: Array  # []
    success: Array  # []
    failed: Array  # [] bool

    @property
    def physics(self) -> Any:
        """Physics, for drawing: `data` in MuJoCo Playground, `pipeline_state` in Brax."""
        return self.inner.data if hasattr(self.inner, "data") else self.inner.pipeline_state


@struct.dataclass
class EndingState(BraxState):
    """State of an environment whose `done` ends the episode."""

    terminal: Array  # [] bool


class BraxEnv:
    """An environment of another library as a goal-conditioned one, from `from_brax`."""

    def __init__(
        self, env: Any, parts: tuple[Part, Part, Part], threshold: float, episode_length: int, distance: DistanceFn, ends: bool
    ):
        self.env, self.goal_distance, self._ends = env, distance, ends
        self._achieved, self._goal, self._observe = parts
        self.distance_threshold, self.episode_length = float(threshold), episode_length
        self.name, self.action_size, self.dt = type(env).__name__, int(env.action_size), float(env.dt)
        if (model := getattr(env, "mj_model", None) or getattr(getattr(env, "sys", None), "mj_model", None)) is not None:
            self.model = model

    @functools.cached_property
    def spec(self) -> EnvSpec:
        """The contract. The reset is traced once for it."""
        obs = jax.eval_shape(self.reset, jax.random.key(0)).obs
        goal_size = obs["achieved_goal"].shape[0]
        return EnvSpec(obs["observation"], goal_size, self.action_size, self.episode_length, ends=self._ends)

    def reset(self, key: PRNGKey) -> BraxState:
        """Resets the inner environment, and keeps its goal for the episode."""
        inner = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), self.env.reset(key))
        return self._state(inner, self._goal(inner), jnp.zeros((), bool))

    def step(self, state: BraxState, action: Array) -> BraxState:
        """Steps the inner environment with an action [A], which is clipped to [-1, 1]."""
        if jnp.shape(action) != (self.action_size,):
            raise ValueError(f"action has shape {jnp.shape(action)}; {self.name} takes ({self.action_size},)")
        copied = jax.tree.map(lambda x: x, state.inner)  # Brax's environments modify their metrics
        following = self.env.step(copied, jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0))
        inner = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), following, state.inner)
        return self._state(inner, state.obs["desired_goal"], state.failed)

    def with_goal(self, state: BraxState, goal: Array) -> BraxState:
        """State with another desired goal [G]."""
        if jnp.shape(goal) != (shape := state.obs["desired_goal"].shape):
            raise ValueError(f"goal has shape {jnp.shape(goal)}; {self.name} has goals {shape}")
        return dataclasses.replace(self._state(state.inner, goal, state.failed), reward=state.reward)

    def reached(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Whether goals [..., G] are reached, bool [...]."""
        return self.goal_distance(achieved_goal, desired_goal) <= self.distance_threshold

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards [...] of goals [..., G]: 0 if reached, else -1."""
        return self.reached(achieved_goal, desired_goal).astype(jnp.float32) - 1.0

    def _state(self, inner: Any, goal: Array, failed: Array) -> BraxState:
        achieved, goal = (jnp.asarray(x, jnp.float32) for x in (self._achieved(inner), goal))
        if not achieved.ndim == goal.ndim == 1:
            raise ValueError(f"from_brax: achieved and goal must return vectors [G]; got {achieved.shape} and {goal.shape}")
        observation = jax.tree.map(_plain, self._observe(inner))
        obs = GoalObs(observation=observation, achieved_goal=achieved, desired_goal=goal)
        reward = self.compute_reward(achieved, goal)
        done = jnp.asarray(inner.done, bool)
        if self._ends:
            return EndingState(inner, obs, reward, success=reward + 1.0, failed=failed, terminal=done)
        failed = failed | done
        return BraxState(inner, obs, reward, success=jnp.where(failed, 0.0, reward + 1.0), failed=failed)


def _plain(x: Any) -> Array:
    """Numbers as float32, except pictures."""
    return jnp.asarray(x, jnp.uint8 if jnp.result_type(x) == jnp.uint8 else jnp.float32)


def from_brax(
    env: Any,
    achieved: Part,
    goal: Part,
    threshold: float,
    episode_length: int,
    observe: Part = lambda state: state.obs,
    distance: DistanceFn = euclidean,
    ends: bool = False,
) -> BraxEnv:
    """Makes a goal-conditioned task from an environment with Brax's interface.

    Rewards become -1 and 0, and goals that the inner environment draws after the reset are ignored.

    Args:
      env: an environment of Brax, MuJoCo Playground or JaxGCRL, without wrappers that batch it, reset it or limit its steps.
      achieved: maps its state to the achieved goal [G].
      goal: maps the state after a reset to the desired goal [G].
      threshold: largest distance at which the goal is reached.
      observe: maps its state to the observation, [D] or a tree of arrays, without the goal. Default: the state's `obs`.
      distance: (achieved [..., G], desired [..., G]) -> [...]. Default: Euclidean.
      ends: meaning of `done`. True: the episode ends, and no future follows. False: the episode has failed and nothing is
        learned from it. With rewards of -1, True makes an early end attractive.

    Raises:
      ValueError: the environment has such a wrapper, or an argument is out of range.
    """
    layer = env
    for _ in range(100):
        if (kind := type(layer).__name__).endswith(_WRAPPERS):
            raise ValueError(f"env must not be wrapped in {kind}: pass the inner environment")
        layer = getattr(layer, "__dict__", {}).get("env")
    check_number("threshold", threshold, "(0, inf)", float)
    check_count("episode_length", episode_length)
    return BraxEnv(env, (achieved, goal, observe), threshold, episode_length, distance, bool(ends))
