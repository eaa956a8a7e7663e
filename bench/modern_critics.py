"""Critics of 2024 and 2025 in the presets `gpu` of Slide (as of 2026-11-25) and Block Z (2026-11-26).

    python bench/modern_critics.py --out critics --first-seed 10 --plan
    python bench/modern_critics.py --out critics --first-seed 10 --minutes 9   trains and reports; run it again to resume
    python bench/modern_critics.py --out critics --first-seed 10 --runs docs/modern_critics_runs.csv   only runs not in it
    python bench/modern_critics.py --out toy --toy --seeds 2   the same on the point mass, on a CPU

It is bench/bakeoff.py with other arms, and has its options. docs/experiments/ablation.md has the plan.
"""

import sys
from collections.abc import Callable

import bakeoff
from bakeoff_arms import SIZES, TOY, Arm, Experiment, tuned

from mjx_dher.spec import RunSpec

RESET_CYCLES = 6  # of 17 on Slide and 15 on Block Z, so that the last reset has five or three cycles to recover
# What an arm changes about the preset: `dtqc`, `layer_norm` in the critics, three layers of 512.
CHANGES: dict[str, Callable[[RunSpec], RunSpec]] = {
    "preset": lambda run: run,
    "mlp": lambda run: run.replace(networks="mlp"),
    "residual": lambda run: run.replace(networks="residual"),
    "unit_norm": lambda run: run.replace(networks="unit_norm"),
    "categorical": lambda run: run.replace(learner="ctd3"),
    "categorical_unit_norm": lambda run: run.replace(learner="ctd3", networks="unit_norm"),
    "resets": lambda run: run.replace(reset_every=RESET_CYCLES * run.config.updates_per_cycle),
}


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of an arm, seed 0, with the priority `td_error`, which both presets had."""
    del learner
    run = tuned("slide" if toy else task, priority="td_error").replace(env=task)
    return CHANGES[arm.name](run.replace(**(TOY if toy else SIZES["best", task])))


ARMS = tuple(Arm(name, name) for name in CHANGES)
CRITICS = Experiment(ARMS, ("gpu",), ("slide", "block_rotate_z"), spec_of, "modern_critics.csv")

if __name__ == "__main__":
    sys.exit(bakeoff.main(None, CRITICS, __doc__))
