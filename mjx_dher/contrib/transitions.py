"""Priorities that choose among drawn and relabelled transitions."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from mjx_dher.context import Context
from mjx_dher.contrib.episodes import diversity
from mjx_dher.priorities import CANDIDATES, ChooseFn, Priority, by_weight
from mjx_dher.replay import Sample
from mjx_dher.types import Array, Batch, PRNGKey

_CURRICULUM_GROUP = 64  # transitions that `curriculum` chooses together, from twice that number
_COMPARED = 3  # random candidates that `curriculum` compares for each place
_PROXIMITY_RATE = 1e-4  # growth of the weight of proximity in `curriculum` per update
_DIVERSE_WIDTH = 0.5  # m, width of the kernel of `dpp`, as in its authors' code
_MOST_PROXIMITY = 80.0  # log of its largest value, near float32's

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
    """Chooses `number` of the first 2 * number transitions of a group: diverse goals at first, near ones later.

    After the code of Fang et al. 2019 ("CHER"). For each place, three random candidates are compared by

        F(j) - lambda |g_j - a_j|,   F(j) = sum of exp(-d_i^2 / mean(d)^2) over the goals i whose nearest other goal is g_j

    where d_i is the distance of goal i to its nearest other goal, and a_j the goal achieved before the step. lambda is 1.0001
    to the power of the updates made. As in that code, a candidate that led the three for a moment has F = 0 from then on.
    """
    size = 2 * number
    goals, members = batch.desired_goal[:size], jnp.arange(size)
    squares = _squared_distances(goals) + jnp.where(jnp.eye(size, dtype=bool), jnp.inf, 0.0)
    nearest, distance = jnp.argmin(squares, axis=1), jnp.sqrt(jnp.min(squares, axis=1))
    alike = jnp.exp(-jnp.square(distance / jnp.maximum(jnp.mean(distance), 1e-12)))
    far = jnp.sqrt(jnp.sum(jnp.square(goals - sample.episode_goals[members, sample.step[:size]]), axis=-1))
    growth = math.log1p(_PROXIMITY_RATE) * jnp.asarray(context.updates, jnp.float32)
    cost = jnp.exp(jnp.minimum(growth, _MOST_PROXIMITY)) * far

    def add(state: tuple[Array, Array], key: PRNGKey) -> tuple[tuple[Array, Array], Array]:
        covers, free = state  # [2 * number] F, and which may still be chosen
        compared = jax.lax.top_k(jnp.where(free, jax.random.uniform(key, (size,)), -1.0), min(_COMPARED, number + 1))[1]
        value = covers[compared] - cost[compared]
        led = value > jnp.concatenate([jnp.array([-jnp.inf]), jax.lax.cummax(value)[:-1]])
        best = compared[jnp.argmax(value)]
        return (covers.at[compared].multiply(jnp.where(led, 0.0, 1.0)), free.at[best].set(False)), best

    covers = jnp.zeros(size).at[nearest].add(alike)
    _, chosen = jax.lax.scan(add, (covers, jnp.ones(size, bool)), jax.random.split(key, number))
    return chosen


def pick_diverse(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
    """Draws one or two of a group by a k-DPP of their goals (Kulesza & Taskar 2011; Dai, Liu & Bharath 2021).

    P(i, j) is proportional to det(L_ij) = 1 - exp(-d^2 / w^2) for the kernel L = exp(-d^2 / 2 w^2), so goals that lie close
    together are rarely both drawn.
    """
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
