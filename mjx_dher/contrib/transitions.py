"""Priorities that choose among drawn and relabelled transitions."""

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

_CURRICULUM_GROUP = 8  # transitions that `curriculum` chooses together, from four times that number
_DIVERSE_WIDTH = 0.5  # m, width of the kernel of `dpp`, as in its authors' code
_MOST_PROXIMITY = 10.0  # log weight of proximity in `curriculum` at the end of a run

# pick(key, sample, batch of one group [C], number, context) -> indices [number] within the group
GroupFn = Callable[[PRNGKey, Sample, Batch, int, Context], Array]


def _in_groups(pick: GroupFn, size: int) -> ChooseFn:
    """Makes a `choose` that keeps `size` of each group of CANDIDATES * `size` transitions by `pick`.

    If `size` does not divide the number of transitions, groups are smaller.
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
    """Squared distances [C, C] between goals [C, G]."""
    return jnp.sum(jnp.square(goals[:, None] - goals[None]), axis=-1)


def pick_curriculum(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
    """Chooses `number` of a group one by one, for goals that represent the others and are near (Fang et al. 2019).

    Each choice adds most to F(A) = sum_i max_(j in A) sim(g_i, g_j) - lambda sum_(j in A) |g_j - a_j|, where sim = exp(-d^2 /
    mean(d)^2) and a_j is the goal achieved before the step. lambda grows from 1 to e^10 over the run, as in 10^5 updates at
    the authors' rate of 10^-4: diverse goals first, near goals later. The authors compare each goal with its nearest neighbour
    in a larger batch, and look at three random candidates at a time. Groups here are small enough for all.
    """
    del key
    goals, members = batch.desired_goal, jnp.arange(sample.step.shape[0])
    squares = _squared_distances(goals)
    mean = jnp.mean(jnp.sqrt(squares))
    alike = jnp.exp(-squares / jnp.maximum(jnp.square(mean), 1e-12))
    far = jnp.sqrt(jnp.sum(jnp.square(goals - sample.episode_goals[members, sample.step]), axis=-1))
    strength = jnp.exp(_MOST_PROXIMITY * jnp.asarray(context.progress, jnp.float32))

    def add(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        covered, free = state  # [C] how well each goal is represented, and which may still be chosen
        gain = jnp.sum(jnp.maximum(alike - covered[None], 0.0), axis=1) - strength * far
        best = jnp.argmax(jnp.where(free, gain, -jnp.inf))
        return (jnp.maximum(covered, alike[best]), free & (members != best)), best

    _, chosen = jax.lax.scan(add, (jnp.zeros_like(far), jnp.ones(far.shape, bool)), length=number)
    return chosen


def pick_diverse(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
    """Draws one or two of a group by a k-DPP of their goals (Kulesza & Taskar 2011; Dai, Liu & Bharath 2021).

    P(i, j) is proportional to det(L_ij) = 1 - exp(-d^2 / w^2) for the kernel L = exp(-d^2 / 2 w^2), so goals that lie close
    together are rarely both drawn.
    """
    del context
    size = sample.step.shape[0]
    if number == 1:
        return jax.random.randint(key, (1,), 0, size)
    if number != 2:
        raise ValueError(f"number must be 1 or 2 for pick_diverse; got {number}")
    determinants = -jnp.expm1(-_squared_distances(batch.desired_goal) / _DIVERSE_WIDTH**2)
    apart = jnp.triu(jnp.ones((size, size), bool), 1)
    # If all goals are equal, any pair will do.
    log_weights = jnp.where(apart, jnp.log(jnp.maximum(determinants, 1e-12)), -jnp.inf).reshape(-1)
    pair = jax.random.categorical(key, log_weights)
    return jnp.stack([pair // size, pair % size])


def not_misled(sample: Sample, batch: Batch, context: Context) -> Array:
    """Weights [B]: 0 if the hindsight goal was reached before the step, else 1 (Manela & Biess 2021).

    Such a transition is rewarded for any action. Original goals keep their weight.
    """
    before = sample.episode_goals[jnp.arange(sample.step.shape[0]), sample.step]
    reached = context.reached(before, batch.desired_goal)
    replaced = jnp.any(batch.desired_goal != sample.desired_goal, axis=-1)
    return 1.0 - (reached & replaced).astype(jnp.float32)


dpp = Priority(weigh=diversity, choose=_in_groups(pick_diverse, 2))
curriculum = Priority(choose=_in_groups(pick_curriculum, _CURRICULUM_GROUP))
not_misleading = Priority(choose=by_weight(not_misled))
