"""A run's metrics: failures and warnings that they show, and loggers in CSV and JSON lines. `services` has the others."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from mjx_dher.config import Config
from mjx_dher.runs.folder.run_folder import METRICS_FILE
from mjx_dher.system import files, machine
from mjx_dher.system.files import FolderError

# The first columns of metrics.csv; the other metrics of an epoch follow.
COUNTS = ("epoch", "env_steps", "updates", "wall_seconds")
FIRST_COLUMNS = (*COUNTS, "success_rate", "return_mean")
JSON_FILE = "metrics.jsonl"
DIGEST = "digest"  # the last column of metrics.csv


class CsvSink:
    """metrics.csv, with one line per epoch, written before the next epoch begins. The last column is the run's digest.

    If a run resumes after some epochs, later lines are removed. Metrics that its learner did not report then get columns, and
    those that it no longer reports are nan. Raises FolderError if the file lacks lines of these epochs.
    """

    def __init__(self, path: Path, epochs: int = 0, digest: str = ""):
        self._writer: csv.DictWriter[str] | None = None
        self._path, self._digest = path, digest
        self._kept: list[str] = []
        if epochs:
            from mjx_dher.runs.folder import results

            if (whole := len(results.read_rows(path))) < epochs:
                raise FolderError(f"{path} is damaged: {epochs} epochs had ended, but it has complete lines of only {whole}")
            self._kept = results.whole_lines(path)[: 1 + epochs]
        self._write_all("".join(self._kept))

    def write(self, row: dict[str, Any]) -> None:
        if self._writer is None:
            self._writer = self._begin(row)
        values = {name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()}
        self._writer.writerow({**values, DIGEST: self._digest})
        self._file.flush()

    def close(self) -> None:
        self._file.close()

    def _write_all(self, lines: str) -> None:
        files.write(self._path, lines.encode())
        self._file = self._path.open("a", newline="", encoding="utf-8")

    def _begin(self, row: dict[str, Any]) -> "csv.DictWriter[str]":
        """Writes the head, and the lines of a resumed run again if `row` has other metrics."""
        kept, lines = csv.DictReader(self._kept), io.StringIO(newline="")
        columns = list(kept.fieldnames or (*FIRST_COLUMNS, DIGEST))
        new = [name for name in row if name not in columns]
        if new or not self._kept:
            columns[-1:] = *new, columns[-1]
            writer = csv.DictWriter(lines, columns, restval="nan")
            writer.writeheader()
            writer.writerows(kept)
            self._file.close()
            self._write_all(lines.getvalue())
        return csv.DictWriter(self._file, columns, restval="nan", extrasaction="ignore")  # older files have no digest


class JsonlSink:
    """metrics.jsonl, with one object per epoch. Numbers that are not finite are null. If a run resumes after some epochs,
    missing lines are taken from metrics.csv.
    """

    def __init__(self, path: Path, epochs: int = 0):
        from mjx_dher.runs.folder.results import read_rows

        whole = files.whole_lines(path)[:epochs]
        missing = read_rows(path.with_name(METRICS_FILE))[len(whole) : epochs] if epochs else []
        files.write(path, "".join([*whole, *map(_to_json, missing)]).encode())
        self._file = path.open("a", encoding="utf-8")

    def write(self, row: dict[str, Any]) -> None:
        self._file.write(_to_json(row))
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def _to_json(row: dict[str, Any]) -> str:
    return json.dumps({name: v if math.isfinite(v) else None for name, v in row.items() if name != DIGEST}) + "\n"


def flush_logs(folder: Path) -> None:
    """Flushes the CSV file and the JSON lines of the run in `folder` to disk."""
    for path in filter(Path.exists, (folder / METRICS_FILE, folder / JSON_FILE)):
        files.flush(path)
    files.flush(folder)


class Sink(Protocol):
    """A log, with one row per epoch."""

    def write(self, row: dict[str, Any]) -> None: ...

    def close(self) -> None: ...


def open_sinks(folder: Path, logs: Sequence[str], epochs: int = 0, env_steps: int = 0, digest: str = "") -> list[Sink]:
    """Opens metrics.csv and `logs` of the run in `folder`, after `epochs` epochs and `env_steps` environment steps."""
    sinks: list[Sink] = [CsvSink(folder / METRICS_FILE, epochs, digest)]
    for log in dict.fromkeys(logs):
        if log == "jsonl":
            sinks.append(JsonlSink(folder / JSON_FILE, epochs))
        else:
            from mjx_dher.runs.folder import services

            sinks.append(services.open_sink(log, folder, env_steps))
    return sinks


def metrics_row(progress: Any, metrics: dict[str, float]) -> dict[str, Any]:
    """Row for the sinks, in the order of metrics.csv, from a `loop.Progress` and the metrics of one run."""
    steps, updates = progress.env_steps / progress.epoch, progress.updates / progress.epoch  # all epochs are equal
    return {
        **{name: getattr(progress, name) for name in COUNTS},
        **{name: metrics[name] for name in FIRST_COLUMNS if name in metrics},
        **metrics,
        "steps_per_second": steps / progress.epoch_seconds,
        "updates_per_second": updates / progress.epoch_seconds,
        "memory_bytes": machine.used_bytes() or math.nan,
    }


def failure(metrics: Mapping[str, float], config: Config, finite: bool) -> str | None:
    """Why a run fails after an epoch with these metrics, or None. `finite` tells whether all of the learner's floats are."""
    if not finite:
        return "the networks or normalizers have numbers that are not finite (smaller actor_lr and critic_lr may help)"
    episodes = config.num_envs * config.cycles_per_epoch
    if metrics["discarded_episodes"] >= episodes:
        return (
            f"all {episodes} episodes were discarded, so nothing can be learned: the environment reports `failed`, or `done` or"
            " `terminal` at its reset, or an observation, a goal, an action or a reward is not finite"
        )
    if metrics["bad_success"] > 0:
        return f"success must be 0 or 1; in {metrics['bad_success']:.3g} of the episodes it is not"
    if metrics["bad_rewards"] >= 0.5:
        return f"{metrics['bad_rewards']:.3g} of the rewards lie outside the environment's reward range (EnvSpec.reward_range)"
    if metrics["no_goal_share"] >= 1:
        return "the sampler offers no hindsight goal for any transition: its weights are all 0, NaN or infinite"
    return None


def warnings(metrics: Mapping[str, float], config: Config) -> dict[str, str]:
    """Warning sentences about an epoch, by metric."""
    episodes = config.num_envs * config.cycles_per_epoch
    sentences = {
        "discarded_episodes": f"{metrics['discarded_episodes']:.0f} of {episodes} episodes were discarded: the environment"
        " reports `failed`, or has ended at its reset, or a number in them is not finite",
        "bad_rewards": f"{metrics['bad_rewards']:.3g} of the rewards lie outside the reward range, which bounds the targets",
        "no_goal_share": f"the sampler offers no goal for {metrics['no_goal_share']:.3g} of the transitions to relabel;"
        " these keep their own",
    }
    return {name: text for name, text in sentences.items() if metrics[name] > 0}
