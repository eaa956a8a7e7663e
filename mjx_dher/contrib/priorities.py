"""Priorities of episodes, by rarity and by diversity of achieved goals, and choices among drawn and relabelled transitions."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from mjx_dher.context import Context
from mjx_dher.priorities import ChooseFn, Priority, by_weight
from mjx_dher.replay import ReplayState, Sample
from mjx_dher.types import Array, Batch, Episode, PRNGKey

COMPONENTS = 3  # Gaussians of the mixture that `max_entropy` fits
ROUNDS = 10  # of expectation maximization
_CURRICULUM_GROUP = 64  # transitions that `curriculum` chooses together, from twice that number
_COMPARED = 3  # random candidates that `curriculum` compares for each place
_PROXIMITY_RATE = 1e-4  # growth of the weight of proximity in `curriculum` per update
_DIVERSE_WIDTH = 0.5  # m, width of the kernel of `dpp`, as in its authors' code
_MOST_PROXIMITY = 80.0  # log of its largest value, near float32's

# pick(key, sample, batch of one group [C], number, context) -> indices [number] within the group
GroupFn = Callable[[PRNGKey, Sample, Batch, int, Context], Array]


def diversity(episode: Episode, context: Context) -> Array:
    """Diversity of an episode's achieved goals (Dai, Liu & Bharath 2021, "DTGSH").

    The sum over pairs of successive goals of det(X X') = 1 - c^2, where X is the pair as unit vectors and c their cosine. It
    is computed as d^2 - d^4 / 4 from their distance d, which keeps small angles despite rounding.
    """
    goals = episode.achieved_goal
    unit = goals / jnp.maximum(jnp.linalg.norm(goals, axis=-1, keepdims=True), 1e-12)
    squared = jnp.sum(jnp.square(unit[1:] - unit[:-1]), axis=-1)
    return jnp.sum(jnp.maximum(squared - 0.25 * jnp.square(squared), 0.0))


def _log_parts(rows: Array, means: Array, variances: Array, shares: Array) -> Array:
    """Log densities [E, components] of `rows` [E, K] under each component, including its weight."""
    inverse = 1.0 / variances
    constant = jnp.sum(jnp.square(means) * inverse + jnp.log(2.0 * jnp.pi * variances), axis=1)
    squares = jnp.square(rows) @ inverse.T - 2.0 * rows @ (means * inverse).T + constant[None]
    return jnp.log(shares)[None] - 0.5 * squares


def fit_mixture(rows: Array, counted: Array) -> Array:
    """Log densities [E] of `rows` [E, K] under a mixture of Gaussians fitted to the rows in `counted` [E]. Deterministic.

    Three components with diagonal covariances are fitted by ten rounds of expectation maximization. Their means start along
    the first principal axis, which power iteration finds.
    """
    weight = counted.astype(rows.dtype)[:, None]
    total = jnp.maximum(jnp.sum(weight), 1.0)
    mean = jnp.sum(weight * rows, axis=0) / total
    centred = weight * (rows - mean[None])
    variance = jnp.sum(jnp.square(centred), axis=0) / total
    floor = 1e-3 * jnp.mean(variance) + 1e-12
    axis = jnp.sqrt(variance + floor)
    for _ in range(3):
        axis = centred.T @ (centred @ axis)
        axis = axis / jnp.maximum(jnp.linalg.norm(axis), 1e-12)
    spread = jnp.sqrt(jnp.sum(jnp.square(centred @ axis)) / total)
    places = jnp.arange(COMPONENTS, dtype=rows.dtype) - (COMPONENTS - 1) / 2
    means = mean[None] + spread * places[:, None] * axis[None]
    state = means, jnp.tile(variance + floor, (COMPONENTS, 1)), jnp.full(COMPONENTS, 1.0 / COMPONENTS, rows.dtype)

    def step(state: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        share = weight * jax.nn.softmax(_log_parts(rows, *state), axis=1)
        count = jnp.sum(share, axis=0) + 1e-6
        means = share.T @ rows / count[:, None]
        squares = share.T @ jnp.square(rows) / count[:, None] - jnp.square(means)
        return (means, jnp.maximum(squares, 0.0) + floor, count / jnp.sum(count)), None

    state, _ = jax.lax.scan(step, state, length=ROUNDS)
    return jax.nn.logsumexp(_log_parts(rows, *state), axis=1)


def _by_rarity(ring: ReplayState, context: Context) -> Array:
    """Ranks [E] of episodes by the rarity of their achieved goals. The most common has rank 0.

    In Zhao, Sun & Tresp 2019 ("MEP"), a mixture of three Gaussians over sequences of achieved goals gives their density.
    Episodes are drawn in proportion to their rank by negative log density.
    """
    goals = ring.episodes.achieved_goal
    filled = jnp.arange(goals.shape[0]) < ring.size
    rows = goals.reshape(goals.shape[0], -1)
    first = rows[:1]  # near zero, squares lose less to rounding
    rarity = jnp.where(filled, -fit_mixture(jnp.where(filled[:, None], rows - first, 0.0), filled), -jnp.inf)
    order = jnp.argsort(rarity)
    rank = jnp.zeros(rarity.shape, jnp.int32).at[order].set(jnp.arange(rarity.shape[0], dtype=jnp.int32))
    empty = rarity.shape[0] - ring.size
    return jnp.maximum(rank - empty, 0).astype(jnp.float32)


max_entropy = Priority(renew=_by_rarity)


def _in_groups(pick: GroupFn, size: int) -> ChooseFn:
    """Makes a `choose` that keeps `size` of each group of `Priority.candidates` * `size` transitions by `pick`.

    If `size` does not divide the number of transitions, groups are smaller.
    """

    def choose(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
        kept = math.gcd(number, size)
        groups, together = number // kept, kept * (len(batch.reward) // number)
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
        order = jnp.where(free, jax.random.uniform(key, (size,), jnp.float32), -1.0)
        compared = jax.lax.top_k(order, min(_COMPARED, number + 1))[1]
        value = covers[compared] - cost[compared]
        led = value > jnp.concatenate([jnp.array([-jnp.inf]), jax.lax.cummax(value)[:-1]])
        best = compared[jnp.argmax(value)]
        return (covers.at[compared].multiply(jnp.where(led, 0.0, 1.0)), free.at[best].set(False)), best

    covers = jnp.zeros(size, alike.dtype).at[nearest].add(alike)
    _, chosen = jax.lax.scan(add, (covers, jnp.ones(size, bool)), jax.random.split(key, number))
    return chosen


def pick_diverse(key: PRNGKey, sample: Sample, batch: Batch, number: int, context: Context) -> Array:
    """Draws one or two of a group by a k-DPP of their goals (Kulesza & Taskar 2011; Dai, Liu & Bharath 2021).

    P(i, j) is proportional to det(L_ij) = 1 - exp(-d^2 / w^2) for the kernel L = exp(-d^2 / 2 w^2), so goals that lie close
    together are rarely both drawn.
    """
    size = sample.step.shape[0]
    if number == 1:
        return jax.random.randint(key, (1,), 0, size, jnp.int32)
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
curriculum = Priority(choose=_in_groups(pick_curriculum, _CURRICULUM_GROUP), candidates=2)
not_misleading = Priority(choose=by_weight(not_misled))
