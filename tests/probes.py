"""Environments whose answers are known."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher.types import Array, GoalObs


@struct.dataclass
class ProbeState:
    obs: GoalObs
    reward: Array
    success: Array


class PointMass:
    """A point in the plane that moves by 0.1 times its action; the goal is a place. No physics engine.

    The sparse reward is -1 until the point is within 0.1 of the goal, so a good policy needs a step for every 0.1 of distance.
    """

    name = "point_mass"
    observation_size, goal_size, action_size = 2, 2, 2

    def __init__(self, episode_length: int = 10):
        self.episode_length = episode_length

    def reset(self, key) -> ProbeState:
        start, goal = jax.random.uniform(key, (2, 2), minval=-0.4, maxval=0.4)
        return self._state(start, goal)

    def step(self, state: ProbeState, action: Array) -> ProbeState:
        position = state.obs["achieved_goal"] + 0.1 * jnp.clip(action, -1, 1)
        return self._state(position, state.obs["desired_goal"])

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        return -(jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) > 0.1).astype(jnp.float32)

    def _state(self, position: Array, goal: Array) -> ProbeState:
        reward = self.compute_reward(position, goal)
        obs = GoalObs(observation=position, achieved_goal=position, desired_goal=goal)
        return ProbeState(obs=obs, reward=reward, success=(reward == 0).astype(jnp.float32))


class Clock(PointMass):
    """A point that moves by exactly its action from the origin: achieved goals are sums of actions."""

    name = "clock"

    def reset(self, key) -> ProbeState:
        return self._state(jnp.zeros(2), jax.random.uniform(key, (2,)))

    def step(self, state: ProbeState, action: Array) -> ProbeState:
        return self._state(state.obs["achieved_goal"] + action, state.obs["desired_goal"])


@struct.dataclass
class ExplodingState(ProbeState):
    step: Array
    failed: Array


class Explodes(PointMass):
    """PointMass of which the episodes that start beyond `edge` break at their third step.

    `value` then stands in their observations for one step; None: they say `failed` and show nothing.
    """

    EDGE = 0.2

    def __init__(self, value: float | None, edge: float = EDGE):
        super().__init__()
        self.value, self.edge = value, edge

    def reset(self, key) -> ExplodingState:
        state = super().reset(key)
        breaks = state.obs["achieved_goal"][0] > self.edge
        # Counts up from 0 in an episode that will break, from 100 in any other.
        return ExplodingState(state.obs, state.reward, state.success, jnp.where(breaks, 0, 100), jnp.zeros((), bool))

    def step(self, state: ExplodingState, action: Array) -> ExplodingState:
        following = super().step(state, action)
        step, obs = state.step + 1, following.obs
        if self.value is None:
            failed = state.failed | (step == 3)
        else:
            failed = state.failed
            obs = obs | {"observation": jnp.where(step == 3, self.value, obs["observation"])}
        return ExplodingState(obs, following.reward, following.success, step, failed)
