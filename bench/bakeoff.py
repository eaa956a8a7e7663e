"""Bake-off of hindsight methods: every arm of bench/bakeoff_arms.py against `future`, with the same seeds.

    python bench/bakeoff.py --out bakeoff --plan        what would be trained
    python bench/bakeoff.py --out bakeoff               trains and reports; run it again to resume
    python bench/bakeoff.py --out bakeoff --report      reports the runs that have ended
    python bench/bakeoff.py --out toy --toy --seeds 3   the same on the point mass, on a CPU in minutes

Each learner and task is a sweep with a separate folder (`python train.py plot bakeoff/paper-slide` draws it, too). The report
is bakeoff.csv, with one row per arm, learner and task, and one forest plot per task. p is corrected over the arms in --arms.
bakeoff_runs.csv has one row per run: `--runs FILE` resumes from it on a machine without the folders.
docs/experiments/bakeoff.md has the plan.
"""

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bakeoff_arms import BAKEOFF, THRESHOLDS, Experiment
from bakeoff_report import Row, compare, corrected, forest
from bakeoff_runs import Run, by_arm, load, merged, save
from rich.console import Console

from mjx_dher import stats
from mjx_dher.cli import sentence
from mjx_dher.cli.common import Screen, make_env
from mjx_dher.cli.settings import check_writable
from mjx_dher.runs.folder import fingerprint, reading, results
from mjx_dher.spec import Options, RunSpec, validate
from mjx_dher.sweeps import comparison, grid, tables
from mjx_dher.system import files, signals
from mjx_dher.system.machine import prepare

TOY_TASK = "point_mass:PointMass"


def parse(
    argv: Sequence[str] | None = None, experiment: Experiment = BAKEOFF, about: str | None = __doc__
) -> argparse.Namespace:
    """Checked arguments. Unusable ones end the program with status 2 and an error message."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    learners, tasks, names = experiment.learners, experiment.tasks, [arm.name for arm in experiment.arms if arm.group]
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweeps and of the report")
    parser.add_argument("--learners", nargs="+", choices=learners, default=learners)
    parser.add_argument("--tasks", nargs="+", choices=tasks, default=tasks)
    parser.add_argument("--arms", nargs="+", choices=names, default=names)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--lanes", type=int, help="parallel runs (default: as many as fit on a GPU, 1 on a CPU)")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after the epoch that ends then; resumable")
    parser.add_argument("--plan", action="store_true", help="print what would be trained, and train nothing")
    parser.add_argument("--report", action="store_true", help="report the runs that have ended, and train nothing")
    parser.add_argument("--runs", type=Path, nargs="+", default=(), help="runs from other machines: *_runs.csv of a report")
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
        args.learners, args.tasks = learners[:1], (TOY_TASK,)
        sys.path.insert(0, str(Path(__file__).parent.parent / "docs" / "examples"))
    args.arms = [arm for arm in experiment.arms if arm.name in (experiment.baseline, *args.arms)]
    args.experiment = experiment
    try:
        if not args.plan:
            check_writable(args.out)
        former = {arm.name for arm in experiment.arms if arm.former}  # their settings have another meaning today
        args.known = {run.name: run for path in args.runs for run in load(path, experiment) if run.arm not in former}
    except files.FolderError as error:
        parser.error(str(error))
    return args


def folder_of(args: argparse.Namespace, learner: str, task: str) -> Path:
    """Folder of a sweep."""
    return args.out / f"{learner}-{fingerprint.in_a_path(task)}"


def trials_of(args: argparse.Namespace, learner: str, task: str, group: str) -> list[RunSpec]:
    """Runs of the arms of a group, seed by seed, so that runs to be compared end together."""
    settings = [args.experiment.spec_of(learner, task, arm, args.toy) for arm in args.arms if arm.group == group]
    for setting in settings:
        validate(setting)
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    return [dataclasses.replace(setting, seed=seed) for seed in seeds for setting in settings]


def plan(args: argparse.Namespace, console: Console) -> None:
    """Prints the runs of each sweep, and the number already done."""
    for learner in args.learners:
        for task in args.tasks:
            folder = folder_of(args, learner, task)
            runs = [run for group in args.experiment.groups for run in trials_of(args, learner, task, group)]
            done = sum(is_done(args, folder, run) for run in runs)
            steps = runs[0].config.total_steps
            console.print(f"{folder}: {len(runs)} runs of {steps:,} steps, {done} done; learner {runs[0].learner}")


def train(args: argparse.Namespace, console: Console) -> bool:
    """Trains the runs that are not done. True if all are done afterwards."""
    prepare()
    until = time.monotonic() + 60 * args.minutes
    with signals.taken(), signals.held(console.print, args.out):
        for learner in args.learners:
            for task in args.tasks:
                for group in args.experiment.groups:
                    if signals.are_asked() or time.monotonic() > until:
                        return False
                    if not _train_group(args, (learner, task, group), console, until):
                        return False
    return True


def _train_group(args: argparse.Namespace, which: tuple[str, str, str], console: Console, until: float) -> bool:
    """Trains the runs of a group that are not done, in one program. True if all are done afterwards."""
    learner, task, group = which
    folder = folder_of(args, learner, task)
    todo = [run for run in trials_of(args, learner, task, group) if not is_done(args, folder, run)]
    if not todo:
        return True
    files.make_folder(folder / grid.CELLS)
    console.print(f"{folder}, {group}: {len(todo)} runs")
    screen = Screen(console, todo)
    try:
        grid.train(
            folder,
            todo,
            make_env,
            options=Options(final_episodes=100 if args.toy else 500, checkpoint_every=1 if args.toy else 5),
            lanes=args.lanes,
            should_stop=lambda: signals.are_asked() or time.monotonic() > until,
            report=console.print,
            on_epoch=screen.show,
        )
    finally:
        screen.close()
    return all(is_done(args, folder, run) for run in todo)


def is_done(args: argparse.Namespace, folder: Path, run: RunSpec) -> bool:
    """Whether a run has ended, in its folder or in --runs."""
    return fingerprint.trial_name(run) in args.known or grid.is_done(folder, run)


def trials_by_arm(args: argparse.Namespace, learner: str, task: str) -> dict[str, list[dict[str, Any]]]:
    """Trials (`tables.read`) of a sweep's folder that have ended, by arm. Equal arms share trials, which the first one has."""
    folder, arms = folder_of(args, learner, task), args.experiment.arms
    wanted = {args.experiment.spec_of(learner, task, arm, args.toy): arm.name for arm in reversed(arms)}
    found: dict[str, list[dict[str, Any]]] = {arm.name: [] for arm in arms}
    for trial in tables.read(folder) if any((folder / grid.CELLS).glob("*/result.json")) else []:
        _, spec = reading.read_run(trial["folder"])
        if (arm := wanted.get(dataclasses.replace(spec, seed=0))) is not None:
            found[arm].append(trial)
    return {arm: trials for arm, trials in found.items() if trials}


