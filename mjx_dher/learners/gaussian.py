"""The tanh-Gaussian actor, with entropy regularization."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher.config import HParams
from mjx_dher.learners.actors import ActorKind, Judge, Noise, exploration_noise
from mjx_dher.networks import GaussianActor
from mjx_dher.types import Array, Metrics, PRNGKey, PyTree

_LOG_STD_RANGE = (-20.0, 2.0)  # Haarnoja et al. 2018, their code


@dataclasses.dataclass(frozen=True)
class Gaussian(ActorKind):
    """A tanh-Gaussian actor with entropy regularization (SAC, Haarnoja et al. 2018).

    Parameters are {"network", "log_alpha"}. The entropy weight alpha is `entropy_weight` exp(log_alpha). It is learned so that
    the mean of log pi becomes -`entropy_target` A.
    """

    is_gaussian = True
    has_target = False

    def init(self, network: Any, key: PRNGKey, *inputs: PyTree) -> PyTree:
        return {"network": network.init(key, *inputs), "log_alpha": jnp.zeros((), jnp.float32)}

    def act(self, network: Any, params: PyTree, observation: Array, goal: Array) -> Array:
        """Tanh of the means, [..., A]."""
        return jnp.tanh(_moments(network, params, observation, goal)[0])

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, action_size: int, hparams: HParams) -> Noise:
        return exploration_noise(key, num_steps, num_envs, action_size, hparams._replace(noise_std=1.0, random_noise=0.0))

    def explore(self, network: Any, params: PyTree, observation: Array, goal: Array, noise: Noise) -> Array:
        """Actions [N, A] drawn from the policy, or uniformly random."""
        mean, log_std = _moments(network, params, observation, goal)
        action = jnp.tanh(mean + jnp.exp(log_std) * noise.gaussian)
        return jnp.where(noise.is_random[..., None], noise.uniform, action)

    def next_action(
        self, network: Any, params: PyTree, observation: Array, goal: Array, normal: Array, hparams: HParams
    ) -> tuple[Array, Array]:
        """Actions [B, A] drawn from the policy, and alpha log pi [B] (Haarnoja et al. 2018, equation 3)."""
        action, log_prob = sample_action(network, params, observation, goal, normal)
        return action, _alpha(params, hparams) * log_prob

    def loss(
        self, network: Any, params: PyTree, observation: Array, goal: Array, judge: Judge, normal: Array, hparams: HParams
    ) -> tuple[Array, Metrics]:
        """Loss mean(alpha log pi - Q) plus the loss of alpha, with alpha and the entropy as metrics.

        Haarnoja et al. 2018 ("Algorithms and Applications"), equations 7 and 18, the latter with log alpha, as in their code.
        `action_l2` is as in other learners.
        """
        action, log_prob = sample_action(network, params, observation, goal, normal)
        alpha = _alpha(params, hparams)
        still = jax.lax.stop_gradient
        policy_loss = jnp.mean(still(alpha) * log_prob - judge(action)) + hparams.action_l2 * jnp.mean(jnp.square(action))
        target = hparams.entropy_target * action.shape[-1]
        alpha_loss = -params["log_alpha"] * still(jnp.mean(log_prob) + target)
        return policy_loss + alpha_loss, {"entropy_weight": alpha, "entropy": -jnp.mean(log_prob)}

    def dense(self, network: Any, params: PyTree) -> Any:
        """Linear layers, without the last layer's outputs for standard deviations, or None for custom networks."""
        if not (type(network) is GaussianActor and network.style.is_plain):
            return None
        layers = dict(params["network"]["params"])
        last = f"Dense_{len(layers) - 1}"
        layers[last] = {name: x[..., : network.action_size] for name, x in layers[last].items()}
        return layers


def sample_action(network: Any, params: PyTree, observation: Array, goal: Array, normal: Array) -> tuple[Array, Array]:
    """Actions tanh(u) [B, A] for u = mean + std `normal` [B, A], and their log densities [B].

    log pi = log N(u) - sum log(1 - tanh(u)^2) (Haarnoja et al. 2018, equation 21), and 1 - tanh(u)^2 = 4 / (e^u + e^-u)^2.
    """
    mean, log_std = _moments(network, params, observation, goal)
    u = mean + jnp.exp(log_std) * normal
    log_normal = -0.5 * jnp.square(normal) - log_std - 0.5 * math.log(2.0 * math.pi)
    log_slope = 2.0 * (math.log(2.0) - u - jax.nn.softplus(-2.0 * u))
    return jnp.tanh(u), jnp.sum(log_normal - log_slope, axis=-1)


def _moments(network: Any, params: PyTree, observation: Array, goal: Array) -> tuple[Array, Array]:
    mean, log_std = network.apply(params["network"], observation, goal)
    return mean, jnp.clip(log_std, *_LOG_STD_RANGE)


def _alpha(params: PyTree, hparams: HParams) -> Array:
    return hparams.entropy_weight * jnp.exp(params["log_alpha"])
