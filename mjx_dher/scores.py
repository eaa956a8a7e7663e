"""Scores: numbers that the learner gives the achieved goals of a stored episode, once a cycle.

    score(episode, view) -> [T+1]

A goal sampler may have a score (`samplers.Sampler`), and so may a distance that is learned.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from flax import struct

from mjx_dher import components, lookup
from mjx_dher.context import View, of_each_episode
from mjx_dher.types import Array, Episode

# score(episode, view) -> [T+1]
ScoreFn = Callable[[Episode, View], Array]


@struct.dataclass
class LearnedMetric:
    """A distance that the learner knows: those of an episode's achieved goals to its desired one, finite and not negative."""

    score: ScoreFn = struct.field(pytree_node=False)


def make_metric(metric: Any) -> Any:
    """Returns the metric that `metric` names, or is: a function (achieved, desired) -> [T+1], or a `LearnedMetric`.

    Raises:
      ValueError: no such metric, module or attribute, or something that is none.
    """
    value = components.load("metric", metric)
    if isinstance(value, LearnedMetric):
        lookup.check_function("metric: score", value.score, ("episode", "view"))
        return value
    return lookup.check_function("metric", value, ("achieved", "desired"))


def score_of(score: ScoreFn, episode: Episode, view: View) -> Array:
    """Returns the scores [T+1] of one episode.

    Raises:
      ValueError: they are no floating-point numbers [T+1].
    """
    value = score(episode, view)
    num_goals = episode.achieved_goal.shape[0]
    if getattr(value, "shape", None) != (num_goals,) or not jnp.issubdtype(value.dtype, jnp.floating):
        given = f"{value.dtype}{list(value.shape)}" if hasattr(value, "shape") else f"a {type(value).__name__}"
        raise ValueError(f"a score gives numbers [T+1] = [{num_goals}], floating-point; {score} gives {given}")
    return value


def of_episodes(score: ScoreFn | None, episodes: Episode, view: View) -> Array | None:
    """Returns the scores [E, T+1] of episodes (leaves lead with [E]); None where there is no `score`.

    Raises:
      ValueError: as `score_of`.
    """
    return None if score is None else of_each_episode(lambda episode: score_of(score, episode, view), episodes)
