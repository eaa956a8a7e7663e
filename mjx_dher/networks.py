"""Networks of a learner. The default, `mlp`, is the paper's: four linear layers, ReLU between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax.typing import DTypeLike

from mjx_dher import names
from mjx_dher.spec import NETWORKS
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
        """Maps observations [..., D] and goals [..., G] to actions [..., A]."""
        inputs = jnp.concatenate([observation, goal], axis=-1)
        return jnp.tanh(_mlp(inputs, self.hidden_sizes, self.action_size, self.dtype))


class Critic(nn.Module):
    """Q value of an action in a state, for a goal. Parameters and values are float32."""

    hidden_sizes: Sequence[int] = (256, 256, 256)
    dtype: DTypeLike = jnp.float32  # of the hidden layers' products and activations

    @nn.compact
    def __call__(self, observation: Array, goal: Array, action: Array) -> Array:
        """Maps observations [..., D], goals [..., G] and actions [..., A] to values [...]."""
        inputs = jnp.concatenate([observation, goal, action], axis=-1)
        return _mlp(inputs, self.hidden_sizes, 1, self.dtype)[..., 0]


class Networks(NamedTuple):
    """The modules of actor and critic, as flax modules with `init` and `apply`; static."""

    actor: Any  # (observation [..., D], goal [..., G]) -> action [..., A] in [-1, 1]
    critic: Any  # (observation [..., D], goal [..., G], action [..., A]) -> value [...]


# make(action_size, hidden_sizes, dtype) -> Networks; those of another dtype have the same parameters
NetworksFn = Callable[[int, tuple[int, ...], DTypeLike], Networks]


def mlp(action_size: int, hidden_sizes: tuple[int, ...], dtype: DTypeLike = "float32") -> Networks:
    """Makes the default networks."""
    return Networks(actor=Actor(action_size, hidden_sizes, jnp.dtype(dtype)), critic=Critic(hidden_sizes, jnp.dtype(dtype)))


def make(name: str | NetworksFn) -> NetworksFn:
    """Returns the function that makes the networks called `name`, of one's own, or named as "module:attribute".

    Raises:
      ValueError: no such networks, or no function of (action_size, hidden_sizes, dtype).
    """
    return names.resolve("networks", name, NETWORKS, ("action_size", "hidden_sizes", "dtype"))
