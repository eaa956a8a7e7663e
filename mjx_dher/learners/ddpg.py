"""DDPG (Lillicrap et al. 2016) as in HER (Andrychowicz et al. 2017)."""

import dataclasses
from typing import cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_dher.config import Config, HParams
from mjx_dher.learners import common
from mjx_dher.learners.common import ActorCriticBase, Params
from mjx_dher.networks import Networks, NetworksFn, zeros
from mjx_dher.normalizer import NormalizerState
from mjx_dher.types import Array, Batch, EnvSpec, GoalObs, Metrics, PRNGKey, PyTree


@struct.dataclass
class DDPGState:
    """Learner state."""

    params: Params
    target: Params
    opt_state: PyTree  # Adam's moments, of both networks
    observation_norm: PyTree  # NormalizerState [D], or a tree of them
    goal_norm: NormalizerState  # [G]
    num_updates: Array  # [] int32


Bounds = tuple[Array | float, Array | float]  # of returns


def compute_gradients(
    networks: Networks, params: Params, target: Params, batch: Batch, bounds: Bounds, hparams: HParams
) -> tuple[Params, Metrics]:
    """Gradients of both losses on a normalized batch, each with respect to its own network's parameters, and the metrics.

    y = r + discount Q'(s', pi'(s')), clipped to the bounds of returns
    critic: mean (Q(s, a) - y)^2;  actor: -mean Q(s, pi(s)) + action_l2 mean pi(s)^2
    """
    pi, q = networks.actor.apply, networks.critic.apply
    observation, next_observation, goal = batch.observation, batch.next_observation, batch.desired_goal
    next_q = q(target.critic, next_observation, goal, pi(target.actor, next_observation, goal))
    y = jnp.clip(batch.reward + batch.discount * next_q, *bounds)

    def critic_loss(critic: PyTree) -> tuple[Array, Array]:
        value = q(critic, observation, goal, batch.action)
        return jnp.mean(jnp.square(value - y)), jnp.mean(value)

    def actor_loss(actor: PyTree) -> Array:
        action = pi(actor, observation, goal)
        value = q(params.critic, observation, goal, action)
        return -jnp.mean(value) + hparams.action_l2 * jnp.mean(jnp.square(action))

    (c_loss, q_mean), c_gradient = jax.value_and_grad(critic_loss, has_aux=True)(params.critic)
    a_loss, a_gradient = jax.value_and_grad(actor_loss)(params.actor)
    return Params(actor=a_gradient, critic=c_gradient), {"critic_loss": c_loss, "actor_loss": a_loss, "q_mean": q_mean}


@dataclasses.dataclass(frozen=True)
class DDPG(ActorCriticBase):
    """Learner with pure functions of a `DDPGState`. `learners.Learner` documents the methods."""

    gradients = staticmethod(compute_gradients)  # a subclass can override it

    def init(self, key: PRNGKey) -> DDPGState:
        actor_key, critic_key = jax.random.split(key)
        observation, goal, action = zeros(self.spec, self.networks)
        params = Params(
            actor=self.project(self.networks.actor.init(actor_key, observation, goal)),
            critic=self.project(self.networks.critic.init(critic_key, observation, goal, action)),
        )
        return DDPGState(
            params=params,
            target=jax.tree.map(jnp.copy, params),
            opt_state=common.adam(0.0).init(params),
            num_updates=jnp.zeros((), jnp.int32),
            **self.normalizers(),
        )

    def value(self, state: DDPGState, obs: GoalObs, action: Array, hparams: HParams) -> Array:
        """Q value [...] of actions [..., A]."""
        inputs = self.normalize(state, obs["observation"], obs["desired_goal"], hparams)
        return cast(Array, self.learning.critic.apply(state.params.critic, *inputs, action))

    def update(self, state: DDPGState, batch: Batch, hparams: HParams) -> tuple[DDPGState, Metrics]:
        """Takes one Adam step for critic and actor, both from the old parameters."""
        batch, bounds = self.normalize_batch(state, batch, hparams), self.return_bounds(hparams)
        gradients, metrics = self.gradients(self.learning, state.params, state.target, batch, bounds, hparams)
        adam = common.adam(Params(actor=hparams.actor_lr, critic=hparams.critic_lr), hparams.adam_eps)
        updates, opt_state = adam.update(self.mean(gradients), state.opt_state)
        params = optax.apply_updates(state.params, updates)
        params = Params(actor=self.project(params.actor), critic=self.project(params.critic))
        state = dataclasses.replace(state, params=params, opt_state=opt_state, num_updates=state.num_updates + 1)
        return state, metrics


def make(config: Config, spec: EnvSpec, networks: NetworksFn) -> DDPG:
    """Makes the learner. Raises ValueError if outputs of the networks have wrong shapes."""
    return DDPG(spec, *common.make_networks("ddpg", config, spec, networks))
