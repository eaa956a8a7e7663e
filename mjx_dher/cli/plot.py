"""The command `plot`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro
from rich.console import Console

from mjx_dher.cli.commands import parse
from mjx_dher.cli.common import compare, print_table
from mjx_dher.sweeps import grid
from mjx_dher.system import files
from mjx_dher.tools import curves, figures
from mjx_dher.validation import check_number

TOGETHER = "curves"  # the picture of several runs, without its ending


@dataclasses.dataclass(frozen=True)
class PlotArgs:
    """Draw how a run went, several runs together, or a sweep.

    Of a run: success, returns, values and losses, in its folder. Of several: their success together, in the current folder.
    Of a sweep: learning curves, epochs to a threshold and comparison, in its folder; comparison.csv is written anew.
    """

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or the folder of one sweep."""
    out: Path | None = None
    """Folder for the pictures; the run's or the sweep's own unless given, and the current one for several runs."""
    threshold: float = 0.9
    """Success rate for the time that it takes to get there (of a sweep)."""
    baseline: str = "future"
    """Setting that the others are compared with: a sampler, or a setting as the table names it (of a sweep)."""
    formats: tuple[str, ...] = ("png", "svg")
    """Formats of the pictures: png, svg, pdf."""


def plot_command(argv: list[str], console: Console) -> int:
    """Draws runs, or a sweep."""
    args = parse(PlotArgs, argv)
    check_number("threshold", args.threshold, "(0, 1]", float)
    figures.check(args.formats)
    if grid.is_sweep(args.folders):
        return _plot_sweep(args, console)
    runs = [curves.read_curve(folder) for folder in args.folders]
    together = len(runs) > 1
    out = args.out or (Path() if together else args.folders[0])
    files.make_folder(out)
    if together:
        print_table(*curves.curves_table(runs), console)
    name = TOGETHER if together else curves.CURVE
    for ending in args.formats:  # drawn anew: a figure that was written before has another layout
        path = out / f"{name}.{ending}"
        figures.write(curves.draw_together(runs) if together else curves.draw_curve(runs[0]), path)
        console.print(f"wrote {path}")
    return 0


def _plot_sweep(args: PlotArgs, console: Console) -> int:
    from mjx_dher.sweeps import comparison, plotting, tables

    (folder,) = args.folders
    by_env = comparison.groups(tables.read(folder))
    out = args.out or folder
    files.make_folder(out)
    rows = compare(out, by_env, args.baseline, args.threshold, console)
    for env, groups in by_env.items():
        own = [row for row in rows if row.env == env]
        for path in plotting.write(out, groups, own, args.threshold, args.formats):
            console.print(f"wrote {path}")
    return 0
