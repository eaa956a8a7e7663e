"""Mirror images of transitions (Lin et al. 2020, "Invariant Transform Experience Replay", arXiv 1909.10707)."""

import dataclasses
from collections.abc import Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import check, lookup
from mjx_dher.types import Array, Batch, MirrorFn, PRNGKey


def of_env(env: Any) -> MirrorFn:
    """The method `mirror` of an environment. Raises ValueError if it has none, or it is no function of three arguments."""
    try:
        mirror = env.mirror
    except AttributeError as error:
        needed = "augmentation mirror needs the environment's method mirror(observation, goal, action)"
        raise ValueError(f"{needed}: {error}. Without it, choose augmentation none") from error
    return cast("MirrorFn", lookup.check_function("mirror", mirror, ("observation", "goal", "action")))


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


def across_y(
    entries: Mapping[str, int], middle: float, observation: Array, goal: Array, action: Array
) -> tuple[Array, Array, Array]:
    """Mirror image, at the plane y = `middle` in m, of a scene with one gripper that moves along the axes.

    Args:
      entries: names of the observation's entries and their sizes. Three numbers are a position ("..._pos"), a rotation
        ("..._euler" or "..._angvel"), or else a difference or a velocity. Two are the fingers, which change places.
      observation: [..., D].
      goal: position [..., 3].
      action: displacement and fingers [..., 4].

    Raises:
      ValueError: the observation has another size.
    """
    if observation.shape[-1] != sum(entries.values()):
        raise ValueError(f"mirror: the observation must be [..., {sum(entries.values())}]; got {list(observation.shape)}")
    across = np.array([1.0, -1.0, 1.0], np.float32)
    shift = np.array([0.0, 2.0 * middle, 0.0], np.float32)

    def image(name: str, entry: Array) -> Array:
        if entry.shape[-1] == 2:
            return entry[..., ::-1]
        turned = name.endswith(("_euler", "_angvel"))
        placed = name.endswith("_pos") and " - " not in name
        return entry * (-across if turned else across) + (shift if placed else 0.0)

    parts = jnp.split(observation, np.cumsum([*entries.values()])[:-1], axis=-1)
    seen = jnp.concatenate([image(*part) for part in zip(entries, parts)], axis=-1)
    return seen, goal * across + shift, action * np.append(across, np.float32(1.0))
