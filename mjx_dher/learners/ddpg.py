"""DDPG (Lillicrap et al. 2016) as HER uses it (Andrychowicz et al. 2017): losses, one update, and how to act."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import ClassVar, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_dher import normalizer
from mjx_dher.config import Config, HParams
from mjx_dher.learners import common
from mjx_dher.learners.common import Losses, Params
from mjx_dher.networks import Actor, Critic, Networks, NetworksFn, check_outputs
from mjx_dher.normalizer import NormalizerState
from mjx_dher.parallel.split import ALONE, Split
from mjx_dher.policy import Policy, from_mlp
from mjx_dher.types import Array, Batch, GoalObs, Metrics, PRNGKey, PyTree, Sizes


@struct.dataclass
class DDPGState:
    """Everything that learning changes."""

    params: Params
    target: Params
    opt_state: PyTree  # Adam's moments, of both networks
    observation_norm: NormalizerState  # [D]
    goal_norm: NormalizerState  # [G]
    num_updates: Array  # [] int32


# compute_gradients(networks, params, target params, normalized batch, hparams) -> gradients, losses
GradientFn = Callable[[Networks, Params, Params, Batch, HParams], tuple[Params, Losses]]


def target_value(networks: Networks, target: Params, batch: Batch, hparams: HParams) -> Array:
    """Returns [B] reward + gamma Q'(s', pi'(s')), clipped to what returns can be: [-1/(1-gamma), 0]. `batch` is normalized.

    Episodes end by the clock alone, so every next state has a value.
    """
    next_action = _pi(networks, target.actor, batch.next_observation, batch.desired_goal)
    next_q = _q(networks, target.critic, batch.next_observation, batch.desired_goal, next_action)
    return jnp.clip(batch.reward + common.discount(batch, hparams) * next_q, -1.0 / (1.0 - hparams.gamma), 0.0)


def critic_loss(networks: Networks, critic: PyTree, batch: Batch, target: Array) -> tuple[Array, Array]:
    """Returns the mean squared difference of Q to `target` [B], and the mean Q. `batch` is normalized."""
    q = _q(networks, critic, batch.observation, batch.desired_goal, batch.action)
    return jnp.mean(jnp.square(q - target)), jnp.mean(q)


def actor_loss(networks: Networks, actor: PyTree, critic: PyTree, batch: Batch, hparams: HParams) -> Array:
    """Returns minus the mean Q of the policy's actions plus `action_l2` times their mean square. `batch` is normalized."""
    action = _pi(networks, actor, batch.observation, batch.desired_goal)
    q = _q(networks, critic, batch.observation, batch.desired_goal, action)
    return -jnp.mean(q) + hparams.action_l2 * jnp.mean(jnp.square(action))


def compute_gradients(
    networks: Networks, params: Params, target: Params, batch: Batch, hparams: HParams
) -> tuple[Params, Losses]:
    """Computes the gradients of both losses, each by its own network's parameters. `batch` is normalized."""
    value = target_value(networks, target, batch, hparams)
    (c_loss, q_mean), c_grad = jax.value_and_grad(lambda critic: critic_loss(networks, critic, batch, value), has_aux=True)(
        params.critic
    )
    a_loss, a_grad = jax.value_and_grad(lambda actor: actor_loss(networks, actor, params.critic, batch, hparams))(params.actor)
    return Params(actor=a_grad, critic=c_grad), Losses(critic_loss=c_loss, actor_loss=a_loss, q_mean=q_mean)


