"""Shared types: the data that the library's modules exchange.

Shape comments use these dimension letters:

    B  batch of transitions      E  episodes in the replay ring     A  action size
    N  environments in parallel  T  steps of an episode             D  observation size
    S  seeds                     G  goal size
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

Array = jax.Array
PRNGKey = jax.Array
PyTree = Any


class GoalObs(TypedDict):
    """Observation of a goal-conditioned environment, with the keys of gymnasium-robotics."""

    observation: PyTree  # [..., D], or a pytree of arrays
    achieved_goal: Array  # [..., G]
    desired_goal: Array  # [..., G]


@struct.dataclass
class Episode:
    """A whole episode with T+1 observations. Batched forms lead with [N] or [E].

    An episode that ended early is padded: its last observation and goal repeat up to T, and its actions are 0.
    """

    observation: PyTree  # [T+1, D], or a pytree of arrays that all lead with T+1
    achieved_goal: Array  # [T+1, G]
    desired_goal: Array  # [G]
    action: Array  # [T, A]
    length: Array = None  # type: ignore[assignment]  # [] steps played, int32; None means T (`filled`)
    terminal: Array = None  # type: ignore[assignment]  # [] whether no future follows, for any goal; None means False

    def filled(self) -> "Episode":
        """Fills in `length` and `terminal` if they are None. Arrays may be `jax.ShapeDtypeStruct`s."""
        sizes = np.shape(self.action)
        if len(sizes) < 2:
            raise ValueError(f"action of an episode must be [T, A]; got shape {sizes}")
        shape, num_steps = sizes[:-2], sizes[-2]
        length: Any = self.length
        terminal: Any = self.terminal
        if isinstance(self.action, jax.ShapeDtypeStruct):
            length = jax.ShapeDtypeStruct(shape, jnp.int32) if length is None else length
            terminal = jax.ShapeDtypeStruct(shape, jnp.bool_) if terminal is None else terminal
        else:
            length = jnp.full(shape, num_steps, jnp.int32) if length is None else length
            terminal = jnp.zeros(shape, bool) if terminal is None else terminal
        return dataclasses.replace(self, length=length, terminal=terminal)


@struct.dataclass
class Batch:
    """Transitions for the learner, with hindsight goals in place."""

    observation: PyTree  # [B, D]
    next_observation: PyTree  # [B, D]
    desired_goal: Array  # [B, G]
    action: Array  # [B, A]
    reward: Array  # [B] with n-step returns, the discounted sum of m rewards
    # [B] factor of the next observation's value: gamma, or 0 after a terminal transition. With n-step returns it is gamma^m,
    # and the next observation is m steps ahead.
    discount: Array
    row: Array  # [B] ring row of the transition's episode, int32
    # [B, G] goal that the sampler chose, whether or not it replaced the desired goal; None in batches made by hand
    hindsight_goal: Array | None = None


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """Contract of a task as data. `contract.env_spec` returns the one of an environment."""

    observation: PyTree  # shapes and dtypes of one observation (`jax.ShapeDtypeStruct`s)
    goal_size: int  # G
    action_size: int  # A
    episode_length: int  # T, the maximum
    reward_range: tuple[float, float] = (-1.0, 0.0)  # lowest and highest reward; may be infinite
    ends: bool = False  # whether episodes can end before T; the state has `done`, `terminal` or both
    ends_at_goal: bool = False  # whether reaching the goal ends the episode; no future follows for this goal

    def __post_init__(self) -> None:
        for name in ("goal_size", "action_size", "episode_length"):
            check_size(name, getattr(self, name))
        bounds = self.reward_range
        if not (isinstance(bounds, tuple) and len(bounds) == 2 and bounds[0] < bounds[1]):
            raise ValueError(f"reward_range must be (low, high) with low < high; got {self.reward_range}")
        if self.ends_at_goal and not self.ends:
            raise ValueError("ends must be True if ends_at_goal is True; got False")

    @property
    def observation_size(self) -> int:
        """Size D of an observation that is one vector. Raises ValueError for any other tree."""
        leaves = jax.tree.leaves(self.observation)
        if len(leaves) != 1 or leaves[0] is not self.observation or len(leaves[0].shape) != 1:
            raise ValueError(f"observation must be one vector [D] here; it is {self.observation}")
        return int(leaves[0].shape[0])

    @property
    def sizes(self) -> tuple[Any, int, int]:
        """Sizes D, G and A. D is a tree of sizes or shapes if the observation is not one vector."""
        observation = jax.tree.map(lambda x: x.shape[0] if len(x.shape) == 1 else x.shape, self.observation)
        return observation, self.goal_size, self.action_size


def is_key(leaf: Any) -> bool:
    """Whether an array, or its shape, has typed random keys."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def without_key(leaf: Any) -> Any:
    """The array, or the data of its random keys."""
    return jax.random.key_data(leaf) if is_key(leaf) else leaf


