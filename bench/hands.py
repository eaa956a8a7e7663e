"""What helps on the Shadow hand: samplers, k and priorities against `future`, by the preset `gpu`.

    python bench/hands.py --out hands --first-seed 310 --plan
    python bench/hands.py --out hands --first-seed 310 --minutes 9   trains for 9 minutes and reports; run it again to resume
    python bench/hands.py --out toy --toy --seeds 2                  the same on the point mass, on a CPU

It is bench/bakeoff.py with other arms, and has its options. docs/experiments/preset_hands.md has the plan.
"""

from __future__ import annotations

import dataclasses
import sys

import bakeoff
from bakeoff_arms import COMPILE_SECONDS, TOY, Arm, Experiment

from mjx_dher import presets
from mjx_dher.spec import RunSpec

HALF = {"priority_fraction": 0.5}
ARMS = (
    Arm("future", "plain"),
    Arm("weighted", "plain", {"sampler": "weighted"}),
    *(Arm(f"k{k}", "plain", numbers={"her_k": float(k)}) for k in (1, 8, 16)),
    Arm("eventful", "plain", numbers=HALF),
    Arm("td_error", "errors", {"priority": "td_error"}, HALF),
)
STEPS = {"hand_reach": 1_024_000, "block_rotate_z": 1_536_000}
SIZES = {"hand_reach": {}, "block_rotate_z": {"cycles_per_epoch": 1}}  # 20 and 15 epochs
SECONDS = {"hand_reach": 11.0, "block_rotate_z": 18.5}  # of a run among others, from docs/experiments/preset_hands.md


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of an arm, seed 0. Without its own, an arm has the sampler `future`, k 4 and no priority."""
    del learner
    parts = {"sampler": "future", "priority": "eventful", **arm.parts}
    run = dataclasses.replace(presets.preset("gpu", "hand_reach" if toy else task, **parts), env=task)
    changes = TOY if toy else {**SIZES[task], "total_steps": STEPS[task], "replay_size": STEPS[task]}
    numbers = {"her_k": 4.0, "priority_fraction": 0.0, **arm.numbers}
    return dataclasses.replace(run, config=dataclasses.replace(run.config, **changes), hparams=run.hparams._replace(**numbers))


def minutes(learners: tuple[str, ...], tasks: tuple[str, ...], arms: tuple[Arm, ...], seeds: int) -> float:
    """Minutes of one H200 for the runs, compilation included."""
    del learners
    programs = len(tasks) * len({arm.group for arm in arms})
    return (sum(SECONDS[task] for task in tasks) * len(arms) * seeds + COMPILE_SECONDS * programs) / 60


HANDS = Experiment(ARMS, ("gpu",), tuple(STEPS), spec_of, minutes, "hands.csv")

if __name__ == "__main__":
    sys.exit(bakeoff.main(None, HANDS, __doc__))
