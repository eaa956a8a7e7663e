"""TD3, SAC, their categorical forms, REDQ, TQC and DTQC: one update for an actor (`actors`) and several critics (`critics`).

    y = clip(r + discount (combine(Q'_1..C(s', a')) - cost(a')))
    critics: one Adam step on loss(Q_1..C(s, a), y)
    actor:   one Adam step on its own loss, every `policy_delay` critic steps

Targets, including the entropy term, are clipped to the bounds of returns (Hiraoka 2023).
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher.config import Config, HParams
from mjx_dher.learners import common, critics
from mjx_dher.learners.actors import ActorKind, Deterministic
from mjx_dher.learners.common import ActorCriticBase, Params
from mjx_dher.learners.critics import Categorical, Critics
from mjx_dher.learners.gaussian import Gaussian
from mjx_dher.networks import Heads, NetworksFn, check_heads, zeros
from mjx_dher.normalizer import NormalizerState
from mjx_dher.types import Array, Batch, EnvSpec, GoalObs, Metrics, PRNGKey, PyTree


@struct.dataclass
class ActorCriticState:
    """Learner state. The critics' parameters lead with [C]."""

    params: Params
    target: Params  # its actor is () if the target actions come from the actor itself
    actor_moments: PyTree  # Adam's
    critic_moments: PyTree
    observation_norm: PyTree  # NormalizerState [D], or a tree of them
    goal_norm: NormalizerState  # [G]
    key: Array  # key data for updates, into which their number is folded
    num_updates: Array  # [] int32


def _key_data(key: PRNGKey) -> Array:
    """Data of a learner's key, in JAX's default implementation, with which updates wrap it."""
    if jax.random.key_impl(key) != jax.random.key_impl(jax.random.key(0)):
        key = jax.random.key(jax.random.bits(key))
    return jax.random.key_data(key)


def first_state(learner: ActorCriticBase, key: PRNGKey, init_critic: Callable[..., PyTree]) -> ActorCriticState:
    """State with fresh networks, equal targets and empty normalizers.

    Args:
      init_critic: maps a key, observations, goals and actions to the critics' parameters.
    """
    actor_key, critic_key, update_key = jax.random.split(key, 3)
    observation, goal, action = zeros(learner.spec, learner.networks)
    params = Params(
        actor=learner.project(learner.actor.init(learner.networks.actor, actor_key, observation, goal)),
        critic=learner.project(init_critic(critic_key, observation, goal, action)),
    )
    return ActorCriticState(
        params=params,
        target=jax.tree.map(jnp.copy, learner.lagging(params)),
        actor_moments=common.adam(0.0).init(params.actor),
        critic_moments=common.adam(0.0).init(params.critic),
        key=_key_data(update_key),
        num_updates=jnp.zeros((), jnp.int32),
        **learner.normalizers(),
    )