def read(args: argparse.Namespace, learner: str, task: str) -> list[Run]:
    """Results of the runs that have ended: first from the sweep's folder, then from --runs."""
    threshold, trials = THRESHOLDS.get(task, 0.9), trials_by_arm(args, learner, task)
    own = [run for arm in trials for run in _runs((learner, task, arm), trials[arm], threshold)]
    return merged([*own, *(run for run in args.known.values() if (run.learner, run.task) == (learner, task))])


def _runs(which: tuple[str, str, str], trials: list[dict[str, Any]], threshold: float) -> list[Run]:
    (groups,) = comparison.groups(trials).values()
    (group,) = groups
    reach = stats.first_reach(group.env_steps, group.success, threshold)
    by_seed = {trial["seed"]: trial for trial in trials}
    return [
        Run(
            *which, seed, Path(by_seed[seed]["folder"]).name, int(by_seed[seed]["status"] == results.FAILED), *map(float, found)
        )
        for seed, *found in zip(group.seeds, comparison.areas_of(group), group.final, reach)
    ]


def report(args: argparse.Namespace, console: Console) -> int:
    """Writes the table and the forest plots of the ended runs. Returns the number of rows."""
    rows: list[Row] = []
    runs: list[Run] = []
    tests = args.experiment.tests
    for task in args.tasks:
        its: list[Row] = []
        for learner in args.learners:
            runs += (own := read(args, learner, task))
            scores = by_arm(own)
            its += compare(learner, task, scores, args.arms, tests) if args.experiment.baseline in scores else []
        rows += corrected(its, tests) if tests else its
    if not rows:
        console.print(f"{args.out}: no run of `{args.experiment.baseline}` has ended, and so nothing can be compared yet")
        return 0
    files.make_folder(args.out)
    save(args.out / args.experiment.runs, runs)
    console.print(f"wrote {args.out / args.experiment.runs}, {len(runs)} runs")
    save(args.out / args.experiment.table, [row[:-1] for row in rows], Row._fields[:-1])  # `runs` has the seeds' differences
    console.print(f"wrote {args.out / args.experiment.table}")
    for task in args.tasks:
        if shown := [row for row in rows if row.task == task]:
            path = args.out / f"{fingerprint.in_a_path(task)}_forest.png"
            forest(shown, path, args.experiment.baseline)
            console.print(f"wrote {path}")
    return len(rows)


def main(argv: Sequence[str] | None = None, experiment: Experiment = BAKEOFF, about: str | None = __doc__) -> int:
    """Plans, trains and reports. Returns 0 (all done), 2 (an error, which is printed) or 3 (run again for the rest)."""
    args, console = parse(argv, experiment, about), Console(highlight=False, markup=False, soft_wrap=True)
    try:
        if args.plan:
            plan(args, console)
            return 0
        done = args.report or train(args, console)
        report(args, console)
    except Exception as error:
        if (reason := sentence(error)) is None:
            raise  # a bug in this program
        console.print(f"error: {reason}", style="red")
        return 2
    if not done:
        console.print("stopped; run the same command again to resume")
    return 0 if done else 3


if __name__ == "__main__":
    sys.exit(main())
