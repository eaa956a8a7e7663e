"""Running mean and standard deviation, merged batch by batch (Chan, Golub & LeVeque 1983)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher.types import Array


@struct.dataclass
class NormalizerState:
    """Moments of all values so far. Kept as mean and variance: float32 sums of squares would cancel."""

    count: Array  # []
    mean: Array  # [D]
    var: Array  # [D] biased (divided by count)


def init(size: int) -> NormalizerState:
    """State before any value: mean 0, variance 1."""
    return NormalizerState(count=jnp.zeros(()), mean=jnp.zeros(size), var=jnp.ones(size))


def update(
    state: NormalizerState, values: Array, clip: Array | float, valid: Array | None = None, axis_name: str | None = None
) -> NormalizerState:
    """Returns the moments with `values` [..., D] added, after clipping them to +- `clip`.

    Args:
      state: moments so far.
      values: what to add.
      clip: bound of the values' magnitudes.
      valid: mask that broadcasts against [...]; the other values are left out, even NaN. All are valid if None.
      axis_name: mapped axis of the devices, if each has a part of the values; all devices get the moments of all values.
    """

    def total(x: Array) -> Array:
        return x if axis_name is None else jax.lax.psum(x, axis_name)

    mask = jnp.ones(values.shape[:-1], bool) if valid is None else jnp.broadcast_to(valid, values.shape[:-1])
    mask = mask.reshape(-1, 1)
    values = jnp.clip(values, -clip, clip).reshape(-1, values.shape[-1])
    number = total(jnp.sum(mask)).astype(jnp.float32)
    batch_mean = total(jnp.sum(jnp.where(mask, values, 0.0), axis=0)) / jnp.maximum(number, 1.0)
    squares = jnp.where(mask, jnp.square(values - batch_mean[None]), 0.0)
    batch_var = total(jnp.sum(squares, axis=0)) / jnp.maximum(number, 1.0)
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
