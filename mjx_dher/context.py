"""What a method may look at beside the data: rewards, numbers, how far the run is, and the learner's values.

Priorities that choose among transitions, priorities that are renewed, goal generators and distances that are learned all take a
`View`. It is made anew for each cycle, from the learner as it then is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_dher.config import HParams
from mjx_dher.types import Array, Batch, RewardFn

ROWS_AT_ONCE = 256  # episodes that `of_each_episode` hands over at a time: their activations need memory


class Values(NamedTuple):
    """Functions of the learner as it is now; a learner with a method `value` has them (`learners.Learner`)."""

    act: Callable[[Array, Array], Array]  # observation [..., D], goal [..., G] -> action [..., A], the deterministic policy's
    value: Callable[[Array, Array, Array], Array]  # observation, goal, action [..., A] -> estimated return [...]

    def of_state(self, observation: Array, goal: Array) -> Array:
        """Returns the estimated return [...] of following the policy from `observation` [..., D] to `goal` [..., G]."""
        return self.value(observation, goal, self.act(observation, goal))


class View(NamedTuple):
    """What a method may look at beside the data."""

    compute_reward: RewardFn
    hparams: HParams
    progress: Array | float = 0.0  # [] share of the run's updates that have been made
    values: Values | None = None  # there for a method that says `uses_values`, None for others

    def td_error(self, batch: Batch) -> Array:
        """Returns the errors of one step, r + gamma V(s', g) - Q(s, a, g) [B], of a batch [B], by the learner as it is."""
        assert self.values is not None
        following = self.values.of_state(batch.next_observation, batch.desired_goal)
        bound = -1.0 / (1.0 - self.hparams.gamma)
        target = jnp.clip(batch.reward + self.hparams.gamma * following, bound, 0.0)
        return target - self.values.value(batch.observation, batch.desired_goal, batch.action)


def pick(results: Sequence[Any], number: Array) -> Array:
    """Returns the result with a number, traced: what lanes of one program do that differ in a part (`one_of`)."""
    kept = jnp.asarray(results[0])
    for index, result in enumerate(results[1:], 1):
        kept = jnp.where(number == index, result, kept)
    return kept


def of_each_episode(function: Callable[[Any], Array], episodes: Any) -> Array:
    """Returns `function` of each episode (leaves lead with [E]), a few hundred at a time."""
    number = jax.tree.leaves(episodes)[0].shape[0]
    return jax.lax.map(function, episodes, batch_size=min(number, ROWS_AT_ONCE))
