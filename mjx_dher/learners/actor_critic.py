"""An actor and several critics, as values: the update that td3, sac, tqc, redq and dtqc share.

    y = clip(r + gamma (combine(Q'_1..C(s', a')) - cost(a')), -1/(1-gamma), 0)
    critics: one step of Adam down loss(Q_1..C(s, a), y)
    actor:   one step of Adam down its own loss, once every `policy_delay` steps of the critics

The bounds are those of returns whose rewards lie in [-1, 0], for entropy's pay, too (Hiraoka 2023).
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_dher import normalizer
from mjx_dher.config import Config, HParams
from mjx_dher.learners import common, critics
from mjx_dher.learners.actors import ActorKind
from mjx_dher.learners.common import Params
from mjx_dher.learners.critics import Critics
from mjx_dher.networks import Heads, Networks, NetworksFn, check_heads, check_outputs
from mjx_dher.normalizer import NormalizerState
from mjx_dher.parallel.split import ALONE, Split
from mjx_dher.policy import Policy, from_mlp
from mjx_dher.types import Array, Batch, GoalObs, Metrics, PRNGKey, PyTree, Sizes


@struct.dataclass
class ActorCriticState:
    """Everything that learning changes. The critics' parameters lead with [C]."""

    params: Params
    target: Params  # its actor is () where targets take their actions from the actor itself
    actor_moments: PyTree  # Adam's
    critic_moments: PyTree
    observation_norm: NormalizerState  # [D]
    goal_norm: NormalizerState  # [G]
    key: Array  # data of the key that updates draw from, with their number
    num_updates: Array  # [] int32


