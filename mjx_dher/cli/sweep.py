"""The commands `sweep` and `plot`."""

from __future__ import annotations

import dataclasses
import itertools
import math
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import tyro
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table

from mjx_dher import config, envs, names, presets
from mjx_dher.config import Config, HParams
from mjx_dher.host import files
from mjx_dher.host.caches import prepare
from mjx_dher.host.files import FolderError
from mjx_dher.runs.stopping import Stop
from mjx_dher.sweeps import comparison, sweep
from mjx_dher.sweeps.sweep import Cell

_GRID = ("env", "sampler", "weight_kernel", "metric")
SECONDS_A_LINE = 10.0  # between lines of progress, where there is no terminal


def _fields_of(of: Any, kind: Any, but: Sequence[str] = ()) -> list[tuple[str, Any, Any]]:
    names = [f.name for f in dataclasses.fields(of)] if dataclasses.is_dataclass(of) else of._fields
    return [(name, kind(of, name), dataclasses.field(default=None)) for name in names if name not in but]


def _optional(of: Any, name: str) -> Any:
    return Annotated[get_type_hints(of)[name] | None, tyro.conf.arg(help=f"The preset's {name}, changed.")]


def _values(of: Any, name: str) -> Any:
    return Annotated[tuple[float, ...] | None, tyro.conf.arg(help=f"Values of {name}; the preset's unless given.")]


if TYPE_CHECKING:

    class _Axes: ...

    class _Changes: ...

else:  # every number, and every shape, by its own name
    _Axes = dataclasses.make_dataclass("_Axes", _fields_of(HParams, _values), frozen=True)
    _Changes = dataclasses.make_dataclass("_Changes", _fields_of(Config, _optional, _GRID), frozen=True)


@dataclasses.dataclass(frozen=True)
class SweepArgs:
    """Train every combination of environments, samplers, numbers and seeds, and compare them.

    Runs that differ in sampler, numbers or seed are trained side by side in one compiled program. Each finished run is a run
    folder in cells/: the same command again goes on where a sweep was stopped, and a larger one trains what is new.
    """

    out: Path
    """Folder of the sweep: results.csv, finals.csv and comparison.csv (docs/sweeps.md describes them), and cells/."""
    changes: Annotated[_Changes, tyro.conf.arg(name="")]
    sweep: _Axes
    """Numbers to try: --sweep.her-k 2 4 8."""
    env: tuple[str, ...] = ("push",)
    """Environments, by name or as module:attribute."""
    sampler: tuple[str, ...] = ("future", "closest", "epsilon_closest", "weighted")
    """Samplers of hindsight goals, by name or as module:attribute."""
    weight_kernel: tuple[str, ...] = ("linear",)
    """For weighted: linear, inverse, softmax."""
    metric: tuple[str, ...] = ("position",)
    """Distances that closest, epsilon_closest and weighted go by."""
    seeds: int = 10
    """Runs of each setting; every setting has the same seeds, and so the same first networks and resets."""
    first_seed: int = 0
    """The seeds are this one and those that follow."""
    preset: str = "auto"
    """cpu, gpu, paper, or auto, the one for this machine."""
    lanes: int | None = None
    """Runs side by side, at most; by default 1 on a CPU, whose cores one fills, and on a GPU as many as its memory holds."""
    share: str = "1/1"
    """2/4: the second of four shares of the runs. For several programs at once on one folder, each with a GPU of its own."""
    final_episodes: int = 500
    """Episodes of the evaluation that ends each run."""
    checkpoint_every: int = 10
    """Epochs between checkpoints of the runs side by side, from which the same command goes on; 0: only when it is stopped."""
    threshold: float = 0.9
    """Success rate for the time that it takes to get there."""
    baseline: str = "future"
    """What the others are compared with: a sampler, or a setting as the table names it."""


@dataclasses.dataclass(frozen=True)
class PlotArgs:
    """Draw a sweep's learning curves, epochs to a threshold and comparison, and write comparison.csv anew."""

    folder: tyro.conf.Positional[Path]
    """The sweep's folder."""
    out: Path | None = None
    """Folder for the pictures; the sweep's own unless given."""
    threshold: float = 0.9
    """Success rate for the time that it takes to get there."""
    baseline: str = "future"
    """What the others are compared with: a sampler, or a setting as the table names it."""
    formats: tuple[str, ...] = ("png", "svg")
    """Of the pictures: png, svg, pdf."""


