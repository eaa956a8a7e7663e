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

TOGETHER = "curves"  # stem of the picture of several runs


@dataclasses.dataclass(frozen=True)
class PlotArgs:
    """Draw the curves of a run, of several runs together, or of a sweep.

    One run: success, returns, values and losses, in its folder. Several runs: their success together, in the current folder. A
    sweep: learning curves, epochs to a threshold, and comparison, in its folder. comparison.csv is rewritten.
    """

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or the folder of one sweep."""
    out: Path | None = None
    """Folder for the pictures. Default: the folder of the run or sweep, or the current folder for several runs."""
    threshold: float = 0.9
    """Success rate for the time to success (for a sweep)."""
    baseline: str = "future"
    """Setting to compare with: a sampler, or a setting as named in the table (for a sweep)."""
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
    for ending in args.formats:  # drawn for each, because writing a figure changes its layout
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
