"""Where a run's numbers go: the screen and a CSV file."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

from mjx_dher.run_folder import RunFolderError, whole

# The columns of metrics.csv that are always there, first and in this order; whatever an epoch's metrics hold more follows.
FIRST_COLUMNS = ("epoch", "env_steps", "updates", "wall_seconds", "success_rate", "return_mean")


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
      RunFolderError: the file has not the lines of all these epochs.
    """

    def __init__(self, path: Path, epochs: int = 0):
        self._writer: csv.DictWriter[str] | None = None
        if epochs == 0:
            self._file = path.open("w", newline="")
            return
        lines = path.read_bytes().decode().splitlines(keepends=True) if path.exists() else []
        kept = lines[: 1 + epochs]
        if [line.split(",")[0] for line in kept] != ["epoch", *map(str, range(1, 1 + epochs))] or not kept[-1].endswith("\n"):
            raise RunFolderError(f"{path} is damaged: it has not the lines of all {epochs} epochs that had ended")
        with whole(path) as partial:
            partial.write_bytes("".join(kept).encode())
        self._file = path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, kept[0].strip().split(","))

    def write(self, row: dict[str, Any]) -> None:
        if self._writer is None:
            columns = [*FIRST_COLUMNS, *(name for name in row if name not in FIRST_COLUMNS)]
            self._writer = csv.DictWriter(self._file, columns)
            self._writer.writeheader()
        self._writer.writerow({name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()})
        self._file.flush()

    def close(self) -> None:
        self._file.close()


class ConsoleSink:
    """A live line on a terminal; elsewhere a plain line an epoch."""

    def __init__(self, console: Console, num_epochs: int):
        self._console = console
        self._num_epochs = num_epochs
        self._live: Progress | None = None
        if console.is_terminal:
            self._live = Progress(SpinnerColumn(), BarColumn(bar_width=20), TextColumn("{task.description}"), console=console)
            self._task = self._live.add_task("first epoch ...", total=num_epochs)
            self._live.start()

    def write(self, row: dict[str, Any]) -> None:
        remaining = self._num_epochs - row["epoch"]
        eta = remaining * row["wall_seconds"] / row["epoch"]
        line = (
            f"epoch {row['epoch']}/{self._num_epochs}  {row['env_steps']:,} steps"
            f"  {row['steps_per_second']:,.0f} steps/s  {row['updates_per_second']:,.0f} updates/s"
            f"  success {row['success_rate']:.2f}  return {row['return_mean']:.1f}  ETA {clock(eta)}"
        )
        if self._live is None:
            self._console.print(line, soft_wrap=True, highlight=False)
        else:
            self._live.update(self._task, completed=row["epoch"], description=line)

    def close(self) -> None:
        if self._live is not None:
            self._live.stop()


def clock(seconds: float) -> str:
    """For a reader: "1:02:03"."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
