"""Writes docs/images/samplers.png, the README's first picture: `python docs/make_readme_figure.py` (extra `plot`)."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import paper_set
from paper_analysis import DOCS, NAMES, STEPS, Sweeps

from mjx_dher import stats

# Okabe and Ito's colours, and a line's style.
STYLES = {
    "future": ("#0072B2", "-"),
    "weighted": ("#D55E00", "--"),
    "epsilon_closest": ("#009E73", "-."),
    "closest": ("#000000", ":"),
}
SAMPLERS = {"push": tuple(STYLES), "pick_and_place": ("future", "weighted"), "slide": ("future", "weighted")}
# Task, its file, environment steps per epoch, and samplers.
PANELS = tuple((NAMES[task], task, STEPS[task], samplers) for task, samplers in SAMPLERS.items())


@functools.cache
def today() -> dict[str, Sweeps]:
    """Curves of the paper's experiment by task."""
    return paper_set.current(paper_set.load_set(paper_set.FOLDER))


def curves(task: str, sampler: str) -> np.ndarray:
    """Success rates [seeds, epochs] of a sampler in the paper's experiment, from docs/paper/TASK_curves.csv."""
    return today()[task]["samplers", sampler].success


def make() -> Any:
    """The figure."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12, 3.9), sharey=True, layout="constrained")
    for axis, (title, task, steps, samplers) in zip(axes, PANELS, strict=True):
        for sampler in samplers:
            color, line = STYLES[sampler]
            middle, low, high = stats.curve_interval(curves(task, sampler))
            x = np.arange(1, len(middle) + 1) * steps / 1e6
            axis.fill_between(x, low, high, color=color, alpha=0.13, linewidth=0)
            axis.plot(x, middle, color=color, linestyle=line, linewidth=1.8, label=sampler)
        axis.set(title=title, xlabel="million environment steps", xlim=(0, None), ylim=(0, 1.02))
        axis.grid(alpha=0.2)
    axes[0].set_ylabel("success rate")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=11)
    return figure


if __name__ == "__main__":
    make().savefig(DOCS / "images" / "samplers.png", dpi=110)
