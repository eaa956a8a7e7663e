"""Published methods with their authors' numbers: first one claim of each, then all of them with a tuned k.

    python bench/as_published.py cher --out published/cher --seeds 10     FetchReach with one worker, batches of 64
    python bench/as_published.py next_future --out published/next_future  tolerances of 5 and 2 cm
    python bench/as_published.py ebp --out published/ebp                  PickAndPlace with 19 workers
    python bench/as_published.py tune --out published/tune --first-seed 900 --seeds 5
    python bench/as_published.py test --out published/test                k of each method by the runs of `tune`

Each is bench/bakeoff.py with other arms, and has its options. docs/experiments/as_published.md is the plan. `tune` writes
tune_runs.csv, and `test` reads its copy, docs/as_published_tune_runs.csv.
"""

import argparse
import dataclasses
import functools
import sys
from pathlib import Path

import bakeoff
import bakeoff_arms
import numpy as np
from bakeoff_arms import TASKS, TOY, Arm, Experiment
from bakeoff_runs import load

from mjx_dher import presets
from mjx_dher.spec import RunSpec

TUNED = Path(__file__).resolve().parents[1] / "docs" / "as_published_tune_runs.csv"
KS = (4, 8, 16)
_SHARED = ("future", "next_future", "max_entropy", "dpp", "td_error", "curriculum", "not_misleading", "hgg", "archer")
CLIPPED = Arm("energy_clipped", "plain", {"priority": "energy_clipped"})
METHODS = (*(arm for arm in bakeoff_arms.ARMS if arm.name in _SHARED), CLIPPED)
_BY_NAME = {arm.name: arm for arm in (*bakeoff_arms.ARMS, CLIPPED)}


def _arms(*names: str) -> tuple[Arm, ...]:
    return tuple(_BY_NAME[name] for name in names)


def _workers(
    number: int, batch: int, cycles: int, epochs: int, learner: str, task: str, arm: Arm, toy: bool = False
) -> RunSpec:
    """Run with openai/baselines' settings, which both authors use: two episodes for each of `number` workers."""
    del learner
    run = presets.preset("paper", task, networks="mlp", **arm.parts)
    steps = 2 * number * 50 * cycles * epochs
    sizes = {"num_envs": 2 * number, "batch_size": number * batch, "cycles_per_epoch": cycles}
    numbers = {"random_noise": 0.0, "adam_eps": 1e-8 / number, "priority_fraction": float(arm.prioritized)}  # all of a batch
    return run.replace(**(TOY if toy else {**sizes, "total_steps": steps, "replay_size": steps}), **numbers)


# FetchReach as in the README of CHER's code, with one worker. Success is 1 after 4,000 steps.
cher = functools.partial(_workers, 1, 64, 2, 20)
# PickAndPlace as in the README of EBP's code: 19 workers, 50 epochs of 50 cycles.
ebp = functools.partial(_workers, 19, 256, 50, 50)


def next_future(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of the bake-off's `paper` at a tolerance: `5cm` or `2cm`."""
    run = bakeoff_arms.spec_of("paper", task, arm, toy)
    return run.replace(env_kwargs=("distance_threshold=0.02",)) if learner == "2cm" else run


def with_k(task: str, arm: Arm, k: int, toy: bool) -> RunSpec:
    """Run of the bake-off's `paper` with another k."""
    return bakeoff_arms.spec_of("paper", task, arm, toy).replace(her_k=float(k))


def tune(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of an arm that is named after a method and its k."""
    del learner
    return with_k(task, arm, int(arm.name.rpartition("_k")[2]), toy)


@functools.cache
def best_k(task: str, method: str) -> int:
    """k with the largest mean success of a method's tuning runs. Raises FolderError if there are none."""
    scores: dict[int, list[float]] = {}
    for run in load(TUNED):
        name, _, k = run.arm.rpartition("_k")
        if (run.task, name) == (task, method):
            scores.setdefault(int(k), []).append(run.mean_success)
    if set(scores) != set(KS):
        raise bakeoff.files.FolderError(f"{TUNED} lacks runs of {method} on {task} with some k of {KS}")
    return max(KS, key=lambda k: float(np.mean(scores[k])))


def tuned(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of a method with the best k of its tuning runs."""
    del learner
    return with_k(task, arm, KS[0] if toy else best_k(task, arm.name), toy)


TUNED_ARMS = tuple(
    dataclasses.replace(arm, name=f"{arm.name}_k{k}", numbers={**arm.numbers, "her_k": float(k)}) for arm in METHODS for k in KS
)
EXPERIMENTS = {
    "cher": Experiment(_arms("future", "curriculum"), ("one_worker",), ("reach",), cher, "cher.csv"),
    "ebp": Experiment(_arms("future", "energy_clipped", "energy"), ("workers",), ("pick_and_place",), ebp, "ebp.csv"),
    "next_future": Experiment(_arms("future", "next_future"), ("5cm", "2cm"), TASKS[:2], next_future, "next_future.csv"),
    "tune": Experiment(TUNED_ARMS, ("paper",), TASKS, tune, "tune.csv"),
    "test": Experiment(METHODS, ("paper",), TASKS, tuned, "test.csv"),
}


def main() -> int:
    """Runs the experiment that the first argument names, with bench/bakeoff.py's options after it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiment", choices=EXPERIMENTS)
    return bakeoff.main(sys.argv[2:], EXPERIMENTS[parser.parse_args(sys.argv[1:2]).experiment], __doc__)


if __name__ == "__main__":
    sys.exit(main())
