"""Shared parts of the built-in learners: normalization, acting, target updates and export."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.flatten_util
import jax.numpy as jnp
import optax
from flax import struct

from mjx_dher import normalizer
from mjx_dher.config import Config, HParams
from mjx_dher.context import return_bounds
from mjx_dher.learners import Learner
from mjx_dher.learners.actors import ActorKind, Deterministic, Noise
from mjx_dher.networks import Heads, Networks, NetworksFn, check_outputs, concatenated, with_encoder
from mjx_dher.policy import Policy, from_mlp
from mjx_dher.types import Array, Batch, EnvSpec, GoalObs, Metrics, PRNGKey, PyTree

State = TypeVar("State", bound=Any)  # has params, target, observation_norm and goal_norm
Tree = TypeVar("Tree", bound=Any)
_RESET = 2**32 - 1  # folded into the key of new networks, because updates fold their number into the same key


@struct.dataclass
class Params:
    """Parameters of both networks."""

    actor: PyTree
    critic: PyTree


def adam(learning_rate: Any, eps: Any = 1e-8) -> optax.GradientTransformation:
    """Adam with a learning rate that may be traced: one number, or a tree with one per subtree of the parameters.

    Its state is the one of `optax.scale_by_adam`. `optax.adam` would wrap it in a tuple, which older checkpoints do not have.
    """
    moments = optax.scale_by_adam(eps=eps)

    def update(gradients: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        directions, state = moments.update(gradients, state, params)
        scale = lambda rate, subtree: jax.tree.map(lambda d: -rate * d, subtree)  # noqa: E731
        return jax.tree.map(scale, learning_rate, directions), state

    return optax.GradientTransformation(moments.init, update)


@dataclasses.dataclass(frozen=True)
class ActorCriticBase(Learner):
    """A learner with actor, critic, targets and normalizers. Subclasses add `init`, `update` and `value`."""

    spec: EnvSpec
    networks: Networks  # float32; used to act
    learning: Networks  # in the learner's dtype, with the same parameters; used in updates and for values
    actor: ActorKind = dataclasses.field(default_factory=Deterministic)
    axis_name: str | None = None  # mapped axis of the devices that share the run
    reset_every: int = 0  # updates after which networks are drawn again (`Config.reset_every`); the state then needs a `key`

    def normalizers(self) -> dict[str, PyTree]:
        """Empty normalizers of observations and goals, by their names in the state."""
        goal = jax.ShapeDtypeStruct((self.spec.goal_size,), jnp.float32)
        return {"observation_norm": normalizer.init(self.spec.observation), "goal_norm": normalizer.init(goal)}

    def update_normalizers(
        self, state: State, observation: PyTree, goal: Array, hparams: HParams, valid: Array | None = None
    ) -> State:
        """Adds goals [B, G], and observations [N, T+1, D] for which `valid` [N] or [N, T+1] is True, to the normalizers."""
        clip, any_valid = hparams.obs_clip, None if valid is None else jnp.any(valid)
        state = dataclasses.replace(
            state,
            observation_norm=normalizer.update(state.observation_norm, observation, clip, valid, self.axis_name),
            goal_norm=normalizer.update(state.goal_norm, goal, clip, any_valid, self.axis_name),
        )
        return self._reset(state) if self.reset_every else state

    def _reset(self, state: State) -> State:
        """State with new networks and Adam moments once every `reset_every` updates (Nikishin et al. 2022)."""
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), _RESET)
        fresh = self.init(jax.random.fold_in(key, state.num_updates))
        kept = {name: getattr(state, name) for name in ("observation_norm", "goal_norm", "key", "num_updates")}
        due = (state.num_updates > 0) & (state.num_updates % self.reset_every == 0)
        return jax.tree.map(lambda new, old: jnp.where(due, new, old), dataclasses.replace(fresh, **kept), state)

    def normalize(self, state: State, observation: PyTree, goal: Array, hparams: HParams) -> tuple[PyTree, Array]:
        """Inputs of the networks: normalized observations [..., D], or trees for an encoder, and goals [..., G]."""
        numbers = hparams.norm_eps, hparams.norm_clip, hparams.obs_clip
        observation = normalizer.normalize(state.observation_norm, observation, *numbers)
        goal = normalizer.normalize(state.goal_norm, goal, *numbers)
        return concatenated(observation) if self.networks.encoder is None else observation, goal

    def normalize_batch(self, state: State, batch: Batch, hparams: HParams) -> Batch:
        """Batch with normalized observations and goals."""
        observation, goal = self.normalize(state, batch.observation, batch.desired_goal, hparams)
        next_observation, _ = self.normalize(state, batch.next_observation, batch.desired_goal, hparams)
        return dataclasses.replace(batch, observation=observation, next_observation=next_observation, desired_goal=goal)

    def return_bounds(self, hparams: HParams) -> tuple[Array | float, Array | float]:
        """Lowest and highest return [] of the task, to which targets are clipped."""
        return return_bounds(self.spec.reward_range, hparams.gamma)

    def act(self, state: State, obs: GoalObs, hparams: HParams) -> Array:
        inputs = self.normalize(state, obs["observation"], obs["desired_goal"], hparams)
        return self.actor.act(self.networks.actor, state.params.actor, *inputs)

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, hparams: HParams) -> Noise:
        return self.actor.noise(key, num_steps, num_envs, self.spec.action_size, hparams)

    def explore(self, state: State, obs: GoalObs, noise: Noise, hparams: HParams) -> Array:
        inputs = self.normalize(state, obs["observation"], obs["desired_goal"], hparams)
        return self.actor.explore(self.networks.actor, state.params.actor, *inputs, noise)

    def lagging(self, params: Params) -> Params:
        """Parameters that have a target."""
        return params if self.actor.has_target else Params(actor=(), critic=params.critic)

    def update_target(self, state: State, hparams: HParams) -> State:
        """Moves the targets towards the networks. They keep a fraction `polyak` of their values."""
        target = optax.incremental_update(self.lagging(state.params), state.target, 1.0 - hparams.polyak)
        return dataclasses.replace(state, target=target)

    def summary(self, state: State) -> Metrics:
        """Euclidean norms of all parameters: actor_norm and critic_norm."""
        return {"actor_norm": optax.tree.norm(state.params.actor), "critic_norm": optax.tree.norm(state.params.critic)}

    def export(self, state: State, hparams: HParams) -> Policy | None:
        """Deterministic policy as NumPy arrays, or None for custom networks and for observations other than one vector."""
        dense = self.actor.dense(self.networks.actor, state.params.actor)
        one_vector = isinstance(self.spec.observation, jax.ShapeDtypeStruct)
        return None if dense is None or not one_vector else from_mlp(dense, state.observation_norm, state.goal_norm, hparams)

    def descend(
        self, loss: Callable[[Tree], tuple[Array, Any]], params: Tree, moments: PyTree, rate: Array | float, hparams: HParams
    ) -> tuple[Tree, PyTree, Array, Any]:
        """Takes one step of Adam down `loss`, a function of `params` that gives (loss [], more).

        Returns:
          The parameters and Adam's moments after the step, the loss before it, and the second value of `loss`.
        """
        (value, more), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        updates, moments = adam(rate, hparams.adam_eps).update(self.mean(gradient), moments)
        return self.project(optax.apply_updates(params, updates)), moments, value, more

    def project(self, params: Tree) -> Tree:
        """Parameters after `Networks.project`, if there is one."""
        return params if self.networks.project is None else self.networks.project(params)

    def mean(self, gradients: Tree) -> Tree:
        """Mean of the gradients over the devices that share the run. They exchange one array, because each takes its time."""
        if self.axis_name is None:
            return gradients
        flat, restore = jax.flatten_util.ravel_pytree(gradients)
        return restore(jax.lax.pmean(flat, self.axis_name))

    def normal(self, key: PRNGKey, shape: tuple[int, ...]) -> Array:
        """Standard normal numbers of `shape` [B, ...]. Devices that share a run get different rows of one draw."""
        if self.axis_name is None:
            return jax.random.normal(key, shape, jnp.float32)
        whole = jax.random.normal(key, (shape[0] * jax.lax.axis_size(self.axis_name), *shape[1:]), jnp.float32)
        return jax.lax.dynamic_slice_in_dim(whole, jax.lax.axis_index(self.axis_name) * shape[0], shape[0])


def reset_period(config: Config) -> int:
    """Updates between resets. Raises ValueError unless resets are due at the beginnings of cycles."""
    if config.reset_every % config.updates_per_cycle:
        raise ValueError(
            f"reset_every must be a multiple of updates_per_cycle ({config.updates_per_cycle}), or 0; got {config.reset_every}"
        )
    return config.reset_every


def make_networks(
    learner: str, config: Config, spec: EnvSpec, networks: NetworksFn, *heads: Heads
) -> tuple[Networks, Networks]:
    """Networks for acting, in float32, and for updates, in the learner's dtype. Raises ValueError if the networks cannot take
    the observations of `spec`, or their outputs have wrong shapes.
    """
    acting, learning = (
        with_encoder(networks(spec.action_size, config.hidden_sizes, dtype, *heads))
        for dtype in ("float32", config.learner_dtype)
    )
    check_outputs(learner, acting, spec, *heads)
    return acting, learning
