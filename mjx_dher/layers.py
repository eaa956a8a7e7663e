"""Linear layers and layer normalization whose gradients sum over the batch in products with ones.

XLA's own sums over a batch take longer on a GPU than the products. Three of them took 171 of the 589 us of a `dtqc` update in
bfloat16 with layers of 512 on an H100. Parameters have Flax's names and shapes, and results are Flax's up to rounding. At JAX's
default precision an H200 rounds float32 to TF32, which moves a sum by 7e-5. Derivatives are reverse-mode only, not `jax.jvp`.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from mjx_dher.types import Array

_ROWS = 8  # of ones: the fewest that a tensor core multiplies
_EPSILON = 1e-6  # Flax's


def _summed(x: Array) -> Array:
    """Sum [F] of `x` [..., F] over all other axes, added up in float32."""
    flat = x.reshape(-1, x.shape[-1])
    return jnp.dot(jnp.ones((_ROWS, len(flat)), flat.dtype), flat, preferred_element_type=jnp.float32)[0]


@jax.custom_vjp
def _shifted(x: Array, bias: Array) -> Array:
    """`x` [..., F] plus a float32 `bias` [F], in the dtype of `x`."""
    return x + bias.astype(x.dtype)


_shifted.defvjp(lambda x, bias: (_shifted(x, bias), None), lambda _, gradient: (gradient, _summed(gradient)))


@jax.custom_vjp
def _scaled(x: Array, scale: Array) -> Array:
    """`x` [..., F] times `scale` [F], both float32."""
    return x * scale


def _backwards(kept: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, scale = kept
    return gradient * scale, _summed(gradient * x)


_scaled.defvjp(lambda x, scale: (x * scale, (x, scale)), _backwards)


class Dense(nn.Module):
    """`flax.linen.Dense`: maps `x` [..., I] to [..., features]. Parameters are float32, products have the dtype."""

    features: int
    dtype: DTypeLike
    kernel_init: Any
    bias_init: Any = nn.initializers.zeros_init()

    @nn.compact
    def __call__(self, x: Array) -> Array:
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features), jnp.float32)
        bias = self.param("bias", self.bias_init, (self.features,), jnp.float32)
        return _shifted(x.astype(self.dtype) @ kernel.astype(self.dtype), bias)


class LayerNorm(nn.Module):
    """`flax.linen.LayerNorm` of `x` [..., F] over its last axis: computed in float32, returned in the dtype."""

    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Array) -> Array:
        scale = self.param("scale", nn.initializers.ones_init(), (x.shape[-1],), jnp.float32)
        bias = self.param("bias", nn.initializers.zeros_init(), (x.shape[-1],), jnp.float32)
        x = x.astype(jnp.float32)
        mean = x.mean(-1, keepdims=True)
        variance = jnp.maximum(0.0, jnp.square(x).mean(-1, keepdims=True) - jnp.square(mean))
        normal = (x - mean) * jax.lax.rsqrt(variance + _EPSILON)
        return _shifted(_scaled(normal, scale), bias).astype(self.dtype)