@dataclasses.dataclass(frozen=True)
class ActorCritic(ActorCriticBase):
    """Learner with pure functions of an `ActorCriticState`. `learners.Learner` documents the methods."""

    critics: Critics = dataclasses.field(kw_only=True)
    policy_delay: int = 1

    def init(self, key: PRNGKey) -> ActorCriticState:
        return first_state(self, key, functools.partial(self.critics.init, self.networks.critic))

    def value(self, state: ActorCriticState, obs: GoalObs, action: Array, hparams: HParams) -> Array:
        """Value [...] of actions [..., A] by the critics."""
        inputs = *self.normalize(state, obs["observation"], obs["desired_goal"], hparams), action
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[action.ndim - 1 :]), inputs)
        judges = self.critics.judges(state.params.critic)
        return self.critics.judge(self.returns(judges, hparams, *flat)).reshape(action.shape[:-1])

    def returns(self, params: PyTree, hparams: HParams, *inputs: PyTree) -> Array:
        """Estimated returns [C, B, K] by critics with `params`, of normalized observations and goals, and actions."""
        outputs = critics.values(self.learning.critic, params, *inputs)
        return self.critics.returns(outputs, *self.return_bounds(hparams))

    def update(
        self, state: ActorCriticState, batch: Batch, hparams: HParams, with_actor: bool = True
    ) -> tuple[ActorCriticState, Metrics]:
        """Takes one Adam step for the critics and then, if `with_actor`, for the actor with the updated critics."""
        batch = self.normalize_batch(state, batch, hparams)
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.num_updates)
        target_key, actor_key = jax.random.split(key)
        atoms, bounds = self.target(state, batch, hparams, target_key), self.return_bounds(hparams)

        def critic_loss(critic: PyTree) -> tuple[Array, Array]:
            outputs = critics.values(self.learning.critic, critic, batch.observation, batch.desired_goal, batch.action)
            returns = self.critics.returns(outputs, *bounds)
            return self.critics.error(outputs, atoms, *bounds), jnp.mean(returns)

        critic, critic_moments, loss, q_mean = self.descend(
            critic_loss, state.params.critic, state.critic_moments, hparams.critic_lr, hparams
        )
        state = dataclasses.replace(
            state,
            params=dataclasses.replace(state.params, critic=critic),
            critic_moments=critic_moments,
            num_updates=state.num_updates + 1,
        )
        metrics = {"critic_loss": loss, "q_mean": q_mean}
        if not with_actor:
            return state, metrics
        state, more = self._update_actor(state, batch, hparams, actor_key)
        return state, metrics | more

    def target(self, state: ActorCriticState, batch: Batch, hparams: HParams, key: PRNGKey) -> Array:
        """Atoms [B, K] of the critics' target for a normalized batch."""
        action_key, combine_key = jax.random.split(key)
        params = state.target.actor if self.actor.has_target else state.params.actor
        inputs, normal = (batch.next_observation, batch.desired_goal), self.normal(action_key, batch.action.shape)
        action, cost = self.actor.next_action(self.learning.actor, params, *inputs, normal, hparams)
        following = self.returns(state.target.critic, hparams, *inputs, action)
        future = (self.critics.combine(following, combine_key) - cost[:, None]).T  # [K, B]
        return jnp.clip(batch.reward + batch.discount * future, *self.return_bounds(hparams)).T

    def _update_actor(
        self, state: ActorCriticState, batch: Batch, hparams: HParams, key: PRNGKey
    ) -> tuple[ActorCriticState, Metrics]:
        inputs, normal = (batch.observation, batch.desired_goal), self.normal(key, batch.action.shape)
        judges = self.critics.judges(state.params.critic)

        def judge(action: Array) -> Array:
            return self.critics.judge(self.returns(judges, hparams, *inputs, action))

        def actor_loss(actor: PyTree) -> tuple[Array, Metrics]:
            return self.actor.loss(self.learning.actor, actor, *inputs, judge, normal, hparams)

        actor, moments, loss, metrics = self.descend(
            actor_loss, state.params.actor, state.actor_moments, hparams.actor_lr, hparams
        )
        state = dataclasses.replace(state, params=dataclasses.replace(state.params, actor=actor), actor_moments=moments)
        return state, {"actor_loss": loss, **metrics}


def _make(name: str, config: Config, spec: EnvSpec, networks: NetworksFn, actor: ActorKind, parts: Critics) -> ActorCritic:
    check_heads(networks, name)
    if isinstance(parts, Categorical) and not all(map(math.isfinite, spec.reward_range)):
        raise ValueError(f"reward_range must be finite for learner {name}, which classifies returns; got {spec.reward_range}")
    heads = Heads(gaussian=actor.is_gaussian, critic_size=parts.size)
    acting, learning = common.make_networks(name, config, spec, networks, heads)
    resets = common.reset_period(config)
    return ActorCritic(spec, acting, learning, actor, reset_every=resets, critics=parts, policy_delay=config.policy_delay)


