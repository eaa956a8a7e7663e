"""Runs of bench/bakeoff.py as rows of a file, which suffices for the report without the runs' folders."""

import csv
import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bakeoff_arms import Experiment
from bakeoff_report import Scores

from mjx_dher.runs.folder import fingerprint
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError


class Run(NamedTuple):
    """Result of a run."""

    learner: str
    task: str
    arm: str
    seed: int
    name: str  # of its folder, which has a digest of its settings
    failed: int  # 1 where it failed
    mean_success: float  # over the epochs
    final: float  # success of the last policy
    steps: float  # environment steps to the threshold; infinite where it is never reached


def save(path: Path, rows: Iterable[Iterable[Any]], columns: Sequence[str] = Run._fields) -> None:
    """Writes rows, by default runs, under the names of their columns."""
    with files.atomic_write(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([f"{value:.12g}" if isinstance(value, float) else value for value in row] for row in rows)


def load(path: Path, experiment: Experiment | None = None) -> list[Run]:
    """Runs of a file written by `save`.

    Raises:
      FolderError: the file does not exist, a row is invalid, or a run's settings differ from the `experiment`'s arm today.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = csv.DictReader(file)
            if tuple(rows.fieldnames or ()) != Run._fields:
                raise FolderError(f"{path} has not the columns {', '.join(Run._fields)}")
            found = [_run(f"{path}, line {number}", row) for number, row in enumerate(rows, start=2)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FolderError(f"{path} cannot be read ({error})") from error
    if experiment is not None:
        for number, run in enumerate(found, start=2):
            _check(f"{path}, line {number}", run, experiment)
    return found


def _run(where: str, row: dict[str, str]) -> Run:
    """The run of a row. Raises FolderError if the row is invalid."""
    try:
        run = Run(
            *(row["learner"], row["task"], row["arm"], int(row["seed"]), row["name"], int(row["failed"])),
            *(float(row["mean_success"]), float(row["final"]), float(row["steps"])),
        )
    except (TypeError, ValueError) as error:
        raise FolderError(f"{where}: {error}") from error
    if not (0 <= run.mean_success <= 1 and 0 <= run.final <= 1 and run.steps > 0 and run.failed in (0, 1)):
        raise FolderError(f"{where}: success must lie between 0 and 1, steps above 0, failed be 0 or 1; got {run[5:]}")
    return run


def _check(where: str, run: Run, experiment: Experiment) -> None:
    """Raises FolderError for a run that the experiment lacks, or has with other settings."""
    arms = {arm.name: arm for arm in experiment.arms}
    for column, values in {"learner": experiment.learners, "task": experiment.tasks, "arm": tuple(arms)}.items():
        if getattr(run, column) not in values:
            raise FolderError(f"{where}: {column} must be one of {', '.join(values)}; got {getattr(run, column)!r}")
    today = name_of(experiment.spec_of(run.learner, run.task, arms[run.arm], False), run.seed)
    if run.name != today:
        raise FolderError(f"{where}: {run.name} has other settings than {run.arm} has today ({today}); remove the row")


def name_of(spec: RunSpec, seed: int) -> str:
    """Folder name of a run with this seed."""
    return fingerprint.trial_name(dataclasses.replace(spec, seed=seed))


def merged(runs: Iterable[Run]) -> list[Run]:
    """The runs without duplicates: the first of each name."""
    found: dict[str, Run] = {}
    for run in runs:
        found.setdefault(run.name, run)
    return list(found.values())


def by_arm(runs: Iterable[Run]) -> dict[str, Scores]:
    """Scores by arm of the runs of one learner and task, ordered by seed."""
    found: dict[str, list[Run]] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        found.setdefault(run.arm, []).append(run)
    return {
        arm: Scores(
            seeds=tuple(run.seed for run in own),
            area=np.array([run.mean_success for run in own]),
            final=np.array([run.final for run in own]),
            steps=np.array([run.steps for run in own]),
            failed=sum(run.failed for run in own),
        )
        for arm, own in found.items()
    }
