"""Mirror images of transitions (Lin et al. 2020, "Invariant Transform Experience Replay", arXiv 1909.10707)."""

import dataclasses
from collections.abc import Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import check, lookup
from mjx_dher.types import Array, Batch, MirrorFn, PRNGKey

PARTS = ("observation", "goal", "action")


def of_env(env: Any) -> MirrorFn:
    """The method `mirror` of an environment. Raises ValueError if it has none, or it is no function of three arguments."""
    try:
        mirror = own(env)
    except AttributeError as error:
        needed = "augmentation mirror needs the environment's method mirror(observation, goal, action)"
        raise ValueError(f"{needed}: {error}. Without it, choose augmentation none") from error
    return cast("MirrorFn", lookup.check_function("mirror", mirror, PARTS))


def own(env: Any) -> Any:
    """The attribute `mirror` of an environment. Raises AttributeError if it has none, or if its class inherits it, not from a
    mixin, and does not set `keeps_mirror` itself: its observations may be others, whose images would be wrong without an error.
    """
    task = type(env)
    owner = next((base for base in task.__mro__ if "mirror" in vars(base)), task)
    is_mixin = owner in task.__bases__ and not hasattr(owner, "reset")
    if not (owner is task or is_mixin or vars(task).get("keeps_mirror")):
        raise AttributeError(f"the inherited mirror may contradict {task.__name__}, unless it sets keeps_mirror")
    return env.mirror


def of_parts(mirror: MirrorFn, *given: Any, leading: int) -> tuple[Any, Array, Array]:
    """Mirror image of an observation, a goal and an action. Raises ValueError if it has other shapes, after `leading` axes."""
    image = mirror(*given)
    if not isinstance(image, tuple) or len(image) != len(PARTS):
        got = f"{len(image)} of them" if isinstance(image, tuple) else f"a {type(image).__name__}"
        raise ValueError(f"mirror must return a tuple of {', '.join(PARTS)}; got {got}")
    check.kept("mirror", dict(zip(PARTS, given)), dict(zip(PARTS, image)), leading)
    return image


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
        return of_parts(mirror, observation, goal, batch.action, leading=batch.reward.ndim)

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
