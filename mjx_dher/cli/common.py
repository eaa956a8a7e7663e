"""Shared parts of the commands: flags, progress on the screen, and the summary of an evaluation."""

import itertools
import os
import time
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Annotated, Any, Literal

import numpy as np
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Column, Table
from typing_extensions import Doc

from mjx_dher import __version__, envs
from mjx_dher.cli import PlainConsole
from mjx_dher.runs.folder import fingerprint
from mjx_dher.spec import RunSpec, custom_components

CURVE_WIDTH = 24  # characters of the live curve
# Types of options.
Devices = int | Literal["all"]
EnvKwargs = Annotated[tuple[str, ...], Doc("Arguments of the environment as NAME=VALUE, which override the run's.")]
Physics = Annotated[
    str | None, Doc("Physics: native, jax, warp or auto. Default: the run's, or native for warp without a GPU.")
]
Trust = Annotated[
    bool, Doc("Use code and data that the run folder names even if you have not trained with them on this machine.")
]
VIEW_PORT = 8080  # port of the viewer
SECONDS_PER_LINE = 10.0  # between a sweep's lines of progress without a terminal


def warn_of_tau(polyak: float, console: Console) -> None:
    """Explains a small polyak, which is probably meant as the tau of other libraries."""
    if polyak < 0.5:
        console.print(
            f"polyak {polyak:g} keeps {polyak:.0%} of the old target at each soft update: it is 1 - tau in other libraries"
        )


def make_env(run: RunSpec, engine: str | None = None) -> Any:
    """Makes the environment of a run, with `engine` instead of the run's if given."""
    return envs.make(run.env, engine=engine or run.engine, **run.env_arguments)


def settle_compiler(engine: str) -> None:
    """Avoids a deadlock of MJX programs on a CPU. Call it before JAX starts.

    With jaxlib 0.10.2, some 300 environments of `jax` with objects make XLA's CPU backend lose a task. Its older scheduler
    does not (https://github.com/openxla/xla; no upstream issue known).
    """
    if engine == "jax" and "concurrency_optimized_scheduler" not in (flags := os.environ.get("XLA_FLAGS", "")):
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_enable_concurrency_optimized_scheduler=false".strip()


def try_components(specs: Sequence[RunSpec], console: Console, env: Any = None, on_cpu: bool = False) -> None:
    """Tests the custom components of runs, grouped by environment, before anything is compiled or written.

    Without `env`, it is made, with native physics in place of warp if `on_cpu`. Raises ValueError for the first violation.
    """
    own = [spec for spec in specs if custom_components(spec)]
    for _, group in itertools.groupby(own, key=lambda spec: spec.env):
        from mjx_dher.testing import verdicts

        runs = list(group)
        made = make_env(runs[0], "native" if on_cpu and runs[0].engine == "warp" else None) if env is None else env
        for line in verdicts.check(made, runs):
            console.print(line)


def join(distributed: bool, described: Mapping[str, Any], console: Console) -> Console:
    """Joins this process to the others if the command is `distributed`. Returns a console that prints in the first process.

    Raises ValueError if there are no other processes, or their versions or settings in `described` differ.
    """
    if not distributed:
        return console
    from mjx_dher.parallel import processes

    processes.connect()
    versions = {"version of mjx_dher": __version__, "version of jax": metadata.version("jax"), **fingerprint.jax_flags()}
    processes.check_equal({**versions, **described})
    return console if processes.leads() else Console(quiet=True)


def print_summary(summary: dict[str, Any], console: Console) -> None:
    """Prints the result of `evaluate.summarize`."""
    discarded = summary.get("discarded_episodes", 0)
    console.print(
        f"success {summary['success_rate']:.3f} (95 % interval {summary['success_low']:.3f} to {summary['success_high']:.3f},"
        f" {summary['episodes']} episodes); already at reset {summary['reset_success_rate']:.3f};"
        f" mean return {summary['return_mean']:.2f}"
        + (f"; {discarded} episodes were discarded, which are failures without a return" if discarded else "")
    )


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]], console: Console) -> None:
    """Prints a table in full, row by row if the terminal is too narrow."""
    table = Table(*head)
    for row in rows:
        table.add_row(*row)
    width = Measurement.get(console, console.options.update(max_width=10_000), table).maximum
    if not console.is_terminal:
        PlainConsole(file=console.file, width=width).print(table)
    elif width <= console.width:
        console.print(table, soft_wrap=False)
    else:
        for row in rows:
            console.print("\n".join(f"{name}: {cell}" for name, cell in zip(head, row) if cell), "", sep="\n", soft_wrap=True)


