"""Figures of a sweep, drawn with Matplotlib (extra `plot`) and readable without colour."""

import math
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher import stats
from mjx_dher.sweeps.comparison import Group, Row
from mjx_dher.tools import figures


def curves(groups: Sequence[Group], threshold: float) -> Any:
    """Success over epochs, environment steps and seconds: interquartile mean over seeds, with its 95 % interval."""
    labels = [textwrap.fill(_name(group), 120) for group in groups]
    columns = max(1, min(4, 140 // (6 + max(map(len, labels)))))
    height = 3.6 + 0.2 * math.ceil(len(groups) / columns)
    figure, axes = figures.subplots(1, 3, 12, height, sharey=True)
    for group, (color, line, marker) in zip(groups, figures.styles(len(groups))):
        middle, low, high = stats.curve_interval(group.success)
        every = max(1, len(group.epoch) // 8)
        for axis, x in zip(axes, (group.epoch, group.env_steps / 1e6, group.seconds)):
            axis.fill_between(x, low, high, color=color, alpha=0.13, linewidth=0)
            style = {"color": color, "linestyle": line, "marker": marker, "markevery": every, "markersize": 4}
            axis.plot(x, middle, **style, label=_name(group))
    side_by_side = max(group.lanes for group in groups) > 1
    seconds = "seconds (parallel runs)" if side_by_side else "seconds (one run)"
    for axis in axes:
        axis.axhline(threshold, color="0.6", linewidth=0.8)
        axis.axhline(groups[0].at_reset, color="0.6", linewidth=0.8, linestyle=":")
    title = f"{groups[0].env}: interquartile mean of {_seeds(len(group.seeds) for group in groups)}, 95 % interval"
    figures.label_success(figure, axes, ("epoch", "million environment steps", seconds), labels, columns, title)
    return figure


def thresholds(groups: Sequence[Group], rows: Sequence[Row], threshold: float) -> Any:
    """Epochs to the threshold: each seed, and the median with its interval.

    Seeds that never reach the threshold lie above the dashed line.
    """
    names = ["\n".join(textwrap.fill(part, 20) for part in _name(group).split(", ")) for group in groups]
    lines = max(name.count("\n") for name in names)
    width = 1.6 + max(3.0, max(1.3, 0.085 * max(len(line) for name in names for line in name.split("\n"))) * len(groups))
    figure, (axis,) = figures.subplots(1, 1, width, 3.8 + 0.13 * lines)
    last = max(float(group.epoch[-1]) for group in groups)
    never = 1.1 * last
    for place, (group, row, (color, _, marker)) in enumerate(zip(groups, rows, figures.styles(len(groups)))):
        reach = np.minimum(stats.first_reach(group.epoch, group.success, threshold), never)
        spread = np.linspace(-0.18, 0.18, len(reach)) if len(reach) > 1 else np.zeros(1)
        axis.plot(place + spread, reach, linestyle="none", marker=marker, color=color, markersize=4, alpha=0.55)
        middle, low, high = (min(value, never) for value in (row.epochs, row.epochs_low, row.epochs_high))
        axis.errorbar(place + 0.32, middle, [[middle - low], [high - middle]], color=color, marker=marker, capsize=4)
    axis.axhline(1.05 * last, color="0.6", linewidth=0.8, linestyle="--")
    axis.text(-0.45, never, "never", fontsize=8, va="center", color="0.3")
    axis.set_xticks(range(len(groups)), map(figures.plain, names), fontsize=8)
    axis.set_xlim(-0.5, len(groups) - 0.3)
    axis.set_ylim(0, 1.16 * last)
    axis.set_ylabel(f"epochs to {threshold:g}")
    figure.suptitle(figures.folded(f"{groups[0].env}: each seed, and the median with its 95 % interval", width), fontsize=10)
    axis.grid(axis="y", alpha=0.2)
    return figure


def comparison(rows: Sequence[Row]) -> Any:
    """Final success, mean success over epochs, and probability of improvement over the baseline, with intervals."""
    names = [textwrap.fill(f"{row.setting}{_failures(row.failed, row.seeds)}", 40) for row in rows]
    lines = sum(1 + name.count("\n") for name in names)
    figure, axes = figures.subplots(1, 3, 11, 1.4 + 0.3 * lines + 0.15 * len(rows), sharey=True)
    panels = (
        ("final success (IQM)", [(r.final_iqm, r.final_low, r.final_high) for r in rows]),
        ("mean success over epochs (IQM)", [(r.area, r.area_low, r.area_high) for r in rows]),
        ("P(better than the baseline)", [(r.better, r.better_low, r.better_high) for r in rows]),
    )
    for axis, (label, values) in zip(axes, panels):
        for place, ((middle, low, high), (color, _, marker)) in enumerate(zip(values, figures.styles(len(rows)))):
            if np.isfinite(middle) and rows[place].failed < rows[place].seeds:
                around = [[max(0.0, middle - low)], [max(0.0, high - middle)]]
                axis.errorbar(middle, place, xerr=around, color=color, marker=marker, markersize=5, capsize=3)
        axis.set_xlabel(label)
        axis.locator_params(axis="x", nbins=4)
        axis.ticklabel_format(axis="x", useOffset=False)
        axis.grid(axis="x", alpha=0.2)
    axes[2].axvline(0.5, color="0.6", linewidth=0.8)
    axes[2].set_xlim(-0.03, 1.03)
    axes[0].set_yticks(range(len(rows)), map(figures.plain, names), fontsize=9)
    axes[0].invert_yaxis()
    figure.suptitle(figures.folded(f"{rows[0].env}: {_seeds(row.seeds for row in rows)}, 95 % intervals", 11), fontsize=11)
    return figure


def draw(groups: Sequence[Group], rows: Sequence[Row], threshold: float) -> dict[str, Any]:
    """The three figures of an environment and their names."""
    return {
        "curves": curves(groups, threshold),
        "thresholds": thresholds(groups, rows, threshold),
        "comparison": comparison(rows),
    }


def write(stem: Path, groups: Sequence[Group], rows: Sequence[Row], threshold: float, formats: Sequence[str]) -> list[Path]:
    """Writes the three figures of an environment: STEM_curves.png and so on, for a `stem` with its folder. Returns paths."""
    written = []
    for name, figure in draw(groups, rows, threshold).items():
        for ending in formats:
            path = stem.with_name(f"{stem.name}_{name}.{ending}")
            figures.write(figure, path)
            written.append(path)
    return written


def _name(group: Group) -> str:
    return group.label + _failures(group.failed, len(group.seeds))


def _failures(failed: int, seeds: int) -> str:
    return f" ({failed} of {seeds} failed)" if failed else ""


def _seeds(counts: Iterable[int]) -> str:
    low, *_, high = (*(ordered := sorted(counts)), ordered[-1])
    return f"{low} seeds" if low == high else f"{low} to {high} seeds"
