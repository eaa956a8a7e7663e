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
    eventful: Array  # [E] whether the episode is worth drawing more often, bool; see `draw_rows`
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
        eventful=jnp.zeros(num_episodes, bool),
        cursor=jnp.zeros((), jnp.int32),
        size=jnp.zeros((), jnp.int32),
    )


def nbytes(episode: Episode, num_episodes: int) -> int:
    """Bytes that `init` allocates for the episodes."""
    return num_episodes * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(episode))


def capacity(state: ReplayState) -> int:
    """Episodes that the ring holds, E."""
    return state.episodes.action.shape[0]


def add(state: ReplayState, episodes: Episode, eventful: Array | bool = False, valid: Array | None = None) -> ReplayState:
    """The ring with `episodes` (leaves lead with [N]) written over its oldest.

    Args:
      state: the ring.
      episodes: N of them.
      eventful: [N], or one for all: whether an episode belongs to those that `draw_rows` can draw more often.
      valid: [N] which of them to write; the others leave no trace. All, where None.

    Raises:
      ValueError: more episodes at once than the ring holds.
    """
    num_new, num_rows = episodes.action.shape[0], capacity(state)
    if num_new > num_rows:
        raise ValueError(f"cannot add {num_new} episodes at once to a ring of {num_rows}")
    valid = jnp.ones(num_new, bool) if valid is None else valid
    order = jnp.cumsum(valid, dtype=jnp.int32) - 1
    written = order[-1] + 1
    # Out of bounds where not valid, so that the write is dropped; each its own, because indices are promised to be unique.
    rows = jnp.where(valid, (state.cursor + order) % num_rows, num_rows + jnp.arange(num_new, dtype=jnp.int32))

    def write(ring: Array, new: Array | bool) -> Array:
        return ring.at[rows].set(new, mode="drop", unique_indices=True)

    return ReplayState(
        episodes=jax.tree.map(write, state.episodes, episodes),
        eventful=write(state.eventful, eventful),
        cursor=(state.cursor + written) % num_rows,
        size=jnp.minimum(state.size + written, num_rows),
    )


def can_sample(state: ReplayState) -> Array:
    """[] whether the ring holds any episode."""
    return state.size > 0


def count_eventful(state: ReplayState) -> Array:
    """[E] how many eventful episodes there are up to and with each row, int32. `draw_rows` takes it, so that a loop of draws
    from one ring makes it once.
    """
    return jnp.cumsum(state.eventful, dtype=jnp.int32)


def draw_rows(state: ReplayState, key: PRNGKey, batch_size: int, eventful_share: Array | float, counts: Array) -> Array:
    """[B] rows of the ring: with probability `eventful_share` one of the eventful episodes, else any; uniform among each.

    While there is no eventful episode, any. `counts` is `count_eventful(state)`. The ring must not be empty.
    """
    coin_key, bits_key = jax.random.split(key)
    total = counts[-1]
    any_bits, rank_bits = jax.random.bits(bits_key, (2, batch_size))
    rank = 1 + below(rank_bits, total)
    eventful = jnp.searchsorted(counts, rank).astype(jnp.int32)
    coin = jax.random.uniform(coin_key, (batch_size,)) < eventful_share
    return jnp.where(coin & (total > 0), eventful, below(any_bits, state.size))


def sample(state: ReplayState, key: PRNGKey, batch_size: int, rows: Array | None = None) -> Sample:
    """`batch_size` transitions, with replacement: a uniform step of each of `rows` [B].

    Without `rows`, uniform over all transitions in the ring, which must not be empty.
    """
    row_bits, step_bits = jax.random.bits(key, (2, batch_size))
    if rows is None:
        rows = below(row_bits, state.size)
    steps = below(step_bits, state.episodes.action.shape[1])
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
    return state.episodes.achieved_goal[below(jax.random.bits(key, (batch_size,)), state.size)]


def below(bits: Array, number: Array | int) -> Array:
    """Random integers 0 ... `number` - 1, int32, from random `bits`, uint32 of any shape: the upper 32 of the product's 64.

    One is likelier than another by `number` / 2^32 of its probability at most. `jax.random.randint` makes three draws, each of
    them more than a hundred operations to a compiler. 0 where `number` is 0.
    """
    number = jnp.asarray(number, jnp.uint32)
    high, low, number_high, number_low = bits >> 16, bits & 0xFFFF, number >> 16, number & 0xFFFF
    middle = high * number_low + (low * number_low >> 16)
    carried = low * number_high + (middle & 0xFFFF)
    return (high * number_high + (middle >> 16) + (carried >> 16)).astype(jnp.int32)
