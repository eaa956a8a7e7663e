"""Tables of a sweep: reads its finished trials and writes results.csv, results.npz and finals.csv."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher.runs.folder import fingerprint, loggers, results, run_folder
from mjx_dher.runs.folder.run_folder import FAILED
from mjx_dher.sweeps.grid import CELLS
from mjx_dher.system import files
from mjx_dher.system.files import FolderError, atomic_write

RESULTS = "results.csv"
FINALS = "finals.csv"
_FINAL = ("success_rate", "reset_success_rate", "return_mean", "episodes")


def read(folder: Path) -> list[dict[str, Any]]:
    """Finished trials of a sweep, each a dict.

    Keys: folder, settings, seed, asked_engine, lanes, status, reason, curve and final. The settings include the engine used
    and `source`: custom source files, JAX flags, and the number of devices if several share the run. The curve has lists
    by column. The last evaluation, final, is empty if the run failed. Raises FolderError if it is not a sweep, no run has
    ended, a link leads out of the folder, or a trial is invalid (`results.read_trial`), and OSError if a folder cannot be read.
    """
    cells = _entries(folder / CELLS)
    inside = files.inside(folder, [folder / CELLS, *cells, *(path for cell in cells for path in _entries(cell))])
    paths = [path.parent for path in inside if path.name == run_folder.RESULT_FILE]
    if not paths:
        raise FolderError(f"{folder} has no finished run of a sweep")
    trials = [_read_trial(path) for path in paths]
    return sorted(trials, key=lambda t: (t["settings"]["env"], t["settings"]["sampler"], str(t["settings"]), t["seed"]))


def _entries(path: Path) -> list[Path]:
    """Entries of a folder, or none of a file. Raises OSError for a folder that cannot be read, which `glob` takes for empty."""
    return list(path.iterdir()) if path.is_dir() else []


def _read_trial(path: Path) -> dict[str, Any]:
    try:
        _, content, spec, rows, result = results.read_trial(path)
    except FolderError as error:
        raise FolderError(f"{error}; run the sweep's command to train it again, or remove the folder") from error
    failed = result["status"] == FAILED
    flags = [f"{name} {value}" for name, value in content.get("jax_flags", {}).items()]
    if (sharers := content.get("devices", 1) // content.get("lanes", 1)) > 1:  # other first states, noise and batches
        flags.append(f"{sharers} devices")
    try:
        columns = [name for name in (rows[0] if rows else ()) if name != loggers.DIGEST]
        return {
            "folder": path,
            "settings": {
                **fingerprint.settings(spec),
                "engine": content["physics"],
                "source": ", ".join([*dict.fromkeys(content["sources"].values()), *flags]),
            },
            "seed": spec.seed,
            "asked_engine": spec.engine,
            "status": result["status"],
            "reason": result["reason"],
            "lanes": result["lanes"],
            "final": {} if failed else {name: _short(result.get(name)) for name in _FINAL},
            "curve": {name: [row[name] for row in rows] for name in columns},
        }
    except (ValueError, KeyError, TypeError) as error:
        raise FolderError(f"{path} is not a finished run of a sweep ({type(error).__name__}: {error})") from error


def _short(value: float | None) -> float:
    """Rounds a number to the digits of metrics.csv. None, which result.json has for NaN, is NaN."""
    return value if isinstance(value, int) else float(f"{math.nan if value is None else value:.6g}")


def write(folder: Path, trials: Sequence[dict[str, Any]]) -> None:
    """Writes the tables of the trials from `read`. docs/sweeps.md describes the columns."""
    results: list[dict[str, Any]] = []
    finals: list[dict[str, Any]] = []
    for trial in trials:
        sizes = "x".join(map(str, trial["settings"]["hidden_sizes"]))
        own = {"hidden_sizes": sizes, "env_kwargs": " ".join(trial["settings"]["env_kwargs"])}
        head = {name: "" if value is None else value for name, value in {**trial["settings"], **own}.items()}
        head |= {"seed": trial["seed"], "lanes": trial["lanes"]}
        curve = {f"metric_{name}" if name in head else name: values for name, values in trial["curve"].items()}
        epochs = range(len(curve.get("epoch", ())))
        results += [{**head, **{name: values[i] for name, values in curve.items()}} for i in epochs]
        last = {name: curve[name][-1] for name in ("epoch", "env_steps", "updates", "wall_seconds") if epochs}
        finals.append({**head, "status": trial["status"], "reason": trial["reason"], **last, **trial["final"]})
    _write_csv(folder / RESULTS, results)
    _write_csv(folder / FINALS, finals)
    columns = {name: np.array([row.get(name, np.nan) for row in results]) for name in _columns(results)}
    with atomic_write(folder / "results.npz") as partial, partial.open("wb") as file:
        np.savez_compressed(file, **columns)  # type: ignore[arg-type]


def _columns(rows: Sequence[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _columns(rows), restval="")
        writer.writeheader()
        writer.writerows(rows)
