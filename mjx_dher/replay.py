"""A ring of whole episodes on the device.

Each observation is stored once (there is no next-observation copy), and what a sampled transition may look at is its own
episode's row, so an index cannot reach into a neighbour. All episodes of a ring have one length, T: one that
ends early has to be filled up, with a state that it stays in. All functions are pure.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mjx_dher.types import Array, Episode, PRNGKey, PyTree, check_size


@struct.dataclass
class ReplayState:
    """The ring and its write position."""

    episodes: Episode  # every leaf leads with [E]
    priority: Array  # [E] weight by which `draw_rows` can draw the episode, float32
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
    row: Array  # [B] of the ring, which holds the episode, int32


def init(episode: Episode, num_episodes: int) -> ReplayState:
    """Makes an empty ring for `num_episodes` episodes like `episode` (arrays or `jax.ShapeDtypeStruct`s, unbatched).

    Raises:
      ValueError: fewer than one episode, or leaves whose shapes do not agree.
    """
    check_size("num_episodes", num_episodes)
    _check_one(episode)
    return ReplayState(
        episodes=jax.tree.map(lambda x: jnp.zeros((num_episodes, *x.shape), x.dtype), episode),
        priority=jnp.zeros(num_episodes, jnp.float32),
        cursor=jnp.zeros((), jnp.int32),
        size=jnp.zeros((), jnp.int32),
    )


def _check_one(episode: Episode) -> None:
    """Raises ValueError unless one, unbatched episode is arrays of the shapes that `Episode` says."""
    leaves = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(episode)}
    for name, leaf in leaves.items():
        if not hasattr(leaf, "shape"):
            raise ValueError(f"leaf {name} of an episode must be an array; got a {type(leaf).__name__}")
        if 0 in leaf.shape:
            raise ValueError(f"leaf {name} of an episode must not be empty; got shape {leaf.shape}")
    action, achieved, desired = (np.shape(x) for x in (episode.action, episode.achieved_goal, episode.desired_goal))
    if len(action) != 2:
        raise ValueError(f"leaf .action of one episode must be [T, A]; got shape {action}")
    for name, leaf in leaves.items():
        if not name.startswith((".action", ".desired_goal")) and leaf.shape[:1] != (action[0] + 1,):
            raise ValueError(f"leaf {name} must lead with T+1 = {action[0] + 1} (T actions); got shape {leaf.shape}")
    if len(desired) != 1 or achieved[1:] != desired:
        raise ValueError(
            f"leaves .achieved_goal and .desired_goal must be [T+1, G] and [G], of one size G; got shapes {achieved} and"
            f" {desired}"
        )


def nbytes(episode: Episode, num_episodes: int) -> int:
    """Returns the bytes that `init` allocates for the episodes."""
    return num_episodes * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(episode))


def capacity(state: ReplayState) -> int:
    """Returns the number of episodes that the ring holds, E."""
    return state.episodes.action.shape[0]


def add(state: ReplayState, episodes: Episode, priority: Array | float = 0.0, valid: Array | None = None) -> ReplayState:
    """Returns the ring with `episodes` (leaves lead with [N]) written over its oldest.

    Args:
      state: the ring.
      episodes: N of them.
      priority: [N], or one for all: weight by which `draw_rows` can draw an episode; what `as_priority` takes.
      valid: [N] which of them to write; the others leave no trace. All, where None.

    Raises:
      ValueError: more episodes at once than the ring holds, or arrays of other shapes or types than its own.
    """
    num_new, num_rows = _check_new(state, episodes, priority, valid), capacity(state)
    if num_new > num_rows:
        raise ValueError(f"cannot add {num_new} episodes at once to a ring of {num_rows}")
    valid = jnp.ones(num_new, bool) if valid is None else jnp.asarray(valid, bool)
    order = jnp.cumsum(valid, dtype=jnp.int32) - 1
    written = order[-1] + 1
    # Out of bounds where not valid, so that the write is dropped; each its own, because indices are promised to be unique.
    rows = jnp.where(valid, (state.cursor + order) % num_rows, num_rows + jnp.arange(num_new, dtype=jnp.int32))

    def write(ring: Array, new: Array | float) -> Array:
        return ring.at[rows].set(new, mode="drop", unique_indices=True)

    return ReplayState(
        episodes=jax.tree.map(write, state.episodes, episodes),
        priority=write(state.priority, as_priority(priority)),
        cursor=(state.cursor + written) % num_rows,
        size=jnp.minimum(state.size + written, num_rows),
    )


def as_priority(weight: Array | float) -> Array:
    """Returns weights as float32; what is not a positive, finite number is 0.

    Raises:
      ValueError: something that is no real number.
    """
    try:
        weight = jnp.asarray(weight)
    except (TypeError, ValueError):
        raise ValueError(f"a priority must be a number; got {weight!r}") from None
    if jnp.issubdtype(weight.dtype, jnp.complexfloating):
        raise ValueError(f"a priority must be a real number; got {weight.dtype}")
    weight = weight.astype(jnp.float32)
    return jnp.where((weight > 0) & jnp.isfinite(weight), weight, 0.0)


def _check_new(state: ReplayState, episodes: Episode, priority: Array | float, valid: Array | None) -> int:
    """Returns the number of `episodes`, N; raises ValueError for what `state` has no place for, by its name."""
    ring = dict(jax.tree_util.tree_leaves_with_path(state.episodes))
    new = dict(jax.tree_util.tree_leaves_with_path(episodes))
    structure: PyTree = jax.tree.structure(state.episodes)
    if structure != jax.tree.structure(episodes):
        differing = [jax.tree_util.keystr(path) for path in {**ring, **new} if (path in ring) != (path in new)]
        raise ValueError(
            f"episodes must have the arrays of the ring's; only one of them has {', '.join(differing) or 'its type'}"
        )
    leading = jnp.shape(episodes.action)[:1]
    for path, leaf in new.items():
        own, shape, dtype = ring[path], jnp.shape(leaf), jnp.result_type(leaf)
        if shape != (*leading, *own.shape[1:]) or jnp.promote_types(own.dtype, dtype) != own.dtype:
            needed = ", ".join(map(str, ("N", *own.shape[1:])))
            raise ValueError(
                f"episodes{jax.tree_util.keystr(path)} must be {own.dtype}[{needed}] for N episodes (of which actions have"
                f" {leading[0] if leading else 'none'}); got {dtype}{list(shape)}"
            )
    for name, value in (("priority", priority), ("valid", valid)):
        if value is not None and np.shape(value) not in ((), leading)[name == "valid" :]:
            raise ValueError(f"{name} must be [N] = {list(leading)}, one for each episode; got {list(np.shape(value))}")
    if leading == (0,):
        raise ValueError("add takes one or more episodes; got none")
    return leading[0]


def can_sample(state: ReplayState) -> Array:
    """Returns [] whether the ring holds any episode."""
    return state.size > 0


def mean_priority(state: ReplayState) -> Array:
    """Returns the mean [] of the priorities of the rows that hold an episode; 0 where none does."""
    return jnp.sum(state.priority) / jnp.maximum(state.size, 1).astype(jnp.float32)


def cumulative_priority(state: ReplayState) -> Array:
    """Returns the sums [E] of the priorities up to and with each row, int32, in units that make the last about 2^29.

    Integers make the sums exact and never falling, whatever the order of addition; the unit is a power of two, so that
    priorities of 0 and 1 are exact. `draw_rows` takes the sums, so that a loop of draws from one ring makes them once.
    """
    largest_power = 0x7F800000  # the exponent's bits of a float32: what they alone stand for is the power of two below it
    total = jnp.maximum(jnp.sum(state.priority), jnp.finfo(jnp.float32).tiny)
    bits = jax.lax.bitcast_convert_type(total, jnp.int32) & largest_power
    unit = jax.lax.bitcast_convert_type(bits, jnp.float32)
    return jnp.cumsum(jnp.round(state.priority / unit * 2.0**29).astype(jnp.int32), dtype=jnp.int32)


def draw_rows(state: ReplayState, key: PRNGKey, batch_size: int, fraction: Array | float, cumulative: Array) -> Array:
    """Draws rows [B] of the ring: with probability `fraction` in proportion to their priorities, else uniformly.

    While all priorities are 0, uniformly. `cumulative` is `cumulative_priority(state)`. The ring must not be empty.
    """
    coin_key, bits_key = jax.random.split(key)
    total = cumulative[-1]
    any_bits, rank_bits = jax.random.bits(bits_key, (2, batch_size))
    rank = 1 + randint_from_bits(rank_bits, total)
    by_priority = jnp.searchsorted(cumulative, rank).astype(jnp.int32)
    coin = jax.random.uniform(coin_key, (batch_size,)) < fraction
    return jnp.where(coin & (total > 0), by_priority, randint_from_bits(any_bits, state.size))


def take(state: ReplayState, rows: Array) -> ReplayState:
    """Returns a full ring of the episodes in `rows` [R], with their priorities."""
    episodes = jax.tree.map(lambda x: x[rows], state.episodes)
    number = jnp.asarray(rows.shape[0], jnp.int32)
    return ReplayState(episodes=episodes, priority=state.priority[rows], cursor=jnp.zeros_like(number), size=number)


def newest_and_others(state: ReplayState, key: PRNGKey, newest: int, others: int) -> Array:
    """Returns the rows [newest + others] of the newest episodes, and of others drawn at random, with replacement.

    Rows of `newest` hold no episode where as many have not been written. The ring must not be empty for the others.
    """
    new = (state.cursor - 1 - jnp.arange(newest, dtype=jnp.int32)) % capacity(state)
    return jnp.concatenate([new, randint_from_bits(jax.random.bits(key, (others,)), state.size)])


def sample(state: ReplayState, key: PRNGKey, batch_size: int, rows: Array | None = None) -> Sample:
    """Draws `batch_size` transitions, with replacement: a uniform step of each of `rows` [B].

    Without `rows`, uniform over all transitions in the ring, which must not be empty.

    Raises:
      ValueError: fewer than one transition, or `rows` that are not integers [B].
    """
    check_size("batch_size", batch_size)
    if rows is not None and (jnp.shape(rows) != (batch_size,) or not jnp.issubdtype(jnp.result_type(rows), jnp.integer)):
        raise ValueError(f"rows must be integers [B] = [{batch_size}]; got {jnp.result_type(rows)}{list(jnp.shape(rows))}")
    row_bits, step_bits = jax.random.bits(key, (2, batch_size))
    if rows is None:
        rows = randint_from_bits(row_bits, state.size)
    steps = randint_from_bits(step_bits, state.episodes.action.shape[1])
    episodes = state.episodes
    return Sample(
        observation=jax.tree.map(lambda x: x[rows, steps], episodes.observation),
        next_observation=jax.tree.map(lambda x: x[rows, steps + 1], episodes.observation),
        action=episodes.action[rows, steps],
        episode_goals=episodes.achieved_goal[rows],
        desired_goal=episodes.desired_goal[rows],
        step=steps,
        row=rows,
    )


def sample_episode_goals(state: ReplayState, key: PRNGKey, batch_size: int) -> Array:
    """Draws `batch_size` episodes uniformly; returns their achieved goals [B, T+1, G]. The ring must not be empty."""
    return state.episodes.achieved_goal[randint_from_bits(jax.random.bits(key, (batch_size,)), state.size)]


def randint_from_bits(bits: Array, number: Array | int) -> Array:
    """Maps random `bits`, uint32 of any shape, to int32 in [0, number), by the high word of bits * number (Lemire 2019).

    The bias is at most `number` / 2^32. `jax.random.randint` makes three draws, each of them more than a hundred operations
    to a compiler. Returns 0 where `number` is 0.
    """
    number = jnp.asarray(number, jnp.uint32)
    high, low, number_high, number_low = bits >> 16, bits & 0xFFFF, number >> 16, number & 0xFFFF
    middle = high * number_low + (low * number_low >> 16)
    carried = low * number_high + (middle & 0xFFFF)
    return (high * number_high + (middle >> 16) + (carried >> 16)).astype(jnp.int32)
