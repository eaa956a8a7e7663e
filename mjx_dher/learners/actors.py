"""Pieces for learners: how an actor acts, explores, and learns. Deterministic, and a Gaussian under tanh.

Inputs are normalized. `judge` is what the critics think of actions: [B, A] -> [B].
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Protocol, cast

import jax
import jax.numpy as jnp

from mjx_dher.config import HParams
from mjx_dher.learners import common
from mjx_dher.networks import Actor, GaussianActor
from mjx_dher.parallel.split import ALONE, Split
from mjx_dher.types import Array, Metrics, PRNGKey, PyTree, Sizes

Judge = Callable[[Array], Array]
LOG_STD_RANGE = (-20.0, 2.0)  # Haarnoja et al. 2018, their code


class ActorKind(Protocol):
    """What a learner asks of its actor, whose module is `network` and whose parameters are `params`."""

    @property
    def is_gaussian(self) -> bool: ...  # whether its network gives moments: `networks.Heads.gaussian`

    @property
    def has_target(self) -> bool: ...  # whether the critics' targets take their actions from a slower copy of it

    def split_over(self, split: Split) -> ActorKind:
        """Returns the actor of a run in parts: it draws for the rows of all parts, and takes its own."""

    def init(self, network: Any, key: PRNGKey, sizes: Sizes) -> PyTree:
        """Makes parameters."""

    def act(self, network: Any, params: PyTree, observation: Array, goal: Array) -> Array:
        """Returns the deterministic actions [..., A]."""

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, action_size: int, hparams: HParams) -> common.Noise:
        """Draws what `explore` takes; leaves lead with [T, N]."""

    def explore(self, network: Any, params: PyTree, observation: Array, goal: Array, noise: common.Noise) -> Array:
        """Returns actions [N, A] under the noise of one step."""

    def next_action(
        self, network: Any, params: PyTree, observation: Array, goal: Array, key: PRNGKey, hparams: HParams
    ) -> tuple[Array, Array]:
        """Returns actions [B, A] for a target, and what is taken off their values [B]."""

    def loss(
        self, network: Any, params: PyTree, observation: Array, goal: Array, judge: Judge, key: PRNGKey, hparams: HParams
    ) -> tuple[Array, Metrics]:
        """Returns the actor's loss [], and metrics."""

    def dense(self, network: Any, params: PyTree) -> Any:
        """Returns the linear layers of the deterministic policy, for `policy.from_mlp`; None for networks of one's own."""


@dataclasses.dataclass(frozen=True)
class Deterministic:
    """A deterministic actor: it explores under noise, and a target's actions are smoothed by clipped noise (TD3)."""

    is_gaussian: bool = False
    has_target: bool = True
    split: Split = ALONE

    def split_over(self, split: Split) -> Deterministic:
        """Returns the actor of a run in parts."""
        return dataclasses.replace(self, split=split)

    def init(self, network: Any, key: PRNGKey, sizes: Sizes) -> PyTree:
        """Makes parameters."""
        return network.init(key, jnp.zeros(sizes.observation), jnp.zeros(sizes.goal))

    def act(self, network: Any, params: PyTree, observation: Array, goal: Array) -> Array:
        """Returns the actions [..., A]."""
        return cast(Array, network.apply(params, observation, goal))

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, action_size: int, hparams: HParams) -> common.Noise:
        """Draws what `explore` takes; leaves lead with [T, N]."""
        return common.exploration_noise(key, num_steps, num_envs, action_size, hparams)

    def explore(self, network: Any, params: PyTree, observation: Array, goal: Array, noise: common.Noise) -> Array:
        """Returns the actions with noise, [N, A]."""
        return common.add_noise(noise, self.act(network, params, observation, goal))

    def next_action(
        self, network: Any, params: PyTree, observation: Array, goal: Array, key: PRNGKey, hparams: HParams
    ) -> tuple[Array, Array]:
        """Returns smoothed actions [B, A] (Fujimoto et al. 2018, equation 14), whose values stay as they are."""
        action = self.act(network, params, observation, goal)
        bound = hparams.target_noise_clip
        smoothing = jnp.clip(hparams.target_noise * self.split.normal(key, action.shape, action.dtype), -bound, bound)
        return jnp.clip(action + smoothing, -1.0, 1.0), jnp.zeros(action.shape[0], action.dtype)

    def loss(
        self, network: Any, params: PyTree, observation: Array, goal: Array, judge: Judge, key: PRNGKey, hparams: HParams
    ) -> tuple[Array, Metrics]:
        """Returns minus the mean value of the actions, plus `action_l2` times their mean square."""
        del key
        action = self.act(network, params, observation, goal)
        return -jnp.mean(judge(action)) + hparams.action_l2 * jnp.mean(jnp.square(action)), {}

    def dense(self, network: Any, params: PyTree) -> Any:
        """Returns the linear layers; None for networks of one's own."""
        return params["params"] if isinstance(network, Actor) else None


