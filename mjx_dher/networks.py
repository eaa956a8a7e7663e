"""The paper's networks: four linear layers, ReLU between them."""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp

from mjx_dher.types import Array


def _mlp(x: Array, hidden_sizes: Sequence[int], output_size: int) -> Array:
    for size in hidden_sizes:
        x = nn.relu(nn.Dense(size, kernel_init=nn.initializers.xavier_uniform())(x))
    return nn.Dense(output_size, kernel_init=nn.initializers.xavier_uniform())(x)


class Actor(nn.Module):
    """Deterministic policy: normalized observation and goal to an action in [-1, 1]."""

    action_size: int
    hidden_sizes: Sequence[int] = (256, 256, 256)

    @nn.compact
    def __call__(self, observation: Array, goal: Array) -> Array:
        """[..., D], [..., G] -> [..., A]."""
        return jnp.tanh(_mlp(jnp.concatenate([observation, goal], axis=-1), self.hidden_sizes, self.action_size))


class Critic(nn.Module):
    """Q value of an action in a state, for a goal."""

    hidden_sizes: Sequence[int] = (256, 256, 256)

    @nn.compact
    def __call__(self, observation: Array, goal: Array, action: Array) -> Array:
        """[..., D], [..., G], [..., A] -> [...]."""
        return _mlp(jnp.concatenate([observation, goal, action], axis=-1), self.hidden_sizes, 1)[..., 0]
