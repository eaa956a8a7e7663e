"""Samplers, k and priorities against `future` on the Shadow hand, with the preset `gpu`.

    python bench/hands.py --out hands --first-seed 310 --plan
    python bench/hands.py --out hands --first-seed 310 --minutes 9   trains for 9 minutes and reports. Run it again to resume
    python bench/hands.py --out toy --toy --seeds 2                  the same on the point mass, on a CPU

It is bench/bakeoff.py with other arms, and has its options. docs/experiments/preset_hands.md has the plan.
"""

import sys

import bakeoff
from bakeoff_arms import SIZES, TOY, Arm, Experiment

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


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of an arm, seed 0. Without its own, an arm has the sampler `future`, k 4 and no priority."""
    del learner
    parts = {"sampler": "future", "priority": "eventful", **arm.parts}
    sizes = TOY if toy else SIZES["best", task]
    changes = {"replay_size": sizes["total_steps"], **sizes, "her_k": 4.0, "priority_fraction": 0.0, **arm.numbers}
    return presets.preset("gpu", "hand_reach" if toy else task, **parts).replace(env=task, **changes)


HANDS = Experiment(ARMS, ("gpu",), ("hand_reach", "block_rotate_z"), spec_of, "hands.csv")

if __name__ == "__main__":
    sys.exit(bakeoff.main(None, HANDS, __doc__))