@dataclasses.dataclass(frozen=True)
class Gaussian:
    """A Gaussian under tanh, which explores by itself and is paid for its entropy (SAC, Haarnoja et al. 2018).

    Parameters are {"network", "log_alpha"}. The entropy's weight alpha is `entropy_weight` exp(log_alpha), and is learned so
    that the mean of log pi becomes -`entropy_target` A.
    """

    is_gaussian: bool = True
    has_target: bool = False
    split: Split = ALONE

    def split_over(self, split: Split) -> Gaussian:
        """Returns the actor of a run in parts."""
        return dataclasses.replace(self, split=split)

    def init(self, network: Any, key: PRNGKey, sizes: Sizes) -> PyTree:
        """Makes parameters."""
        network_params = network.init(key, jnp.zeros(sizes.observation), jnp.zeros(sizes.goal))
        return {"network": network_params, "log_alpha": jnp.zeros(())}

    def act(self, network: Any, params: PyTree, observation: Array, goal: Array) -> Array:
        """Returns the tanh of the means, [..., A]."""
        return jnp.tanh(_moments(network, params, observation, goal)[0])

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, action_size: int, hparams: HParams) -> common.Noise:
        """Draws what `explore` takes; leaves lead with [T, N]."""
        return common.exploration_noise(
            key, num_steps, num_envs, action_size, hparams._replace(noise_std=1.0, random_noise=0.0)
        )

    def explore(self, network: Any, params: PyTree, observation: Array, goal: Array, noise: common.Noise) -> Array:
        """Returns a draw of the policy [N, A], or a uniformly random action where the noise says so."""
        mean, log_std = _moments(network, params, observation, goal)
        action = jnp.tanh(mean + jnp.exp(log_std) * noise.gaussian)
        return jnp.where(noise.is_random[..., None], noise.uniform, action)

    def next_action(
        self, network: Any, params: PyTree, observation: Array, goal: Array, key: PRNGKey, hparams: HParams
    ) -> tuple[Array, Array]:
        """Returns draws of the policy [B, A], and alpha log pi [B] (Haarnoja et al. 2018, equation 3)."""
        action, log_prob = draw(network, params, observation, goal, key, self.split)
        return action, _alpha(params, hparams) * log_prob

    def loss(
        self, network: Any, params: PyTree, observation: Array, goal: Array, judge: Judge, key: PRNGKey, hparams: HParams
    ) -> tuple[Array, Metrics]:
        """Returns mean(alpha log pi - Q) plus the loss of alpha, and alpha and the entropy as metrics.

        Haarnoja et al. 2018 ("Algorithms and Applications"), equations 7 and 18; `action_l2` as in other learners.
        """
        action, log_prob = draw(network, params, observation, goal, key, self.split)
        alpha = _alpha(params, hparams)
        still = jax.lax.stop_gradient
        policy_loss = jnp.mean(still(alpha) * log_prob - judge(action)) + hparams.action_l2 * jnp.mean(jnp.square(action))
        target = hparams.entropy_target * action.shape[-1]
        alpha_loss = -params["log_alpha"] * still(jnp.mean(log_prob) + target)
        return policy_loss + alpha_loss, {"entropy_weight": alpha, "entropy": -jnp.mean(log_prob)}

    def dense(self, network: Any, params: PyTree) -> Any:
        """Returns the linear layers, of the last one the half that gives means; None for networks of one's own."""
        if not isinstance(network, GaussianActor):
            return None
        layers = dict(params["network"]["params"])
        last = f"Dense_{len(layers) - 1}"
        layers[last] = {name: x[..., : network.action_size] for name, x in layers[last].items()}
        return layers


def draw(
    network: Any, params: PyTree, observation: Array, goal: Array, key: PRNGKey, split: Split = ALONE
) -> tuple[Array, Array]:
    """Draws actions tanh(u), u ~ N(mean, std), [B, A]; returns them and the logarithms of their densities [B].

    log pi = log N(u) - sum log(1 - tanh(u)^2) (Haarnoja et al. 2018, equation 21), and 1 - tanh(u)^2 = 4 / (e^u + e^-u)^2.
    """
    mean, log_std = _moments(network, params, observation, goal)
    standard = split.normal(key, mean.shape, mean.dtype)
    u = mean + jnp.exp(log_std) * standard
    log_normal = -0.5 * jnp.square(standard) - log_std - 0.5 * math.log(2.0 * math.pi)
    log_slope = 2.0 * (math.log(2.0) - u - jax.nn.softplus(-2.0 * u))
    return jnp.tanh(u), jnp.sum(log_normal - log_slope, axis=-1)


def _moments(network: Any, params: PyTree, observation: Array, goal: Array) -> tuple[Array, Array]:
    mean, log_std = network.apply(params["network"], observation, goal)
    return mean, jnp.clip(log_std, *LOG_STD_RANGE)


def _alpha(params: PyTree, hparams: HParams) -> Array:
    return hparams.entropy_weight * jnp.exp(params["log_alpha"])
