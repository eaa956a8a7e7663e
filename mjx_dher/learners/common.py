"""Shared pieces of learners: parameters, normalized inputs, exploration noise."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_dher import normalizer
from mjx_dher.config import HParams
from mjx_dher.normalizer import NormalizerState
from mjx_dher.parallel.split import ALONE, Split
from mjx_dher.types import Array, Batch, GoalObs, PRNGKey, PyTree


@struct.dataclass
class Params:
    """Parameters of both networks."""

    actor: PyTree
    critic: PyTree


class Losses(NamedTuple):
    """Losses of one update; all []."""

    critic_loss: Array  # mean squared Bellman error
    actor_loss: Array  # minus the mean Q value, plus the action penalty
    q_mean: Array  # mean Q value of the critic on the batch


def adam(hparams: HParams | None = None) -> optax.GradientTransformation:
    """Returns Adam without its step size, which is applied apart, because it is traced; None where moments alone are made."""
    return optax.scale_by_adam() if hparams is None else optax.scale_by_adam(eps=hparams.adam_eps)


State = TypeVar("State", bound=Any)  # has observation_norm and goal_norm, NormalizerStates [D] and [G]


class Noise(NamedTuple):
    """What exploration adds to the actions of whole episodes; drawn at once, because it does not depend on them."""

    gaussian: Array  # [T, N, A] added to the policy's action
    is_random: Array  # [T, N] whether a uniformly random action takes the place of the policy's
    uniform: Array  # [T, N, A] that random action, in [-1, 1]


def exploration_noise(key: PRNGKey, num_steps: int, num_envs: int, action_size: int, hparams: HParams) -> Noise:
    """Draws noise for `num_envs` episodes of `num_steps` steps: a fraction `random_eps` of the actions is uniformly random.

    Random actions have a fraction `random_noise` of the noise of the others.
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


def add_noise(noise: Noise, action: Array) -> Array:
    """Returns `action` [N, A] with the noise of one step (leaves lead with [N])."""
    return jnp.where(noise.is_random[..., None], noise.uniform, jnp.clip(action + noise.gaussian, -1.0, 1.0))


def update_normalizers(
    state: State, observation: Array, goal: Array, hparams: HParams, valid: Array | None = None, split: Split = ALONE
) -> State:
    """Returns the state after its normalizers have taken in observations [..., D] and goals [..., G].

    `valid`, where given, is [N] and says which of the observations [N, ..., D] to take in; the goals are taken in if any of
    it is true. Of a run in parts, those of all parts are taken in.
    """
    mask = None if valid is None else valid.reshape(-1, *(1,) * (observation.ndim - 2))
    return dataclasses.replace(
        state,
        observation_norm=normalizer.update(state.observation_norm, observation, hparams.obs_clip, mask, split),
        goal_norm=normalizer.update(state.goal_norm, goal, hparams.obs_clip, None if valid is None else jnp.any(valid), split),
    )


def discount(batch: Batch, hparams: HParams) -> Array | float:
    """Returns what the values of a batch's next observations count: [B], or gamma for all."""
    return hparams.gamma if batch.discount is None else batch.discount


def normalize(state: NormalizerState, values: Array, hparams: HParams) -> Array:
    """Returns normalized, clipped `values` [..., D]."""
    return normalizer.normalize(state, values, hparams.norm_eps, hparams.norm_clip, hparams.obs_clip)


def normalize_obs(state: Any, obs: GoalObs, hparams: HParams) -> tuple[Array, Array]:
    """Returns the normalized observation [..., D] and desired goal [..., G] of `obs`."""
    observation = normalize(state.observation_norm, obs["observation"], hparams)
    return observation, normalize(state.goal_norm, obs["desired_goal"], hparams)


def normalize_batch(state: Any, batch: Batch, hparams: HParams) -> Batch:
    """Returns `batch` with normalized observations and goals."""
    return dataclasses.replace(
        batch,
        observation=normalize(state.observation_norm, batch.observation, hparams),
        next_observation=normalize(state.observation_norm, batch.next_observation, hparams),
        desired_goal=normalize(state.goal_norm, batch.desired_goal, hparams),
    )
