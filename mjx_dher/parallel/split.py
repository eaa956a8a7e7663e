"""Collectives over the devices that share one run. The axis name is the one of `jax.shard_map`, or None for one device."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from mjx_dher.types import Array, PRNGKey

Tree = TypeVar("Tree", bound=Any)
AxisName = str | None


def own_key(key: PRNGKey, axis_name: AxisName) -> PRNGKey:
    """Key of this device."""
    return key if axis_name is None else jax.random.fold_in(key, jax.lax.axis_index(axis_name))


def own_rows(number: int, axis_name: AxisName) -> Array:
    """Rows of this device, of `number` rows. All devices get equally many, so some rows may repeat."""
    if axis_name is None:
        return jnp.arange(number)
    devices = jax.lax.axis_size(axis_name)
    return (jnp.arange(-(-number // devices)) * devices + jax.lax.axis_index(axis_name)) % number


def mean(tree: Tree, axis_name: AxisName) -> Tree:
    """Mean of the devices' arrays."""
    return tree if axis_name is None else jax.lax.pmean(tree, axis_name)


def total(tree: Tree, axis_name: AxisName) -> Tree:
    """Sum of the devices' arrays."""
    return tree if axis_name is None else jax.lax.psum(tree, axis_name)


def all_true(flag: Array, axis_name: AxisName) -> Array:
    """Whether `flag` [] is true on all devices."""
    return flag if axis_name is None else jax.lax.pmin(flag.astype(jnp.int32), axis_name) > 0


def gather(tree: Tree, axis_name: AxisName) -> Tree:
    """Concatenates the arrays [N, ...] of all devices to [devices * N, ...]."""
    return tree if axis_name is None else jax.lax.all_gather(tree, axis_name, tiled=True)
