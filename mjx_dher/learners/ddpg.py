"""DDPG (Lillicrap et al. 2016) as HER uses it (Andrychowicz et al. 2017): losses, one update, and how to act."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_dher import normalizer
from mjx_dher.config import HParams
from mjx_dher.networks import Actor, Critic
from mjx_dher.normalizer import NormalizerState
from mjx_dher.types import Array, Batch, GoalObs, PRNGKey, PyTree

_ADAM = optax.scale_by_adam()  # the step size is applied apart, because it is traced


class Networks(NamedTuple):
    """The two modules; static."""

    actor: Actor
    critic: Critic


@struct.dataclass
class Params:
    """Parameters of both networks."""

    actor: PyTree
    critic: PyTree


@struct.dataclass
class DDPGState:
    """Everything that learning changes."""

    params: Params
    target: Params
    opt_state: PyTree  # Adam's moments, of both networks
    observation_norm: NormalizerState  # [D]
    goal_norm: NormalizerState  # [G]
    num_updates: Array  # [] int32


class Losses(NamedTuple):
    """What one update saw; all []."""

    critic_loss: Array  # mean squared Bellman error
    actor_loss: Array  # minus the mean Q value, plus the action penalty
    q_mean: Array  # mean Q value of the critic on the batch


# What `compute_gradients` is: networks, parameters, target parameters, a normalized batch and numbers to gradients and losses.
GradientFn = Callable[[Networks, Params, Params, Batch, HParams], tuple[Params, Losses]]


def init(key: PRNGKey, networks: Networks, observation_size: int, goal_size: int, action_size: int) -> DDPGState:
    """Fresh networks, targets equal to them, normalizers that have seen nothing."""
    actor_key, critic_key = jax.random.split(key)
    obs, goal, action = jnp.zeros(observation_size), jnp.zeros(goal_size), jnp.zeros(action_size)
    params = Params(actor=networks.actor.init(actor_key, obs, goal), critic=networks.critic.init(critic_key, obs, goal, action))
    return DDPGState(
        params=params,
        target=jax.tree.map(jnp.copy, params),
        opt_state=_ADAM.init(params),
        observation_norm=normalizer.init(observation_size),
        goal_norm=normalizer.init(goal_size),
        num_updates=jnp.zeros((), jnp.int32),
    )


def act(networks: Networks, state: DDPGState, obs: GoalObs, hparams: HParams) -> Array:
    """The policy's actions [..., A] in [-1, 1], without exploration."""
    observation = _normalize(state.observation_norm, obs["observation"], hparams)
    goal = _normalize(state.goal_norm, obs["desired_goal"], hparams)
    return _pi(networks, state.params.actor, observation, goal)


class Noise(NamedTuple):
    """What exploration adds to the actions of whole episodes; drawn at once, because it does not depend on them."""

    gaussian: Array  # [T, N, A] added to the policy's action
    is_random: Array  # [T, N] where the policy's action gives way to a uniformly random one
    uniform: Array  # [T, N, A] that one, in [-1, 1]


def exploration_noise(key: PRNGKey, num_steps: int, num_envs: int, action_size: int, hparams: HParams) -> Noise:
    """Noise for `num_envs` episodes of `num_steps` steps: a share `random_eps` of the actions is uniformly random."""
    gaussian_key, uniform_key = jax.random.split(key)
    shape = (num_steps, num_envs)
    uniform = jax.random.uniform(uniform_key, (*shape, action_size + 1))
    return Noise(
        gaussian=hparams.noise_std * jax.random.normal(gaussian_key, (*shape, action_size)),
        is_random=uniform[..., -1] < hparams.random_eps,
        uniform=2.0 * uniform[..., :-1] - 1.0,
    )


def explore(noise: Noise, action: Array) -> Array:
    """`action` [N, A] with the noise of one step (leaves lead with [N])."""
    return jnp.where(noise.is_random[..., None], noise.uniform, jnp.clip(action + noise.gaussian, -1.0, 1.0))


def update_normalizers(
    state: DDPGState, observation: Array, goal: Array, hparams: HParams, valid: Array | None = None
) -> DDPGState:
    """The state after its normalizers saw observations [..., D] and goals [..., G].

    `valid`, where given, is [N] and says which of the observations [N, ..., D] to see; the goals are seen if any of it is true.
    """
    seen = None if valid is None else valid.reshape(-1, *(1,) * (observation.ndim - 2))
    return dataclasses.replace(
        state,
        observation_norm=normalizer.update(state.observation_norm, observation, hparams.obs_clip, seen),
        goal_norm=normalizer.update(state.goal_norm, goal, hparams.obs_clip, None if valid is None else jnp.any(valid)),
    )


