"""Where a run's numbers go: the screen, a CSV file, and, where asked for, JSON lines, TensorBoard or Weights & Biases."""

from __future__ import annotations

import csv
import itertools
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from mjx_dher.lookup import check_name, require_extra
from mjx_dher.runs.folder import fingerprint, run_folder
from mjx_dher.runs.folder.run_folder import METRICS_FILE
from mjx_dher.system import files, memory
from mjx_dher.system.files import FolderError

# The columns of metrics.csv that are always there, first and in this order; whatever an epoch's metrics hold more follows.
COUNTS = ("epoch", "env_steps", "updates", "wall_seconds")
FIRST_COLUMNS = (*COUNTS, "success_rate", "return_mean")
LOGS = ("jsonl", "tensorboard", "wandb")
JSON_FILE = "metrics.jsonl"
DIGEST = "digest"  # the last column of metrics.csv


class Sink(Protocol):
    """Takes a row after each epoch."""

    def write(self, row: dict[str, Any]) -> None: ...

    def close(self) -> None: ...


class CsvSink:
    """metrics.csv: one line an epoch, handed to the system before the next begins. Its last column is the run's digest.

    Args:
      path: of the file.
      epochs: of a run that is resumed, those that had ended; their lines stay, and later ones go.
      digest: of the run's settings; see `fingerprint.digest`.

    Raises:
      FolderError: the file has not the lines of all these epochs.
    """

    def __init__(self, path: Path, epochs: int = 0, digest: str = ""):
        self._writer: csv.DictWriter[str] | None = None
        self._digest = digest
        kept = _whole_lines(path)[: 1 + epochs] if epochs else []
        if epochs and len(kept) != 1 + epochs:
            whole = max(0, len(kept) - 1)
            raise FolderError(f"{path} is damaged: {epochs} epochs had ended, and it has whole lines of {whole}")
        _write(path, kept)
        self._file = path.open("a", newline="")
        if kept:
            self._writer = self._make_writer(kept[0].strip().split(","))

    def write(self, row: dict[str, Any]) -> None:
        if self._writer is None:
            self._writer = self._make_writer([*FIRST_COLUMNS, *(name for name in row if name not in FIRST_COLUMNS), DIGEST])
            self._writer.writeheader()
        values = {name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()}
        self._writer.writerow({**values, DIGEST: self._digest})
        self._file.flush()

    def close(self) -> None:
        self._file.close()

    def _make_writer(self, columns: Sequence[str]) -> csv.DictWriter[str]:
        # A resumed run keeps the columns of its file.
        return csv.DictWriter(self._file, columns, extrasaction="ignore")


class JsonlSink:
    """metrics.jsonl: an object a line, an epoch each; numbers that are not finite are null.

    Args:
      path: of the file.
      epochs: of a run that is resumed, those that had ended; lines that are missing are made of metrics.csv beside it.
    """

    def __init__(self, path: Path, epochs: int = 0):
        lines = path.read_bytes().decode(errors="replace").splitlines(keepends=True) if epochs and path.exists() else []
        whole = list(itertools.takewhile(lambda line: line.endswith("}\n"), lines))[:epochs]
        missing = read_rows(path.with_name(METRICS_FILE))[len(whole) : epochs] if epochs else []
        _write(path, [*whole, *map(_to_json, missing)])
        self._file = path.open("a")

    def write(self, row: dict[str, Any]) -> None:
        self._file.write(_to_json(row))
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def whole_epochs(folder: Path) -> int:
    """Returns up to which epoch metrics.csv in `folder` has whole lines; 0 where there is none."""
    return max(0, len(_whole_lines(folder / METRICS_FILE)) - 1)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Returns the whole lines of a metrics.csv as numbers; the digest stays text."""
    head, *lines = list(csv.reader(_whole_lines(path))) or [[]]
    return [{name: x if name == DIGEST else _to_number(x) for name, x in zip(head, line)} for line in lines]


def _whole_lines(path: Path) -> list[str]:
    """Returns the head of metrics.csv, and its lines up to the first that is cut, or of another epoch than is due."""
    if not path.exists():
        return []
    head, *lines = path.read_bytes().decode(errors="replace").splitlines(keepends=True) or [""]
    columns = head.count(",")
    if not head.startswith(",".join(FIRST_COLUMNS) + ","):
        return []
    whole = itertools.takewhile(
        lambda i: lines[i].startswith(f"{i + 1},") and lines[i].endswith("\n") and lines[i].count(",") == columns,
        range(len(lines)),
    )
    return [head, *(lines[i] for i in whole)]


def _write(path: Path, lines: Sequence[str]) -> None:
    with files.atomic_write(path) as partial:
        partial.write_bytes("".join(lines).encode())
        files.flush(partial)


def _to_number(text: str) -> int | float:
    return int(text) if text.isdigit() else float(text)


def _to_json(row: dict[str, Any]) -> str:
    return json.dumps({name: v if math.isfinite(v) else None for name, v in row.items() if name != DIGEST}) + "\n"


def flush(folder: Path) -> None:
    """Flushes what CSV and JSON lines have of the run in `folder` onto the disk."""
    for name in (METRICS_FILE, JSON_FILE):
        if (folder / name).exists():
            files.flush(folder / name)
    files.flush(folder)


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
        # A resumed run keeps its id, so settings that may change are not part of it.
        described = {name: x for name, x in run_folder.identity_of(content, run).items() if name not in fingerprint.MAY_CHANGE}
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "mjx-dher"),
            name=folder.absolute().name,
            id=fingerprint.sha256_of([folder.absolute().name, described])[:16],
            resume="allow",
            dir=folder,
            config={**fingerprint.settings(run), "seed": run.seed, "engine": content["physics"]},
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
    if not isinstance(logs, (list, tuple)):
        raise ValueError(f"log must be names among {', '.join(LOGS)}; got {logs!r}")
    for log in logs:
        check_name("log", log, LOGS)
        if log in EXTRAS:
            require_extra(f"log {log}", EXTRAS[log], log)


def open_sinks(folder: Path, logs: Sequence[str], epochs: int = 0, env_steps: int = 0, digest: str = "") -> list[Sink]:
    """Opens metrics.csv, and `logs`, of the run in `folder`, of which so many epochs and environment steps had ended."""
    makers: dict[str, Callable[[], Sink]] = {
        "jsonl": lambda: JsonlSink(folder / JSON_FILE, epochs),
        "tensorboard": lambda: TensorBoardSink(folder / "tensorboard", env_steps),
        "wandb": lambda: WandbSink(folder, run_folder.read_content(folder)),
    }
    return [CsvSink(folder / METRICS_FILE, epochs, digest), *(makers[log]() for log in dict.fromkeys(logs))]


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
