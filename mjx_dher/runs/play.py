"""Plays a policy, and sums up how its episodes went."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import stats
from mjx_dher.evaluate import evaluate
from mjx_dher.policy import Policy
from mjx_dher.rollout import Outcome, check_steps
from mjx_dher.types import Env

CHUNK = 500  # episodes at once


def play(env: Env, policy: Policy, num_episodes: int, seed: int) -> Outcome:
    """Plays `policy` in `env`; returns the outcomes [num_episodes] as NumPy arrays."""
    chunk = min(num_episodes, CHUNK)

    @jax.jit
    def run(key: jax.Array) -> Outcome:
        return evaluate(env, lambda obs: policy.forward(obs["observation"], obs["desired_goal"], jnp), key, chunk)

    keys = jax.random.split(jax.random.key(seed), -(-num_episodes // chunk))
    outcomes = [jax.device_get(run(key)) for key in keys]
    check_steps(env)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:num_episodes], *outcomes)


def summarize(success: Any, reset_success: Any, ret: Any, valid: Any = None, bad_rewards: Any = None) -> dict[str, Any]:
    """Returns the means of episodes' outcomes (arrays [N]), success with its 95 % interval (Wilson 1927).

    An episode that is not `valid` [N] counts as a failure and has no return. `bad_rewards` is not looked at.

    Raises:
      ValueError: a success that is neither 0 nor 1.
    """
    del bad_rewards
    if wrong := [float(x) for x in np.ravel((success, reset_success)) if x not in (0.0, 1.0)]:
        raise ValueError(f"success must be 0 or 1; of {np.size(success)} episodes it is {wrong[0]:g} in {len(wrong)}")
    ret = np.asarray(ret, np.float64)[slice(None) if valid is None else np.asarray(valid, bool)]
    low, high = stats.wilson_interval(int(np.sum(success)), len(success))
    return {
        "episodes": len(success),
        "success_rate": float(np.mean(success, dtype=np.float64)),
        "success_low": low,
        "success_high": high,
        "reset_success_rate": float(np.mean(reset_success, dtype=np.float64)),
        "return_mean": float(ret.mean()) if len(ret) else math.nan,
    }