def with_key(array: Array, like: Any) -> Array:
    """Inverse of `without_key`: random keys from their data if `like`, an array or its shape, has keys, else the array."""
    return jax.random.wrap_key_data(array, impl=jax.random.key_impl(jnp.empty((), like.dtype))) if is_key(like) else array


# Scalars [] by name, for the log.
Metrics = dict[str, Array]

# compute_reward(achieved_goal [..., G], desired_goal [..., G]) -> reward [...]
RewardFn = Callable[[Array, Array], Array]


# reached(achieved_goal [..., G], desired_goal [..., G]) -> bool [...]
ReachedFn = Callable[[Array, Array], Array]
# goal_distance(achieved_goal [..., G], desired_goal [..., G]) -> distance [...], not negative
DistanceFn = Callable[[Array, Array], Array]
# mirror(observation [..., D], goal [..., G], action [..., A]) -> the three in a mirror image
MirrorFn = Callable[[PyTree, Array, Array], tuple[PyTree, Array, Array]]


class EnvState(Protocol):
    """Environment state, as far as the trainer reads it. It may hold more.

    Optional fields, all [] bool:

    - `failed`: the simulation diverged. Nothing is learned from the episode.
    - `done`: the episode ends here (needs `EnvSpec.ends`). Nothing is learned from one that ends at its reset.
    - `terminal`: the episode ends here without a future for any goal, as after an object was dropped (needs `EnvSpec.ends`).
    """

    @property
    def obs(self) -> GoalObs: ...

    @property
    def reward(self) -> Array: ...  # []

    @property
    def success(self) -> Array: ...  # [], 1.0 if the goal is reached


class Env(Protocol):
    """A pure, unbatched, goal-conditioned environment; `jax.vmap` makes batches. Test yours with `testing.check_env`.

    `step` takes an action [A]. `compute_reward` maps goals [..., G] to rewards [...]. Optional members:

      spec: an `EnvSpec`. Without it, rewards lie in [-1, 0] and every episode has `episode_length` steps.
      reached(achieved_goal, desired_goal): whether the goal is reached, bool [...]. Default: the reward is at its maximum.
      goal_distance(achieved_goal, desired_goal): distance [...] for metrics, `weighted` and logs. Default: Euclidean.
      dt: seconds per step, for videos, the viewer, Gymnasium and `energy`. Default: 0.04.
      rest_action: action [A] that holds the start pose; action delays and filters begin with it. Default: 0.
      with_goal(state, goal): initial state with another desired goal [G]. Goal generators need it.
      mirror(observation, goal, action): the three in a mirror image, which keeps rewards. `Config.augmentation` needs it.
      check(): called on the host after each epoch. Raises ValueError if steps were silently wrong.
    """

    @property
    def action_size(self) -> int: ...

    @property
    def episode_length(self) -> int: ...

    def reset(self, key: PRNGKey) -> EnvState: ...

    def step(self, state: Any, action: Array) -> EnvState: ...

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array: ...


def check_size(name: str, value: Any) -> None:
    """Raises ValueError unless `value` is a Python or NumPy integer of at least 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1; it is {value!r}")
