"""What the built-in learners share: normalized inputs, acting, moving targets, and exporting the policy."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_dher import normalizer
from mjx_dher.config import HParams
from mjx_dher.learners import Learner
from mjx_dher.learners.actors import ActorKind, Deterministic, Noise
from mjx_dher.networks import Networks
from mjx_dher.normalizer import NormalizerState
from mjx_dher.policy import Policy, from_mlp
from mjx_dher.types import Array, Batch, GoalObs, Metrics, PRNGKey, PyTree, Sizes

State = TypeVar("State", bound=Any)  # has params, target, observation_norm and goal_norm
Tree = TypeVar("Tree", bound=Any)


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


def adam(learning_rate: Any, eps: Any = 1e-8) -> optax.GradientTransformation:
    """Adam, with a learning rate that may be traced: one number, or a tree with one for each subtree of the parameters.

    Its state is that of `optax.scale_by_adam`; `optax.adam` would wrap it in a tuple, and older checkpoints could not be read.
    """
    moments = optax.scale_by_adam(eps=eps)

    def update(gradients: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        directions, state = moments.update(gradients, state, params)
        scale = lambda rate, subtree: jax.tree.map(lambda d: -rate * d, subtree)  # noqa: E731
        return jax.tree.map(scale, learning_rate, directions), state

    return optax.GradientTransformation(moments.init, update)


@dataclasses.dataclass(frozen=True)
class ActorCriticBase(Learner):
    """A learner with an actor, a critic, their targets and normalizers. Subclasses add `init`, `update` and `value`."""

    sizes: Sizes
    networks: Networks  # float32; used to act
    learning: Networks  # in the learner's dtype, with the same parameters; used in updates
    actor: ActorKind = dataclasses.field(default_factory=Deterministic)
    axis_name: str | None = None  # mapped axis of the devices that one run is split over

    def update_normalizers(
        self, state: State, observation: Array, goal: Array, hparams: HParams, valid: Array | None = None
    ) -> State:
        """Adds observations [N, T+1, D], where `valid` [N] or [N, T+1] is true, and goals [B, G] to the normalizers."""
        if valid is not None:
            valid = valid.reshape(*valid.shape, *(1,) * (observation.ndim - 1 - valid.ndim))
        any_valid = None if valid is None else jnp.any(valid)
        clip, axis = hparams.obs_clip, self.axis_name
        return dataclasses.replace(
            state,
            observation_norm=normalizer.update(state.observation_norm, observation, clip, valid, axis),
            goal_norm=normalizer.update(state.goal_norm, goal, clip, any_valid, axis),
        )

    def act(self, state: State, obs: GoalObs, hparams: HParams) -> Array:
        """Deterministic policy's actions [..., A]."""
        return self.actor.act(self.networks.actor, state.params.actor, *normalize_obs(state, obs, hparams))

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, hparams: HParams) -> Noise:
        """Exploration noise of `num_envs` episodes; leaves lead with [T, N]."""
        return self.actor.noise(key, num_steps, num_envs, self.sizes.action, hparams)

    def explore(self, state: State, obs: GoalObs, noise: Noise, hparams: HParams) -> Array:
        """Exploring policy's actions [N, A]."""
        inputs = normalize_obs(state, obs, hparams)
        return self.actor.explore(self.networks.actor, state.params.actor, *inputs, noise)

    def lagging(self, params: Params) -> Params:
        """Those of `params` that have a target."""
        return params if self.actor.has_target else Params(actor=(), critic=params.critic)

    def update_target(self, state: State, hparams: HParams) -> State:
        """Moves the targets softly: they keep a fraction `polyak` of themselves and take the rest from the networks."""
        target = optax.incremental_update(self.lagging(state.params), state.target, 1.0 - hparams.polyak)
        return dataclasses.replace(state, target=target)

    def summary(self, state: State) -> Metrics:
        """Euclidean norms of all parameters: actor_norm and critic_norm."""
        return {"actor_norm": optax.tree.norm(state.params.actor), "critic_norm": optax.tree.norm(state.params.critic)}

    def export(self, state: State, hparams: HParams) -> Policy | None:
        """Deterministic policy as NumPy arrays, or None for custom networks."""
        dense = self.actor.dense(self.networks.actor, state.params.actor)
        return None if dense is None else from_mlp(dense, state.observation_norm, state.goal_norm, hparams)

    def mean(self, gradients: Tree) -> Tree:
        """Mean of the gradients over the devices of a split run."""
        return gradients if self.axis_name is None else jax.lax.pmean(gradients, self.axis_name)

    def normal(self, key: PRNGKey, shape: tuple[int, ...]) -> Array:
        """Standard normal numbers of `shape` [B, ...]: in a split run, this device's rows of those for all devices."""
        if self.axis_name is None:
            return jax.random.normal(key, shape, jnp.float32)
        whole = jax.random.normal(key, (shape[0] * jax.lax.axis_size(self.axis_name), *shape[1:]), jnp.float32)
        return jax.lax.dynamic_slice_in_dim(whole, jax.lax.axis_index(self.axis_name) * shape[0], shape[0])


def normalize(state: NormalizerState, values: Array, hparams: HParams) -> Array:
    """Normalized, clipped `values` [..., D]."""
    return normalizer.normalize(state, values, hparams.norm_eps, hparams.norm_clip, hparams.obs_clip)


def normalize_obs(state: Any, obs: GoalObs, hparams: HParams) -> tuple[Array, Array]:
    """Normalized observation [..., D] and desired goal [..., G] of `obs`."""
    observation = normalize(state.observation_norm, obs["observation"], hparams)
    return observation, normalize(state.goal_norm, obs["desired_goal"], hparams)


def normalize_batch(state: Any, batch: Batch, hparams: HParams) -> Batch:
    """`batch` with normalized observations and goals."""
    return dataclasses.replace(
        batch,
        observation=normalize(state.observation_norm, batch.observation, hparams),
        next_observation=normalize(state.observation_norm, batch.next_observation, hparams),
        desired_goal=normalize(state.goal_norm, batch.desired_goal, hparams),
    )
