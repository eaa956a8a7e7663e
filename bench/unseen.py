"""Presets on seeds that had no part in choosing them: success over 500 episodes of ten seeds from 600 on.

    python bench/unseen.py --out unseen --learners cpu --tasks reach push --first-seed 600 --minutes 9
    python bench/unseen.py --out unseen --learners cpu --tasks reach push --first-seed 600 --report

It is bench/bakeoff.py with a preset in place of a learner and one arm, and has its options. The report's unseen_runs.csv has
one row per seed. docs/experiments/presets.md has the table.
"""

import sys

import bakeoff
from bakeoff_arms import TOY, Arm, Experiment

from mjx_dher import presets
from mjx_dher.components import robot
from mjx_dher.spec import RunSpec

HANDS = ("hand_reach", "block_rotate_z", "block_rotate_parallel", "block_rotate_xyz", "egg_rotate")
TASKS = ("reach", "push", "pick_and_place", "slide", *HANDS)


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of a preset, seed 0, with README's sampler on the Fetch tasks."""
    del arm
    run = presets.preset(learner, task, **({} if robot(task) == "hand" else {"sampler": "weighted"}))
    return run.replace(**TOY, n_step=1) if toy else run


UNSEEN = Experiment((Arm("preset", "plain"),), ("cpu", "gpu", "frugal"), TASKS, spec_of, "unseen.csv")

if __name__ == "__main__":
    sys.exit(bakeoff.main(None, UNSEEN, __doc__))
