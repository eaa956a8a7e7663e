"""Goal generators: which goals the episodes of a rollout are played for, in place of those that the reset drew.

    generator(key, obs, ring, view) -> goals [N, G]

`obs` are the observations of N resets, their own goals among them; `ring` is the replay so far, which may be empty; `view` has
rewards, numbers and, for a generator that says so, the learner's values (`view.View`). A goal that is not finite leaves the
reset's own. Evaluations are always played for the reset's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher import components, lookup
from mjx_dher.context import View, pick
from mjx_dher.replay import ReplayState
from mjx_dher.types import Array, GoalObs, PRNGKey

# generator(key, obs with leading [N], ring, view) -> goals [N, G]
GenerateFn = Callable[[PRNGKey, GoalObs, ReplayState, View], Array]


@dataclasses.dataclass(frozen=True)
class Generator:
    """A goal generator, and whether it asks the learner."""

    generate: GenerateFn
    uses_values: bool = False  # of `view.values`


def own_goals(key: PRNGKey, obs: GoalObs, ring: ReplayState, view: View) -> Array:
    """Returns the goals [N, G] that the reset drew."""
    del key, ring, view
    return obs["desired_goal"]


reset = Generator(own_goals)


def make(name: str | Generator | GenerateFn) -> Generator:
    """Returns the generator called `name`, a function of one's own, or the one that "module:attribute" names.

    Raises:
      ValueError: no such generator, module or attribute, or no function of (key, obs, ring, view).
    """
    value = components.load("generator", name)
    generator = value if isinstance(value, Generator) else Generator(value)
    lookup.check_function("generator", generator.generate, ("key", "obs", "ring", "view"))
    return generator


def one_of(choices: Sequence[Generator | GenerateFn]) -> Generator:
    """Joins several generators in one compiled program: `hparams.generator_choice`, traced, says which of them a run uses.

    Raises:
      ValueError: no generator, or something that is none.
    """
    made = [make(choice) for choice in choices]
    if not made:
        raise ValueError("one_of joins one or more generators; got none")
    if len(made) == 1:
        return made[0]

    def of_lane(key: PRNGKey, obs: GoalObs, ring: ReplayState, view: Any) -> Array:
        return pick([goals_of(own, key, obs, ring, view) for own in made], view.hparams.generator_choice)

    return Generator(of_lane, uses_values=any(generator.uses_values for generator in made))


def goals_of(generator: Generator, key: PRNGKey, obs: GoalObs, ring: ReplayState, view: View) -> Array:
    """Returns the goals [N, G] to play for: the generator's where they are finite, else those of the reset.

    Raises:
      ValueError: it does not give floating-point numbers [N, G].
    """
    own = obs["desired_goal"]
    goals = generator.generate(key, obs, ring, view)
    if not (isinstance(goals, jax.Array) and goals.shape == own.shape and jnp.issubdtype(goals.dtype, jnp.floating)):
        given = f"{goals.dtype}{list(goals.shape)}" if isinstance(goals, jax.Array) else f"a {type(goals).__name__}"
        name = getattr(generator.generate, "__name__", generator.generate)
        raise ValueError(f"a generator gives goals [N, G] = {list(own.shape)}, as floating-point numbers; {name} gives {given}")
    return jnp.where(jnp.all(jnp.isfinite(goals), axis=-1, keepdims=True), goals.astype(own.dtype), own)


def check_env(generator: Generator, env: Any) -> None:
    """Raises ValueError where a generator is to set goals in an environment that has no method for it."""
    if generator is not reset and not callable(getattr(env, "with_goal", None)):
        raise ValueError(
            f"a goal generator needs an environment with a method with_goal(state, goal) -> state; {env!r} has none"
        )
