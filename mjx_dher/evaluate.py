"""How good is the policy without exploration?"""

from __future__ import annotations

import jax.numpy as jnp

from mjx_dher import ddpg
from mjx_dher.config import HParams
from mjx_dher.ddpg import DDPGState, Networks
from mjx_dher.rollout import Outcome, rollout
from mjx_dher.types import Array, Env, GoalObs, PRNGKey


def evaluate(
    env: Env, networks: Networks, state: DDPGState, hparams: HParams, key: PRNGKey, num_episodes: int
) -> Outcome:
    """The outcomes [num_episodes] of the deterministic policy."""

    def policy(_: PRNGKey, obs: GoalObs) -> Array:
        return ddpg.act(networks, state, obs, hparams)

    return rollout(env, policy, key, num_episodes)[1]


def summary(outcome: Outcome) -> dict[str, Array]:
    """Means over the episodes; all []."""
    return {
        "success_rate": jnp.mean(outcome.success),
        "reset_success_rate": jnp.mean(outcome.reset_success),
        "return_mean": jnp.mean(outcome.ret),
    }
