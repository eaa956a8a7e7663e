"""Episode priorities by rarity and by diversity of achieved goals."""

import jax
import jax.numpy as jnp

from mjx_dher.context import Context
from mjx_dher.priorities import Priority
from mjx_dher.replay import ReplayState
from mjx_dher.types import Array, Episode

COMPONENTS = 3  # Gaussians of the mixture that `max_entropy` fits
ROUNDS = 10  # of expectation maximization


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
