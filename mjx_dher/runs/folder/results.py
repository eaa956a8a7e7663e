"""Results of runs that have ended, and checks that their files are whole."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from mjx_dher.runs.folder import contents, loggers, run_folder
from mjx_dher.runs.folder.run_folder import FAILED, FINISHED
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError


def has_result(folder: Path) -> bool:
    """Whether the run has a result, damaged or not."""
    return (folder / run_folder.RESULT_FILE).exists()


def read_result(folder: Path) -> dict[str, Any]:
    """Reads the result of a run that has ended.

    Raises:
      FolderError: it is missing, damaged or of another run.
    """
    path = folder / run_folder.RESULT_FILE
    with run_folder.checked(path):
        content = {"reason": "", **files.read_json(path)}
        numbers = {name: value for name, value in content.items() if value is not None}
        contents.check(numbers, contents.RESULT_FINISHED if content["status"] == FINISHED else contents.RESULT)
    if content["digest"] != (digest := run_folder.read_config(folder)["digest"]):
        other = f"its digest is {content['digest']}, that of {run_folder.CONFIG_FILE} {digest}"
        raise FolderError(f"{path} is of a run with other settings: {other}")
    return content


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Reads the lines of metrics.csv, all of which must be of the run in `folder`.

    Raises:
      FolderError: no run folder, a line that is missing or has an invalid value, or one of another run.
    """
    path, content = folder / run_folder.METRICS_FILE, run_folder.read_config(folder)
    rows = loggers.read_rows(path, run_folder.digests(content))
    strange = {row.get(loggers.DIGEST) for row in rows} - {content["digest"]}
    if strange and "earlier" not in content:
        warnings.warn(
            f"{path} has lines of digest {', '.join(map(str, strange))}, {run_folder.CONFIG_FILE} has {content['digest']}; the"
            " version that wrote it kept no earlier digests, so the lines may be of another run",
            stacklevel=2,
        )
    return rows


def earlier_digests(folder: Path, digest: str) -> list[str]:
    """Digests that a run has had before it resumes with `digest`."""
    content, lines = run_folder.read_config(folder), [row[loggers.DIGEST] for row in read_metrics(folder)]
    known = run_folder.digests(content) or [*dict.fromkeys(lines), content["digest"]]
    return [one for one, after in zip(known, [*known[1:], digest]) if one != after]


def can_go_on(folder: Path, total_steps: int) -> bool:
    """Whether a run that has ended can resume: it failed, or made fewer than `total_steps`, and it has a checkpoint.

    Raises:
      FolderError: its result is damaged.
    """
    result = read_result(folder)
    due = result["status"] == FAILED or result["env_steps"] < total_steps
    return due and bool(run_folder.checkpoints(folder))


def result_problem(folder: Path, with_policy: bool = True) -> str | None:
    """Reason why a run with a result is not whole: its files are damaged, or are of other runs. None if it is whole.

    A run can go on without its policy, and so can be looked at without it.
    """
    try:
        result = read_result(folder)
        content, spec = run_folder.read_run(folder)
        rows = read_metrics(folder)
        if with_policy and result["status"] == FINISHED:
            if not (folder / run_folder.POLICY_FILE).exists():
                return f"{folder} has no {run_folder.POLICY_FILE}"
            if other := run_folder.foreign(content, spec, run_folder.read_policy_settings(folder)):
                return f"{folder / run_folder.POLICY_FILE} is of a run with other settings: {other}"
    except FolderError as error:
        return str(error)
    epochs = result["epochs"] - (result["status"] == FAILED)  # the epoch that failed has no line
    if len(rows) != epochs:
        return f"{folder / run_folder.METRICS_FILE} has whole lines of {len(rows)} of {epochs} epochs"
    if rows and rows[-1].get(loggers.DIGEST) != content["digest"]:
        return (
            f"{folder / run_folder.METRICS_FILE} ends with the digest {rows[-1].get(loggers.DIGEST)}, not {content['digest']}"
        )
    return None


def trial_problem(folder: Path, spec: RunSpec) -> str | None:
    """Reason why a trial of a sweep that has a result is not whole, or its folder holds another trial; None if it is right."""
    try:
        run_folder.check_same(folder, spec, ("physics",))
    except FolderError as error:
        return str(error)
    return result_problem(folder)


def is_done(folder: Path, spec: RunSpec) -> bool:
    """Whether a trial of a sweep has ended, and its files are whole."""
    return has_result(folder) and trial_problem(folder, spec) is None
