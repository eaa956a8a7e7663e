"""Replay ring of whole episodes on the device.

Each observation is stored once, without a next-observation copy. A sampled transition reads only its episode's row. Episodes
that end early are padded to T steps, and padded steps are never drawn. All functions are pure.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mjx_dher.check import array, describe
from mjx_dher.types import Array, Episode, PRNGKey, PyTree, check_size

HUGE = 2.0**64  # sums of larger values could overflow


@struct.dataclass
class ReplayState:
    """The ring and its write position."""

    episodes: Episode  # every leaf leads with [E]
    priority: Array  # [E] weight of the episode in `draw_rows`, float32
    cursor: Array  # [] row that is written next, int32
    size: Array  # [] rows that hold an episode, int32
    ends: bool = struct.field(pytree_node=False, default=False)  # whether episodes can be shorter than T (`EnvSpec.ends`)


class Pool(NamedTuple):
    """Achieved goals of one random episode per transition."""

    goals: Array  # [B, T+1, G]
    length: Array  # [B] int32


@struct.dataclass
class Sample:
    """Transitions drawn from the ring, with everything that relabelling reads."""

    observation: PyTree  # [B, D]
    next_observation: PyTree  # [B, D]
    action: Array  # [B, A]
    episode_goals: Array  # [B, T+1, G] achieved goals of the transition's episode
    desired_goal: Array  # [B, G] desired goal of the episode
    step: Array  # [B] index of the transition from `step` to `step + 1`, int32
    row: Array  # [B] ring row of the episode, int32
    length: Array  # [B] steps of the episode, int32
    terminal: Array  # [B] whether no future follows this transition, for any goal, bool
    pool: Pool | None = None  # goals of other episodes, if the sampler uses them
    ends: bool = struct.field(pytree_node=False, default=False)  # whether episodes can be shorter than T


class Cumulative(NamedTuple):
    """Cumulative weights [E] of the rows, int32, for `draw_rows`. Computed once per cycle."""

    priority: Array  # of priorities (times lengths, if episodes can be shorter than T)
    length: Array | None  # of lengths; None if all are T, and rows are drawn uniformly


def init(episode: Episode, num_episodes: int, ends: bool = False) -> ReplayState:
    """Makes an empty ring.

    Args:
      episode: one unbatched episode with the shapes and dtypes to store (arrays or `jax.ShapeDtypeStruct`s).
      ends: whether episodes can be shorter than T.

    Raises:
      ValueError: `num_episodes` is below 1, or the shapes of the leaves disagree.
    """
    check_size("num_episodes", num_episodes)
    episode = episode.filled()
    _check_one(episode)
    return ReplayState(
        episodes=jax.tree.map(lambda x: jnp.zeros((num_episodes, *x.shape), x.dtype), episode),
        priority=jnp.zeros(num_episodes, jnp.float32),
        cursor=jnp.zeros((), jnp.int32),
        size=jnp.zeros((), jnp.int32),
        ends=ends,
    )


def _check_one(episode: Episode) -> None:
    """Raises ValueError unless an unbatched episode has the shapes that `Episode` documents."""
    leaves = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(episode)}
    for name, leaf in leaves.items():
        if not hasattr(leaf, "shape") or 0 in leaf.shape:
            raise ValueError(f"leaf {name} of an episode must be an array that is not empty; got {describe(leaf)}")
    action, achieved, desired = (np.shape(x) for x in (episode.action, episode.achieved_goal, episode.desired_goal))
    if len(action) != 2:
        raise ValueError(f"leaf .action of one episode must be [T, A]; got shape {action}")
    for name, leaf in leaves.items():
        if name.startswith((".observation", ".achieved_goal")) and leaf.shape[:1] != (action[0] + 1,):
            raise ValueError(f"leaf {name} must lead with T+1 = {action[0] + 1} (T actions); got shape {leaf.shape}")
        if name in (".length", ".terminal") and leaf.shape != ():
            raise ValueError(f"leaf {name} of one episode must be a scalar []; got shape {leaf.shape}")
    if len(desired) != 1 or achieved[1:] != desired:
        raise ValueError(
            f"leaves .achieved_goal and .desired_goal must be [T+1, G] and [G], of one size G; got shapes {achieved} and"
            f" {desired}"
        )


def nbytes(episode: Episode, num_episodes: int) -> int:
    """Bytes that `init` allocates for the episodes."""
    rows = jax.eval_shape(lambda: init(episode, num_episodes).episodes)
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(rows))


def capacity(state: ReplayState) -> int:
    """Number of rows E."""
    return state.episodes.action.shape[0]


def add(state: ReplayState, episodes: Episode, priority: Array | float = 0.0, valid: Array | None = None) -> ReplayState:
    """Overwrites the oldest episodes of the ring with new ones.

    Args:
      episodes: N episodes; leaves lead with [N].
      priority: weights [N] for `draw_rows`, or one number for all (see `as_priority`).
      valid: mask [N] of the episodes to write, bool. Default: all.

    Raises:
      ValueError: more episodes than the ring holds, or arrays with other shapes or dtypes. Outside `jit` also for a length
        below 1 or above T, or below T in a ring without `ends`.
    """
    episodes = episodes.filled()
    num_new, num_rows = _check_new(state, episodes, priority, valid), capacity(state)
    if num_new > num_rows:
        raise ValueError(f"cannot add {num_new} episodes at once to a ring of {num_rows}")
    valid = jnp.ones(num_new, bool) if valid is None else jnp.asarray(valid, bool)
    order = jnp.cumsum(valid, dtype=jnp.int32) - 1
    written = order[-1] + 1
    # Invalid episodes get rows out of bounds, whose writes are dropped. They differ, because indices must be unique.
    rows = jnp.where(valid, (state.cursor + order) % num_rows, num_rows + jnp.arange(num_new, dtype=jnp.int32))

    def write(ring: Array, new: Array | float) -> Array:
        return ring.at[rows].set(new, mode="drop", unique_indices=True)

    return dataclasses.replace(
        state,
        episodes=jax.tree.map(write, state.episodes, episodes),
        priority=write(state.priority, as_priority(priority)),
        cursor=(state.cursor + written) % num_rows,
        size=jnp.minimum(state.size + written, num_rows),
    )


def as_priority(weight: Array | float) -> Array:
    """Converts weights to float32. Any weight that is not positive and finite becomes 0. Raises ValueError for other types."""
    weight = array("priority", weight, np.shape(weight), jnp.number).astype(jnp.float32)
    return jnp.where((weight > 0) & jnp.isfinite(weight), weight, 0.0)


def _check_new(state: ReplayState, episodes: Episode, priority: Array | float, valid: Array | None) -> int:
    """Number N of `episodes`. Raises ValueError for arrays that do not fit `state`."""
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
        raise ValueError("episodes must have at least one episode; got none")
    if not isinstance(episodes.length, jax.core.Tracer) and not isinstance(valid, jax.core.Tracer):
        most = episodes.action.shape[1]
        least = 1 if state.ends else most
        length = np.asarray(episodes.length)[... if valid is None else np.asarray(valid, bool)]
        if not np.all((length >= least) & (length <= most)):
            hint = "" if state.ends else " (shorter ones need a ring by init(..., ends=True))"
            raise ValueError(f"length of episodes must be in [{least}, {most}]{hint}; got {length.tolist()[:8]}")
    return leading[0]


def can_sample(state: ReplayState) -> Array:
    """Whether the ring holds any episode, bool []."""
    return state.size > 0


def sum_factor(values: Array) -> Array:
    """Factor [] that lets huge values be summed without overflow: 1, or a small power of two, which keeps every digit."""
    return jnp.where(jnp.max(jnp.abs(values)) > HUGE, 1.0 / HUGE, 1.0)


def mean(values: Array, number: Array | int) -> Array:
    """Mean [] of `number` of the values [E], if the others are 0. It does not overflow, and is 0 if `number` is 0."""
    factor = sum_factor(values)
    return jnp.sum(values * factor) / jnp.maximum(number, 1).astype(jnp.float32) / factor


def cumulative(state: ReplayState) -> Cumulative:
    """Cumulative weights of the ring's rows, for `draw_rows`."""
    priority = state.priority * sum_factor(state.priority)
    if not state.ends:
        return Cumulative(_cumulate(priority), None)
    length = state.episodes.length.astype(jnp.float32)
    return Cumulative(_cumulate(priority * length), _cumulate(length))