def parse_sweep_args(argv: list[str]) -> tuple[SweepArgs, list[Cell]]:
    """The arguments of `sweep` and the cells that they ask for, checked without loading JAX or MuJoCo.

    Raises:
      ValueError: one or more of them cannot be used.
    """
    default = SweepArgs(tyro.MISSING, changes=_Changes(), sweep=_Axes())
    args = tyro.cli(SweepArgs, prog="train.py sweep", args=argv, default=default)
    for field, allowed in (
        ("env", envs.list_envs()),
        ("sampler", config.sampler_names()),
        ("weight_kernel", config.WEIGHT_KERNELS),
        ("metric", config.metric_names()),
    ):
        for value in getattr(args, field) or ("",):
            names.check_name(field, value, allowed, own=field in ("env", "sampler"))
    names.check_name("preset", args.preset, ("auto", *presets.PRESETS))
    for field in ("seeds", "final_episodes", *(("lanes",) if args.lanes is not None else ())):
        config.check_count(field, getattr(args, field))
    config.check_every("checkpoint_every", args.checkpoint_every)
    if args.first_seed < 0:
        raise ValueError(f"first_seed must be an integer of at least 0; got {args.first_seed}")
    _check_threshold(args.threshold)
    share = _share(args.share)
    if args.out.exists() and not args.out.is_dir():
        raise FolderError(f"out: {args.out} is there already and is no folder")
    if args.out.is_dir() and any(args.out.iterdir()) and not (args.out / sweep.CELLS).is_dir():
        raise FolderError(f"out: {args.out} holds something else than a sweep; name a new or empty folder")
    statics, numbers = [], []
    preset = presets.machine_preset() if args.preset == "auto" else args.preset
    for env in dict.fromkeys(args.env):
        base, hparams = presets.preset(preset, env)
        base = dataclasses.replace(base, **{k: v for k, v in vars(args.changes).items() if v is not None})
        axes = {name: values for name, values in vars(args.sweep).items() if values is not None}
        points = [hparams._replace(**dict(zip(axes, point))) for point in itertools.product(*axes.values())]
        for choice in itertools.product(args.sampler, args.weight_kernel, args.metric):
            sampler, kernel, metric = choice
            static = dataclasses.replace(base, sampler=sampler, weight_kernel=kernel, metric=metric)
            for point in points:
                config.validate(static, point)
            statics.append(static)
            numbers.append(points)
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    cells = sweep.cells(statics, numbers, seeds)
    if not (own := sweep.share(cells, *share)):
        raise ValueError(f"share {args.share} is empty: there are {len(cells)} runs in all")
    return args, own


