"""Writes docs/images/preference.png, loss over the strength of a preference for near goals (extra `plot`).

    python docs/make_preference_figure.py

The strength is the share of draws that differ from `future` on the way to a goal (docs/samplers.md). The loss is of mean
success over 30 epochs of Push, paired over ten seeds (with the paper's cycles, `weighted` over twenty).
"""

from pathlib import Path
from typing import NamedTuple

import paper_set
from make_samplers_figure import SITUATIONS, TRAINED, total_variation
from paper_analysis import DOCS, MARGIN, Difference, area, difference, read, with_seeds
from scipy.stats import spearmanr

from mjx_dher import samplers

PICTURE = DOCS / "images" / "preference.png"
EPOCHS, EPSILONS = 30, (0.1, 0.2, 0.3, 0.5)
# Sweeps with the paper's cycles, for those with one cycle per epoch; readings of `weighted` have the same settings.
OWN = {
    ("samplers", "weighted"): ("own_push", "weighted"),
    ("samplers", "closest"): ("own_methods", "closest"),
    ("samplers", "epsilon_closest, epsilon 0.2"): ("own_methods", "epsilon_closest"),
}
BELOW = {"sum": -13, "far": 1, "mean, softmax": -16, "minmax": -6, "closest": -10}  # points from a dot to its label


class Point(NamedTuple):
    """A setting: its share of draws that differ, and its mean success less the mean of `future`."""

    name: str
    share: float
    gain: Difference


def points(own: bool = False) -> list[Point]:
    """Settings on Push that choose goals by distance, by share: thirteen, or ten with the paper's `own` cycles."""
    way, push = SITUATIONS["on the way"], read(paper_set.FOLDER / "push_curves.csv")
    made = {("samplers", "closest"): ("closest", total_variation(samplers.make("closest"), way))}
    for epsilon in EPSILONS:  # draws at random differ from nothing
        made["samplers", f"epsilon_closest, epsilon {epsilon}"] = (
            f"ε {epsilon}",
            (1 - epsilon) * made["samplers", "closest"][1],
        )
    for normalization, kernel in TRAINED:
        sweep = "readings_push_softmax" if kernel == "softmax" else "readings_push"
        name = (sweep, f"weighted, {normalization}, {kernel}")
        share = total_variation(samplers.make("weighted", kernel, normalization=normalization), way)
        made[("samplers", "weighted") if (normalization, kernel) == ("mean", "linear") else name] = (
            f"{normalization}, {kernel}" if kernel == "softmax" else normalization,
            share,
        )
    found = []
    for long, (label, share) in made.items():
        name = OWN.get(long, (long[0].replace("readings_", "readings_own_"), long[1])) if own else long
        if own == ("own" in name[0]):
            base = with_seeds(push["own_push" if own else "samplers", "future"], push[name].seeds)
            found.append(Point(label, share, difference(area(push[name], EPOCHS), area(base, EPOCHS))))
    return sorted(found, key=lambda point: point.share)


def correlation(found: list[Point]) -> float:
    """Spearman's rank correlation of share and gain."""
    return float(spearmanr([point.share for point in found], [point.gain.mean for point in found]).statistic)


def draw(path: Path) -> None:
    """Draws the figure."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8, 4.2), layout="constrained")
    shares, gains = zip(*((point.share, point.gain.mean) for point in points(own=True)))
    axis.plot(shares, gains, "x", color="#5b6671", label="with the paper's cycles")
    for point in points():
        away = point.name == "far"
        around = [[point.gain.mean - point.gain.low], [point.gain.high - point.gain.mean]]
        color, face = ("#0072B2", "white") if away else ("#b3261e", "#b3261e")
        axis.errorbar(point.share, point.gain.mean, around, fmt="o", color=color, markerfacecolor=face, capsize=3)
        offset = (7, BELOW.get(point.name, 3))
        axis.annotate(point.name, (point.share, point.gain.mean), offset, textcoords="offset points", fontsize=8)
    axis.axhline(0, color="#1c232b", linewidth=0.8)
    axis.axhspan(-MARGIN, MARGIN, color="#eef2f6", zorder=0)
    axis.set(xlim=(-0.03, 1.08), xlabel="share of draws that differ from future, on the way to a goal")
    axis.set(ylabel="mean success less future's", title="Push: the stronger the preference for near goals, the slower")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, loc="lower left")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Writes the figure, and prints the correlation."""
    draw(PICTURE)
    print(f"Spearman {correlation(points()):.2f}, with the paper's cycles {correlation(points(own=True)):.2f}")


if __name__ == "__main__":
    main()
