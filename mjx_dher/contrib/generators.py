"""Goal generators: goals for the episodes of a rollout, in place of the reset's goals.

    generator(key, obs, ring, context) -> goals [N, G]

`obs` are the observations of N resets with their goals. `ring` is the replay ring, which may be empty. `context` has rewards,
numbers and, if the generator has `uses_values`, the learner's values. A goal that is not finite is replaced by the reset's.
Evaluations always use the reset's goals.
"""

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
    """A goal generator, and whether it uses the learner's values."""

    generate: GenerateFn
    uses_values: bool = False  # whether it reads `context.values`

    def __call__(self, key: PRNGKey, obs: GoalObs, ring: ReplayState, context: Context) -> Array:
        """Goals [N, G] for the N episodes of a rollout."""
        return self.generate(key, obs, ring, context)


reset = Generator(lambda key, obs, ring, context: obs["desired_goal"])


def make(name: str | Generator | GenerateFn) -> Generator:
    """Loads a generator: a built-in name, "module:attribute", or a function. Raises ValueError if there is no such generator,
    or it is not a function of (key, obs, ring, context).
    """
    value = components.load("generator", name)
    generator = value if isinstance(value, Generator) else Generator(value)
    lookup.check_function("generator", generator.generate, ("key", "obs", "ring", "context"))
    return generator


def join(choices: Sequence[Generator | GenerateFn]) -> Generator:
    """Joins generators in one compiled program, in which the traced number `hparams.generator_choice` selects a lane's
    generator. Raises ValueError for something other than a generator.
    """
    made = [make(choice) for choice in choices]
    if len(made) == 1:
        return made[0]
    generate = one_of(made, "generator_choice")
    return Generator(generate, uses_values=any(generator.uses_values for generator in made))
