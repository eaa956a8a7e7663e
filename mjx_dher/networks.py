"""The paper's networks: four linear layers, ReLU between them."""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jax.typing import DTypeLike

from mjx_dher.types import Array


def _mlp(x: Array, hidden_sizes: Sequence[int], output_size: int, dtype: DTypeLike) -> Array:
    for size in hidden_sizes:
        x = nn.relu(nn.Dense(size, dtype=dtype, kernel_init=nn.initializers.xavier_uniform())(x))
    return nn.Dense(output_size, dtype=jnp.float32, kernel_init=nn.initializers.xavier_uniform())(x)


class Actor(nn.Module):
    """Deterministic policy: normalized observation and goal to an action in [-1, 1]. Parameters and actions are float32."""

    action_size: int
    hidden_sizes: Sequence[int] = (256, 256, 256)
    dtype: DTypeLike = jnp.float32  # of the hidden layers' products and activations

    @nn.compact
    def __call__(self, observation: Array, goal: Array) -> Array:
        """[..., D], [..., G] -> [..., A]."""
        inputs = jnp.concatenate([observation, goal], axis=-1)
        return jnp.tanh(_mlp(inputs, self.hidden_sizes, self.action_size, self.dtype))


class Critic(nn.Module):
    """Q value of an action in a state, for a goal. Parameters and values are float32."""

    hidden_sizes: Sequence[int] = (256, 256, 256)
    dtype: DTypeLike = jnp.float32  # of the hidden layers' products and activations

    @nn.compact
    def __call__(self, observation: Array, goal: Array, action: Array) -> Array:
        """[..., D], [..., G], [..., A] -> [...]."""
        inputs = jnp.concatenate([observation, goal, action], axis=-1)
        return _mlp(inputs, self.hidden_sizes, 1, self.dtype)[..., 0]
