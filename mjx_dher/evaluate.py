"""Evaluation of a policy without exploration."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp

from mjx_dher.rollout import Outcome, rollout
from mjx_dher.types import Array, Env, GoalObs, PRNGKey


def evaluate(env: Env, act: Callable[[GoalObs], Array], key: PRNGKey, num_episodes: int) -> Outcome:
    """Plays a deterministic policy: `act` takes observations that lead with [num_episodes]. Returns the outcomes."""
    return rollout(env, lambda _, obs: act(obs), key, num_episodes)[1]


def summary(outcome: Outcome) -> dict[str, Array]:
    """Returns means over the episodes; all []. An episode that is not valid counts as a failure and has no return."""
    return {
        "success_rate": jnp.mean(outcome.success),
        "reset_success_rate": jnp.mean(outcome.reset_success),
        "return_mean": return_mean(outcome),
    }


def return_mean(outcome: Outcome) -> Array:
    """Returns the mean return [] of the valid episodes; NaN where there is none."""
    count = jnp.sum(outcome.valid, dtype=outcome.ret.dtype)
    total = jnp.sum(jnp.where(outcome.valid, outcome.ret, 0.0))
    return jnp.where(count > 0, total / jnp.maximum(count, 1.0), jnp.nan)


def faults(outcome: Outcome) -> dict[str, Array]:
    """Returns the shares [] of rewards outside [-1, 0] and of successes, at the end and at the reset, that are not 0 or 1."""
    successes = jnp.stack([outcome.success, outcome.reset_success])
    return {
        "bad_rewards": jnp.mean(outcome.bad_rewards),
        "bad_success": jnp.mean((successes != 0.0) & (successes != 1.0), dtype=jnp.float32),
    }
