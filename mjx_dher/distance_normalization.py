"""Readings of the paper's "normalized distance values": how distances become what the kernels of `weighted` weigh.

A normalization is a function of the distances [T+1] of one episode's achieved goals to the desired one, of which goals are
candidates [T+1], and of a length in metres (`weight_scale`); it gives relative distances [T+1]. A kernel gives the weight of a
relative distance: at 1 it is 1, with every kernel and temperature. docs/samplers.md has the formulas, and what follows.

    normalization(distance [T+1], candidates [T+1], scale []) -> relative distance [T+1]

What is no candidate may be given any number that is not NaN. Where no candidates differ, a normalization gives all of them the
same.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp

from mjx_dher.types import Array

NormalizationFn = Callable[[Array, Array, Array | float], Array]


def by_mean(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """Returns d / mean d; 1 where every candidate lies on the goal. `linear` at temperature 1 then is 2 - d / mean d."""
    del scale
    distance = jnp.where(candidates, distance, 0.0)
    mean = jnp.sum(distance) / jnp.sum(candidates, dtype=distance.dtype)
    # Where every candidate lies on the goal, all are equally near.
    return jnp.where(candidates & (mean != 0), distance / jnp.where(mean != 0, mean, 1.0), 1.0)


def mirrored(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """Returns 2 - d / mean d, the mirror image of `by_mean`: `linear` at temperature 1 is d / mean d, so p = d / sum d."""
    return 2.0 - by_mean(distance, candidates, scale)


def by_sum(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """Returns 1 + d / sum d: `linear` at temperature 1 is 1 - d / sum d."""
    del scale
    return _one_and(distance, jnp.sum(jnp.where(candidates, distance, 0.0)), candidates)


def by_max(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """Returns 1 + d / max d: `linear` at temperature 1 is 1 - d / max d."""
    del scale
    return _one_and(distance, _largest(distance, candidates), candidates)


def by_range(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """Returns 1 + (d - min d) / (max d - min d): `linear` at temperature 1 falls from 1, the nearest, to 0, the farthest."""
    del scale
    least = jnp.min(jnp.where(candidates, distance, jnp.inf))
    return _one_and(distance - least, _largest(distance, candidates) - least, candidates)


def by_scale(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """Returns 1 + d / scale, a length in metres: `softmax` at temperature 1 is exp(-d / scale). Alone in having a scale."""
    return _one_and(distance, scale, candidates)


def _largest(distance: Array, candidates: Array) -> Array:
    return jnp.max(jnp.where(candidates, distance, 0.0))


def _one_and(distance: Array, unit: Array | float, candidates: Array) -> Array:
    """Returns 1 + distance / unit of the candidates, and 1 where the unit is 0, as where all lie on the goal."""
    return jnp.where(candidates & (unit != 0), 1.0 + distance / jnp.where(unit != 0, unit, 1.0), 1.0)
