"""Running mean and standard deviation, merged batch by batch (Chan, Golub & LeVeque 1983)."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct

from mjx_dher.parallel.split import ALONE, Split
from mjx_dher.types import Array


@struct.dataclass
class NormalizerState:
    """Moments of all values so far. Kept as mean and variance: float32 sums of squares would cancel."""

    count: Array  # []
    mean: Array  # [D]
    var: Array  # [D] biased (divided by count)


def init(size: int) -> NormalizerState:
    """Makes the state before any value: mean 0, variance 1."""
    return NormalizerState(count=jnp.zeros(()), mean=jnp.zeros(size), var=jnp.ones(size))


def update(
    state: NormalizerState, values: Array, clip: Array | float, valid: Array | None = None, split: Split = ALONE
) -> NormalizerState:
    """Returns the moments with `values` [..., D] added, after clipping them to +- `clip`.

    `valid` broadcasts against [..., 1] and says which of them to add, whatever the others hold; all, where None. Of a run in
    parts, the values of all parts are added, and all have the same moments.
    """
    mask = jnp.ones(values.shape[:-1], bool) if valid is None else jnp.broadcast_to(valid, values.shape[:-1])
    mask = mask.reshape(-1, 1)
    values = jnp.clip(values, -clip, clip).reshape(-1, values.shape[-1])
    number = split.sum(jnp.sum(mask)).astype(jnp.float32)
    batch_mean = split.sum(jnp.sum(jnp.where(mask, values, 0.0), axis=0)) / jnp.maximum(number, 1.0)
    squares = jnp.where(mask, jnp.square(values - batch_mean[None]), 0.0)
    batch_var = split.sum(jnp.sum(squares, axis=0)) / jnp.maximum(number, 1.0)
    count = state.count + number
    share = number / jnp.maximum(count, 1.0)
    delta = batch_mean - state.mean
    return NormalizerState(
        count=count,
        mean=state.mean + delta * share,
        var=state.var * (1.0 - share) + batch_var * share + jnp.square(delta) * share * (1.0 - share),
    )


def normalize(
    state: NormalizerState, values: Array, eps: Array | float, clip: Array | float, input_clip: Array | float
) -> Array:
    """Returns `values` [..., D] clipped to +- `input_clip`, centred, divided by max(std, eps) and clipped to +- `clip`."""
    values = jnp.clip(values, -input_clip, input_clip)
    mean, std = (jnp.expand_dims(x, range(values.ndim - 1)) for x in (state.mean, jnp.maximum(jnp.sqrt(state.var), eps)))
    return jnp.clip((values - mean) / std, -clip, clip)
