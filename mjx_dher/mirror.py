"""Mirror images of transitions (Lin et al. 2020, "Invariant Transform Experience Replay", arXiv 1909.10707)."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp

from mjx_dher import check
from mjx_dher.types import Array, Batch, MirrorFn, PRNGKey


def of_env(env: Any) -> MirrorFn:
    """The method `mirror` of an environment. Raises ValueError if it has none."""
    if not callable(mirror := getattr(env, "mirror", None)):
        raise ValueError(f"augmentation mirror needs an environment with mirror(observation, goal, action); {env!r} has none")
    return cast("MirrorFn", mirror)


def half(batch: Batch, mirror: MirrorFn, key: PRNGKey) -> Batch:
    """Replaces each transition, with probability 1/2, by its mirror image.

    An image has the reward and the discount of its transition, because a mirror keeps distances between goals.

    Args:
      batch: relabelled transitions with any leading axes.
      mirror: the environment's method (`types.Env`).

    Raises:
      ValueError: `mirror` changes a shape or a type, or does not return three parts.
    """

    def seen(observation: Any, goal: Array) -> tuple[Any, Array, Array]:
        given = observation, goal, batch.action
        image = mirror(*given)
        check.kept("mirror", given, image)
        return image

    hindsight = batch.hindsight_goal
    observation, goal, action = seen(batch.observation, batch.desired_goal)
    following, other, _ = seen(batch.next_observation, batch.desired_goal if hindsight is None else hindsight)
    image = dataclasses.replace(
        batch,
        observation=observation,
        next_observation=following,
        desired_goal=goal,
        action=action,
        hindsight_goal=None if hindsight is None else other,
    )
    coin = jax.random.bernoulli(key, shape=batch.reward.shape)

    def keep(own: Array, mirrored: Array) -> Array:
        return jnp.where(coin.reshape(*coin.shape, *[1] * (own.ndim - coin.ndim)), mirrored, own)

    return jax.tree.map(keep, batch, image)
