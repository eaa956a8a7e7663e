"""The check of arrays."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_dher import check


@pytest.mark.parametrize(
    ("value", "shape", "kind"),
    [
        (jnp.zeros((2, 3)), (2, 3), jnp.floating),
        (np.zeros(2, np.float32), (2,), jnp.floating),
        ([1.0, jnp.float32(2.0)], (2,), jnp.floating),
        (1.5, (), jnp.floating),
        (jnp.arange(3), (3,), jnp.integer),
        (jnp.arange(3), (3,), jnp.number),
        (jnp.zeros(3, jnp.bfloat16), (3,), jnp.number),
        (True, (), jnp.bool_),
    ],
)
def test_an_array_of_the_expected_shape_and_kind_is_returned(value: Any, shape: tuple[int, ...], kind: Any) -> None:
    result = check.array("x", value, shape, kind)
    assert isinstance(result, jax.Array)
    assert result.shape == shape


@pytest.mark.parametrize(
    ("value", "shape", "kind", "given"),
    [
        (jnp.zeros(3), (2,), jnp.floating, "float32[3]"),
        (jnp.zeros(()), (1,), jnp.floating, "float32[]"),
        (jnp.arange(2), (2,), jnp.floating, "int32[2]"),
        (jnp.zeros(2), (2,), jnp.integer, "float32[2]"),
        (None, (2,), jnp.floating, "a NoneType"),
        ("text", (), jnp.floating, "a str"),
        ({"a": 1.0}, (1,), jnp.floating, "a dict"),
        ([[1.0], [1.0, 2.0]], (2,), jnp.floating, "a list"),
    ],
)
def test_another_shape_kind_or_type_is_rejected(value: Any, shape: tuple[int, ...], kind: Any, given: str) -> None:
    with pytest.raises(ValueError, match=f"^weights .* {re.escape(str(list(shape)))}; got {re.escape(given)}$"):
        check.array("weights [T+1]", value, shape, kind)


def test_a_traced_value_is_checked_while_it_is_traced() -> None:
    with pytest.raises(ValueError, match="x must"):
        jax.eval_shape(lambda x: check.array("x", x, (2,)), jnp.zeros(3))


def test_a_state_that_is_one_array_is_named() -> None:
    with pytest.raises(ValueError, match=r"^step must .*; it is float32\[2\] and becomes float32\[3\]$"):
        check.kept("step", jnp.zeros(2), jnp.zeros(3))