def td3(config: Config, spec: EnvSpec, networks: NetworksFn) -> ActorCritic:
    """TD3 (Fujimoto et al. 2018): the smaller of two critics as the target, target smoothing, a delayed actor.

    y = r + gamma min_i Q'_i(s', clip(pi'(s') + clip(eps, -c, c)))  (equations 10 and 14)
    critics: mean (Q_i(s, a) - y)^2;  actor: -mean Q_1(s, pi(s))
    """
    parts = Critics(config.num_critics, 1, critics.smallest, critics.squared_error, critics.lowest, num_judges=1)
    return _make("td3", config, spec, networks, Deterministic(), parts)


def sac(config: Config, spec: EnvSpec, networks: NetworksFn) -> ActorCritic:
    """SAC (Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications"), with a learned entropy weight.

    y = r + gamma (min_i Q'_i(s', a') - alpha log pi(a'|s')),  a' ~ pi(s')  (equations 2, 3 and 5)
    critics: mean (Q_i(s, a) - y)^2;  actor: mean(alpha log pi(a|s) - min_i Q_i(s, a))
    """
    parts = Critics(config.num_critics, 1, critics.smallest, critics.squared_error, critics.lowest)
    return _make("sac", config, spec, networks, Gaussian(), parts)


def csac(config: Config, spec: EnvSpec, networks: NetworksFn) -> ActorCritic:
    """SAC with critics that classify the return into `num_bins` values (`Categorical`)."""
    return _make("csac", config, spec, networks, Gaussian(), _bins(config))


def ctd3(config: Config, spec: EnvSpec, networks: NetworksFn) -> ActorCritic:
    """TD3 with critics that classify the return into `num_bins` values (`Categorical`)."""
    return _make("ctd3", config, spec, networks, Deterministic(), dataclasses.replace(_bins(config), num_judges=1))


def _bins(config: Config) -> Critics:
    return Categorical(config.num_critics, config.num_bins, critics.smallest, critics.two_hot, critics.lowest)


def redq(config: Config, spec: EnvSpec, networks: NetworksFn) -> ActorCritic:
    """REDQ (Chen et al. 2021): SAC with many critics and targets from `subset_critics` random ones.

    y = r + gamma (min_{i in M} Q'_i(s', a') - alpha log pi(a'|s'))  (algorithm 1)
    critics: mean (Q_i(s, a) - y)^2;  actor: mean(alpha log pi(a|s) - mean_i Q_i(s, a))
    The paper uses 10 critics, subsets of 2, and 20 updates per step.
    """
    if config.subset_critics > config.num_critics:
        raise ValueError(f"subset_critics must be at most num_critics ({config.num_critics}); got {config.subset_critics}")
    combine = critics.smallest_of(config.subset_critics)
    parts = Critics(config.num_critics, 1, combine, critics.squared_error, critics.mean)
    return _make("redq", config, spec, networks, Gaussian(), parts)


def tqc(config: Config, spec: EnvSpec, networks: NetworksFn) -> ActorCritic:
    """TQC (Kuznetsov et al. 2020): SAC with quantile critics, whose largest quantiles are dropped from the target.

    y_k = r + gamma (z_k(s', a') - alpha log pi(a'|s')),  z_1 <= z_2 <= ... the pooled quantiles without the largest
    critics: the quantile Huber loss (equation 12);  actor: mean(alpha log pi(a|s) - the mean of all quantiles)
    The paper uses 5 critics with 25 quantiles each, and drops 2 of each.
    """
    return _make("tqc", config, spec, networks, Gaussian(), _quantiles(config))


def dtqc(config: Config, spec: EnvSpec, networks: NetworksFn) -> ActorCritic:
    """TQC's critics with TD3's deterministic actor and exploration noise."""
    return _make("dtqc", config, spec, networks, Deterministic(), _quantiles(config))


def _quantiles(config: Config) -> Critics:
    if config.dropped_quantiles >= config.num_quantiles:
        raise ValueError(
            f"dropped_quantiles must be less than num_quantiles ({config.num_quantiles}); got {config.dropped_quantiles}"
        )
    combine = critics.truncated(config.dropped_quantiles)
    return Critics(config.num_critics, config.num_quantiles, combine, critics.quantile_huber, critics.mean)
