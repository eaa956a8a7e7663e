"""Contrastive RL (Eysenbach et al. 2022, arXiv 2206.07568), as in JaxGCRL (Bortkiewicz et al. 2024, arXiv 2408.11052).

    logits[i, j] = energy(phi(s_i, a_i), psi(g_j)),  g_i a goal that the episode achieved after (s_i, a_i)
    critic: mean_i (logsumexp_j logits[i, j] - logits[i, i]) + logsumexp_penalty mean_i (logsumexp_j logits[i, j])^2
    actor:  mean_i (alpha log pi(a|s_i, g) - energy(phi(s_i, a), psi(g))),  a ~ pi(s_i, g)

There are no rewards, targets or returns. With the sampler `geometric`, the best energy is, up to a function of g, the
logarithm of the discounted probability of reaching g after (s, a). The critic learns from the sampler's goals only. The actor
learns from the batch's goals: hindsight goals, and one in her_k + 1 that its episode was played for.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from mjx_dher.config import Config, HParams
from mjx_dher.learners import common
from mjx_dher.learners.actor_critic import ActorCriticState, first_state
from mjx_dher.learners.common import ActorCriticBase, Params
from mjx_dher.learners.gaussian import Gaussian
from mjx_dher.networks import Heads, NetworksFn, check_heads
from mjx_dher.types import Array, Batch, EnvSpec, Metrics, PRNGKey, PyTree

# energy(inner product, product of both squared lengths, squared distance), each of one shape
EnergyFn = Callable[[Array, Array, Array], Array]
_EPS = 1e-6  # JaxGCRL's, below roots and in quotients

_ENERGIES: dict[str, EnergyFn] = {
    "norm": lambda product, lengths, distance: -jnp.sqrt(distance + _EPS),
    "l2": lambda product, lengths, distance: -distance,
    "dot": lambda product, lengths, distance: product,
    "cosine": lambda product, lengths, distance: product / (jnp.sqrt(lengths + _EPS**2) + _EPS),
}


def _square(x: Array) -> Array:
    return jnp.sum(jnp.square(x), axis=-1)


def energy(name: str, phi: Array, psi: Array) -> Array:
    """Energies [...] of pairs phi [..., R] and psi [..., R]; `name` is one of _ENERGIES."""
    return _ENERGIES[name](jnp.sum(phi * psi, axis=-1), _square(phi) * _square(psi), _square(phi - psi))


def energies(name: str, phi: Array, psi: Array) -> Array:
    """Energies [B, B] of each phi [B, R] with each psi [B, R].

    Distances come from one matrix product, an order of magnitude faster than differences. On the diagonal, where small
    distances would cancel in the product, `energy` computes them.
    """
    product = jnp.matmul(phi, psi.T, precision=jax.lax.Precision.HIGHEST)
    rows, columns = _square(phi)[:, None], _square(psi)[None]
    distance = jnp.where(
        jnp.eye(len(phi), dtype=bool), _square(phi - psi)[:, None], jnp.maximum(rows + columns - 2.0 * product, 0.0)
    )
    return _ENERGIES[name](product, rows * columns, distance)


def info_nce(logits: Array, loss: str, penalty: Array | float) -> Array:
    """InfoNCE loss [] of logits [B, B], whose diagonal has the positive pairs; rows are actions and columns goals.

    Args:
      logits: energies; -inf for excluded pairs.
      loss: forward, backward or symmetric (`Config.contrastive_loss`).
      penalty: weight of the squared logsumexp over each row's goals.
    """
    over_goals, over_actions = jax.nn.logsumexp(logits, axis=1), jax.nn.logsumexp(logits, axis=0)
    normalizers = {"forward": over_goals, "backward": over_actions, "symmetric": over_goals + over_actions}
    pulls = 2.0 if loss == "symmetric" else 1.0
    return jnp.mean(normalizers[loss] - pulls * jnp.diag(logits)) + penalty * jnp.mean(jnp.square(over_goals))


@dataclasses.dataclass(frozen=True)
class CRL(ActorCriticBase):
    """The learner: pure functions of an `ActorCriticState` without targets. `learners.Learner` describes the methods."""

    energy: str = "norm"
    loss: str = "forward"
    mask: bool = False  # whether other goals of the same episode are excluded
    policy_delay: int = 1

    def init(self, key: PRNGKey) -> ActorCriticState:
        return first_state(self, key, self.networks.critic.init)

    def lagging(self, params: Params) -> Params:
        """Nothing: there are no targets."""
        return Params(actor=(), critic=())

    def update(
        self, state: ActorCriticState, batch: Batch, hparams: HParams, with_actor: bool = True
    ) -> tuple[ActorCriticState, Metrics]:
        """Takes one step of Adam for the critic and, `with_actor`, one for the actor, judged by the critic before it."""
        if batch.hindsight_goal is None:
            raise ValueError("hindsight_goal is missing: learner crl needs batches that `relabel.relabel` has made")
        observation, positive = self.normalize(state, batch.observation, batch.hindsight_goal, hparams)
        _, goal = self.normalize(state, batch.observation, batch.desired_goal, hparams)
        before = state.params

        def critic_loss(critic: PyTree) -> tuple[Array, Metrics]:
            logits = self.logits(critic, observation, positive, batch)
            correct = jnp.argmax(logits, axis=1) == jnp.arange(len(logits))
            metrics = {"accuracy": jnp.mean(correct, dtype=jnp.float32), "energy_mean": jnp.mean(jnp.diag(logits))}
            return info_nce(logits, self.loss, hparams.logsumexp_penalty), metrics

        critic, moments, loss, metrics = self.descend(
            critic_loss, before.critic, state.critic_moments, hparams.critic_lr, hparams
        )
        state = dataclasses.replace(state, critic_moments=moments, num_updates=state.num_updates + 1)
        metrics, actor = {"critic_loss": loss, **metrics}, before.actor
        if with_actor:
            key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.num_updates)
            normal = self.normal(key, batch.action.shape)

            def judge(action: Array) -> Array:
                return energy(self.energy, *self.learning.critic.apply(before.critic, observation, goal, action))

            def actor_loss(actor: PyTree) -> tuple[Array, Metrics]:
                return self.actor.loss(self.learning.actor, actor, observation, goal, judge, normal, hparams)

            actor, moments, loss, more = self.descend(actor_loss, before.actor, state.actor_moments, hparams.actor_lr, hparams)
            state, metrics = dataclasses.replace(state, actor_moments=moments), {**metrics, "actor_loss": loss, **more}
        return dataclasses.replace(state, params=Params(actor, critic)), metrics

    def logits(self, critic: PyTree, observation: PyTree, goal: Array, batch: Batch) -> Array:
        """Energies [B, B] of each action with each goal, of all devices in a split run. Inputs are normalized."""
        phi, psi = self.learning.critic.apply(critic, observation, goal, batch.action)
        device = jnp.zeros_like(batch.row)
        row = jnp.stack([batch.row, device], axis=-1)
        if self.axis_name is not None:
            row = row.at[:, 1].set(jax.lax.axis_index(self.axis_name))
            phi, psi, row = (jax.lax.all_gather(x, self.axis_name, tiled=True) for x in (phi, psi, row))
        logits = energies(self.energy, phi, psi)
        if not self.mask:
            return logits
        same = jnp.all(row[:, None] == row[None], axis=-1) & ~jnp.eye(len(row), dtype=bool)
        return jnp.where(same, -jnp.inf, logits)


def make(config: Config, spec: EnvSpec, networks: NetworksFn) -> CRL:
    """Makes the learner. Raises ValueError for an n_step above 1, or networks whose outputs have wrong shapes."""
    if config.n_step != 1:
        raise ValueError(f"n_step must be 1 for learner crl, which has no returns; got {config.n_step}")
    check_heads(networks, "crl")
    heads = Heads(gaussian=True, representation=config.representation_size)
    acting, learning = common.make_networks("crl", config, spec, networks, heads)
    return CRL(
        spec,
        acting,
        learning,
        Gaussian(),
        energy=config.energy,
        loss=config.contrastive_loss,
        mask=config.same_episode == "masked",
        policy_delay=config.policy_delay,
        reset_every=common.reset_period(config),
    )