def _share(text: str) -> tuple[int, int]:
    number, _, of = text.partition("/")
    if not (number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
        raise ValueError(f"share must be N/M, 1 to M, such as 2/4; got {text!r}")
    return int(number), int(of)


def sweep_command(argv: list[str], console: Console) -> int:
    """`sweep`: trains a grid of runs."""
    args, cells = parse_sweep_args(argv)
    todo = [cell for cell in cells if not sweep.is_done(args.out, cell)]
    done = f"; {len(cells) - len(todo)} of them are done already" if len(todo) < len(cells) else ""
    of = "" if args.share == "1/1" else f", share {args.share} of the sweep"
    console.print(f"{len(cells)} runs{of}{done}; writing to {args.out}", soft_wrap=True)
    if todo:
        prepare()
        stop = Stop(console, args.out)
        screen = _Screen(console, todo, stop)
        make_env = lambda static: envs.make(static.env, engine=static.engine)  # noqa: E731
        options = (args.lanes, args.final_episodes, args.checkpoint_every)
        say = lambda text: console.print(text, soft_wrap=True)  # noqa: E731
        try:
            with stop:
                sweep.run(args.out, todo, make_env, *options, say, screen.show)
        except KeyboardInterrupt:
            if left := sum(not sweep.is_done(args.out, cell) for cell in cells):
                console.print(f"stopped; {len(cells) - left} runs are done, and the same command goes on with the other {left}")
                return 128 + (stop.asked or signal.SIGINT)
        finally:
            screen.close()
    with files.lock(args.out / sweep.CELLS, sweep.LOCK, wait=True):  # another share's program may be writing them
        found = sweep.read(args.out)
        sweep.write_tables(args.out, found)
        _compare(args.out, comparison.groups(found), args.baseline, args.threshold, console)
    console.print(f"wrote {sweep.RESULTS}, {sweep.FINALS} and {comparison.COMPARISON} in {args.out}", soft_wrap=True)
    return 0


def plot_command(argv: list[str], console: Console) -> int:
    """`plot DIR`: draws a sweep."""
    from mjx_dher.sweeps import plotting

    args = tyro.cli(PlotArgs, prog="train.py plot", args=argv)
    _check_threshold(args.threshold)
    plotting.check(args.formats)
    found = comparison.groups(sweep.read(args.folder))
    rows = _compare(args.folder, found, args.baseline, args.threshold, console)
    out = args.out or args.folder
    out.mkdir(parents=True, exist_ok=True)
    for env, groups in found.items():
        own = [row for row in rows if row.env == env]
        for path in plotting.write(out, groups, own, args.threshold, args.formats):
            console.print(f"wrote {path}", soft_wrap=True)
    return 0


def _check_threshold(threshold: float) -> None:
    if not 0 < threshold <= 1:
        raise ValueError(f"threshold must lie in (0, 1]; got {threshold:g}")


def _compare(
    folder: Path, found: dict[str, list[comparison.Group]], baseline: str, threshold: float, console: Console
) -> list[comparison.Row]:
    """Prints the comparison of all settings, and writes it into the folder."""
    rows = [row for groups in found.values() for row in comparison.compare(groups, baseline, threshold)]
    comparison.write(folder, rows)
    head, lines = comparison.table(rows)
    table = Table(*head)
    for line in lines:
        table.add_row(*line)
    console.print(table)
    for env, groups in found.items():
        if len(groups) > 1 and all(math.isnan(row.better) for row in rows if row.env == env):
            labels = "; ".join(group.label for group in groups)
            console.print(f"{env}: no baseline {baseline!r} to compare with among: {labels}", soft_wrap=True)
    return rows


class _Screen:
    """Progress over the whole sweep: a live bar on a terminal, elsewhere a line now and then."""

    def __init__(self, console: Console, todo: Sequence[Cell], stop: Stop):
        self._console, self._stop = console, stop
        self._total = sum(cell.config.total_steps for cell in todo)
        self._done = 0.0  # environment steps, of all runs
        self._done_before = 0.0  # the present ones
        self._present: Sequence[Cell] = ()
        self._trained = 0.0  # since this start of the sweep, in `_seconds`
        self._seconds = 0.0
        self._printed = time.monotonic()
        self._bar: Bar | None = None
        if console.is_terminal:
            self._bar = Bar(BarColumn(bar_width=20), TextColumn("{task.description}"), console=console)
            self._task = self._bar.add_task("...", total=self._total)
            self._bar.start()

    def show(self, cells: Sequence[Cell], progress: Any) -> None:
        """After each epoch of those side by side; raises KeyboardInterrupt where a stop was asked for."""
        from mjx_dher.runs.sinks import clock

        if self._stop.asked is not None:
            raise KeyboardInterrupt
        total = cells[0].config.total_steps
        if cells is not self._present:
            self._present, self._done_before = cells, self._done
        an_epoch = len(cells) * total / progress.num_epochs
        self._done = self._done_before + an_epoch * progress.epoch
        self._trained += an_epoch
        self._seconds += progress.epoch_seconds
        left = self._seconds * (self._total - self._done) / self._trained
        success = [float(rate) for rate in progress.metrics["success_rate"]][: len(cells)]
        by_sampler: dict[str, list[float]] = {}
        for cell, rate in zip(cells, success):
            by_sampler.setdefault(cell.config.sampler, []).append(rate)
        means = "  ".join(f"{name} {sum(rates) / len(rates):.2f}" for name, rates in by_sampler.items())
        line = (
            f"{self._done / self._total:.0%}  {cells[0].config.env}, {len(cells)} runs: epoch {progress.epoch}/"
            f"{progress.num_epochs}  success {means}  ETA {clock(left)}"
        )
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, description=line)
        elif time.monotonic() - self._printed > SECONDS_A_LINE or progress.epoch == progress.num_epochs:
            self._console.print(line, soft_wrap=True)
            self._printed = time.monotonic()

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
