"""Where a run's numbers go: the screen, a CSV file, and, where asked for, JSON lines, TensorBoard or Weights & Biases."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from mjx_dher.host import memory
from mjx_dher.host.files import FolderError, atomic_write
from mjx_dher.names import check_name, require_extra
from mjx_dher.runs import run_folder
from mjx_dher.runs.run_folder import METRICS_FILE

# The columns of metrics.csv that are always there, first and in this order; whatever an epoch's metrics hold more follows.
COUNTS = ("epoch", "env_steps", "updates", "wall_seconds")
FIRST_COLUMNS = (*COUNTS, "success_rate", "return_mean")
OLD_NAMES = {"eventful_share": "priority_mean"}  # metrics of earlier versions, and what they are called now
LOGS = ("jsonl", "tensorboard", "wandb")


class Sink(Protocol):
    """Takes a row after each epoch."""

    def write(self, row: dict[str, Any]) -> None: ...

    def close(self) -> None: ...


class CsvSink:
    """metrics.csv: one line an epoch, on disk before the next begins.

    Args:
      path: of the file.
      epochs: of a run that is resumed, those that had ended; their lines stay, and later ones go.

    Raises:
      FolderError: the file has not the lines of all these epochs.
    """

    def __init__(self, path: Path, epochs: int = 0):
        self._writer: csv.DictWriter[str] | None = None
        kept = _keep_lines(path, 1 + epochs if epochs else 0)
        if kept and [line.split(",")[0] for line in kept] != ["epoch", *map(str, range(1, 1 + epochs))]:
            raise FolderError(f"{path} is damaged: it has not the lines of all {epochs} epochs that had ended")
        self._file = path.open("a", newline="")
        if kept:
            self._writer = csv.DictWriter(self._file, [OLD_NAMES.get(name, name) for name in kept[0].strip().split(",")])

    def write(self, row: dict[str, Any]) -> None:
        if self._writer is None:
            columns = [*FIRST_COLUMNS, *(name for name in row if name not in FIRST_COLUMNS)]
            self._writer = csv.DictWriter(self._file, columns)
            self._writer.writeheader()
        self._writer.writerow({name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()})
        self._file.flush()

    def close(self) -> None:
        self._file.close()


class JsonlSink:
    """metrics.jsonl: an object a line, an epoch each; numbers that are not finite are null. See `CsvSink`."""

    def __init__(self, path: Path, epochs: int = 0):
        _keep_lines(path, epochs)
        self._file = path.open("a")

    def write(self, row: dict[str, Any]) -> None:
        self._file.write(json.dumps({name: v if math.isfinite(v) else None for name, v in row.items()}) + "\n")
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def _keep_lines(path: Path, count: int) -> list[str]:
    """Cuts a file after `count` lines, or makes it, and returns them."""
    lines = path.read_bytes().decode().splitlines(keepends=True)[:count] if count and path.exists() else []
    if len(lines) < count or not all(line.endswith("\n") for line in lines):
        raise FolderError(f"{path} is damaged: it has {len(lines)} whole lines, not {count}")
    with atomic_write(path) as partial:
        partial.write_bytes("".join(lines).encode())
    return lines


class TensorBoardSink:
    """An event file for TensorBoard in `path`, over environment steps. Extra `tensorboard`."""

    def __init__(self, path: Path, env_steps: int = 0):
        from tensorboardX import SummaryWriter

        self._writer = SummaryWriter(str(path), purge_step=env_steps + 1 if env_steps else None)

    def write(self, row: dict[str, Any]) -> None:
        for name, value in row.items():
            if name not in COUNTS:
                self._writer.add_scalar(name, value, row["env_steps"])
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


class WandbSink:
    """A run of Weights & Biases, whose own variables rule it (WANDB_MODE=offline, WANDB_PROJECT, ...). Extra `wandb`.

    Args:
      folder: of the run; what is logged offline is kept in it, and a resumed run goes on with the same one.
      content: of config.json.
    """

    def __init__(self, folder: Path, content: dict[str, Any]):
        import wandb

        run = run_folder.to_spec(folder, content)
        written = json.loads((folder / run_folder.CONFIG_FILE).read_text())  # as it was, whatever version wrote it
        identity = hashlib.sha256(json.dumps([folder.absolute().name, written], sort_keys=True).encode()).hexdigest()[:16]
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "mjx-dher"),
            name=folder.absolute().name,
            id=identity,
            resume="allow",
            dir=folder,
            config={**run_folder.settings(run), "seed": run.seed, "engine": content["physics"]},
            settings=wandb.Settings(silent=True),
        )

    def write(self, row: dict[str, Any]) -> None:
        self._run.log(row, step=row["epoch"], commit=True)

    def close(self) -> None:
        self._run.finish()


EXTRAS = {"tensorboard": "tensorboardX", "wandb": "wandb"}  # of LOGS, and the package that each needs


def check(logs: Sequence[str]) -> None:
    """Raises unless all names are in LOGS and their packages are installed.

    Raises:
      ValueError: names the log, and the extra to install.
    """
    for log in logs:
        check_name("log", log, LOGS)
        if log in EXTRAS:
            require_extra(f"log {log}", EXTRAS[log], log)


def open_sinks(folder: Path, logs: Sequence[str], epochs: int = 0, env_steps: int = 0) -> list[Sink]:
    """Opens metrics.csv, and `logs`, of the run in `folder`, of which so many epochs and environment steps had ended."""
    makers: dict[str, Callable[[], Sink]] = {
        "jsonl": lambda: JsonlSink(folder / "metrics.jsonl", epochs),
        "tensorboard": lambda: TensorBoardSink(folder / "tensorboard", env_steps),
        "wandb": lambda: WandbSink(folder, run_folder.read_content(folder)),
    }
    return [CsvSink(folder / METRICS_FILE, epochs), *(makers[log]() for log in dict.fromkeys(logs))]


def row(progress: Any, metrics: dict[str, float]) -> dict[str, Any]:
    """Returns what the sinks take of an epoch: a `loop.Progress` and the metrics of one run, in the order of metrics.csv."""
    steps, updates = progress.env_steps / progress.epoch, progress.updates / progress.epoch  # all epochs are alike
    first = {name: metrics[name] for name in FIRST_COLUMNS if name in metrics}
    return {
        **{name: getattr(progress, name) for name in COUNTS},
        **first,
        **metrics,
        "steps_per_second": steps / progress.epoch_seconds,
        "updates_per_second": updates / progress.epoch_seconds,
        "memory_bytes": memory.used_bytes() or math.nan,
    }
