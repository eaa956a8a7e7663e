"""Goal generators: which goals the episodes of a rollout are played for, in place of those that the reset drew.

    generator(key, obs, ring, context) -> goals [N, G]

`obs` are the observations of N resets, with the goals that they drew. `ring` is the replay so far, which may be empty.
`context` has rewards, numbers and, for a generator with `uses_values`, the learner's values. A goal that is not finite leaves
the reset's own. Evaluations are always played for the reset's goals.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from mjx_dher import components, lookup
from mjx_dher.context import Context, one_of
from mjx_dher.replay import ReplayState
from mjx_dher.types import Array, GoalObs, PRNGKey

# generator(key, obs with leading [N], ring, context) -> goals [N, G]
GenerateFn = Callable[[PRNGKey, GoalObs, ReplayState, Context], Array]


@dataclasses.dataclass(frozen=True)
class Generator:
    """A goal generator, and whether it asks the learner."""

    generate: GenerateFn
    uses_values: bool = False  # of `context.values`

    def __call__(self, key: PRNGKey, obs: GoalObs, ring: ReplayState, context: Context) -> Array:
        """Goals [N, G] to play for."""
        return self.generate(key, obs, ring, context)


def _own_goals(key: PRNGKey, obs: GoalObs, ring: ReplayState, context: Context) -> Array:
    """Returns the goals [N, G] that the reset drew."""
    del key, ring, context
    return obs["desired_goal"]


reset = Generator(_own_goals)


def make(name: str | Generator | GenerateFn) -> Generator:
    """Returns the generator called `name`, a function of one's own, or the one that "module:attribute" names.

    Raises:
      ValueError: no such generator, module or attribute, or no function of (key, obs, ring, context).
    """
    value = components.load("generator", name)
    generator = value if isinstance(value, Generator) else Generator(value)
    lookup.check_function("generator", generator.generate, ("key", "obs", "ring", "context"))
    return generator


def join(choices: Sequence[Generator | GenerateFn]) -> Generator:
    """Joins generators in one compiled program: the traced number `hparams.generator_choice` says which one a lane uses.

    Raises:
      ValueError: no generator, or something else in its place.
    """
    made = [make(choice) for choice in choices]
    if not made:
        raise ValueError("join takes one or more generators; got none")
    if len(made) == 1:
        return made[0]
    generate = one_of(made, "generator_choice")
    return Generator(generate, uses_values=any(generator.uses_values for generator in made))
