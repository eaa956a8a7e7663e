"""Normalizations and kernels of the sampler `weighted`: readings of the paper's "normalized distance values".

A normalization maps the distances between achieved goals and the desired goal to relative distances. A kernel maps a relative
distance to a log weight, which is 0 at 1 for any temperature. docs/samplers.md has the formulas.

    normalization(distance [T+1], candidates [T+1] bool, scale [] in metres) -> relative distance [T+1]
    kernel(relative distance [T+1], temperature []) -> log weight [T+1]

A goal that is not a candidate may get any number except NaN. Equally far candidates get equal numbers.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp

from mjx_dher.types import Array

NormalizationFn = Callable[[Array, Array, Array | float], Array]


def by_mean(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """d / mean d, or 1 if every candidate lies on the goal. `linear` at temperature 1 is then 2 - d / mean d."""
    del scale
    distance = jnp.where(candidates, distance, 0.0)
    mean = _sum(distance) / jnp.sum(candidates, dtype=distance.dtype)
    return jnp.where(candidates & (mean != 0), distance / jnp.where(mean != 0, mean, 1.0), 1.0)


def mirrored(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """2 - d / mean d, the mirror image of `by_mean`: `linear` at temperature 1 is d / mean d, so p = d / sum d."""
    return 2.0 - by_mean(distance, candidates, scale)


def by_sum(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """1 + d / sum d: `linear` at temperature 1 is 1 - d / sum d."""
    del scale
    return _one_and(distance, _sum(jnp.where(candidates, distance, 0.0)), candidates)


def by_max(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """1 + d / max d: `linear` at temperature 1 is 1 - d / max d."""
    del scale
    return _one_and(distance, _largest(distance, candidates), candidates)


def by_range(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """1 + (d - min d) / (max d - min d): `linear` at temperature 1 falls from 1, the nearest, to 0, the farthest."""
    del scale
    least = jnp.min(jnp.where(candidates, distance, jnp.inf))
    return _one_and(distance - least, _largest(distance, candidates) - least, candidates)


def by_scale(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """1 + d / scale, with the scale in metres. `softmax` at temperature 1 is exp(-d / scale)."""
    return _one_and(distance, scale, candidates)


def _sum(distance: Array) -> Array:
    """Sum [] of distances, or NaN if it overflows, so that no goal is offered."""
    total = jnp.sum(distance)
    return jnp.where(total < jnp.inf, total, jnp.nan)


def _largest(distance: Array, candidates: Array) -> Array:
    return jnp.max(jnp.where(candidates, distance, 0.0))


def _one_and(distance: Array, unit: Array | float, candidates: Array) -> Array:
    """1 + distance / unit for the candidates, or 1 if the unit is 0."""
    return jnp.where(candidates & (unit != 0), 1.0 + distance / jnp.where(unit != 0, unit, 1.0), 1.0)


def linear(relative: Array, temperature: Array | float) -> Array:
    """log max(1 - (r - 1) / temperature, 0) of relative distances r [T+1]."""
    return jnp.log(jnp.maximum(1.0 - (relative - 1.0) / temperature, 0.0))


def inverse(relative: Array, temperature: Array | float) -> Array:
    """log r^(-1/temperature) of relative distances r [T+1]; below 0.001, r counts as 0.001."""
    return -jnp.log(jnp.maximum(relative, 1e-3)) / temperature


def softmax(relative: Array, temperature: Array | float) -> Array:
    """-(r - 1) / temperature of relative distances r [T+1]."""
    return -(relative - 1.0) / temperature
