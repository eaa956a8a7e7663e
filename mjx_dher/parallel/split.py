"""One run in equal parts, one on each of several devices: what the parts average, gather and draw apart.

The methods of `Split` are called inside `jax.shard_map`, over one axis of its mesh. Of a run on one device they change nothing.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from mjx_dher.types import Array, PRNGKey

Tree = TypeVar("Tree", bound=Any)


@dataclasses.dataclass(frozen=True)
class Split:
    """The axis of the mesh over which a run's parts lie, and their number; a run on one device has neither."""

    axis: str | None = None
    number: int = 1

    def share(self, count: int) -> int:
        """Returns a part's share of `count`, which the number of parts divides."""
        return count // self.number

    def key(self, key: PRNGKey) -> PRNGKey:
        """Returns a key of this part's own."""
        return key if self.axis is None else jax.random.fold_in(key, jax.lax.axis_index(self.axis))

    def mean(self, tree: Tree) -> Tree:
        """Returns the mean of the parts' arrays."""
        return tree if self.axis is None else jax.lax.pmean(tree, self.axis)

    def sum(self, tree: Tree) -> Tree:
        """Returns the sum of the parts' arrays."""
        return tree if self.axis is None else jax.lax.psum(tree, self.axis)

    def all(self, flag: Array) -> Array:
        """Returns whether `flag` [] is true in all parts."""
        return flag if self.axis is None else jax.lax.pmin(flag.astype(jnp.int32), self.axis) > 0

    def gather(self, tree: Tree) -> Tree:
        """Returns the arrays [N, ...] of all parts, one part's behind the other's: [number * N, ...]."""
        if self.axis is None:
            return tree
        return jax.tree.map(lambda x: jax.lax.all_gather(x, self.axis, tiled=True), tree)

    def own(self, tree: Tree, axis: int = 0) -> Tree:
        """Returns this part's share of arrays that are whole in all parts, along `axis`."""
        if self.axis is None:
            return tree
        part = jax.lax.axis_index(self.axis)

        def cut(x: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(x, part * self.share(x.shape[axis]), self.share(x.shape[axis]), axis)

        return jax.tree.map(cut, tree)

    def keys(self, key: PRNGKey, number: int) -> PRNGKey:
        """Returns the keys of this part's share of `number` episodes, those of a run on one device; there, `key` itself."""
        return key if self.axis is None else self.own(jax.random.split(key, number))

    def normal(self, key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
        """Draws standard normal numbers for the rows of all parts; returns those of this part's rows, of `shape`."""
        return self.own(jax.random.normal(key, (shape[0] * self.number, *shape[1:]), dtype))


ALONE = Split()
