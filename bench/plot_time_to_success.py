"""Draws the learning curves that bench/time_to_success.py wrote. Needs the extra `plot`.

python bench/plot_time_to_success.py docs/push_learning_curve.csv docs/push_learning_curve.png
"""

from __future__ import annotations

import csv
import sys

import matplotlib.pyplot as plt


def main(source: str, target: str) -> None:
    seeds: dict[str, list[tuple[float, float, float]]] = {}
    with open(source) as file:
        for row in csv.DictReader(file):
            point = (float(row["wall_seconds"]), float(row["env_steps"]), float(row["success_rate"]))
            seeds.setdefault(row["seed"], []).append(point)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True)
    for axis, column, scale, label in zip(axes, (0, 1), (1, 1e3), ("seconds of training", "thousand environment steps")):
        for points in seeds.values():
            axis.plot([p[column] / scale for p in points], [p[2] for p in points], color="#1f5a94", alpha=0.6, linewidth=1.3)
        axis.axhline(0.07, color="0.4", linestyle=":", linewidth=1)
        axis.axhline(0.9, color="0.4", linestyle="--", linewidth=1)
        axis.set_xlabel(label)
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate (100 episodes)")
    axes[0].set_ylim(0, 1.02)
    axes[0].text(0, 0.09, "reached at the reset", color="0.3", fontsize=8)
    figure.tight_layout()
    figure.savefig(target, dpi=130)


if __name__ == "__main__":
    main(*sys.argv[1:])
