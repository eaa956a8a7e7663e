"""Results of runs that have ended, and checks that their files are whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mjx_dher.runs.folder import loggers, run_folder
from mjx_dher.runs.folder.run_folder import FAILED, FINISHED
from mjx_dher.system import files
from mjx_dher.system.files import FolderError


def has_result(folder: Path) -> bool:
    """Whether the run has a result, damaged or not."""
    return (folder / run_folder.RESULT_FILE).exists()


def read_result(folder: Path) -> dict[str, Any]:
    """Reads the result of a run that has ended.

    Raises:
      FolderError: it is missing or damaged.
    """
    path = folder / run_folder.RESULT_FILE
    try:
        content = files.read_json(path)
        return {"reason": "", **content, "status": str(content["status"]), "epochs": int(content["epochs"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FolderError(f"{path} is damaged ({type(error).__name__}: {error})") from error


def can_go_on(folder: Path, total_steps: int) -> bool:
    """Whether a run that has ended can resume: it failed, or made fewer than `total_steps`, and it has a checkpoint.

    Raises:
      FolderError: its result is damaged.
    """
    result = read_result(folder)
    due = result["status"] == FAILED or result.get("env_steps", total_steps) < total_steps
    return due and bool(run_folder.checkpoints(folder))


def result_problem(folder: Path) -> str | None:
    """Reason why a run with a result is not whole: metrics are missing, or files have other settings. None if it is whole."""
    try:
        result = read_result(folder)
        content, _ = run_folder.read_run(folder)
    except FolderError as error:
        return str(error)
    epochs = result["epochs"] - (result["status"] == FAILED)  # the epoch that failed has no line
    whole = loggers.whole_epochs(folder)
    if whole != epochs:
        return f"{folder / run_folder.METRICS_FILE} has whole lines of {whole} of {epochs} epochs"
    if result["status"] == FINISHED and not (folder / run_folder.POLICY_FILE).exists():
        return f"{folder} has no {run_folder.POLICY_FILE}"
    digest = content["digest"]
    rows = loggers.read_rows(folder / run_folder.METRICS_FILE)
    last = {run_folder.RESULT_FILE: result, run_folder.METRICS_FILE: rows[-1] if rows else {loggers.DIGEST: digest}}
    for name, values in last.items():
        if (other := values.get(loggers.DIGEST)) != digest:
            return f"{folder / name} is of a run with other settings: its digest is {other}, that of config.json {digest}"
    return None


def is_whole(folder: Path) -> bool:
    """Whether the run has ended and its files are whole."""
    return has_result(folder) and result_problem(folder) is None
