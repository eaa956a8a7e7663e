"""Writes the table of readings in docs/samplers.md and its picture: `python docs/make_samplers_figure.py`.

The library's functions compute the weights of 25 goals after a step, given as distances in metres.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from paper_analysis import DOCS, table, with_tables

from mjx_dher import HParams, samplers

PAGE, PICTURE, SCRIPT = DOCS / "samplers.md", DOCS / "images" / "sampler_weights.png", "docs/make_samplers_figure.py"
CANDIDATES = 25
_STEPS = np.arange(CANDIDATES)
SITUATIONS = {
    "on the way": np.linspace(0.15, 0.05, CANDIDATES),
    "the same, ten times nearer": np.linspace(0.015, 0.005, CANDIDATES),
    "at the goal": 0.02 + 0.01 * np.cos(2 * np.pi * _STEPS / CANDIDATES),
    "solved": np.where(_STEPS < 10, 0.15 - 0.0145 * _STEPS, 0.005 + 0.003 * np.cos(2 * np.pi * _STEPS / 15)),
}
# Lines of the picture by kernel and normalization. The colours are distinct in print and for the colour-blind.
DRAWN = {
    ("mean", "linear"): ("#1b62a5", "-"),
    ("sum", "linear"): ("#8a8f98", "-"),
    ("max", "linear"): ("#d97706", "-"),
    ("minmax", "linear"): ("#d97706", "--"),
    ("far", "linear"): ("#b3261e", "-"),
    ("mean", "softmax"): ("#1b62a5", "--"),
    ("mean", "inverse"): ("#1b62a5", ":"),
    ("none", "softmax"): ("#2e7d4f", "-"),
    ("none", "linear"): ("#2e7d4f", "--"),
}


def probabilities(sampler: samplers.Sampler, distances: NDArray) -> NDArray:
    """Probabilities [n] of goals at `distances` [n] from the desired one, all in the future, under a sampler."""
    achieved = jnp.asarray(np.concatenate([distances[:1], distances]), jnp.float32)[:, None]
    log_weights = sampler.log_weights(achieved, jnp.zeros(1), jnp.array(0), HParams())
    return np.asarray(samplers.probabilities(log_weights))[1:]


def total_variation(sampler: samplers.Sampler, distances: NDArray) -> float:
    """Total variation distance to `future`: the share of draws that differ."""
    return 0.5 * float(np.abs(probabilities(sampler, distances) - 1 / len(distances)).sum())


# Readings with runs, by normalization and kernel.
TRAINED = [(n, "linear") for n in ("mean", "sum", "max", "minmax", "none", "far")] + [("mean", "softmax"), ("none", "softmax")]


def rows() -> list[tuple[str, list[float]]]:
    """Rows of the table: a name, and the total variation in each situation."""
    made = {f"`{n}`, `{k}`": samplers.make("weighted", k, normalization=n) for n, k in TRAINED}
    made |= {"`epsilon_closest`": samplers.make("epsilon_closest"), "`closest`": samplers.make("closest")}
    return [(name, [total_variation(sampler, d) for d in SITUATIONS.values()]) for name, sampler in made.items()]


def with_table(page: str) -> str:
    """The page's text with the current table."""
    lines = [[name, *(f"{value:.3f}" for value in values)] for name, values in rows()]
    return with_tables(page, SCRIPT, {"readings": table(" | ".join(["normalization, kernel", *SITUATIONS]), lines)})


def draw(path: Path) -> None:
    """Draws the probability of a goal, relative to `future`, over its distance, for three situations."""
    import matplotlib.pyplot as plt

    chosen = ("on the way", "at the goal", "solved")
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), sharey=True)
    for ax, situation in zip(axes, chosen):
        distances = SITUATIONS[situation]
        order = np.argsort(distances)
        for (normalization, kernel), (color, line) in DRAWN.items():
            sampler = samplers.make("weighted", kernel, normalization=normalization)
            times = CANDIDATES * probabilities(sampler, distances)[order]
            label = f"{normalization}, {kernel}"
            ax.plot(100 * distances[order], times, line, color=color, linewidth=1.8, label=label, marker=".", markersize=3)
        ax.axhline(1.0, color="#1c232b", linewidth=0.8)
        ax.set(title=situation, xlabel="distance to the desired goal, cm", ylim=(0, 3))
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("probability, as a multiple of future's")
    axes[1].text(3.0, 1.04, "future", fontsize=9, ha="right")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    figure.tight_layout(rect=(0, 0.12, 1, 1))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Writes both."""
    PAGE.write_text(with_table(PAGE.read_text()))
    draw(PICTURE)


if __name__ == "__main__":
    main()
