"""The commands `plot` and `report`."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console

from mjx_dher import cli
from mjx_dher.cli import settings
from mjx_dher.cli.common import Trust, print_table
from mjx_dher.runs.folder import fingerprint
from mjx_dher.sweeps import grid
from mjx_dher.system import files, outputs
from mjx_dher.tools import curves, figures
from mjx_dher.validation import check_number

if TYPE_CHECKING:
    from mjx_dher.sweeps.comparison import Group, Row

EPISODES = 3  # per video


def compare(
    folder: Path, by_env: dict[str, "list[Group]"], baseline: str, threshold: float, console: Console
) -> "Sequence[Row]":
    """Prints the comparison of all settings of a sweep, and writes it to `folder`. Returns its rows."""
    from mjx_dher.sweeps import comparison

    rows = [row for groups in by_env.values() for row in comparison.compare(groups, baseline, threshold)]
    comparison.write(folder, rows)
    print_table(*comparison.table(rows), console)
    for env, groups in by_env.items():
        own = [row.better for row in rows if row.env == env]
        alone = [g.label for g, better in zip(groups, own) if math.isnan(better) and baseline not in (g.sampler, g.label)]
        if len(groups) > 1 and alone:
            console.print(f"{env}: no baseline {baseline!r} of the same length and other settings for: {'; '.join(alone)}")
    return rows


@dataclasses.dataclass(frozen=True)
class PlotArgs:
    """Draw the curves of a run, of several runs together, or of a sweep.

    One run: success, returns, values and losses, in its folder. Several runs: their success together, in the current folder. A
    sweep: learning curves, epochs to a threshold, and comparison, in its folder. comparison.csv is rewritten.
    """

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or the folder of one sweep."""
    out: Path | None = None
    """Folder for the pictures and a sweep's comparison.csv, which are replaced there. Default: the folder of the run or sweep,
    or the current folder for several runs."""
    threshold: float = 0.9
    """Success rate for the time to success (for a sweep)."""
    baseline: str = "future"
    """Setting to compare with: a sampler, or a setting as named in the table (for a sweep)."""
    formats: tuple[str, ...] = ("png", "svg")
    """Formats of the pictures: png, svg, pdf."""


def plot_command(argv: list[str], console: Console) -> int:
    """Draws runs, or a sweep."""
    args = cli.parse(PlotArgs, argv)
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
    name = "curves" if together else curves.CURVE
    for ending in args.formats:  # drawn for each, because writing a figure changes its layout
        path = out / f"{name}.{ending}"
        figures.write(curves.draw_together(runs) if together else curves.draw_curve(runs[0]), path)
        console.print(f"wrote {path}")
    return 0


def _plot_sweep(args: PlotArgs, console: Console) -> int:
    from mjx_dher.sweeps import comparison, plotting, tables

    (folder,) = args.folders
    by_env = comparison.groups(tables.read(folder))
    comparison.check_baseline(by_env, args.baseline)
    out = args.out or folder
    files.make_folder(out)
    rows = compare(out, by_env, args.baseline, args.threshold, console)
    stems = fingerprint.in_paths(by_env)
    for env, groups in by_env.items():
        own = [row for row in rows if row.env == env]
        for path in plotting.write(out / stems[env], groups, own, args.threshold, args.formats):
            console.print(f"wrote {path}")
    return 0


@dataclasses.dataclass(frozen=True)
class ReportArgs:
    """Write an HTML report of a run or a sweep: curves, tables, settings and videos in one file that opens without a server.

    Videos (.mp4, .gif, .webm) in the folder are included. Needs the extra `plot`.
    """

    folder: tyro.conf.Positional[Path]
    """Run folder, finished or not, or the folder of a sweep."""
    out: Path | None = None
    """File to write, which ends in .html. Default: report.html in the folder, which is replaced."""
    overwrite: bool = False
    """Replace an existing file."""
    video: bool = False
    """First draw a video of the run, or of a sweep's best run per task, into the folder (extra video)."""
    trust: Trust = False
    threshold: float = 0.9
    """Success rate for the time to success (for a sweep)."""
    baseline: str = "future"
    """Setting to compare with: a sampler, or a setting as named in the table (for a sweep)."""


def report_command(argv: list[str], console: Console) -> int:
    """Writes a report of a run or a sweep."""
    args = cli.parse(ReportArgs, argv)
    check_number("threshold", args.threshold, "(0, 1]", float)
    figures.check(("svg",), "report")
    sweep = grid.is_sweep((args.folder,))
    if args.out is not None:
        outputs.check_file(args.out, (".html",), args.overwrite)
    from mjx_dher.sweeps import comparison, report, tables

    trials = tables.read(args.folder) if sweep else []
    if sweep:
        comparison.check_baseline(comparison.groups(trials), args.baseline)
    out = args.out or args.folder / report.REPORT
    settings.check_writable(out.parent)
    if args.video:
        for run, video in _to_film(args.folder, trials):
            own = ("--out", str(video), "--episodes", str(EPISODES), "--overwrite", *(("--trust",) if args.trust else ()))
            cli.run("render", [str(run), *own], console)
    tell = console.print
    if sweep:
        page = report.of_sweep(args.folder, trials, args.baseline, args.threshold, tell)
    else:
        page = report.of_run(args.folder, tell)
    with files.atomic_write(out) as partial:
        partial.write_text(page, encoding="utf-8")
    console.print(f"wrote {out}")
    return 0


def _to_film(folder: Path, trials: Sequence[dict[str, Any]]) -> list[tuple[Path, Path]]:
    """Run folders to draw videos of, with the files to write. For a sweep with `trials`, the best run of each task."""
    if not trials:
        return [(folder, folder / "video.mp4")]
    best: dict[str, dict[str, Any]] = {}
    for trial in trials:
        rate = trial["final"].get("success_rate", -1.0)
        env = trial["settings"]["env"]
        if rate >= 0 and (env not in best or rate > best[env]["final"]["success_rate"]):
            best[env] = trial
    stems = fingerprint.in_paths(best)
    return [
        (trial["folder"], folder / f"{stems[env]}_{fingerprint.in_a_path(trial['settings']['sampler'])}.mp4")
        for env, trial in best.items()
    ]
