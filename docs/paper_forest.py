"""The forest plots of the paper's experiment: `weighted` against `future` in every sweep, and the comparisons of the set."""

from collections.abc import Mapping
from pathlib import Path

from paper_analysis import LAST, MARGIN, NAMES, START, THRESHOLDS, Difference, Sweeps, gain, sooner, window
from paper_set import Compared

REPEATED = ("samplers", "fast", "hopper", "hopper again")  # sweeps whose runs are complete
OWN_CYCLES = ("the paper's cycles", "break-off")
CLAIMED = {("push", START): (2, 3), ("push", 0.9): (5, 5), ("pick_and_place", START): (2, 3), ("pick_and_place", 0.9): (10, 10)}
SHOWN = (-0.3, 0.18)  # range of differences in the picture of the set
WORDS = {
    "future, ": "",
    "her_k": "k",
    "epsilon_closest, epsilon": "method 2, ε",
    "priority_fraction 0.5": "half of each batch eventful",
}
Line = tuple[str, str, Difference, "tuple[float, float] | None"]  # label, sweep, difference, what the paper claims


def success_lines(data: Mapping[str, Sweeps], names: tuple[str, ...]) -> list[Line]:
    """Differences in success to draw: over all epochs, and over the last ones."""
    lines: list[Line] = []
    for task, sweeps in data.items():
        for sweep in (name for name in names if (name, "weighted") in sweeps):
            lines.append((f"{NAMES[task]}, all epochs", sweep, gain(sweeps, sweep, "weighted", "future"), None))
        for sweep in (name for name in names if (name, "weighted") in sweeps):
            late = window(sweeps, sweep, slice(-LAST[task], None))
            lines.append((f"{NAMES[task]}, last {LAST[task]}", sweep, late, None))
    return lines


def epoch_lines(data: Mapping[str, Sweeps], names: tuple[str, ...]) -> list[Line]:
    """Differences in epochs to draw: to the start, and to the threshold."""
    lines: list[Line] = []
    for task, sweeps in data.items():
        for threshold in (START, THRESHOLDS[task]):
            for sweep in (name for name in names if (name, "weighted") in sweeps):
                claimed = CLAIMED.get((task, threshold))
                lines.append((f"{NAMES[task]}, to {threshold:.2f}", sweep, sooner(sweeps, sweep, threshold), claimed))
    return lines


def draw(data: Mapping[str, Sweeps], path: Path, main: tuple[str, ...]) -> None:
    """Draws the picture. The sweeps in `main` come first. Those with the paper's cycles are darker."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(12, 6.2))
    titles = ("mean success: weighted less future", "epochs that weighted is sooner than future")
    for ax, lines, title in zip(axes, (success_lines(data, (*main, *REPEATED)), epoch_lines(data, (*main, *REPEATED))), titles):
        _panel(ax, lines)
        ax.set(xlabel=title)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    axes[0].axvspan(-0.02, 0.02, color="#eef2f6", zorder=0)
    figure.legend(*axes[1].get_legend_handles_labels(), loc="lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_set(found: Mapping[str, list[Compared]], path: Path) -> None:
    """Draws every comparison of the set, one panel per task. Dark: p is below 0.05, corrected over its family."""
    import matplotlib.pyplot as plt

    every = [result for results in found.values() for result in results]
    names = list(dict.fromkeys(_short(result) for result in every))
    figure, axes = plt.subplots(1, len(NAMES), figsize=(12, 1.4 + 0.26 * len(names)), sharey=True)
    for ax, (task, title) in zip(axes, NAMES.items()):
        for result in (result for result in every if result.comparison.task == task):
            y, d = -names.index(_short(result)), result.difference
            color = "#1b62a5" if result.p < 0.05 else "#9aa5b1"
            if d.high < SHOWN[0]:
                ax.annotate(f"◂ {d.mean:+.2f}", (SHOWN[0], y), color=color, va="center")
                continue
            ax.plot([d.low, d.high], [y, y], color=color, linewidth=2)
            ax.plot(d.mean, y, "o", color=color, markersize=5)
        ax.axvline(0, color="#1c232b", linewidth=0.8)
        ax.axvspan(-MARGIN, MARGIN, color="#eef2f6", zorder=0)
        ax.set(title=title, xlim=SHOWN, xlabel="mean success, difference")
        ax.grid(axis="y", alpha=0.25)
        ax.spines[["top", "right", "left"]].set_visible(False)
        ax.tick_params(axis="y", length=0)
    axes[0].set_yticks([-place for place in range(len(names))], names)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _short(result: Compared) -> str:
    """Name of a comparison in the picture: its setting, and its baseline unless that is the set's `future`."""
    setting, against = (result.comparison.setting, (result.comparison.against or ("", ""))[1])
    for name, word in WORDS.items():
        setting, against = setting.replace(name, word), against.replace(name, word)
    return f"{setting}, paper's cycles" if against == "future" else f"{setting}, against {against}" if against else setting


def _panel(ax, lines: list[Line]) -> None:
    """Draws intervals from top to bottom. Intervals with the same label are close together."""
    y, before, ticks = 0.0, "", []
    for label, sweep, d, claimed in lines:
        y -= 0.32 if label == before else 1.0
        if label != before:
            ticks.append((y, label))
        is_main = label != before
        has_own = sweep in OWN_CYCLES
        color = "#1b62a5" if has_own else "#8fb8de"
        told = "the paper's cycles, 95 %" if has_own else "other sweeps"
        label_of_dot = told if told not in ax.get_legend_handles_labels()[1] else None
        ax.plot([d.low, d.high], [y, y], color=color, linewidth=2.2 if is_main else 1.6, solid_capstyle="butt")
        ax.plot(d.mean, y, "o", color=color, markersize=6 if is_main else 4, label=label_of_dot)
        if claimed and label != before:
            told = "the paper, one seed"
            label_of_dot = told if told not in ax.get_legend_handles_labels()[1] else None
            ax.plot(claimed, [y] * len(claimed), "D-", color="#b3261e", markersize=6, label=label_of_dot)
        before = label
    ax.axvline(0, color="#1c232b", linewidth=0.8)
    ax.set_yticks([place for place, _ in ticks], [label for _, label in ticks])
    ax.locator_params(axis="x", nbins=6)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
