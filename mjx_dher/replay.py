"""A ring of whole episodes on the device.

Each observation is stored once (there is no next-observation copy), and what a sampled transition may look at is its own
episode's row, so an index cannot reach into a neighbour. All functions are pure.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher.types import Array, Episode, PRNGKey, PyTree


@struct.dataclass
class ReplayState:
    """The ring and its write position."""

    episodes: Episode  # every leaf leads with [E]
    cursor: Array  # [] row that is written next, int32
    size: Array  # [] rows that hold an episode, int32


@struct.dataclass
class Sample:
    """Transitions drawn from the ring, each with what a goal sampler may look at."""

    observation: PyTree  # [B, D]
    next_observation: PyTree  # [B, D]
    action: Array  # [B, A]
    episode_goals: Array  # [B, T+1, G] the achieved goals of the transition's episode
    desired_goal: Array  # [B, G] the goal that the episode was played for
    step: Array  # [B] the transition leads from `step` to `step + 1`, int32


def init(episode: Episode, num_episodes: int) -> ReplayState:
    """An empty ring for `num_episodes` episodes like `episode` (arrays or `jax.ShapeDtypeStruct`s, unbatched).

    Raises:
      ValueError: fewer than one episode, or leaves whose lengths do not agree.
    """
    if num_episodes < 1:
        raise ValueError(f"num_episodes must be at least 1; got {num_episodes}")
    length = episode.action.shape[0]
    for path, leaf in jax.tree_util.tree_leaves_with_path((episode.observation, episode.achieved_goal)):
        if leaf.shape[0] != length + 1:
            name = jax.tree_util.keystr(path)
            raise ValueError(f"leaf {name} must lead with T+1 = {length + 1} (T actions); got shape {leaf.shape}")
    return ReplayState(
        episodes=jax.tree.map(lambda x: jnp.zeros((num_episodes, *x.shape), x.dtype), episode),
        cursor=jnp.zeros((), jnp.int32),
        size=jnp.zeros((), jnp.int32),
    )


def nbytes(episode: Episode, num_episodes: int) -> int:
    """Bytes that `init` allocates for the episodes."""
    return num_episodes * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(episode))


def capacity(state: ReplayState) -> int:
    """Episodes that the ring holds, E."""
    return state.episodes.action.shape[0]


def add(state: ReplayState, episodes: Episode) -> ReplayState:
    """The ring with `episodes` (leaves lead with [N]) written over its oldest.

    Raises:
      ValueError: more episodes at once than the ring holds.
    """
    num_new, num_rows = episodes.action.shape[0], capacity(state)
    if num_new > num_rows:
        raise ValueError(f"cannot add {num_new} episodes at once to a ring of {num_rows}")
    rows = (state.cursor + jnp.arange(num_new, dtype=jnp.int32)) % num_rows
    return ReplayState(
        episodes=jax.tree.map(
            lambda ring, new: ring.at[rows].set(new, unique_indices=True), state.episodes, episodes
        ),
        cursor=(state.cursor + num_new) % num_rows,
        size=jnp.minimum(state.size + num_new, num_rows),
    )


def can_sample(state: ReplayState) -> Array:
    """[] whether the ring holds any episode."""
    return state.size > 0


def sample(state: ReplayState, key: PRNGKey, batch_size: int) -> Sample:
    """`batch_size` transitions, uniform over those in the ring, with replacement. The ring must not be empty."""
    row_key, step_key = jax.random.split(key)
    num_steps = state.episodes.action.shape[1]
    rows = jax.random.randint(row_key, (batch_size,), 0, state.size)
    steps = jax.random.randint(step_key, (batch_size,), 0, num_steps)
    episodes = state.episodes
    return Sample(
        observation=jax.tree.map(lambda x: x[rows, steps], episodes.observation),
        next_observation=jax.tree.map(lambda x: x[rows, steps + 1], episodes.observation),
        action=episodes.action[rows, steps],
        episode_goals=episodes.achieved_goal[rows],
        desired_goal=episodes.desired_goal[rows],
        step=steps,
    )


def sample_episode_goals(state: ReplayState, key: PRNGKey, batch_size: int) -> Array:
    """[B, T+1, G] the achieved goals of `batch_size` episodes, drawn uniformly. The ring must not be empty."""
    rows = jax.random.randint(key, (batch_size,), 0, state.size)
    return state.episodes.achieved_goal[rows]
