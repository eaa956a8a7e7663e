"""Samplers that measure distances to the desired goal: the paper's three methods, and the parts of `weighted`.

`weighted` reads the paper's "normalized distance values". A normalization maps the distances between achieved goals and the
desired goal to relative distances. A kernel maps a relative distance to a log weight, which is 0 at 1 for any temperature.
docs/samplers.md has the formulas.

    normalization(distance [T+1], candidates [T+1] bool, scale [] in metres) -> relative distance [T+1]
    kernel(relative distance [T+1], temperature []) -> log weight [T+1]

A goal that is not a candidate may get any number except NaN. Equally far candidates get equal numbers.
"""

import jax
import jax.numpy as jnp

from mjx_dher import check
from mjx_dher.config import HParams
from mjx_dher.samplers import KernelFn, MetricFn, NormalizationFn, future, future_mask, measure, position, uniform
from mjx_dher.types import Array


def distances(metric: MetricFn, achieved: Array, desired: Array) -> Array:
    """Distances [T+1] between `achieved` [T+1, G] and `desired` [G]. A negative one becomes NaN, so that no goal is offered."""
    distance = measure(metric, achieved, desired)
    return distance if metric is position else jnp.where(distance >= 0, distance, jnp.nan)


def closest(
    achieved: Array, desired: Array, step: Array, hparams: HParams, metric: MetricFn = position, length: Array | None = None
) -> Array:
    """The future goal nearest to the desired one (the paper's method 1). Equally near goals are equally likely."""
    mask = future_mask(achieved.shape[0], step, length)
    distance = jnp.where(mask, distances(metric, achieved, desired), jnp.inf)
    return uniform(mask & (distance == jnp.min(distance)))  # all can be inf


def epsilon_closest(
    achieved: Array, desired: Array, step: Array, hparams: HParams, metric: MetricFn = position, length: Array | None = None
) -> Array:
    """Any future goal with probability `epsilon`, else the closest (the paper's method 2)."""
    any_future = jax.nn.softmax(future(achieved, desired, step, hparams, length))
    nearest = jax.nn.softmax(closest(achieved, desired, step, hparams, metric, length))
    return jnp.log(hparams.epsilon * any_future + (1.0 - hparams.epsilon) * nearest)


def by_mean(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """d / mean d, or 1 if every candidate lies on the goal. `linear` at temperature 1 is then 2 - d / mean d."""
    distance = jnp.where(candidates, distance, 0.0)
    mean = _sum(distance) / jnp.sum(candidates, dtype=distance.dtype)
    return jnp.where(candidates & (mean != 0), distance / jnp.where(mean != 0, mean, 1.0), 1.0)


def mirrored(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """2 - d / mean d, the mirror image of `by_mean`: `linear` at temperature 1 is d / mean d, so p = d / sum d."""
    return 2.0 - by_mean(distance, candidates, scale)


def by_sum(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """1 + d / sum d: `linear` at temperature 1 is 1 - d / sum d."""
    return _one_and(distance, _sum(jnp.where(candidates, distance, 0.0)), candidates)


def by_max(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """1 + d / max d: `linear` at temperature 1 is 1 - d / max d."""
    return _one_and(distance, _largest(distance, candidates), candidates)


def by_range(distance: Array, candidates: Array, scale: Array | float) -> Array:
    """1 + (d - min d) / (max d - min d): `linear` at temperature 1 falls from 1, the nearest, to 0, the farthest."""
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


def weighted(
    achieved: Array,
    desired: Array,
    step: Array,
    hparams: HParams,
    kernel: KernelFn,
    metric: MetricFn = position,
    normalization: NormalizationFn = by_mean,
    length: Array | None = None,
) -> Array:
    """Future goals, weighted by nearness to the desired goal (the paper's method 3).

    The weight depends on the relative distance r. `normalization` computes r from the distances d = metric(achieved, desired)
    of all goals after the step. By default

        r_i = d_i / mean_j d_j,

    so weights do not depend on the scale of the task, and equal distances (r_i = 1) give exactly `future`. The kernels at
    temperature tau are

        linear    w = max(1 - (r - 1) / tau, 0)    at tau = 1: 2 - r, from 2 at the goal to 0 at twice the mean distance
        inverse   w = r^(-1/tau)
        softmax   w = exp(-(r - 1) / tau)

    `inverse` almost always takes a candidate that lies on the goal. `linear` at tau = 1 makes no candidate more than twice as
    likely as one at the mean distance. If no candidate has a weight, the nearest is chosen. The paper gives no formula.
    docs/samplers.md compares this default with the alternatives.
    """
    mask = future_mask(achieved.shape[0], step, length)
    distance = jnp.where(mask, distances(metric, achieved, desired), 0.0)
    relative = normalization(distance, mask, hparams.weight_scale)
    relative = check.array("normalization: relative distances [T+1]", relative, mask.shape)
    log_weights = check.array("kernel: log weights [T+1]", kernel(relative, hparams.temperature), mask.shape)
    log_weights = jnp.where(mask, log_weights, -jnp.inf)
    if kernel is not linear or normalization in (by_mean, mirrored):  # then some candidate always has weight (r <= 1)
        return log_weights
    beyond = jnp.all(log_weights == -jnp.inf)
    relative = jnp.where(mask, relative, jnp.inf)
    return jnp.where(beyond, uniform(mask & (relative == jnp.min(relative))), log_weights)