def _cumulate(weight: Array) -> Array:
    """Cumulative sums [E] of weights, int32, in units for which the last is about 2^29.

    Integer sums are exact and monotone in any order of addition. The unit is a power of two, so weights of 0 and 1 are exact.
    """
    exponent_bits = 0x7F800000  # of a float32: alone they stand for the largest power of two that is not greater
    total = jnp.maximum(jnp.sum(weight), jnp.finfo(jnp.float32).tiny)
    bits = jax.lax.bitcast_convert_type(total, jnp.int32) & exponent_bits
    unit = jax.lax.bitcast_convert_type(bits, jnp.float32)
    return jnp.cumsum(jnp.round(weight / unit * 2.0**29).astype(jnp.int32), dtype=jnp.int32)


def draw_rows(state: ReplayState, key: PRNGKey, batch_size: int, fraction: Array | float, weights: Cumulative) -> Array:
    """Draws rows [B] of the ring, int32. A uniform step of each row is a transition drawn from the ring.

    Args:
      state: the ring. It must not be empty.
      fraction: probability of drawing a row by priority, not uniformly. All draws are uniform while all priorities are 0.
      weights: `cumulative(state)`.
    """
    coin_key, bits_key = jax.random.split(key)
    any_bits, rank_bits = jax.random.bits(bits_key, (2, batch_size), jnp.uint32)
    by_priority = _row_at(weights.priority, rank_bits)
    any_row = randint_from_bits(any_bits, state.size) if weights.length is None else _row_at(weights.length, any_bits)
    coin = jax.random.uniform(coin_key, (batch_size,), jnp.float32) < fraction
    return jnp.where(coin & (weights.priority[-1] > 0), by_priority, any_row)