class Screen:
    """Progress of runs: a live bar and curve on a terminal, else lines, for a sweep at most one every 10 s. `success` has the
    rates of earlier epochs, if a run resumes.
    """

    def __init__(self, console: Console, specs: Sequence[RunSpec], success: Sequence[float] = ()):
        self._console, self._single = console, len(specs) == 1
        self._total = sum(spec.config.total_steps for spec in specs)
        self._done = 0.0  # environment steps of all runs
        self._done_before = 0.0  # environment steps of earlier runs
        self._present: Sequence[RunSpec] = ()
        self._trained = 0.0  # environment steps of this process, in `_seconds`
        self._seconds = 0.0
        self._printed = time.monotonic()
        self._success = list(success)  # success rates of the current runs, one per epoch
        self._bar: Bar | None = None
        if console.is_terminal:
            # The growing curve of a single run is its bar. A narrow terminal folds the text.
            bar = () if self._single else (BarColumn(bar_width=20),)
            text = TextColumn("{task.description}", table_column=Column(no_wrap=False, overflow="fold"))
            self._bar = Bar(*bar, TextColumn("{task.fields[curve]}"), text, console=console)
            self._task = self._bar.add_task("...", total=self._total, curve="")
            self._bar.start()

    def show(self, specs: Sequence[RunSpec], progress: Any) -> None:
        """Shows an epoch of the parallel runs. `progress` is a `loop.Progress`."""
        total = specs[0].config.total_steps
        if list(specs) != list(self._present):
            self._success = [] if self._present else self._success
            self._present, self._done_before = specs, self._done
        self._success.append(float(np.mean(progress.metrics["success_rate"])))
        per_epoch = len(specs) * total / progress.num_epochs
        self._done = self._done_before + per_epoch * progress.epoch
        self._trained += per_epoch
        self._seconds += progress.epoch_seconds
        eta = clock(self._seconds * (self._total - self._done) / self._trained)
        last = progress.epoch == progress.num_epochs
        line = self._line_of_one(progress, eta) if self._single else self._line_of_many(specs, progress, eta)
        if self._bar is not None:
            curve = sparkline(self._success, progress.num_epochs, ascii_only=self._console.options.ascii_only)
            self._bar.update(self._task, completed=self._done, description=line, curve=curve)
        elif self._single or last or time.monotonic() - self._printed > SECONDS_PER_LINE:
            self._console.print(line, highlight=False)
            self._printed = time.monotonic()

    def _line_of_one(self, progress: Any, eta: str) -> str:
        per_second = 1 / (progress.epoch * progress.epoch_seconds)  # all epochs are equal
        return (
            f"epoch {progress.epoch}/{progress.num_epochs}  {progress.env_steps:,} steps"
            f"  {progress.env_steps * per_second:,.0f} steps/s  {progress.updates * per_second:,.0f} updates/s"
            f"  success {float(progress.metrics['success_rate']):.2f}"
            f"  return {float(progress.metrics['return_mean']):.1f}  ETA {eta}"
        )

    def _line_of_many(self, specs: Sequence[RunSpec], progress: Any, eta: str) -> str:
        by_sampler: dict[str, list[float]] = {}
        rates = progress.metrics["success_rate"]
        for lane, spec in enumerate(specs):
            by_sampler.setdefault(spec.sampler, []).append(float(rates[lane] if rates.ndim else rates))
        means = "  ".join(f"{name} {sum(rates) / len(rates):.2f}" for name, rates in by_sampler.items())
        return (
            f"{self._done / self._total:.0%}  {specs[0].env}, {len(specs)} runs: epoch {progress.epoch}/{progress.num_epochs}"
            f"  success {means}  ETA {eta}"
        )

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()


def sparkline(rates: Sequence[float], total: int, width: int = CURVE_WIDTH, ascii_only: bool = False) -> str:
    """Curve of rates in [0, 1], one per epoch, as at most `width` characters for `total` epochs. Missing epochs are dots."""
    levels, point = (" .:-=+*#", "_") if ascii_only else ("▁▂▃▄▅▆▇█", "·")
    shares = np.array_split(np.arange(total), min(width, total))
    parts = [np.clip(np.nan_to_num(rates[share[0] : share[-1] + 1]), 0, 1) for share in shares]
    return "".join(levels[min(int(part.mean() * len(levels)), len(levels) - 1)] if len(part) else point for part in parts)


def clock(seconds: float) -> str:
    """Formats seconds like "1:02:03"."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
