"""Running mean and standard deviation, merged batch by batch (Chan, Golub & LeVeque 1983).

Values are an array, or a tree of arrays such as a dict observation; its moments are a tree of `NormalizerState`s. Leaves that
are not floats, such as uint8 images, are not normalized and have no moments (None).
"""

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher.parallel import split
from mjx_dher.types import Array, PyTree


@struct.dataclass
class NormalizerState:
    """Moments of all values so far. Kept as mean and variance: float32 sums of squares would cancel."""

    count: Array  # []
    mean: Array  # [D], or the shape of the leaf
    var: Array  # [D] biased (divided by count)


def init(like: PyTree) -> PyTree:
    """Initial moments (mean 0, variance 1) for a tree of arrays or `jax.ShapeDtypeStruct`s without batch axes."""

    def of(x: Array) -> NormalizerState | None:
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return None
        return NormalizerState(jnp.zeros((), jnp.float32), jnp.zeros(x.shape, jnp.float32), jnp.ones(x.shape, jnp.float32))

    return jax.tree.map(of, like)


def update(
    state: PyTree, values: PyTree, clip: Array | float, valid: Array | None = None, axis_name: str | None = None
) -> PyTree:
    """Adds values to the moments, after clipping them to +- `clip`.

    Args:
      values: values to add; leaves are [..., D], with any batch axes.
      clip: bound of the magnitudes.
      valid: bool mask over leading batch axes. Other values are left out, even NaN. Default: all.
      axis_name: mapped axis of devices that hold parts of the values. Each gets the moments of all values.
    """
    return jax.tree.map(lambda x, moments: _update(moments, x, clip, valid, axis_name), values, state)


def _update(
    state: NormalizerState | None, values: Array, clip: Array | float, valid: Array | None, axis_name: str | None
) -> NormalizerState | None:
    if state is None:
        return None
    shape, ndim = state.mean.shape, _batch_axes(state, values)
    valid = jnp.ones((), bool) if valid is None else valid
    if valid.dtype != bool:
        raise ValueError(f"valid must be bool; it is {valid.dtype}")
    mask = jnp.broadcast_to(jnp.expand_dims(valid, range(valid.ndim, ndim)), values.shape[:ndim])
    mask = mask.reshape(-1, *(1,) * len(shape))
    values = jnp.clip(values.astype(state.mean.dtype), -clip, clip).reshape(-1, *shape)
    number = split.total(jnp.sum(mask), axis_name).astype(jnp.float32)
    batch_mean = split.total(jnp.sum(jnp.where(mask, values, 0.0), axis=0), axis_name) / jnp.maximum(number, 1.0)
    squares = jnp.where(mask, jnp.square(values - batch_mean[None]), 0.0)
    batch_var = split.total(jnp.sum(squares, axis=0), axis_name) / jnp.maximum(number, 1.0)
    count = state.count + number
    share = number / jnp.maximum(count, 1.0)
    delta = batch_mean - state.mean
    return NormalizerState(
        count=count,
        mean=state.mean + delta * share,
        var=state.var * (1.0 - share) + batch_var * share + jnp.square(delta) * share * (1.0 - share),
    )


def _batch_axes(state: NormalizerState, values: Array) -> int:
    shape, axes = state.mean.shape, values.ndim - state.mean.ndim
    if axes < 0 or values.shape[axes:] != shape:
        raise ValueError(f"values must have the moments' shape {list(shape)} in their last axes; got {list(values.shape)}")
    return axes


def normalize(state: PyTree, values: PyTree, eps: Array | float, clip: Array | float, input_clip: Array | float) -> PyTree:
    """Normalizes values: clips them to +- `input_clip`, subtracts the mean, divides by max(std, eps) and clips to +- `clip`.

    Args:
      eps: smallest standard deviation to divide by.
    """

    def of(values: Array, state: NormalizerState | None) -> Array:
        if state is None:
            return values
        values = jnp.clip(values, -input_clip, input_clip)
        leading = range(_batch_axes(state, values))
        mean, std = (jnp.expand_dims(x, leading) for x in (state.mean, jnp.maximum(jnp.sqrt(state.var), eps)))
        return jnp.clip((values - mean) / std, -clip, clip)

    return jax.tree.map(of, values, state)
