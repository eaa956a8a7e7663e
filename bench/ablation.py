"""Ablation of the preset `gpu` on PickAndPlace and Slide. Each arm omits one part of the preset; seeds are paired.

    python bench/ablation.py --out ablation --plan      what would be trained
    python bench/ablation.py --out ablation             trains and reports; run it again to resume
    python bench/ablation.py --out ablation --report    reports the runs that have ended
    python bench/ablation.py --out ablation --runs docs/ablation_runs.csv   trains only the runs missing in that file
    python bench/ablation.py --out toy --toy --seeds 3  the same on the point mass, on a CPU in minutes

It is bench/bakeoff.py with other arms, and has its options. Each arm is a separate program. docs/experiments/ablation.md has
the plan.
"""

import sys
from collections.abc import Callable

import bakeoff
from bakeoff_arms import SIZES, TOY, Arm, Experiment, tuned

from mjx_dher.spec import RunSpec

PLAIN = {"tqc": "sac", "dtqc": "td3"}  # a mean in place of quantiles


def other_entropy(run: RunSpec) -> RunSpec:
    """The run with `dtqc`, which has no entropy, in place of `tqc`, or the reverse.

    The numbers are taken from the preset with that learner: with entropy, actions are not punished and targets are not
    smoothed.
    """
    if run.learner == "tqc":
        return run.replace(learner="dtqc", action_l2=1.0, target_noise=0.0)
    return run.replace(learner="tqc", action_l2=0.0, entropy_weight=0.1)


# What an arm changes about the preset's run.
CHANGES: dict[str, Callable[[RunSpec], RunSpec]] = {
    "preset": lambda run: run,
    "no_quantiles": lambda run: run.replace(learner=PLAIN[run.learner]),
    "other_entropy": other_entropy,
    "one_critic": lambda run: run.replace(num_critics=1),
    "no_layer_norm": lambda run: run.replace(networks="mlp"),
    "one_step": lambda run: run.replace(n_step=1),
    "half_width": lambda run: run.replace(hidden_sizes=tuple(size // 2 for size in run.config.hidden_sizes)),
    "half_batch": lambda run: run.replace(batch_size=run.config.batch_size // 2),
    "half_updates": lambda run: run.replace(updates_per_cycle=run.config.updates_per_cycle // 2),
    "no_eventful": lambda run: run.replace(priority_fraction=0.0),
    "ddpg": lambda run: run.replace(learner="ddpg", networks="mlp", n_step=1, action_l2=1.0),
}
ARMS = tuple(Arm(name, name) for name in CHANGES)  # each a program of its own


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of an arm, seed 0. `learner` is `gpu`: the preset's, as in the bake-off.

    The priority is `eventful` in all arms, and returns have three steps except in `one_step` and `ddpg`. The presets differ:
    Slide's has the priority `td_error`; PickAndPlace's has smaller networks, returns of one step and `energy`.
    """
    del learner
    run = tuned("slide" if toy else task, priority="eventful").replace(env=task)
    sizes = {**TOY, "target_period": 10} if toy else SIZES["best", task]
    return CHANGES[arm.name](run.replace(n_step=3, **sizes))


ABLATION = Experiment(ARMS, ("gpu",), ("pick_and_place", "slide"), spec_of, "ablation.csv")

if __name__ == "__main__":
    sys.exit(bakeoff.main(None, ABLATION, __doc__))
