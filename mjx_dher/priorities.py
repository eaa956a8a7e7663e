"""Priorities: which episodes and transitions are likelier to be learned from than others, in `priority_fraction` of a batch.

A priority of episodes is a pure function of one whole episode to a weight, 0 or more:

    priority(episode, compute_reward, hparams) -> []

The ring stores each episode's weight with it; `replay.draw_rows` draws episodes in proportion to their weights. A `Priority`
can do more: renew the weights of the whole ring at each cycle, and choose among transitions that are drawn and relabelled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher import components, lookup, replay
from mjx_dher.config import HParams
from mjx_dher.context import View, pick
from mjx_dher.replay import ReplayState, Sample
from mjx_dher.types import Array, Batch, Episode, PRNGKey, RewardFn

CANDIDATES = 4  # transitions that are drawn for each that a priority of transitions chooses

# priority(episode, compute_reward, hparams) -> weight [], 0 or more
PriorityFn = Callable[[Episode, RewardFn, HParams], Array]
# renew(ring, view) -> weights [E] of all its rows, 0 or more; what they are for empty rows does not matter
RenewFn = Callable[[ReplayState, View], Array]
# choose(key, sample [CANDIDATES * B], batch [CANDIDATES * B], number B, view) -> indices [B] of the candidates
ChooseFn = Callable[[PRNGKey, Sample, Batch, int, View], Array]


@dataclasses.dataclass(frozen=True)
class Priority:
    """A priority: any of three ways to prefer, each of them optional."""

    weigh: PriorityFn | None = None  # an episode, once, when it is added
    renew: RenewFn | None = None  # episodes of the ring, at each cycle, before anything is learned
    choose: ChooseFn | None = None  # among transitions, hindsight goals in place
    uses_values: bool = False  # of `view.values`
    # Whether `renew` weighs each episode alone. Then it may be handed a ring of some of them (`Config.renewals`).
    by_part: bool = False


def eventful(episode: Episode, compute_reward: RewardFn, hparams: HParams) -> Array:
    """Returns 1.0 for an episode whose last achieved goal, as a goal, was not yet reached at its start; else 0.0.

    In all other episodes the hindsight goals are much the same, reached from the first step on, and say nothing of how to
    reach any. Asking the environment's own (sparse) reward needs no scale and no threshold. Cf. the filter for misleading
    samples of Manela & Biess 2021 and the energy-based prioritization of Zhao & Tresp 2018.
    """
    del hparams
    return (compute_reward(episode.achieved_goal[0], episode.achieved_goal[-1]) < 0).astype(jnp.float32)


def make(name: str | Priority | PriorityFn) -> Priority | PriorityFn:
    """Returns the priority called `name`, a function or `Priority` of one's own, or what "module:attribute" names.

    Raises:
      ValueError: no such priority, module or attribute, or neither a function of (episode, compute_reward, hparams) nor a
        `Priority`.
    """
    value = components.load("priority", name)
    if not isinstance(value, Priority):
        return lookup.check_function("priority", value, ("episode", "compute_reward", "hparams"))
    given = {
        "weigh": (value.weigh, ("episode", "compute_reward", "hparams")),
        "renew": (value.renew, ("ring", "view")),
        "choose": (value.choose, ("key", "sample", "batch", "number", "view")),
    }
    for part, (function, parameters) in given.items():
        if function is not None:
            lookup.check_function(f"priority: {part}", function, parameters)
    if all(function is None for function, _ in given.values()):
        raise ValueError("a Priority has weigh, renew or choose; this one has none of them")
    return value


def whole(priority: Priority | PriorityFn) -> Priority:
    """Returns a priority as a `Priority`."""
    return priority if isinstance(priority, Priority) else Priority(weigh=priority)


def weights(priority: PriorityFn | Priority, episodes: Episode, compute_reward: RewardFn, hparams: HParams) -> Array:
    """Returns the weight [N] of each of N episodes (leaves lead with [N]), float32; what is not a positive, finite number is 0.

    Raises:
      ValueError: the priority gives no scalar, or no real number.
    """
    weigh = whole(priority).weigh
    if weigh is None:
        return jnp.zeros(episodes.action.shape[0], jnp.float32)
    weight = jax.vmap(lambda episode: weigh(episode, compute_reward, hparams))(episodes)
    if not isinstance(weight, jax.Array) or weight.ndim != 1:
        given = list(weight.shape[1:]) if isinstance(weight, jax.Array) else f"a {type(weight).__name__}"
        raise ValueError(f"a priority gives one weight [] for an episode; this one gives {given}")
    return replay.as_priority(weight)


def renewed(priority: Priority, ring: ReplayState, view: View, rows: Array | None = None) -> ReplayState:
    """Returns the ring with weights that `priority.renew` gives; as it is, where the priority has no such function.

    Args:
      priority: whose `renew` is asked.
      ring: the ring.
      view: what `renew` may look at.
      rows: [R] those to renew, handed to `renew` as a ring of their own; all, where None. A row may be there twice.

    Raises:
      ValueError: the weights are no real numbers [E], or [R].
    """
    if priority.renew is None:
        return ring
    part = ring if rows is None else replay.take(ring, rows)
    weight = priority.renew(part, view)
    if getattr(weight, "shape", None) != part.priority.shape:
        given = list(weight.shape) if hasattr(weight, "shape") else f"a {type(weight).__name__}"
        raise ValueError(f"priority: renew gives weights [E] = {list(part.priority.shape)}; this one gives {given}")
    filled = (jnp.arange(ring.priority.shape[0]) if rows is None else rows) < ring.size
    weight = jnp.where(filled, replay.as_priority(weight), 0.0)
    return dataclasses.replace(ring, priority=weight if rows is None else ring.priority.at[rows].set(weight))


def chosen(priority: Priority, key: PRNGKey, sample: Sample, batch: Batch, number: int, view: View) -> tuple[Sample, Batch]:
    """Returns `number` of CANDIDATES times as many transitions: a share `priority_fraction` by `priority.choose`.

    The others are the first of each CANDIDATES, as if no more had been drawn.

    Raises:
      ValueError: it does not give integers [number].
    """
    assert priority.choose is not None
    choose_key, coin_key = jax.random.split(key)
    indices = _checked_choice(priority.choose, choose_key, sample, batch, number, view)
    coin = jax.random.uniform(coin_key, (number,)) < view.hparams.priority_fraction
    anyhow = CANDIDATES * jnp.arange(number, dtype=jnp.int32)
    kept = jnp.where(coin, jnp.clip(indices.astype(jnp.int32), 0, CANDIDATES * number - 1), anyhow)
    return jax.tree.map(lambda x: x[kept], (sample, batch))


def _checked_choice(choose: ChooseFn, key: PRNGKey, sample: Sample, batch: Batch, number: int, view: View) -> Array:
    indices = choose(key, sample, batch, number, view)
    if getattr(indices, "shape", None) != (number,) or not jnp.issubdtype(indices.dtype, jnp.integer):
        given = f"{indices.dtype}{list(indices.shape)}" if hasattr(indices, "shape") else f"a {type(indices).__name__}"
        raise ValueError(f"priority: choose gives indices [B] = [{number}], integers; this one gives {given}")
    return indices


def by_weight(weigh: Callable[[Sample, Batch, View], Array]) -> ChooseFn:
    """Returns a `choose` that keeps one of each CANDIDATES transitions, in proportion to weights [B'] that `weigh` gives.

    What is not a positive, finite weight is not kept; where all of them are such, any is.

    Raises:
      ValueError: `weigh` does not give one weight for each transition.
    """

    def choose(key: PRNGKey, sample: Sample, batch: Batch, number: int, view: View) -> Array:
        weight = weigh(sample, batch, view)
        if getattr(weight, "shape", None) != batch.reward.shape:
            given = list(weight.shape) if hasattr(weight, "shape") else f"a {type(weight).__name__}"
            raise ValueError(f"priority: weights of transitions are [B] = {list(batch.reward.shape)}; these are {given}")
        weight = replay.as_priority(weight).reshape(number, CANDIDATES)
        total = jnp.cumsum(jnp.where(jnp.sum(weight, axis=1, keepdims=True) > 0, weight, 1.0), axis=1)
        # 1 - u lies in (0, 1], so what weighs nothing is never the first to reach it.
        threshold = (1.0 - jax.random.uniform(key, (number, 1))) * total[:, -1:]
        place = jnp.argmax(total >= threshold, axis=1).astype(jnp.int32)
        return CANDIDATES * jnp.arange(number, dtype=jnp.int32) + place

    return choose


def one_of(choices: Sequence[Priority | PriorityFn]) -> Priority:
    """Joins several priorities in one compiled program: `hparams.priority_choice`, traced, says which of them a run uses.

    Raises:
      ValueError: no priority, or something that is none.
    """
    made = [whole(make(choice)) for choice in choices]
    if not made:
        raise ValueError("one_of joins one or more priorities; got none")
    if len(made) == 1:
        return made[0]

    def weigh(episode: Episode, compute_reward: RewardFn, hparams: Any) -> Array:
        zero = jnp.zeros(())
        results = [own.weigh(episode, compute_reward, hparams) if own.weigh else zero for own in made]
        return pick([jnp.asarray(result, jnp.float32) for result in results], hparams.priority_choice)

    def renew(ring: ReplayState, view: Any) -> Array:
        return pick([renewed(own, ring, view).priority for own in made], view.hparams.priority_choice)

    def choose(key: PRNGKey, sample: Sample, batch: Batch, number: int, view: Any) -> Array:
        anyhow = CANDIDATES * jnp.arange(number, dtype=jnp.int32)
        results = [_checked_choice(own.choose, key, sample, batch, number, view) if own.choose else anyhow for own in made]
        return pick([result.astype(jnp.int32) for result in results], view.hparams.priority_choice)

    return Priority(
        weigh=weigh if any(own.weigh for own in made) else None,
        renew=renew if any(own.renew for own in made) else None,
        choose=choose if any(own.choose for own in made) else None,
        uses_values=any(own.uses_values for own in made),
        by_part=all(own.by_part for own in made if own.renew),
    )
