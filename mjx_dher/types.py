"""The vocabulary of the library: the data that its parts hand to each other.

Dimension letters, used in every shape comment:

    B  batch of transitions      E  episodes in the replay ring     A  action size
    N  environments in parallel  T  steps of an episode             D  observation size
    S  seeds                     G  goal size
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypedDict

import jax
import numpy as np
from flax import struct

Array = jax.Array
PRNGKey = jax.Array
PyTree = Any


class GoalObs(TypedDict):
    """What a goal-conditioned agent sees; the keys are those of gymnasium-robotics' goal environments."""

    observation: PyTree  # [..., D], or a pytree of arrays
    achieved_goal: Array  # [..., G]
    desired_goal: Array  # [..., G]


@struct.dataclass
class Episode:
    """A whole episode: every observation once, the last one included. Batched forms lead with [N] or [E]."""

    observation: PyTree  # [T+1, D], or a pytree of arrays that all lead with T+1
    achieved_goal: Array  # [T+1, G]
    desired_goal: Array  # [G]
    action: Array  # [T, A]


@struct.dataclass
class Batch:
    """Transitions as the learner takes them, hindsight goals already in place."""

    observation: PyTree  # [B, D]
    next_observation: PyTree  # [B, D]
    desired_goal: Array  # [B, G]
    action: Array  # [B, A]
    reward: Array  # [B]
    # [B] what the value of the next observation counts; gamma where None. With n-step returns, `reward` is the discounted sum
    # of m rewards, this is gamma^m, and the next observation is m steps ahead.
    discount: Array | None = None


class Sizes(NamedTuple):
    """Numbers in an observation, a goal and an action: D, G and A."""

    observation: int
    goal: int
    action: int


# Scalars [] by name, for the log.
Metrics = dict[str, Array]

# compute_reward(achieved_goal [..., G], desired_goal [..., G]) -> reward [...]
RewardFn = Callable[[Array, Array], Array]


class EnvState(Protocol):
    """What the trainer reads of an environment's state; the rest belongs to the environment.

    A state may have `failed`, [] bool: True when the episode is not to be learned from, as after its physics blew up.
    """

    @property
    def obs(self) -> GoalObs: ...

    @property
    def reward(self) -> Array: ...  # []

    @property
    def success(self) -> Array: ...  # [], 1.0 where the goal is reached


class Env(Protocol):
    """An unbatched, pure, goal-conditioned environment of fixed horizon; `jax.vmap` is the batch.

    `step` takes an action [A]. `compute_reward` takes goals [..., G] and gives rewards [...]; the learner's targets are clipped
    to [-1/(1-gamma), 0], so they should lie between -1 and 0. `testing.check_env` tries an environment out.

    It may have `with_goal(state, goal)`, which gives a first state with another desired goal [G] and else the same: goal
    generators need it.

    It may have `check()`, which the trainer calls on the host after each epoch, and which raises ValueError where the steps
    were not what they should be and their results do not show it.
    """

    @property
    def action_size(self) -> int: ...

    @property
    def episode_length(self) -> int: ...

    def reset(self, key: PRNGKey) -> EnvState: ...

    def step(self, state: Any, action: Array) -> EnvState: ...

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array: ...


def check_size(name: str, value: Any) -> None:
    """Raises ValueError unless `value` is an integer of at least 1, of Python or NumPy."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1; it is {value!r}")


def check_env_parts(env: Any) -> None:
    """Raises ValueError unless `env` has the methods and the two numbers of an `Env`. It is not run."""
    if isinstance(env, type):
        raise ValueError(f"an environment is an object, not a class: {env.__name__}(...) instead of {env.__name__}")
    for name in ("reset", "step", "compute_reward"):
        if not callable(getattr(env, name, None)):
            raise ValueError(f"an environment has reset, step and compute_reward; {env!r} has no {name}")
    for name in ("action_size", "episode_length"):
        check_size(name, getattr(env, name, None))
