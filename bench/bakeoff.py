"""The bake-off of hindsight's methods: every arm of bench/bakeoff_arms.py against `future`, with the same seeds.

    python bench/bakeoff.py --out bakeoff --plan        what would be trained, and how long it would take
    python bench/bakeoff.py --out bakeoff               trains and reports; the same command goes on where it was stopped
    python bench/bakeoff.py --out bakeoff --report      reports what has ended
    python bench/bakeoff.py --out toy --toy --seeds 3   the same on the point mass, on a CPU in minutes

Each learner and task is a sweep in a folder of its own (`python train.py plot bakeoff/paper-slide` draws it, too). The report
is bakeoff.csv, a row an arm, learner and task, and a forest plot a task. docs/what_helps.md says beforehand what is compared.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bakeoff_arms import ARMS, BASELINE, GROUPS, LEARNERS, TASKS, THRESHOLDS, Arm, estimated_minutes, spec_of
from numpy.typing import NDArray
from rich.console import Console

from mjx_dher import envs, stats
from mjx_dher.cli.common import Screen
from mjx_dher.host import files
from mjx_dher.host.caches import prepare
from mjx_dher.runs import identity
from mjx_dher.runs.options import Options
from mjx_dher.runs.stopping import Stop
from mjx_dher.spec import RunSpec, validate
from mjx_dher.sweeps import comparison, grid, sweep, tables

TABLE = "bakeoff.csv"
TOY_TASK = "point_mass:PointMass"
ALPHA, POWER = 0.05, 0.8


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the arguments, checked; ends the program with status 2 and a sentence for those that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweeps and of the report")
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=LEARNERS)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--arms", nargs="+", choices=[arm.name for arm in ARMS], default=[arm.name for arm in ARMS])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--lanes", type=int, help="runs side by side, at most; as many as memory holds on a GPU, 1 on a CPU")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop, to go on later, after the epoch that ends then")
    parser.add_argument("--plan", action="store_true", help="say what would be trained, and train nothing")
    parser.add_argument("--report", action="store_true", help="report what has ended, and train nothing")
    parser.add_argument("--toy", action="store_true", help="the point mass, tiny networks: tries the mechanics on a CPU")
    args = parser.parse_args(argv)
    for name in ("seeds", "lanes"):
        value = getattr(args, name)
        if value is not None and not 1 <= value <= 1000:
            parser.error(f"--{name} must lie between 1 and 1000; got {value}")
    if not 0 <= args.first_seed <= 2**32 - 1001:
        parser.error(f"--first-seed must lie between 0 and {2**32 - 1001}; got {args.first_seed}")
    if not args.minutes > 0:
        parser.error(f"--minutes must be more than 0; got {args.minutes}")
    if args.toy:
        args.learners, args.tasks = ("paper",), (TOY_TASK,)
        sys.path.insert(0, str(Path(__file__).parent.parent / "docs" / "examples"))
    args.arms = [arm for arm in ARMS if arm.name in (BASELINE, *args.arms)]
    return args


def folder_of(args: argparse.Namespace, learner: str, task: str) -> Path:
    """Returns the folder of a sweep."""
    return args.out / f"{learner}-{identity.in_a_path(task)}"


def trials_of(args: argparse.Namespace, learner: str, task: str, group: str) -> list[RunSpec]:
    """Returns the runs of the arms of a group, seed by seed, so that what is compared ends together."""
    settings = [spec_of(learner, task, arm, args.toy) for arm in args.arms if arm.group == group]
    for setting in settings:
        validate(setting, envs.list_envs())
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    return [dataclasses.replace(setting, seed=seed) for seed in seeds for setting in settings]


def plan(args: argparse.Namespace, console: Console) -> None:
    """Prints the runs of each sweep, how many of them are done, and the minutes that all of them take."""
    for learner in args.learners:
        for task in args.tasks:
            folder = folder_of(args, learner, task)
            runs = [run for group in GROUPS for run in trials_of(args, learner, task, group)]
            done = sum(grid.is_done(folder, run) for run in runs)
            steps = runs[0].config.total_steps
            console.print(f"{folder}: {len(runs)} runs of {steps:,} steps, {done} of them done; learner {runs[0].learner}")
    if not args.toy:
        minutes = estimated_minutes(tuple(args.learners), tuple(args.tasks), tuple(args.arms), args.seeds)
        console.print(
            f"about {minutes:.0f} minutes of one H200, by what sweeps of `future` took there (bench/README.md,"
            " docs/results.md); what the methods cost beyond that has not been measured"
        )


def train(args: argparse.Namespace, console: Console) -> bool:
    """Trains what is not done; returns whether all is."""
    prepare()
    until = time.monotonic() + 60 * args.minutes
    with Stop(console, args.out) as stop:
        for learner in args.learners:
            for task in args.tasks:
                for group in GROUPS:
                    if stop.asked is not None or time.monotonic() > until:
                        return False
                    if not _train_group(args, (learner, task, group), console, stop, until):
                        return False
    return True


def _train_group(args: argparse.Namespace, which: tuple[str, str, str], console: Console, stop: Stop, until: float) -> bool:
    """Trains the runs of a group that are not done, in one program; returns whether all of them are."""
    learner, task, group = which
    folder = folder_of(args, learner, task)
    todo = [run for run in trials_of(args, learner, task, group) if not grid.is_done(folder, run)]
    if not todo:
        return True
    files.make_folder(folder / grid.CELLS)
    console.print(f"{folder}, {group}: {len(todo)} runs")
    screen = Screen(console, todo)
    try:
        sweep.run(
            folder,
            todo,
            lambda run: envs.make(run.env, engine=run.engine),
            options=Options(final_episodes=100 if args.toy else 500, checkpoint_every=1 if args.toy else 5),
            lanes=args.lanes,
            should_stop=lambda: stop.asked is not None or time.monotonic() > until,
            report=console.print,
            on_epoch=screen.show,
        )
    finally:
        screen.close()
    return all(grid.is_done(folder, run) for run in todo)


class Scores(NamedTuple):
    """What the runs of an arm came to, by seed; all [S]."""

    seeds: tuple[int, ...]
    area: NDArray  # mean success over the epochs
    final: NDArray  # success of the last policy
    steps: NDArray  # environment steps to the threshold; infinite where it is never reached
    failed: int


class Row(NamedTuple):
    """An arm of a learner and task beside `future`. Differences are paired by seed; intervals are at 95 %."""

    learner: str
    task: str
    arm: str
    seeds: int
    failed: int
    mean_success: float
    final: float
    steps_to_threshold: float  # median; infinite if half of the seeds or more never reach it
    difference: float  # of mean success
    low: float
    high: float
    final_difference: float
    better: float  # probability that a seed of the arm has more mean success than one of `future`
    better_low: float
    better_high: float
    p_value: float
    p_corrected: float  # by Holm's method, over all arms of a learner and task
    smallest_effect: float  # that would have been seen four times in five, for this spread of the differences
    claim: str
    source: str


def smallest_effect(spread: float, seeds: int, tests: int) -> float:
    """Returns the mean difference that is significant at 0.05 / tests four times in five, by a paired t-test.

    `spread` is the standard deviation of the differences. Holm's method holds the smallest p to that level.
    """
    from scipy.stats import nct, t

    if seeds < 2:
        return math.nan
    critical = float(t.ppf(1 - ALPHA / tests / 2, seeds - 1))
    low, high = 0.0, 100.0
    for _ in range(60):  # noncentrality at which the power is as asked
        middle = (low + high) / 2
        low, high = (middle, high) if nct.sf(critical, seeds - 1, middle) < POWER else (low, middle)
    return high * spread / math.sqrt(seeds)


def compare(learner: str, task: str, scores: dict[str, Scores]) -> list[Row]:
    """Returns a row an arm: each against `future` on the seeds that both have."""
    base, arms = scores[BASELINE], {arm.name: arm for arm in ARMS}
    others = [name for name in scores if name != BASELINE]
    rows = [_row(learner, task, arms[name], scores[name], base, len(others)) for name in (BASELINE, *others)]
    tested = [number for number, row in enumerate(rows) if not math.isnan(row.p_value)]
    for number, p in zip(tested, stats.holm([rows[number].p_value for number in tested]) if tested else []):
        rows[number] = rows[number]._replace(p_corrected=p)
    return rows


def _row(learner: str, task: str, arm: Arm, own: Scores, base: Scores, tests: int) -> Row:
    common = [seed for seed in own.seeds if seed in base.seeds]
    nan, paired = math.nan, {}
    if arm.name != BASELINE and len(common) > 1:
        mine, theirs = ([scores.seeds.index(seed) for seed in common] for scores in (own, base))
        difference = own.area[mine] - base.area[theirs]
        low, high = stats.bootstrap_interval(difference, np.mean)
        better_low, better_high = stats.improvement_interval(own.area, base.area)
        paired = {
            "difference": float(difference.mean()),
            "low": low,
            "high": high,
            "final_difference": float((own.final[mine] - base.final[theirs]).mean()),
            "better": stats.probability_of_improvement(own.area, base.area),
            "better_low": better_low,
            "better_high": better_high,
            "p_value": stats.paired_p_value(own.area[mine], base.area[theirs]),
            "smallest_effect": smallest_effect(float(difference.std(ddof=1)), len(common), max(tests, 1)),
        }
    empty = dict.fromkeys(
        ("difference", "low", "high", "final_difference", "better", "better_low", "better_high", "p_value", "smallest_effect"),
        nan,
    )
    return Row(
        learner=learner,
        task=task,
        arm=arm.name,
        seeds=len(own.seeds),
        failed=own.failed,
        mean_success=float(own.area.mean()),
        final=float(own.final.mean()),
        steps_to_threshold=float(np.median(own.steps)),
        p_corrected=nan,
        claim=arm.claim,
        source=arm.source,
        **(empty | paired),
    )


def read(args: argparse.Namespace, learner: str, task: str) -> dict[str, Scores]:
    """Returns what the runs that have ended came to, by arm; empty where there are none."""
    folder, threshold = folder_of(args, learner, task), THRESHOLDS.get(task, 0.9)
    if not any((folder / grid.CELLS).glob("*/result.json")):
        return {}
    wanted = {str(_told(spec_of(learner, task, arm, args.toy))): arm.name for arm in ARMS}
    by_arm: dict[str, list[dict[str, Any]]] = {}
    for trial in tables.read(folder):
        told = {name: trial["settings"][name] for name in (*_PARTS, *_NUMBERS)}
        if (name := wanted.get(str(told))) is not None:
            by_arm.setdefault(name, []).append(trial)
    return {name: _scores(task, name, by_arm[name], threshold) for arm in ARMS if (name := arm.name) in by_arm}


_PARTS, _NUMBERS = ("sampler", "metric", "priority", "generator"), ("priority_fraction", "hindsight_reward")


def _told(run: RunSpec) -> dict[str, Any]:
    return {**{name: getattr(run, name) for name in _PARTS}, **{name: float(getattr(run.hparams, name)) for name in _NUMBERS}}


def _scores(task: str, name: str, trials: list[dict[str, Any]], threshold: float) -> Scores:
    (groups,) = comparison.groups(trials).values()
    (group,) = groups
    reach = stats.first_reach(group.env_steps, group.success, threshold)
    return Scores(group.seeds, comparison._areas(group), group.final, reach, group.failed)


def report(args: argparse.Namespace, console: Console) -> int:
    """Writes bakeoff.csv and a forest plot a task of what has ended; returns the number of rows."""
    rows: list[Row] = []
    for task in args.tasks:
        for learner in args.learners:
            scores = read(args, learner, task)
            rows += compare(learner, task, scores) if BASELINE in scores else []
    if not rows:
        console.print(f"{args.out}: no run of `{BASELINE}` has ended, and so nothing can be compared yet")
        return 0
    with files.atomic_write(args.out / TABLE) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in rows)
    console.print(f"wrote {args.out / TABLE}")
    for task in args.tasks:
        if own := [row for row in rows if row.task == task]:
            path = args.out / f"{identity.in_a_path(task)}_forest.png"
            forest(own, path)
            console.print(f"wrote {path}")
    return len(rows)


def forest(rows: Sequence[Row], path: Path) -> None:
    """Draws the paired differences to `future` of a task's arms, a panel a learner, with intervals and corrected p."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    learners = list(dict.fromkeys(row.learner for row in rows))
    names = [arm.name for arm in ARMS if any(row.arm == arm.name for row in rows) and arm.name != BASELINE]
    height = 1.3 + 0.3 * max(len(names), 1)
    figure, axes = plt.subplots(1, len(learners), figsize=(5.2 * len(learners), height), sharey=True, squeeze=False)
    for axis, learner in zip(axes[0], learners):
        for row in rows:
            if row.learner != learner or math.isnan(row.difference):
                continue
            place = names.index(row.arm)
            shown = "black" if row.p_corrected < ALPHA else "0.5"
            around = [[row.difference - row.low], [row.high - row.difference]]
            axis.errorbar(row.difference, place, xerr=around, fmt="o", color=shown, capsize=3, markersize=4)
            axis.annotate(
                f"p {row.p_corrected:.2g}", (1.01, place), xycoords=("axes fraction", "data"), fontsize=7, va="center"
            )
        axis.axvline(0.0, color="0.6", linewidth=0.8)
        axis.set_title(learner, fontsize=10)
        axis.set_xlabel(f"mean success over epochs, difference to {BASELINE}")
        axis.grid(axis="x", alpha=0.2)
    axes[0][0].set_yticks(range(len(names)), names)
    axes[0][0].invert_yaxis()
    figure.suptitle(f"{rows[0].task}: paired by seed, 95 % intervals; black where p corrected < {ALPHA}", fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> int:
    """Plans, trains and reports; 0 where all is done, 3 where runs are left for the same command."""
    args, console = parse(argv), Console(highlight=False, soft_wrap=True)
    if args.plan:
        plan(args, console)
        return 0
    done = args.report or train(args, console)
    report(args, console)
    if not done:
        console.print("stopped; the same command goes on")
    return 0 if done else 3


if __name__ == "__main__":
    sys.exit(main())