def target_value(networks: Networks, target: Params, batch: Batch, hparams: HParams) -> Array:
    """[B] reward + gamma Q'(s', pi'(s')), clipped to what returns can be: [-1/(1-gamma), 0]. `batch` is normalized.

    Episodes end by the clock alone, so every next state has a value.
    """
    next_action = _pi(networks, target.actor, batch.next_observation, batch.desired_goal)
    next_q = _q(networks, target.critic, batch.next_observation, batch.desired_goal, next_action)
    return jnp.clip(batch.reward + hparams.gamma * next_q, -1.0 / (1.0 - hparams.gamma), 0.0)


def critic_loss(networks: Networks, critic: PyTree, batch: Batch, target: Array) -> tuple[Array, Array]:
    """Mean squared difference of Q to `target` [B], and the mean Q. `batch` is normalized."""
    q = _q(networks, critic, batch.observation, batch.desired_goal, batch.action)
    return jnp.mean(jnp.square(q - target)), jnp.mean(q)


def actor_loss(networks: Networks, actor: PyTree, critic: PyTree, batch: Batch, hparams: HParams) -> Array:
    """Minus the mean Q of the policy's actions plus `action_l2` times their mean square. `batch` is normalized."""
    action = _pi(networks, actor, batch.observation, batch.desired_goal)
    q = _q(networks, critic, batch.observation, batch.desired_goal, action)
    return -jnp.mean(q) + hparams.action_l2 * jnp.mean(jnp.square(action))


def compute_gradients(
    networks: Networks, params: Params, target: Params, batch: Batch, hparams: HParams
) -> tuple[Params, Losses]:
    """The gradients of both losses, each by its own network's parameters. `batch` is normalized."""
    value = target_value(networks, target, batch, hparams)
    (c_loss, q_mean), c_grad = jax.value_and_grad(lambda critic: critic_loss(networks, critic, batch, value), has_aux=True)(
        params.critic
    )
    a_loss, a_grad = jax.value_and_grad(lambda actor: actor_loss(networks, actor, params.critic, batch, hparams))(params.actor)
    return Params(actor=a_grad, critic=c_grad), Losses(critic_loss=c_loss, actor_loss=a_loss, q_mean=q_mean)


def update(
    networks: Networks, state: DDPGState, batch: Batch, hparams: HParams, compute_gradients: GradientFn = compute_gradients
) -> tuple[DDPGState, Losses]:
    """One step of Adam for critic and actor, both from the parameters before it. Targets stay: see `update_target`.

    `compute_gradients` computes both: the function above, or `hopper.gradients.compute_gradients`.
    """
    batch = dataclasses.replace(
        batch,
        observation=_normalize(state.observation_norm, batch.observation, hparams),
        next_observation=_normalize(state.observation_norm, batch.next_observation, hparams),
        desired_goal=_normalize(state.goal_norm, batch.desired_goal, hparams),
    )
    params = state.params
    grads, losses = compute_gradients(networks, params, state.target, batch, hparams)
    direction, opt_state = _ADAM.update(grads, state.opt_state)
    params = Params(
        actor=jax.tree.map(lambda p, d: p - hparams.actor_lr * d, params.actor, direction.actor),
        critic=jax.tree.map(lambda p, d: p - hparams.critic_lr * d, params.critic, direction.critic),
    )
    state = dataclasses.replace(state, params=params, opt_state=opt_state, num_updates=state.num_updates + 1)
    return state, losses


def update_target(state: DDPGState, hparams: HParams) -> DDPGState:
    """Soft update: the targets keep a share `polyak` of themselves and take the rest from the networks."""
    target = optax.incremental_update(state.params, state.target, 1.0 - hparams.polyak)
    return dataclasses.replace(state, target=target)


def _pi(networks: Networks, actor: PyTree, observation: Array, goal: Array) -> Array:
    return cast(Array, networks.actor.apply(actor, observation, goal))


def _q(networks: Networks, critic: PyTree, observation: Array, goal: Array, action: Array) -> Array:
    return cast(Array, networks.critic.apply(critic, observation, goal, action))


def _normalize(state: NormalizerState, values: Array, hparams: HParams) -> Array:
    return normalizer.normalize(state, values, hparams.norm_eps, hparams.norm_clip, hparams.obs_clip)
