"""The tables of a sweep: reads its trials that have ended, writes results.csv, results.npz and finals.csv."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher.host.files import FolderError, atomic_write
from mjx_dher.runs import run_folder
from mjx_dher.runs.run_folder import DIVERGED, FINISHED
from mjx_dher.runs.sinks import OLD_NAMES
from mjx_dher.sweeps.grid import CELLS

RESULTS = "results.csv"
FINALS = "finals.csv"
_FINAL = ("success_rate", "reset_success_rate", "return_mean", "episodes")


def read(folder: Path) -> list[dict[str, Any]]:
    """Returns the trials of a sweep that have ended.

    Each has settings (by name), seed, engine (that ran), lanes, status; curve, lists by column; and final, the last evaluation,
    empty for a run that diverged.

    Raises:
      FolderError: no sweep, none ended, or a folder that cannot be read.
    """
    paths = sorted(path.parent for path in (folder / CELLS).glob(f"*/{run_folder.RESULT_FILE}"))
    if not paths:
        raise FolderError(f"{folder} holds no finished run of a sweep")
    trials = [_read_trial(path) for path in paths]
    return sorted(trials, key=lambda t: (t["settings"]["env"], t["settings"]["sampler"], str(t["settings"]), t["seed"]))


def _read_trial(path: Path) -> dict[str, Any]:
    content = run_folder.read_content(path)
    spec = run_folder.to_spec(path, content)
    try:
        result = json.loads((path / run_folder.RESULT_FILE).read_text())
        with (path / run_folder.METRICS_FILE).open() as file:
            rows = list(csv.DictReader(file))
        status = result.get("status", FINISHED)
        columns = rows[0] if rows or status != DIVERGED else {}
        return {
            "settings": {**run_folder.settings(spec), "engine": content["physics"]},
            "seed": spec.seed,
            "status": status,
            "lanes": result["lanes"],
            "final": {name: _short(result[name]) for name in _FINAL} if status != DIVERGED else {},
            "curve": {OLD_NAMES.get(name, name): [_number(row[name]) for row in rows] for name in columns},
        }
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise FolderError(f"{path} is not a finished run of a sweep ({type(error).__name__}: {error})") from error


def _number(text: str) -> int | float:
    return int(text) if text.isdigit() else float(text)


def _short(value: float) -> float:
    """Returns a number to the digits of metrics.csv."""
    return value if isinstance(value, int) else float(f"{value:.6g}")


def write(folder: Path, trials: Sequence[dict[str, Any]]) -> None:
    """Writes the tables of trials that `read` gave; docs/sweeps.md describes the columns."""
    results: list[dict[str, Any]] = []
    finals: list[dict[str, Any]] = []
    for trial in trials:
        sizes = "x".join(map(str, trial["settings"]["hidden_sizes"]))
        head = {**trial["settings"], "hidden_sizes": sizes, "seed": trial["seed"], "lanes": trial["lanes"]}
        curve = trial["curve"]
        epochs = range(len(curve.get("epoch", ())))
        results += [{**head, **{name: values[i] for name, values in curve.items()}} for i in epochs]
        last = {name: curve[name][-1] for name in ("epoch", "env_steps", "updates", "wall_seconds") if epochs}
        finals.append({**head, "status": trial["status"], **last, **trial["final"]})
    _write_csv(folder / RESULTS, results)
    _write_csv(folder / FINALS, finals)
    columns = {name: np.array([row.get(name, np.nan) for row in results]) for name in _columns(results)}
    with atomic_write(folder / "results.npz") as partial, partial.open("wb") as file:
        np.savez_compressed(file, **columns)  # type: ignore[arg-type]


def _columns(rows: Sequence[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    with atomic_write(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, _columns(rows), restval="")
        writer.writeheader()
        writer.writerows(rows)
