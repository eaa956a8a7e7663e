"""A custom priority and a custom goal generator, for any task with `with_goal`. docs/tutorial.md shows how to use them."""

import jax
import jax.numpy as jnp

from mjx_dher.context import Context
from mjx_dher.replay import ReplayState
from mjx_dher.types import Array, Episode, GoalObs, PRNGKey


def travelled(episode: Episode, context: Context) -> Array:
    """A priority: the length [] of the path of an episode's achieved goals [T+1, G]."""
    steps = episode.achieved_goal[1:] - episode.achieved_goal[:-1]
    return jnp.sum(jnp.linalg.norm(steps, axis=-1))


def halfway(key: PRNGKey, obs: GoalObs, ring: ReplayState, context: Context) -> Array:
    """A generator: goals [N, G], a random half of them at half the distance of the reset's goals."""
    nearer = jax.random.bernoulli(key, 0.5, (len(obs["desired_goal"]), 1))
    return jnp.where(nearer, 0.5 * (obs["achieved_goal"] + obs["desired_goal"]), obs["desired_goal"])
