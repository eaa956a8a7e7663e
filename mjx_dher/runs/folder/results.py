"""Metrics and results of runs, with checks that their files are complete."""

import csv
import itertools
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjx_dher.runs.folder import loggers, reading, run_folder
from mjx_dher.runs.folder.run_folder import FAILED, FINISHED
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError


def has_result(folder: Path) -> bool:
    """Whether the run has a result, damaged or not."""
    return (folder / run_folder.RESULT_FILE).exists()


def read_result(folder: Path) -> dict[str, Any]:
    """Reads the result of an ended run. Raises FolderError if it is missing, damaged or belongs to another run."""
    path = folder / run_folder.RESULT_FILE
    with reading.checked(path):
        content = {"reason": "", **files.read_json(path)}
        numbers = {name: value for name, value in content.items() if value is not None}
        reading.check_form(numbers, reading.RESULT_FINISHED if content["status"] == FINISHED else reading.RESULT)
    if content["digest"] != (digest := reading.read_config(folder)["digest"]):
        other = f"its digest is {content['digest']}, but {run_folder.CONFIG_FILE} has {digest}"
        raise FolderError(f"{path} is of a run with other settings: {other}")
    return content


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Reads metrics.csv. All of its lines must belong to the run in `folder`. Raises FolderError if it is not a run folder, or
    a line is missing, invalid or belongs to another run.
    """
    path, content = folder / run_folder.METRICS_FILE, reading.read_config(folder)
    rows = read_rows(path, reading.digests(content))
    strange = {row.get(loggers.DIGEST) for row in rows} - {content["digest"]}
    if strange and "earlier" not in content:
        warnings.warn(
            f"{path} has lines with digest {', '.join(map(str, strange))}, but {run_folder.CONFIG_FILE} {content['digest']};"
            " its version kept no earlier digests, so the lines may belong to another run",
            stacklevel=2,
        )
    return rows


def read_rows(path: Path, digests: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Reads the lines of a metrics.csv as numbers, up to the first truncated one. The digest stays text.

    `digests` are those that the run has had, in order. Raises FolderError if a line is missing, invalid or of another run.
    """
    head, *lines = list(csv.reader(whole_lines(path))) or [[]]
    rows: list[dict[str, Any]] = []
    left = list(digests or ())
    for number, line in enumerate(lines, 1):
        with reading.checked(path, f"has an invalid line of epoch {number}"):
            row: dict[str, Any] = {name: x if name == loggers.DIGEST else _to_number(name, x) for name, x in zip(head, line)}
            reading.check_form({x: v for x, v in row.items() if v == v or x in loggers.FIRST_COLUMNS}, reading.ROW)  # noqa: PLR0124
            if row["epoch"] != number or (rows and row["env_steps"] <= rows[-1]["env_steps"]):
                raise ValueError(f"epoch {row['epoch']} with env_steps {row['env_steps']} does not follow")
            while left and left[0] != row.get(loggers.DIGEST):
                del left[0]
            if digests is not None and not left:
                raise ValueError(
                    f"its digest {row.get(loggers.DIGEST)} belongs to another run; this one has {', '.join(digests)}"
                )
        rows.append(row)
    return rows


def whole_lines(path: Path) -> list[str]:
    """Head of metrics.csv, and its lines up to the first truncated one."""
    head, *lines = files.whole_lines(path) or [""]
    if not head.startswith(",".join(loggers.FIRST_COLUMNS) + ","):
        return []
    return [head, *itertools.takewhile(lambda line: line.count(",") == head.count(","), lines)]


def _to_number(name: str, text: str) -> int | float:
    try:
        return int(text) if text.isdecimal() else float(text)
    except ValueError:
        raise ValueError(f"{name} must be a number; got {text[:40]!r}") from None


def earlier_digests(folder: Path, digest: str) -> list[str]:
    """Digests that a run had before it resumed with `digest`."""
    content, lines = reading.read_config(folder), [row[loggers.DIGEST] for row in read_metrics(folder)]
    known = reading.digests(content) or [*dict.fromkeys(lines), content["digest"]]
    return [one for one, after in zip(known, [*known[1:], digest]) if one != after]


