"""A priority and a goal generator of one's own, for any task with `with_goal`; docs/tutorial.md shows how to use them."""

import jax
import jax.numpy as jnp

from mjx_dher.context import Context
from mjx_dher.replay import ReplayState
from mjx_dher.types import Array, Episode, GoalObs, PRNGKey


def travelled(episode: Episode, context: Context) -> Array:
    """A priority: the way that the achieved goals [T+1, G] of an episode have come, []."""
    steps = episode.achieved_goal[1:] - episode.achieved_goal[:-1]
    return jnp.sum(jnp.linalg.norm(steps, axis=-1))


def halfway(key: PRNGKey, obs: GoalObs, ring: ReplayState, context: Context) -> Array:
    """A generator: goals [N, G] of which one half, at random, are only half as far away as those of the reset."""
    nearer = jax.random.bernoulli(key, 0.5, (len(obs["desired_goal"]), 1))
    return jnp.where(nearer, 0.5 * (obs["achieved_goal"] + obs["desired_goal"]), obs["desired_goal"])