@dataclasses.dataclass(frozen=True)
class DDPG:
    """The learner: pure functions of a `DDPGState`. `learners.Learner` says what each does."""

    sizes: Sizes
    networks: Networks  # float32; these play
    learning: Networks  # of the learner's dtype, with the same parameters; these learn
    compute_gradients: GradientFn = compute_gradients  # what kernels may replace
    split: Split = ALONE
    uses_discount: ClassVar[bool] = True

    def init(self, key: PRNGKey) -> DDPGState:
        """Makes fresh networks, targets equal to them, and empty normalizers."""
        actor_key, critic_key = jax.random.split(key)
        obs, goal, action = (jnp.zeros(size) for size in self.sizes)
        params = Params(
            actor=self.networks.actor.init(actor_key, obs, goal),
            critic=self.networks.critic.init(critic_key, obs, goal, action),
        )
        return DDPGState(
            params=params,
            target=jax.tree.map(jnp.copy, params),
            opt_state=common.adam().init(params),
            observation_norm=normalizer.init(self.sizes.observation),
            goal_norm=normalizer.init(self.sizes.goal),
            num_updates=jnp.zeros((), jnp.int32),
        )

    def split_over(self, split: Split) -> DDPG:
        """Returns the learner of a run in parts: gradients and the normalizers' moments are those of all of them."""
        return dataclasses.replace(self, split=split)

    def update_normalizers(
        self, state: DDPGState, observation: Array, goal: Array, hparams: HParams, valid: Array | None = None
    ) -> DDPGState:
        """Takes new observations and goals into the normalizers."""
        return common.update_normalizers(state, observation, goal, hparams, valid, self.split)

    def act(self, state: DDPGState, obs: GoalObs, hparams: HParams) -> Array:
        """Returns the policy's actions [..., A] in [-1, 1], without exploration."""
        return _pi(self.networks, state.params.actor, *common.normalize_obs(state, obs, hparams))

    def value(self, state: DDPGState, obs: GoalObs, action: Array, hparams: HParams) -> Array:
        """Returns Q [...] of actions [..., A]."""
        return _q(self.networks, state.params.critic, *common.normalize_obs(state, obs, hparams), action)

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, hparams: HParams) -> common.Noise:
        """Draws what `explore` takes; leaves lead with [T, N]."""
        return common.exploration_noise(key, num_steps, num_envs, self.sizes.action, hparams)

    def explore(self, state: DDPGState, obs: GoalObs, noise: common.Noise, hparams: HParams) -> Array:
        """Returns the exploring policy's actions [N, A] under the noise of one step."""
        return common.add_noise(noise, self.act(state, obs, hparams))

    def update(self, state: DDPGState, batch: Batch, hparams: HParams) -> tuple[DDPGState, Metrics]:
        """Takes one step of Adam for critic and actor, both from the parameters before it. Targets stay as they are."""
        params = state.params
        normalized = common.normalize_batch(state, batch, hparams)
        grads, losses = self.compute_gradients(self.learning, params, state.target, normalized, hparams)
        direction, opt_state = common.adam(hparams).update(self.split.mean(grads), state.opt_state)
        params = Params(
            actor=jax.tree.map(lambda p, d: p - hparams.actor_lr * d, params.actor, direction.actor),
            critic=jax.tree.map(lambda p, d: p - hparams.critic_lr * d, params.critic, direction.critic),
        )
        state = dataclasses.replace(state, params=params, opt_state=opt_state, num_updates=state.num_updates + 1)
        return state, losses._asdict()

    def update_target(self, state: DDPGState, hparams: HParams) -> DDPGState:
        """Moves the targets softly: they keep a fraction `polyak` of themselves and take the rest from the networks."""
        target = optax.incremental_update(state.params, state.target, 1.0 - hparams.polyak)
        return dataclasses.replace(state, target=target)

    def summary(self, state: DDPGState) -> Metrics:
        """Returns the Euclidean norms of all parameters: actor_norm and critic_norm."""
        return {"actor_norm": optax.tree.norm(state.params.actor), "critic_norm": optax.tree.norm(state.params.critic)}

    def export(self, state: DDPGState, hparams: HParams) -> Policy | None:
        """Returns the policy as NumPy arrays; None for networks of one's own, which NumPy cannot compute."""
        if not isinstance(self.networks.actor, Actor):
            return None
        return from_mlp(state.params.actor["params"], state.observation_norm, state.goal_norm, hparams)


def make(config: Config, sizes: Sizes, networks: NetworksFn) -> DDPG:
    """Makes the learner, with the gradients that `config.learner_kernels` asks for.

    Raises:
      ValueError: kernels that cannot compute this run's gradients, or networks that give the wrong shapes.
    """
    playing, learning = (networks(sizes.action, config.hidden_sizes, dtype) for dtype in ("float32", config.learner_dtype))
    check_outputs("ddpg", playing, sizes)
    return DDPG(sizes, playing, learning, _choose_gradients(config, sizes, playing))


def _choose_gradients(config: Config, sizes: Sizes, networks: Networks) -> GradientFn:
    if config.learner_kernels == "xla" or (config.learner_kernels == "auto" and config.learner_dtype != "bfloat16"):
        return compute_gradients
    from mjx_dher.hopper import gradients as hopper

    stock = isinstance(networks.actor, Actor) and isinstance(networks.critic, Critic)
    reason = hopper.unsupported_reason(config, sizes.observation + sizes.goal, sizes.action) if stock else "networks mlp"
    if config.learner_kernels == "hopper" and reason is not None:
        raise ValueError(f"learner_kernels hopper needs {reason}")
    return compute_gradients if reason is not None else hopper.compute_gradients


def _pi(networks: Networks, actor: PyTree, observation: Array, goal: Array) -> Array:
    return cast(Array, networks.actor.apply(actor, observation, goal))


def _q(networks: Networks, critic: PyTree, observation: Array, goal: Array, action: Array) -> Array:
    return cast(Array, networks.critic.apply(critic, observation, goal, action))
