"""What each part of the preset `gpu` gives on PickAndPlace and Slide: the preset without it, against the preset, seed by seed.

    python bench/ablation.py --out ablation --plan      what would be trained, and how long it would take
    python bench/ablation.py --out ablation             trains and reports; the same command goes on where it was stopped
    python bench/ablation.py --out ablation --report    reports what has ended
    python bench/ablation.py --out toy --toy --seeds 3  the same on the point mass, on a CPU in minutes

It is bench/bakeoff.py with other arms, and has its options. Each arm is a program of its own. docs/learners.md says beforehand
what is compared.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import bakeoff
from bakeoff_arms import COMPILE_SECONDS, SIZES, TOY, Arm, Experiment

from mjx_dher import presets
from mjx_dher.spec import RunSpec

# Without a part: where the preset has entropy, the same critics without it, and the other way round.
ENTROPY = {"tqc": "dtqc", "dtqc": "tqc"}
PLAIN = {"tqc": "sac", "dtqc": "td3"}  # a mean in place of quantiles
ARMS = (
    Arm("preset", "preset"),
    Arm("no_quantiles", "no_quantiles"),
    Arm("other_entropy", "other_entropy"),
    Arm("one_critic", "one_critic", sizes={"num_critics": 1}),
    Arm("no_layer_norm", "no_layer_norm", {"networks": "mlp"}),
    Arm("one_step", "one_step", sizes={"n_step": 1}),
    Arm("half_width", "half_width"),
    Arm("half_batch", "half_batch"),
    Arm("half_updates", "half_updates"),
    Arm("no_eventful", "no_eventful", numbers={"priority_fraction": 0.0}),
    Arm("ddpg", "ddpg", {"learner": "ddpg", "networks": "mlp"}, sizes={"n_step": 1}),
)
HALVES = {"half_width": "hidden_sizes", "half_batch": "batch_size", "half_updates": "updates_per_cycle"}


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Returns a run of an arm, seed 0. `learner` is `gpu`: the preset's."""
    run = presets.preset(learner, "slide" if toy else task)
    sizes = {**({**TOY, "target_period": 10} if toy else SIZES["best", task].changes), **arm.sizes}
    run = dataclasses.replace(run, env=task, config=dataclasses.replace(run.config, **sizes), **arm.parts)
    if (field := HALVES.get(arm.name)) is not None:
        run = dataclasses.replace(run, config=dataclasses.replace(run.config, **{field: half(getattr(run.config, field))}))
    numbers = dict(arm.numbers)
    if arm.name == "no_quantiles":
        run = dataclasses.replace(run, learner=PLAIN[run.learner])
    elif arm.name == "other_entropy":
        run = dataclasses.replace(run, learner=ENTROPY[run.learner])
        # As the preset that has that learner: actions are not punished where entropy is paid for, and targets not smoothed.
        numbers = {"action_l2": 0.0, "entropy_weight": 0.1} if run.learner == "tqc" else {"action_l2": 1.0, "target_noise": 0.0}
    elif arm.name == "ddpg":
        numbers = {"action_l2": 1.0}
    return dataclasses.replace(run, hparams=run.hparams._replace(**numbers))


def half(size: Any) -> Any:
    """Returns half of a size, or of each of several."""
    return tuple(map(half, size)) if isinstance(size, tuple) else size // 2


def estimated_minutes(learners: tuple[str, ...], tasks: tuple[str, ...], arms: tuple[Arm, ...], seeds: int) -> float:
    """Returns the minutes of one H200 that the runs take, as if each arm cost what the preset does, compilation included."""
    each = [SIZES["best", task].seconds * seeds + COMPILE_SECONDS for task in tasks for _ in arms]
    return len(learners) * sum(each) / 60


ABLATION = Experiment(ARMS, ("gpu",), ("pick_and_place", "slide"), spec_of, estimated_minutes, "ablation.csv")

if __name__ == "__main__":
    sys.exit(bakeoff.main(None, ABLATION, __doc__))