def _row_at(cumulative: Array, bits: Array) -> Array:
    """Maps random `bits` [B] to rows, in proportion to the weights behind the `cumulative` sums."""
    rank = 1 + randint_from_bits(bits, cumulative[-1])
    return jnp.searchsorted(cumulative, rank).astype(jnp.int32)


def take(state: ReplayState, rows: Array) -> ReplayState:
    """Full ring of the episodes in `rows` [R], with their priorities."""
    episodes = jax.tree.map(lambda x: x[rows], state.episodes)
    number = jnp.asarray(rows.shape[0], jnp.int32)
    cursor = jnp.zeros_like(number)
    return dataclasses.replace(state, episodes=episodes, priority=state.priority[rows], cursor=cursor, size=number)


def newest_and_others(state: ReplayState, key: PRNGKey, newest: int, others: int) -> Array:
    """Rows [newest + others]: the newest, and random others with replacement.

    The newest are partly empty until that many episodes have been written. The ring must not be empty if `others` is positive.
    """
    new = (state.cursor - 1 - jnp.arange(newest, dtype=jnp.int32)) % capacity(state)
    return jnp.concatenate([new, randint_from_bits(jax.random.bits(key, (others,), jnp.uint32), state.size)])


def sample(state: ReplayState, key: PRNGKey, batch_size: int, rows: Array | None = None) -> Sample:
    """Draws transitions with replacement.

    Args:
      state: the ring. It must not be empty.
      rows: rows [B] from which to draw a uniform step each. Default: uniform over all transitions.

    Raises:
      ValueError: `batch_size` is below 1, or `rows` are not integers [B].
    """
    check_size("batch_size", batch_size)
    row_bits, step_bits = jax.random.bits(key, (2, batch_size), jnp.uint32)
    episodes = state.episodes
    if rows is not None:
        rows = array("rows [B]", rows, (batch_size,), jnp.integer)
    elif state.ends:
        rows = _row_at(_cumulate(episodes.length.astype(jnp.float32)), row_bits)
    else:
        rows = randint_from_bits(row_bits, state.size)
    length = episodes.length[rows]
    steps = randint_from_bits(step_bits, length if state.ends else episodes.action.shape[1])
    return Sample(
        observation=jax.tree.map(lambda x: x[rows, steps], episodes.observation),
        next_observation=jax.tree.map(lambda x: x[rows, steps + 1], episodes.observation),
        action=episodes.action[rows, steps],
        episode_goals=episodes.achieved_goal[rows],
        desired_goal=episodes.desired_goal[rows],
        step=steps,
        row=rows,
        length=length,
        terminal=episodes.terminal[rows] & (steps + 1 == length),
        ends=state.ends,
    )


def sample_pool(state: ReplayState, key: PRNGKey, batch_size: int) -> Pool:
    """Draws one uniform episode for each of `batch_size` transitions. The ring must not be empty."""
    rows = randint_from_bits(jax.random.bits(key, (batch_size,), jnp.uint32), state.size)
    return Pool(state.episodes.achieved_goal[rows], state.episodes.length[rows])


def randint_from_bits(bits: Array, number: Array | int) -> Array:
    """Maps random `bits`, uint32 of any shape, to int32 in [0, number) (Lemire 2019). `number` is a scalar or has their shape.

    The bias is at most `number` / 2^32. This compiles to far fewer operations than `jax.random.randint`.
    """
    number = jnp.asarray(number, jnp.uint32)
    high, low, number_high, number_low = bits >> 16, bits & 0xFFFF, number >> 16, number & 0xFFFF
    middle = high * number_low + (low * number_low >> 16)
    carried = low * number_high + (middle & 0xFFFF)
    return (high * number_high + (middle >> 16) + (carried >> 16)).astype(jnp.int32)
