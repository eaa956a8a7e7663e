"""Priorities of transitions: among those drawn and relabelled, they choose which to learn from."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from mjx_dher.context import Context
from mjx_dher.contrib.episodes import diversity
from mjx_dher.priorities import CANDIDATES, ChooseFn, Priority, by_weight
from mjx_dher.replay import Sample
from mjx_dher.types import Array, Batch, PRNGKey

_CURRICULUM_GROUP = 8  # transitions that `curriculum` chooses together, of four times as many
_DIVERSE_WIDTH = 0.5  # m, of the kernel by which `dpp` compares goals, as in its authors' code
_MOST_PROXIMITY = 10.0  # exp of this is the weight of proximity in `curriculum` at the end of a run

# pick(key, sample, batch of one group [C], number, view) -> indices [number] within the group
GroupFn = Callable[[PRNGKey, Sample, Batch, int, Context], Array]


def _in_groups(pick: GroupFn, size: int) -> ChooseFn:
    """Returns a `choose` that makes groups of CANDIDATES * `size` transitions and keeps `size` of each by `pick`.

    Where `size` does not divide the number that is wanted, groups are smaller.
    """

    def choose(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
        kept = math.gcd(number, size)
        groups, together = number // kept, kept * CANDIDATES
        parts = jax.tree.map(lambda x: x.reshape(groups, together, *x.shape[1:]), (sample, batch))
        keys = jax.random.split(key, groups)
        indices = jax.vmap(lambda key, sample, batch: pick(key, sample, batch, kept, context))(keys, *parts)
        return (indices.astype(jnp.int32) + together * jnp.arange(groups, dtype=jnp.int32)[:, None]).reshape(number)

    return choose


def _squared_distances(goals: Array) -> Array:
    """Returns the squared distances [C, C] of goals [C, G] to one another."""
    return jnp.sum(jnp.square(goals[:, None] - goals[None]), axis=-1)


def pick_curriculum(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
    """Chooses `number` of a group, one after another, for goals that stand for the others' and are near (Fang et al. 2019).

    Each is the one that adds most to F(A) = sum_i max_(j in A) sim(g_i, g_j) - lambda sum_(j in A) |g_j - a_j|, with sim =
    exp(-d^2 / mean(d)^2), and a_j the goal achieved before the step. lambda grows from 1 to e^10 over the run, as 10^5 updates
    at the authors' rate of 10^-4 make it: first diverse goals, then near ones. They compare each goal with its nearest
    neighbour in a larger batch only and look at three candidates at random at a time; groups here are small enough for all.
    """
    del key
    goals, members = batch.desired_goal, jnp.arange(sample.step.shape[0])
    squares = _squared_distances(goals)
    mean = jnp.mean(jnp.sqrt(squares))
    alike = jnp.exp(-squares / jnp.maximum(jnp.square(mean), 1e-12))
    far = jnp.sqrt(jnp.sum(jnp.square(goals - sample.episode_goals[members, sample.step]), axis=-1))
    strength = jnp.exp(_MOST_PROXIMITY * jnp.asarray(context.progress, jnp.float32))

    def add(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        covered, free = state  # [C] how well each goal is stood for, and which may still be chosen
        gain = jnp.sum(jnp.maximum(alike - covered[None], 0.0), axis=1) - strength * far
        best = jnp.argmax(jnp.where(free, gain, -jnp.inf))
        return (jnp.maximum(covered, alike[best]), free & (members != best)), best

    _, chosen = jax.lax.scan(add, (jnp.zeros_like(far), jnp.ones(far.shape, bool)), length=number)
    return chosen


def pick_diverse(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
    """Draws one or two of a group by a k-DPP of their goals (Kulesza & Taskar 2011; Dai, Liu & Bharath 2021).

    P(i, j) is in proportion to det(L_ij) = 1 - exp(-d^2 / w^2), for the kernel L = exp(-d^2 / 2 w^2): goals that lie
    together are seldom both drawn.
    """
    del context
    size = sample.step.shape[0]
    if number == 1:
        return jax.random.randint(key, (1,), 0, size)
    if number != 2:
        raise ValueError(f"pick_diverse draws one or two of a group; it was asked for {number}")
    determinants = -jnp.expm1(-_squared_distances(batch.desired_goal) / _DIVERSE_WIDTH**2)
    apart = jnp.triu(jnp.ones((size, size), bool), 1)
    # Where all goals are the same, any pair is as good as another.
    log_weights = jnp.where(apart, jnp.log(jnp.maximum(determinants, 1e-12)), -jnp.inf).reshape(-1)
    pair = jax.random.categorical(key, log_weights)
    return jnp.stack([pair // size, pair % size])


def not_misled(sample: Sample, batch: Batch, context: Context) -> Array:
    """Returns weights [B]: 0 for a transition whose hindsight goal was reached before the step, else 1 (Manela & Biess 2021).

    Such a transition is rewarded whatever its action was. Own goals stay.
    """
    before = sample.episode_goals[jnp.arange(sample.step.shape[0]), sample.step]
    reached = context.reached(before, batch.desired_goal)
    replaced = jnp.any(batch.desired_goal != sample.desired_goal, axis=-1)
    return 1.0 - (reached & replaced).astype(jnp.float32)


dpp = Priority(weigh=diversity, choose=_in_groups(pick_diverse, 2))
curriculum = Priority(choose=_in_groups(pick_curriculum, _CURRICULUM_GROUP))
not_misleading = Priority(choose=by_weight(not_misled))
