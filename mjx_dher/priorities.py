"""Priorities: how much likelier than others an episode is drawn from replay, for `priority_fraction` of each batch.

A priority is a pure function of one whole episode to a weight, 0 or more:

    priority(episode, compute_reward, hparams) -> []

The ring stores each episode's weight with it; `replay.draw_rows` draws episodes in proportion to their weights.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from mjx_dher import names, replay
from mjx_dher.config import HParams
from mjx_dher.spec import PRIORITIES
from mjx_dher.types import Array, Episode, RewardFn

# priority(episode, compute_reward, hparams) -> weight [], 0 or more
PriorityFn = Callable[[Episode, RewardFn, HParams], Array]


def eventful(episode: Episode, compute_reward: RewardFn, hparams: HParams) -> Array:
    """Returns 1.0 for an episode whose last achieved goal, as a goal, was not yet reached at its start; else 0.0.

    In all other episodes the hindsight goals are much the same, reached from the first step on, and say nothing of how to
    reach any. Asking the environment's own (sparse) reward needs no scale and no threshold. Cf. the filter for misleading
    samples of Manela & Biess 2021 and the energy-based prioritization of Zhao & Tresp 2018.
    """
    del hparams
    return (compute_reward(episode.achieved_goal[0], episode.achieved_goal[-1]) < 0).astype(jnp.float32)


def make(name: str | PriorityFn) -> PriorityFn:
    """Returns the priority called `name`, a function of one's own, or the one that "module:attribute" names.

    Raises:
      ValueError: no such priority, module or attribute, or no function of (episode, compute_reward, hparams).
    """
    return names.resolve("priority", name, PRIORITIES, ("episode", "compute_reward", "hparams"))


def weights(priority: PriorityFn, episodes: Episode, compute_reward: RewardFn, hparams: HParams) -> Array:
    """Returns the weight [N] of each of N episodes (leaves lead with [N]), float32; what is not a positive, finite number is 0.

    Raises:
      ValueError: the priority gives no scalar, or no real number.
    """
    weight = jax.vmap(lambda episode: priority(episode, compute_reward, hparams))(episodes)
    if not isinstance(weight, jax.Array) or weight.ndim != 1:
        given = list(weight.shape[1:]) if isinstance(weight, jax.Array) else f"a {type(weight).__name__}"
        raise ValueError(f"a priority gives one weight [] for an episode; this one gives {given}")
    return replay.as_priority(weight)