@dataclasses.dataclass(frozen=True)
class ActorCritic:
    """The learner: pure functions of an `ActorCriticState`. `learners.Learner` says what each does."""

    sizes: Sizes
    networks: Networks  # float32; these play
    learning: Networks  # of the learner's dtype, with the same parameters; these learn
    actor: ActorKind
    critics: Critics
    policy_delay: int = 1  # steps of the critics for one of the actor
    split: Split = ALONE
    uses_discount: ClassVar[bool] = True

    def init(self, key: PRNGKey) -> ActorCriticState:
        """Makes fresh networks, targets equal to them, and empty normalizers."""
        actor_key, critic_key, update_key = jax.random.split(key, 3)
        params = Params(
            actor=self.actor.init(self.networks.actor, actor_key, self.sizes),
            critic=self.critics.init(self.networks.critic, critic_key, self.sizes),
        )
        return ActorCriticState(
            params=params,
            target=jax.tree.map(jnp.copy, self._lagging(params)),
            actor_moments=common.adam().init(params.actor),
            critic_moments=common.adam().init(params.critic),
            observation_norm=normalizer.init(self.sizes.observation),
            goal_norm=normalizer.init(self.sizes.goal),
            key=jax.random.key_data(update_key),
            num_updates=jnp.zeros((), jnp.int32),
        )

    def _lagging(self, params: Params) -> Params:
        return params if self.actor.has_target else Params(actor=(), critic=params.critic)

    def split_over(self, split: Split) -> ActorCritic:
        """Returns the learner of a run in parts: gradients and the normalizers' moments are those of all of them."""
        return dataclasses.replace(self, split=split, actor=self.actor.split_over(split))

    def update_normalizers(
        self, state: ActorCriticState, observation: Array, goal: Array, hparams: HParams, valid: Array | None = None
    ) -> ActorCriticState:
        """Takes new observations and goals into the normalizers."""
        return common.update_normalizers(state, observation, goal, hparams, valid, self.split)

    def act(self, state: ActorCriticState, obs: GoalObs, hparams: HParams) -> Array:
        """Returns the deterministic policy's actions [..., A] in [-1, 1]."""
        return self.actor.act(self.networks.actor, state.params.actor, *common.normalize_obs(state, obs, hparams))

    def value(self, state: ActorCriticState, obs: GoalObs, action: Array, hparams: HParams) -> Array:
        """Returns what the critics, as judges of the actor, say [...] of actions [..., A]."""
        observation, goal = common.normalize_obs(state, obs, hparams)
        flat = [x.reshape(-1, x.shape[-1]) for x in (observation, goal, action)]
        judges = self.critics.judges(state.params.critic)
        return self.critics.judge(critics.values(self.networks.critic, judges, *flat)).reshape(action.shape[:-1])

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, hparams: HParams) -> common.Noise:
        """Draws what `explore` takes; leaves lead with [T, N]."""
        return self.actor.noise(key, num_steps, num_envs, self.sizes.action, hparams)

    def explore(self, state: ActorCriticState, obs: GoalObs, noise: common.Noise, hparams: HParams) -> Array:
        """Returns the exploring policy's actions [N, A] under the noise of one step."""
        inputs = common.normalize_obs(state, obs, hparams)
        return self.actor.explore(self.networks.actor, state.params.actor, *inputs, noise)

    def update(self, state: ActorCriticState, batch: Batch, hparams: HParams) -> tuple[ActorCriticState, Metrics]:
        """Takes one step of Adam for the critics, and then for the actor, whose judge they are. Targets stay as they are."""
        return self._update(state, batch, hparams, with_actor=True)

    def update_critic(self, state: ActorCriticState, batch: Batch, hparams: HParams) -> tuple[ActorCriticState, Metrics]:
        """Takes one step of Adam for the critics alone."""
        return self._update(state, batch, hparams, with_actor=False)

    def _update(
        self, state: ActorCriticState, batch: Batch, hparams: HParams, with_actor: bool
    ) -> tuple[ActorCriticState, Metrics]:
        batch = common.normalize_batch(state, batch, hparams)
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.num_updates)
        target_key, actor_key = jax.random.split(key)
        atoms = self.target(state, batch, hparams, target_key)
        (loss, q_mean), gradient = jax.value_and_grad(self._critic_loss, has_aux=True)(state.params.critic, batch, atoms)
        direction, critic_moments = common.adam(hparams).update(self.split.mean(gradient), state.critic_moments)
        critic = jax.tree.map(lambda p, d: p - hparams.critic_lr * d, state.params.critic, direction)
        metrics = {"critic_loss": loss, "q_mean": q_mean}
        state = dataclasses.replace(
            state,
            params=dataclasses.replace(state.params, critic=critic),
            critic_moments=critic_moments,
            num_updates=state.num_updates + 1,
        )
        return self._update_actor(state, batch, hparams, actor_key, metrics) if with_actor else (state, metrics)

    def target(self, state: ActorCriticState, batch: Batch, hparams: HParams, key: PRNGKey) -> Array:
        """Returns the atoms [B, K] of the critics' target; `batch` is normalized.

        Episodes end by the clock alone, so every next state has a value.
        """
        action_key, combine_key = jax.random.split(key)
        params = state.target.actor if self.actor.has_target else state.params.actor
        inputs = batch.next_observation, batch.desired_goal
        action, cost = self.actor.next_action(self.learning.actor, params, *inputs, action_key, hparams)
        following = critics.values(self.learning.critic, state.target.critic, *inputs, action)
        future = (self.critics.combine(following, combine_key) - cost[:, None]).T  # [K, B]
        target = batch.reward + common.discount(batch, hparams) * future
        return jnp.clip(target, -1.0 / (1.0 - hparams.gamma), 0.0).T

    def _critic_loss(self, critic: PyTree, batch: Batch, atoms: Array) -> tuple[Array, Array]:
        values = critics.values(self.learning.critic, critic, batch.observation, batch.desired_goal, batch.action)
        return self.critics.loss(values, atoms), jnp.mean(values)

    def _update_actor(
        self, state: ActorCriticState, batch: Batch, hparams: HParams, key: PRNGKey, metrics: Metrics
    ) -> tuple[ActorCriticState, Metrics]:
        inputs, judges = (batch.observation, batch.desired_goal), self.critics.judges(state.params.critic)

        def judge(action: Array) -> Array:
            return self.critics.judge(critics.values(self.learning.critic, judges, *inputs, action))

        def loss_of(actor: PyTree) -> tuple[Array, Metrics]:
            return self.actor.loss(self.learning.actor, actor, *inputs, judge, key, hparams)

        (loss, more), gradient = jax.value_and_grad(loss_of, has_aux=True)(state.params.actor)
        direction, moments = common.adam(hparams).update(self.split.mean(gradient), state.actor_moments)
        actor = jax.tree.map(lambda p, d: p - hparams.actor_lr * d, state.params.actor, direction)
        state = dataclasses.replace(state, params=dataclasses.replace(state.params, actor=actor), actor_moments=moments)
        return state, {**metrics, "actor_loss": loss, **more}

    def update_target(self, state: ActorCriticState, hparams: HParams) -> ActorCriticState:
        """Moves the targets softly: they keep a fraction `polyak` of themselves and take the rest from the networks."""
        target = optax.incremental_update(self._lagging(state.params), state.target, 1.0 - hparams.polyak)
        return dataclasses.replace(state, target=target)

    def summary(self, state: ActorCriticState) -> Metrics:
        """Returns the Euclidean norms of all parameters: actor_norm and critic_norm."""
        return {"actor_norm": optax.tree.norm(state.params.actor), "critic_norm": optax.tree.norm(state.params.critic)}

    def export(self, state: ActorCriticState, hparams: HParams) -> Policy | None:
        """Returns the deterministic policy as NumPy arrays; None for networks of one's own, which NumPy cannot compute."""
        dense = self.actor.dense(self.networks.actor, state.params.actor)
        return None if dense is None else from_mlp(dense, state.observation_norm, state.goal_norm, hparams)


def make(name: str, config: Config, sizes: Sizes, networks: NetworksFn, actor: ActorKind, parts: Critics) -> ActorCritic:
    """Makes the learner called `name`, after `config`: its dtype, and its `policy_delay` where it has one.

    Raises:
      ValueError: networks without the outputs that it needs, or kernels, which compute ddpg alone.
    """
    if config.learner_kernels == "hopper":
        raise ValueError(f"learner_kernels hopper computes learner ddpg; it is {name}")
    check_heads(networks, name)
    heads = Heads(gaussian=actor.is_gaussian, critic_size=parts.size)
    playing, learning = (
        networks(sizes.action, config.hidden_sizes, dtype, heads) for dtype in ("float32", config.learner_dtype)
    )
    check_outputs(name, playing, sizes, heads)
    return ActorCritic(sizes, playing, learning, actor, parts, config.policy_delay)
