"""Deterministic evaluation of a policy: episodes, outcomes and a summary.

The trainer and compiled programs trace `evaluate`. `play_policy` evaluates a trained policy from Python, and `summarize` adds
confidence intervals. More than `CHUNK` episodes are played in chunks with different keys.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.contract import check_steps
from mjx_dher.policy import TrainedPolicy
from mjx_dher.rates import wilson_interval
from mjx_dher.rollout import Outcome, rollout
from mjx_dher.types import Array, Env, EnvSpec, GoalObs, PRNGKey, check_size

CHUNK = 500  # episodes at once


def evaluate(
    env: Env, act: Callable[[GoalObs], Array], key: PRNGKey, num_episodes: int, spec: EnvSpec | None = None
) -> Outcome:
    """Plays parallel episodes of a deterministic policy. Traceable. Returns outcomes [num_episodes].

    `act` maps observations, whose leaves lead with [num_episodes], to actions [num_episodes, A]. `key` draws the initial
    states. `spec` is as in `rollout.rollout`.
    """
    return rollout(env, lambda _, obs: act(obs), key, num_episodes, spec=spec)[1]


def play_policy(env: Env, policy: TrainedPolicy, num_episodes: int, seed: int) -> Outcome:
    """Outcomes [num_episodes], in NumPy, of a policy from `load_policy`. `seed` draws the initial states."""
    check_size("num_episodes", num_episodes)
    chunk = min(num_episodes, CHUNK)

    @jax.jit
    def play(key: PRNGKey) -> Outcome:
        return evaluate(env, lambda obs: policy.forward(obs["observation"], obs["desired_goal"], jnp), key, chunk)

    outcome = in_chunks(play, jax.random.split(jax.random.key(seed), math.ceil(num_episodes / chunk)), num_episodes)
    check_steps(env)
    return outcome


def in_chunks(
    play: Callable[[Any], Outcome], keys: Iterable[Any], num_episodes: int, fetch: Callable[[Any], Any] = jax.device_get
) -> Outcome:
    """Joins the outcomes [..., chunk] of `play(key)` for all `keys` to NumPy arrays [..., num_episodes]."""
    outcomes = [fetch(play(key)) for key in keys]
    return jax.tree.map(lambda *chunks: np.concatenate(chunks, axis=-1)[..., :num_episodes], *outcomes)


def summarize(success: Any, reset_success: Any, ret: Any, valid: Any = None) -> dict[str, Any]:
    """Means of outcomes [N], and Wilson's 95 % interval of the success rate.

    Args:
      success: success at the last step [N], 0 or 1.
      reset_success: success at the reset [N], 0 or 1.
      ret: returns [N].
      valid: mask [N]. Other episodes are discarded: they are failures and have no return. Default: all.

    Raises:
      ValueError: a success is neither 0 nor 1.
    """
    if wrong := [float(x) for x in np.ravel((success, reset_success)) if x not in (0.0, 1.0)]:
        raise ValueError(f"success must be 0 or 1; of {np.size(success)} episodes it is {wrong[0]:g} in {len(wrong)}")
    valid = np.ones(len(success), bool) if valid is None else np.asarray(valid, bool)
    ret, discarded = np.asarray(ret, np.float64)[valid], int(np.sum(~valid))
    low, high = wilson_interval(int(np.sum(success)), len(success))
    return {
        "episodes": len(success),
        "success_rate": float(np.mean(success, dtype=np.float64)),
        "success_low": low,
        "success_high": high,
        "reset_success_rate": float(np.mean(reset_success, dtype=np.float64)),
        "return_mean": float(ret.mean()) if len(ret) else math.nan,
        **({"discarded_episodes": discarded} if discarded else {}),
    }


def summary(outcome: Outcome) -> dict[str, Array]:
    """Success rates [], traced. An invalid episode counts as a failure."""
    return {"success_rate": jnp.mean(outcome.success), "reset_success_rate": jnp.mean(outcome.reset_success)}


def returns(outcome: Outcome) -> Array:
    """Sum of the valid episodes' returns, and their number, [2]."""
    return jnp.stack([jnp.sum(jnp.where(outcome.valid, outcome.ret, 0.0)), jnp.sum(outcome.valid, dtype=outcome.ret.dtype)])


def faults(outcome: Outcome) -> dict[str, Array]:
    """Fractions [] of rewards outside their range, and of successes other than 0 or 1."""
    successes = jnp.stack([outcome.success, outcome.reset_success])
    return {
        "bad_rewards": jnp.mean(outcome.bad_rewards),
        "bad_success": jnp.mean((successes != 0.0) & (successes != 1.0), dtype=jnp.float32),
    }
