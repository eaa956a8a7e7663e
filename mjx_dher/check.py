"""Checks of arrays and states that user functions return."""

from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher.types import Array, PyTree

_NAMES = {jnp.floating: "floats", jnp.integer: "integers", jnp.number: "numbers", jnp.bool_: "booleans"}


def array(name: str, value: Any, shape: tuple[int, ...], kind: Any = jnp.floating) -> Array:
    """Converts `value` to an array and checks its shape and dtype. Works under tracing, at no run-time cost.

    Args:
      name: of the value, with its symbolic shape, such as "sampler: log weights [T+1]".
      value: array, number, or nested sequence of numbers.
      kind: expected kind of dtype: `jnp.floating`, `jnp.integer`, `jnp.number` or `jnp.bool_`.

    Raises:
      ValueError: names the value, the expected and the given shape and dtype.
    """
    expected = f"{name} must be {_NAMES[kind]} of shape {list(shape)}"
    try:
        result = jnp.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(f"{expected}; got {describe(value)}") from None
    fits = jnp.issubdtype(result.dtype, kind)
    if kind is jnp.number:  # booleans count, complex numbers do not
        fits = (fits or result.dtype == bool) and not jnp.issubdtype(result.dtype, jnp.complexfloating)
    if result.shape != tuple(shape) or not fits:
        raise ValueError(f"{expected}; got {describe(result)}")
    return result


def describe(value: Any) -> str:
    """Dtype and shape of an array, such as "float32[3, 4]", or the type of another object."""
    if isinstance(value, jax.Array):
        return f"{value.dtype}{list(value.shape)}"
    return f"a {type(value).__name__}"


def kept(method: str, before: PyTree, after: PyTree, leading: int = 0) -> None:
    """Raises ValueError unless `after` has the structure, the dtypes and, after `leading` axes, the shapes of `before`."""
    old, new = (
        {jax.tree_util.keystr(path): f"{jnp.result_type(x)}{list(jnp.shape(x)[leading:])}" for path, x in leaves}
        for leaves in map(jax.tree_util.tree_leaves_with_path, (before, after))
    )
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    differing = [f"{name or 'it'} is {old.get(name, 'absent')} and becomes {new.get(name, 'absent')}" for name in names]
    structure: Any = jax.tree.structure(before)
    if structure != jax.tree.structure(after) or differing:
        reason = (differing or ["its type or its static fields differ"])[0]
        raise ValueError(f"{method} must keep structure, shapes and types; {reason}")
