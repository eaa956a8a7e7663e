"""The environment interface: unbatched, pure functions."""

import abc

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mjx_dher.types import Array, GoalObs, PRNGKey, PyTree


@struct.dataclass
class State:
    """State of an episode."""

    physics: PyTree  # the engine's state
    obs: GoalObs  # observation [D], achieved_goal [G], desired_goal [G]
    reward: Array  # [] reward of the last step; 0 after a reset
    success: Array  # [] 1.0 if the goal is reached, else 0.0
    step: Array  # [] number of steps taken, int32
    failed: Array | bool = False  # [] whether the simulation diverged in this episode; do not learn from it


class GoalEnv(abc.ABC):
    """A goal-conditioned environment.

    `reset` and `step` are pure functions of one environment; use `jax.vmap` for a batch. An episode has `episode_length`
    steps. There is no automatic reset, so no last observation is lost. If episodes can end early or rewards lie outside [-1,
    0], define `spec` (`types.EnvSpec`).
    """

    name: str
    observation_size: int  # D
    goal_size: int  # G
    action_size: int  # A
    episode_length: int  # T

    @abc.abstractmethod
    def reset(self, key: PRNGKey) -> State:
        """Initial state, drawn with `key`."""

    @abc.abstractmethod
    def step(self, state: State, action: Array) -> State:
        """State after one step with an action [A], which is clipped to [-1, 1]."""

    @abc.abstractmethod
    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards [...] of `achieved_goal` [..., G] for `desired_goal` [..., G]."""

    def check(self) -> None:  # noqa: B027 - most have nothing to check
        """Raises ValueError if steps so far were wrong in a way that their results do not show.

        Call it on the host after the steps, not while tracing.
        """

    def check_action(self, action: Array) -> Array:
        """Converts `action` to float32. Raises ValueError for a wrong shape or, outside `jit`, for infinite or NaN values."""
        shape = np.shape(action)  # of a list, too
        if shape != (self.action_size,):
            raise ValueError(
                f"action has shape {shape}; {self.name} takes ({self.action_size},)"
                " (step is unbatched: use jax.vmap for a batch)"
            )
        if not isinstance(action, jax.core.Tracer) and not np.all(np.isfinite(np.asarray(action, np.float32))):
            raise ValueError(f"action must be finite; got {np.asarray(action)}")
        return jnp.asarray(action, jnp.float32)
