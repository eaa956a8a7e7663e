"""Priorities: episodes and transitions that are drawn more often, for `priority_fraction` of a batch.

An episode priority is a pure function from one whole episode to a weight, 0 or more:

    priority(episode, context) -> []

The ring stores the weight with the episode, and `replay.draw_rows` draws episodes in proportion to it. A `Priority` can also
renew all weights once per cycle, and choose among relabelled transitions.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from mjx_dher import check, components, lookup, replay
from mjx_dher.context import Context, one_of
from mjx_dher.replay import ReplayState, Sample
from mjx_dher.types import Array, Batch, Episode, PRNGKey
from mjx_dher.validation import check_count

CANDIDATES = 4  # transitions among which one is chosen
GRAVITY = 9.81  # m/s^2
_ROWS_AT_ONCE = 256  # episodes whose errors are computed at a time, to limit memory

# priority(episode, context) -> weight [], 0 or more
PriorityFn = Callable[[Episode, Context], Array]
# renew(ring, context) -> weights [E] of all its rows, 0 or more; weights of empty rows are ignored
RenewFn = Callable[[ReplayState, Context], Array]
# choose(key, sample [candidates * B], batch [candidates * B], number B, context) -> indices [B] of the candidates
ChooseFn = Callable[[PRNGKey, Sample, Batch, int, Context], Array]


@dataclasses.dataclass(frozen=True)
class Priority:
    """A priority. Each of its three functions is optional."""

    weigh: PriorityFn | None = None  # weight of an episode when it is added
    renew: RenewFn | None = None  # weights of the ring's episodes, once per cycle, before learning
    choose: ChooseFn | None = None  # choice among relabelled transitions
    candidates: int = CANDIDATES  # transitions drawn per transition that `choose` keeps
    uses_values: bool = False  # whether it reads `context.values`
    by_part: bool = False  # whether `renew` weighs each episode alone and may get part of the ring (`Config.renewals`)
    renews: Callable[[Context], Array] | None = None  # whether a lane's priority has `renew`, if lanes differ in it (`join`)


def eventful(episode: Episode, context: Context) -> Array:
    """1.0 if the last achieved goal was not yet reached at the start of the episode, else 0.0.

    In other episodes the hindsight goals are nearly equal, and reached from the first step. They do not show how to reach any
    goal. The test needs neither scale nor threshold. Compare the filter of Manela & Biess 2021 for misleading samples, and the
    energy-based prioritization of Zhao & Tresp 2018.
    """
    return (~context.reached(episode.achieved_goal[0], episode.achieved_goal[-1])).astype(jnp.float32)


def make(name: str | Priority | PriorityFn) -> Priority | PriorityFn:
    """Loads a priority: a built-in name, "module:attribute", a function, or a `Priority`. Raises ValueError if there is no such
    priority, or it is neither a function of (episode, context) nor a `Priority`.
    """
    value = components.load("priority", name)
    if not isinstance(value, Priority):
        return lookup.check_function("priority", value, ("episode", "context"))
    given = {
        "weigh": (value.weigh, ("episode", "context")),
        "renew": (value.renew, ("ring", "context")),
        "choose": (value.choose, ("key", "sample", "batch", "number", "context")),
    }
    for field, (function, parameters) in given.items():
        if function is not None:
            lookup.check_function(f"priority: {field}", function, parameters)
    check_count("priority: candidates", value.candidates)
    if all(function is None for function, _ in given.values()):
        raise ValueError("a Priority needs weigh, renew or choose; got none of them")
    return value


def whole(priority: Priority | PriorityFn) -> Priority:
    """Converts a priority function to a `Priority`."""
    return priority if isinstance(priority, Priority) else Priority(weigh=priority)


def weights(priority: PriorityFn | Priority, episodes: Episode, context: Context) -> Array:
    """Weights [N] of N episodes (leaves lead with [N]), float32. Any weight that is not positive and finite becomes 0. Raises
    ValueError if the priority does not return a real number [].
    """
    episodes = episodes.filled()
    number, weigh = episodes.action.shape[0], whole(priority).weigh
    if weigh is None:
        return jnp.zeros(number, jnp.float32)
    weight = jax.vmap(lambda episode: check.array("priority: weight []", weigh(episode, context), (), jnp.number))(episodes)
    return replay.as_priority(weight)


def renew(priority: Priority | PriorityFn, ring: ReplayState, context: Context, rows: Array | None = None) -> ReplayState:
    """Renews the ring's weights with `priority.renew`, if it exists.

    Args:
      rows: rows [R] to renew, which `renew` gets as a ring. They may repeat. Default: all.

    Raises:
      ValueError: `renew` does not return real numbers [E], or [R].
    """
    if (renew := whole(priority).renew) is None:
        return ring
    part = ring if rows is None else replay.take(ring, rows)
    weight = check.array("priority: weights [E] of renew", renew(part, context), part.priority.shape, jnp.number)
    filled = (jnp.arange(ring.priority.shape[0]) if rows is None else rows) < ring.size
    weight = jnp.where(filled, replay.as_priority(weight), 0.0)
    return dataclasses.replace(ring, priority=weight if rows is None else ring.priority.at[rows].set(weight))


def mean(priority: Priority, ring: ReplayState, weight: Array, valid: Array, context: Context) -> Array:
    """Mean priority [] of the whole ring if it is renewed, else of the `valid` [N] new episodes, from their weights [N]."""
    of_new = replay.mean(jnp.where(valid, weight, 0.0), jnp.sum(valid))
    if priority.renew is None:
        return of_new
    of_ring = replay.mean(ring.priority, ring.size)
    return of_ring if priority.renews is None else jnp.where(priority.renews(context), of_ring, of_new)


def choose(
    priority: Priority, key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context
) -> tuple[Sample, Batch]:
    """Chooses transitions among candidates.

    With probability `priority_fraction`, `priority.choose` picks a transition. Otherwise it is the first of its candidates.

    Args:
      sample: candidates, a multiple of `number`.
      batch: the candidates after relabelling.
      number: number of transitions to keep.

    Raises:
      ValueError: `priority.choose` does not return integers [number].
    """
    choose_key, coin_key = jax.random.split(key)
    indices = _choose(priority, choose_key, sample, batch, number, context)
    coin = jax.random.uniform(coin_key, (number,), jnp.float32) < context.hparams.priority_fraction
    first = _choose(Priority(), choose_key, sample, batch, number, context)
    kept = jnp.where(coin, jnp.clip(indices, 0, len(batch.reward) - 1), first)
    return jax.tree.map(lambda x: x[kept], (sample, batch))


def by_weight(weigh: Callable[[Sample, Batch, Context], Array]) -> ChooseFn:
    """Makes a `choose` that keeps one of `Priority.candidates` transitions, in proportion to the weights [B'] from `weigh`.

    With 1 candidate, each is weighed once and is a candidate of CANDIDATES choices, no two of which share another
    (if 17 or more are drawn). So it can be kept up to CANDIDATES times in a draw, which is of many batches.

    A weight that is not positive and finite counts as 0. If all candidates have weight 0, the choice is uniform. Raises
    ValueError unless `weigh` returns one weight per transition.
    """

    def choose(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
        weight = weigh(sample, batch, context)
        weight = check.array("priority: weights [B] of transitions", weight, batch.reward.shape, jnp.number)
        places = jnp.arange(number, dtype=jnp.int32)[:, None]
        candidates = len(weight) // number
        groups = candidates * places + jnp.arange(candidates, dtype=jnp.int32)[None]
        if candidates == 1:  # they share: the differences of 0, 1, 3 and 9 modulo 13 are all different
            apart = [step * max(len(weight), 13) // 13 for step in (0, 1, 3, 9)]
            groups = (places + jnp.asarray([apart], jnp.int32)) % len(weight)
        weight = replay.as_priority(weight)[groups]
        weight = weight * replay.sum_factor(weight)
        total = jnp.cumsum(jnp.where(jnp.sum(weight, axis=1, keepdims=True) > 0, weight, 1.0), axis=1)
        # 1 - u lies in (0, 1], so a weight of 0 is never the first to reach it.
        threshold = (1.0 - jax.random.uniform(key, (number, 1), jnp.float32)) * total[:, -1:]
        return groups[jnp.arange(number), jnp.argmax(total >= threshold, axis=1)]

    return choose


def join(choices: Sequence[Priority | PriorityFn]) -> Priority:
    """Joins priorities in one compiled program, in which the traced number `hparams.priority_choice` selects a lane's priority.
    Raises ValueError for something other than a priority.
    """
    made = [whole(make(choice)) for choice in choices]
    if len(made) == 1:
        return made[0]
    index = "priority_choice"
    renewed = [own.renew is not None for own in made]
    each = [lambda ring, context, own=own: renew(own, ring, context).priority for own in made]
    return Priority(
        weigh=one_of([functools.partial(_weigh, own) for own in made], index) if any(own.weigh for own in made) else None,
        renew=one_of(each, index) if any(renewed) else None,
        choose=one_of([functools.partial(_choose, own) for own in made], index) if any(own.choose for own in made) else None,
        candidates=max((own.candidates for own in made if own.choose), default=1),
        uses_values=any(own.uses_values for own in made),
        by_part=all(own.by_part for own in made if own.renew),
        renews=one_of([lambda context, own=own: jnp.asarray(own) for own in renewed], index) if any(renewed) else None,
    )


def _weigh(priority: Priority, episode: Episode, context: Context) -> Array:
    weight = priority.weigh(episode, context) if priority.weigh else jnp.zeros((), jnp.float32)
    return jnp.asarray(weight, jnp.float32)


def _choose(priority: Priority, key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
    """Indices [number] of the candidates to keep, int32. Without `choose`, they are the first of each group."""
    if priority.choose is None:
        return len(batch.reward) // number * jnp.arange(number, dtype=jnp.int32)
    # Another lane's priority may need more.
    sample, batch = jax.tree.map(lambda x: x[: priority.candidates * number], (sample, batch))
    indices = priority.choose(key, sample, batch, number, context)
    return check.array("priority: indices [B] of choose", indices, (number,), jnp.integer).astype(jnp.int32)


def energy(episode: Episode, context: Context, most: float = math.inf) -> Array:
    """Energy given to the object in an episode, in J per kg (Zhao & Tresp 2018, "EBP").

    sum_t min(max(E_t - E_(t-1), 0), most),  E_t = g (z_t - z_0) + |v_t|^2 / 2,  E_0 = 0

    where v_t are differences of achieved goals. Energy losses do not count, nor does rotation, which positions do not show. A
    goal of fewer than three coordinates has no height.
    """
    achieved = episode.achieved_goal
    kinetic = 0.5 * jnp.sum(jnp.square(displacements(achieved) / context.dt), axis=-1)
    potential = GRAVITY * (achieved[:, 2] - achieved[0, 2]) if achieved.shape[-1] > 2 else jnp.zeros_like(kinetic)
    total = potential + kinetic
    return jnp.sum(jnp.clip(total[1:] - total[:-1], 0.0, most))


energy_clipped = functools.partial(energy, most=0.5)  # J per kg and step, as in the authors' runs on PickAndPlace


def displacements(achieved: Array) -> Array:
    """Displacements [T+1, G] per step of achieved goals [T+1, G]. The first is 0."""
    return jnp.concatenate([jnp.zeros_like(achieved[:1]), achieved[1:] - achieved[:-1]])


def _mean_error(ring: ReplayState, context: Context) -> Array:
    """Mean absolute one-step error of each episode, for its desired goal, shape [E]."""

    def of_episode(episode: Episode) -> Array:
        step = jnp.arange(episode.action.shape[0])
        goals = jnp.broadcast_to(episode.desired_goal[None], episode.achieved_goal[1:].shape)
        terminal = episode.terminal & (step + 1 == episode.length)
        if context.ends_at_goal:
            terminal |= context.reached(episode.achieved_goal[1:], goals)
        batch = Batch(
            observation=jax.tree.map(lambda x: x[:-1], episode.observation),
            next_observation=jax.tree.map(lambda x: x[1:], episode.observation),
            desired_goal=goals,
            action=episode.action,
            reward=context.compute_reward(episode.achieved_goal[1:], goals),
            discount=jnp.where(terminal, 0.0, jnp.asarray(context.hparams.gamma, jnp.float32)),
            row=jnp.zeros_like(step),
        )
        size = jnp.abs(context.td_error(batch))
        if not ring.ends:
            return jnp.mean(size)
        return jnp.sum(size, where=step < episode.length) / jnp.maximum(episode.length, 1).astype(size.dtype)

    return jax.lax.map(of_episode, ring.episodes, batch_size=min(replay.capacity(ring), _ROWS_AT_ONCE))


# Luu & Yoo 2021 ("HGR"): episodes by their mean error, then hindsight goals by theirs.
td_error = Priority(
    renew=_mean_error,
    choose=by_weight(lambda sample, batch, context: jnp.abs(context.td_error(batch))),
    uses_values=True,
    by_part=True,
)
td_error_shared = dataclasses.replace(td_error, candidates=1)  # a quarter of the errors: less time, and less gained per step
