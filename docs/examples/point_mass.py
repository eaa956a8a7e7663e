"""A custom task and goal sampler without a physics engine. docs/tutorial.md explains them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher.config import HParams
from mjx_dher.types import Array, GoalObs, PRNGKey

STEP = 0.1  # distance that an action of 1 moves the point, along each axis
REACH = 0.1  # distance at which the goal is reached


@struct.dataclass
class PointState:
    """State of an episode."""

    obs: GoalObs  # observation [2], achieved_goal [2], desired_goal [2]
    reward: Array  # []
    success: Array  # [] 1.0 if the goal is reached, else 0.0


class PointMass:
    """A point in the plane. An action moves it, and the goal is a place for it."""

    name = "point_mass"
    observation_size, goal_size, action_size = 2, 2, 2

    def __init__(self, episode_length: int = 10):
        self.episode_length = episode_length

    def reset(self, key: PRNGKey) -> PointState:
        """Draws start and goal, uniform in a square."""
        start, goal = jax.random.uniform(key, (2, 2), jnp.float32, minval=-0.4, maxval=0.4)
        return self._state(start, goal)

    def step(self, state: PointState, action: Array) -> PointState:
        """State after `action` [2], which is clipped to [-1, 1]."""
        position = state.obs["achieved_goal"] + STEP * jnp.clip(action, -1, 1)
        return self._state(position, state.obs["desired_goal"])

    def with_goal(self, state: PointState, goal: Array) -> PointState:
        """The state with another goal [2]."""
        return self._state(state.obs["achieved_goal"], goal)

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards [...] of goals [..., 2]: 0 within reach, else -1."""
        return -(jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) > REACH).astype(jnp.float32)

    def _state(self, position: Array, goal: Array) -> PointState:
        reward = self.compute_reward(position, goal)
        obs = GoalObs(observation=position, achieved_goal=position, desired_goal=goal)
        return PointState(obs=obs, reward=reward, success=(reward == 0).astype(jnp.float32))


def soon(achieved: Array, desired: Array, step: Array, hparams: HParams) -> Array:
    """A goal sampler: each future goal is half as likely as the one before it. Log weights [T+1] of the goals [T+1, 2]."""
    del desired, hparams
    later = jnp.arange(achieved.shape[0]) - step
    return jnp.where(later > 0, -jnp.log(2.0) * later, -jnp.inf)