def failure_of(folder: Path) -> str | None:
    """Epoch in which a run failed and why, or None if it did not fail. Raises FolderError if its result is damaged."""
    result = read_result(folder) if has_result(folder) else {"status": ""}
    return f"it failed in epoch {result['epochs']}: {result['reason']}" if result["status"] == FAILED else None


def checkpoints_to_resume(folder: Path) -> list[Path]:
    """Checkpoints of a run, newest first. Raises FolderError, with the reason, if there is none."""
    if paths := run_folder.checkpoints(folder):
        return paths
    why = failure_of(folder) or "it was stopped before it had saved any (see --checkpoint-every)"
    raise FolderError(f"{folder} has no checkpoint to resume from: {why}")


def can_go_on(folder: Path, total_steps: int) -> bool:
    """Whether an ended run can resume: it failed or made fewer than `total_steps`, and it has a checkpoint. Raises FolderError
    if its result is damaged.
    """
    result = read_result(folder)
    due = result["status"] == FAILED or result["env_steps"] < total_steps
    return due and bool(run_folder.checkpoints(folder))


class Record(NamedTuple):
    """Content of a run's folder."""

    folder: Path
    content: dict[str, Any]  # content of config.json
    spec: RunSpec
    rows: list[dict[str, Any]]  # metrics of each epoch
    result: dict[str, Any]  # content of result.json; empty if the run has not ended

    @property
    def status(self) -> str:
        """Finished, failed or not ended."""
        return str(self.result.get("status", "not ended"))

    @property
    def eval_episodes(self) -> int:
        """Episodes of an evaluation. Each of the devices that share a run plays as many."""
        sharers = max(1, self.content.get("devices", 1) // self.content.get("lanes", 1))
        return math.ceil(self.spec.config.eval_episodes / sharers) * sharers

    def column(self, name: str) -> NDArray:
        """A metric of all epochs, shape [P]; NaN if an epoch lacks it."""
        return np.array([row.get(name, math.nan) for row in self.rows], float)


def read(folder: Path, with_policy: bool = True) -> Record:
    """Reads the files of a run. Raises FolderError if it is not a run folder, or if files are damaged, belong to other runs or,
    in an ended run, are incomplete. A run can resume without its policy, so the policy may be left out of the check.
    """
    result = read_result(folder) if has_result(folder) else {}
    content, spec = reading.read_run(folder)
    rows = read_metrics(folder)
    if result:
        if with_policy and result["status"] == FINISHED:
            path = folder / run_folder.POLICY_FILE
            if not path.exists():
                raise FolderError(f"{folder} has no {run_folder.POLICY_FILE}")
            if other := reading.foreign(content, spec, reading.read_policy_settings(folder)):
                raise FolderError(f"{path} is of a run with other settings: {other}")
        epochs = result["epochs"] - (result["status"] == FAILED)  # the epoch that failed has no line
        path = folder / run_folder.METRICS_FILE
        if len(rows) != epochs:
            raise FolderError(f"{path} has complete lines of {len(rows)} of {epochs} epochs")
        if rows and (last := rows[-1].get(loggers.DIGEST)) != content["digest"]:
            raise FolderError(f"{path} ends with the digest {last}, not {content['digest']}")
    return Record(folder, content, spec, rows, result)


def result_problem(folder: Path, with_policy: bool = True) -> str | None:
    """Message of the error of `read`, or None if the run's files are valid."""
    try:
        read(folder, with_policy)
    except FolderError as error:
        return str(error)
    return None


def read_trial(folder: Path) -> Record:
    """`read` for a trial of a sweep. Raises FolderError also if it was resumed alone with `stop_at` and so has fewer steps."""
    record = read(folder)
    total = record.spec.config.total_steps
    if record.result.get("status") == FINISHED and (steps := record.rows[-1]["env_steps"]) < total:
        raise FolderError(f"{folder} has ended after {steps:,.0f} of {total:,} steps ({record.result['reason']})")
    return record


def trial_problem(folder: Path, spec: RunSpec) -> str | None:
    """Reason why a trial with a result is invalid, or its folder holds another trial. None if it is valid."""
    try:
        reading.check_same(folder, spec, ("physics",))
        read_trial(folder)
    except FolderError as error:
        return str(error)
    return None


def is_done(folder: Path, spec: RunSpec) -> bool:
    """Whether a trial of a sweep has ended with valid files."""
    return has_result(folder) and trial_problem(folder, spec) is None
