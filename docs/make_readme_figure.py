"""Writes docs/images/samplers.png, the paper's comparison over its epochs: `python docs/make_readme_figure.py` (extra `plot`).

Thin lines are seeds, thick ones their means. Red diamonds mark the gain that the paper reads off its single curves.
"""

import functools
from typing import Any

import numpy as np
import paper_set
from paper_analysis import DOCS, NAMES, THRESHOLDS, Curves, Sweeps, reach

# Okabe and Ito's colours, and a line's style.
STYLES = {
    "future": ("#0072B2", "-"),
    "weighted": ("#D55E00", "--"),
    "epsilon_closest": ("#009E73", "-."),
    "closest": ("#000000", ":"),
}
CLAIMED = {"push": 5, "pick_and_place": 10}  # epochs that `weighted` is sooner than `future` in the paper
SHOWN = {"push": 50, "pick_and_place": 50, "slide": 100}  # epochs


@functools.cache
def data() -> dict[str, Sweeps]:
    """Curves of the paper's experiment by task."""
    return paper_set.load_set(paper_set.FOLDER)


def curves(task: str) -> dict[str, Curves]:
    """Curves by sampler, with the paper's cycles."""
    own = {name: found for (sweep, name), found in data()[task].items() if sweep in (paper_set.OWN[task], "own_methods")}
    return {name: own[name] for name in STYLES if name in own}


def _panel(axis: Any, task: str) -> None:
    own = curves(task)
    for name, found in own.items():
        color, line = STYLES[name]
        x = np.arange(1, found.success.shape[1] + 1)
        axis.plot(x, found.success.T, color=color, linewidth=0.5, alpha=0.16)
        axis.plot(x, found.success.mean(axis=0), color=color, linestyle=line, linewidth=2.0, label=name)
    if task in CLAIMED:
        place, level = float(np.median(reach(own["future"], THRESHOLDS[task]))), THRESHOLDS[task]
        axis.annotate("", (place - CLAIMED[task], level), (place, level), arrowprops={"arrowstyle": "->", "color": "#b3261e"})
        axis.plot(place - CLAIMED[task], level, "D", color="#b3261e", markersize=6, label="the paper's gain", zorder=5)
    axis.set(title=f"{NAMES[task]}, {len(own['future'].seeds)} seeds, the paper's cycles", xlabel="epoch")
    axis.set(xlim=(0, SHOWN[task]), ylim=(0, 1.02))
    axis.grid(alpha=0.2)


def make() -> Any:
    """The figure."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12, 3.9), sharey=True, layout="constrained")
    for axis, task in zip(axes, NAMES, strict=True):
        _panel(axis, task)
    axes[0].set_ylabel("success rate")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=11)
    return figure


if __name__ == "__main__":
    make().savefig(DOCS / "images" / "samplers.png", dpi=110)
