"""Results of runs that have ended, and whether they can be believed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mjx_dher.runs.folder import loggers, run_folder
from mjx_dher.runs.folder.run_folder import FAILED, FINISHED
from mjx_dher.system.files import FolderError


def exists(folder: Path) -> bool:
    """Returns whether the run has a result, believable or not."""
    return (folder / run_folder.RESULT_FILE).exists()


def read(folder: Path) -> dict[str, Any]:
    """Returns the result of a run that has ended.

    Raises:
      FolderError: it is missing or damaged.
    """
    path = folder / run_folder.RESULT_FILE
    if path.exists() and not path.is_file():
        raise FolderError(f"{path} is damaged: it is not a file")  # a FIFO, whose reader would wait for ever
    try:
        content = json.loads(path.read_text())
        return {"reason": "", **content, "status": str(content["status"]), "epochs": int(content["epochs"])}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FolderError(f"{path} is damaged ({type(error).__name__}: {error})") from error


def can_go_on(folder: Path, total_steps: int) -> bool:
    """Returns whether a run that has ended can go on from a checkpoint: it failed, or `total_steps` is more than it made.

    Raises:
      FolderError: its result is damaged.
    """
    result = read(folder)
    due = result["status"] == FAILED or result.get("env_steps", total_steps) < total_steps
    return due and bool(run_folder.checkpoints(folder))


def problem(folder: Path) -> str | None:
    """Returns why a run with a result is not whole: its curve is cut, or its files are not of one run. None where it is."""
    try:
        result = read(folder)
        content, _ = run_folder.read(folder)
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
    """Returns whether the run has ended, and its result can be believed."""
    return exists(folder) and problem(folder) is None
