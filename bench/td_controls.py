"""Controls of the priority `td_error`: each part alone, a choice at random, more updates, and the fraction with each learner.

    python bench/td_controls.py --learners best --out td --first-seed 500 --seeds 20 --plan
    python bench/td_controls.py --learners best --out td --first-seed 500 --seeds 20 --minutes 9   run it again to resume
    python bench/td_controls.py --out toy --toy --seeds 2                                          the point mass, on a CPU

It is bench/bakeoff.py with other arms, and has its options. docs/experiments/td_controls.md is the plan.
"""

import sys

import bakeoff
import bakeoff_arms
import jax.numpy as jnp
from bakeoff_arms import Arm, Experiment

from mjx_dher import priorities
from mjx_dher.priorities import Priority
from mjx_dher.spec import RunSpec

# With the cost of `random_of_four` and the draws of `future`.
random_of_four = Priority(choose=priorities.by_weight(lambda sample, batch, context: jnp.ones_like(batch.reward)))
episodes_alone = Priority(renew=priorities.td_error.renew, uses_values=True, by_part=True)
transitions_alone = Priority(choose=priorities.td_error.choose, uses_values=True)  # four candidates each, as planned

MORE, SLOWER = "more_updates", 1.75  # seconds of an update with `td_error` over those with `eventful`
ARMS = (
    Arm("future", "plain", {"sampler": "future"}),
    Arm("uniform", "plain", {"sampler": "future"}, {"priority_fraction": 0.0}),
    Arm("weighted", "plain", {"sampler": "weighted"}),
    Arm(MORE, "more", {"sampler": "future"}),
    Arm("td_error", "errors", {"priority": "td_error"}, {"priority_fraction": 0.5}),
    Arm("td_error_whole", "errors", {"priority": "td_error"}, {"priority_fraction": 1.0}),
    Arm("episodes_alone", "episodes", {"priority": "td_controls:episodes_alone"}, {"priority_fraction": 0.5}),
    Arm("transitions_alone", "transitions", {"priority": "td_controls:transitions_alone"}, {"priority_fraction": 0.5}),
    Arm("random_of_four", "four", {"priority": "td_controls:random_of_four"}, {"priority_fraction": 0.5}),
)
TASKS = ("pick_and_place", "slide", "block_rotate_z")


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of an arm, seed 0, as in the bake-off. `best` has TQC learners, and `paper` DDPG with its settings."""
    run = bakeoff_arms.spec_of(learner, task, arm, toy)
    if arm.name == MORE:
        updates, period = run.config.updates_per_cycle, run.config.target_period
        more = period * round(SLOWER * updates / period)  # the targets' period divides it
        run = run.replace(updates_per_cycle=more)
    return run.replace(**arm.numbers)


CONTROLS = Experiment(ARMS, ("best", "paper"), TASKS, spec_of, "td_controls.csv")

if __name__ == "__main__":
    sys.exit(bakeoff.main(None, CONTROLS, __doc__))
