"""Actors, their exploration and losses: what they share, and the deterministic one. `gaussian` has the other.

`judge` maps actions [B, A] to the critics' values [B].
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp

from mjx_dher.config import HParams
from mjx_dher.networks import Actor
from mjx_dher.types import Array, Metrics, PRNGKey, PyTree

Judge = Callable[[Array], Array]


class Noise(NamedTuple):
    """Exploration noise of whole episodes."""

    gaussian: Array  # [T, N, A] added to the policy's action
    is_random: Array  # [T, N] whether a uniformly random action replaces the policy's
    uniform: Array  # [T, N, A] the random action, in [-1, 1]


def exploration_noise(key: PRNGKey, num_steps: int, num_envs: int, action_size: int, hparams: HParams) -> Noise:
    """Draws exploration noise for `num_envs` episodes of `num_steps` steps.

    A fraction `random_eps` of the actions is uniformly random. These get a fraction `random_noise` of the Gaussian noise.
    """
    gaussian_key, uniform_key = jax.random.split(key)
    shape = (num_steps, num_envs)
    uniform = jax.random.uniform(uniform_key, (*shape, action_size + 1), jnp.float32)
    gaussian = hparams.noise_std * jax.random.normal(gaussian_key, (*shape, action_size), jnp.float32)
    return Noise(
        gaussian=gaussian,
        is_random=uniform[..., -1] < hparams.random_eps,
        uniform=jnp.clip(2.0 * uniform[..., :-1] - 1.0 + hparams.random_noise * gaussian, -1.0, 1.0),
    )


class ActorKind(Protocol):
    """An actor of a learner.

    Arguments of the methods: the flax module `network`, its parameters `params`, normalized observations [..., D] and goals
    [..., G], and standard normal numbers `normal` [B, A].
    """

    is_gaussian: ClassVar[bool] = False  # whether the network returns moments (`networks.Heads.gaussian`)
    has_target: ClassVar[bool] = True  # whether the critics' targets use a slower copy of the actor

    def init(self, network: Any, key: PRNGKey, *inputs: PyTree) -> PyTree:
        """Parameters for inputs like `inputs`: an observation [D] and a goal [G]."""
        return network.init(key, *inputs)

    def act(self, network: Any, params: PyTree, observation: Array, goal: Array) -> Array:
        """Deterministic actions [..., A]."""

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, action_size: int, hparams: HParams) -> Noise:
        """Draws the noise for `explore`; leaves lead with [T, N]."""
        return exploration_noise(key, num_steps, num_envs, action_size, hparams)

    def explore(self, network: Any, params: PyTree, observation: Array, goal: Array, noise: Noise) -> Array:
        """Exploring actions [N, A] with the noise of one step."""

    def next_action(
        self, network: Any, params: PyTree, observation: Array, goal: Array, normal: Array, hparams: HParams
    ) -> tuple[Array, Array]:
        """Actions [B, A] for a target, and a cost [B] to subtract from their values."""

    def loss(
        self, network: Any, params: PyTree, observation: Array, goal: Array, judge: Judge, normal: Array, hparams: HParams
    ) -> tuple[Array, Metrics]:
        """Loss [] of the actor, and metrics."""

    def dense(self, network: Any, params: PyTree) -> Any:
        """Linear layers of the deterministic policy, for `policy.from_mlp`, or None for custom networks."""


@dataclasses.dataclass(frozen=True)
class Deterministic(ActorKind):
    """A deterministic actor with exploration noise, and clipped noise on target actions (TD3)."""

    def act(self, network: Any, params: PyTree, observation: Array, goal: Array) -> Array:
        return cast(Array, network.apply(params, observation, goal))

    def explore(self, network: Any, params: PyTree, observation: Array, goal: Array, noise: Noise) -> Array:
        """Actions [N, A] with added noise, clipped, or uniformly random."""
        action = self.act(network, params, observation, goal)
        return jnp.where(noise.is_random[..., None], noise.uniform, jnp.clip(action + noise.gaussian, -1.0, 1.0))

    def next_action(
        self, network: Any, params: PyTree, observation: Array, goal: Array, normal: Array, hparams: HParams
    ) -> tuple[Array, Array]:
        """Smoothed actions [B, A] (Fujimoto et al. 2018, equation 14), at no cost."""
        action = self.act(network, params, observation, goal)
        bound = hparams.target_noise_clip
        smoothing = jnp.clip(hparams.target_noise * normal, -bound, bound)
        return jnp.clip(action + smoothing, -1.0, 1.0), jnp.zeros(action.shape[0], action.dtype)

    def loss(
        self, network: Any, params: PyTree, observation: Array, goal: Array, judge: Judge, normal: Array, hparams: HParams
    ) -> tuple[Array, Metrics]:
        """Minus the mean value of the actions, plus `action_l2` times their mean square."""
        action = self.act(network, params, observation, goal)
        return -jnp.mean(judge(action)) + hparams.action_l2 * jnp.mean(jnp.square(action)), {}

    def dense(self, network: Any, params: PyTree) -> Any:
        return params["params"] if type(network) is Actor and network.style.is_plain else None
