"""The forest plot of docs/results.md: `weighted` against `future`, in every sweep of every task."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from paper_analysis import LAST, NAMES, START, THRESHOLDS, Difference, Sweeps, gain, sooner, window

REPEATED = ("samplers", "fast", "hopper", "hopper again")  # those whose runs are whole
CLAIMED = {("push", START): (2, 3), ("push", 0.9): (5, 5), ("pick_and_place", START): (2, 3), ("pick_and_place", 0.9): (10, 10)}
Line = tuple[str, str, Difference, "tuple[float, float] | None"]  # label, sweep, difference, what the paper claims


def success_lines(data: Mapping[str, Sweeps], names: tuple[str, ...]) -> list[Line]:
    """Returns what is drawn of success: over all epochs, and over the last ones."""
    lines: list[Line] = []
    for task, sweeps in data.items():
        for sweep in (name for name in names if (name, "weighted") in sweeps):
            lines.append((f"{NAMES[task]}, all epochs", sweep, gain(sweeps, sweep, "weighted", "future"), None))
        for sweep in (name for name in names if (name, "weighted") in sweeps):
            late = window(sweeps, sweep, slice(-LAST[task], None))
            lines.append((f"{NAMES[task]}, last {LAST[task]}", sweep, late, None))
    return lines


def epoch_lines(data: Mapping[str, Sweeps], names: tuple[str, ...]) -> list[Line]:
    """Returns what is drawn of epochs: to the start, and to the threshold."""
    lines: list[Line] = []
    for task, sweeps in data.items():
        for threshold in (START, THRESHOLDS[task]):
            for sweep in (name for name in names if (name, "weighted") in sweeps):
                claimed = CLAIMED.get((task, threshold))
                lines.append((f"{NAMES[task]}, to {threshold:.2f}", sweep, sooner(sweeps, sweep, threshold), claimed))
    return lines


def draw(data: Mapping[str, Sweeps], path: Path, main: str) -> None:
    """Draws the picture; `main` is the sweep that comes first, and darker."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(12, 6.2))
    titles = ("mean success: weighted less future", "epochs that weighted is sooner than future")
    for ax, lines, title in zip(axes, (success_lines(data, (main, *REPEATED)), epoch_lines(data, (main, *REPEATED))), titles):
        _panel(ax, lines, main)
        ax.set(xlabel=title)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    axes[0].axvspan(-0.02, 0.02, color="#eef2f6", zorder=0)
    figure.legend(*axes[1].get_legend_handles_labels(), loc="lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _panel(ax, lines: list[Line], main: str) -> None:
    """Draws intervals from top to bottom; those of one question stand close together."""
    y, before, ticks = 0.0, "", []
    for label, sweep, d, claimed in lines:
        y -= 0.32 if label == before else 1.0
        if label != before:
            ticks.append((y, label))
        is_main = sweep == main
        color = "#1b62a5" if is_main else "#8fb8de"
        told = "95 % interval, 2026-11-24" if is_main else "2026-11-22"
        label_of_dot = told if told not in ax.get_legend_handles_labels()[1] else None
        ax.plot([d.low, d.high], [y, y], color=color, linewidth=2.2 if is_main else 1.6, solid_capstyle="butt")
        ax.plot(d.mean, y, "o", color=color, markersize=6 if is_main else 4, label=label_of_dot)
        if claimed and label != before:
            told = "the paper, one seed" if "the paper, one seed" not in ax.get_legend_handles_labels()[1] else None
            ax.plot(claimed, [y] * len(claimed), "D-", color="#b3261e", markersize=6, label=told)
        before = label
    ax.axvline(0, color="#1c232b", linewidth=0.8)
    ax.set_yticks([place for place, _ in ticks], [label for _, label in ticks])
    ax.locator_params(axis="x", nbins=6)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
