"""Draws the learning curves written by bench/time_to_success.py, one colour per file. Needs the extra `plot`.

python bench/plot_time_to_success.py docs/push_learning_curve.csv docs/push_learning_curve.png
python bench/plot_time_to_success.py --label environments docs/push_gpu/{512,2048,8192}.csv docs/push_gpu/num_envs.png
"""

import argparse
import csv
import itertools
from pathlib import Path

import matplotlib.pyplot as plt

# Distinct for colour-blind readers (Okabe and Ito) and, by their dashes, in grey.
LOOKS = (("#0072b2", "-"), ("#d55e00", "--"), ("#009e73", "-."), ("#cc79a7", ":"))


def read(source: Path) -> dict[str, list[tuple[float, float, float]]]:
    """By seed: seconds, environment steps and success rate of each evaluation."""
    seeds: dict[str, list[tuple[float, float, float]]] = {}
    with source.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            point = (float(row["wall_seconds"]), float(row["env_steps"]), float(row["success_rate"]))
            seeds.setdefault(row["seed"], []).append(point)
    return seeds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--label", default="", help="quantity that the files are named after")
    parser.add_argument("--threshold", type=float, default=0.9)
    args = parser.parse_args()
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True)
    for axis, column, scale, label in zip(axes, (0, 1), (1, 1e3), ("seconds of training", "thousand environment steps")):
        for source, (color, dashes) in zip(args.sources, itertools.cycle(LOOKS)):
            name = f"{source.stem} {args.label}".strip()
            for points in read(source).values():
                line = ([p[column] / scale for p in points], [p[2] for p in points])
                axis.plot(*line, color=color, linestyle=dashes, alpha=0.7, linewidth=1.3, label=name)
                name = "_"  # one entry in the legend
        axis.axhline(0.07, color="0.4", linestyle=":", linewidth=1)
        axis.axhline(args.threshold, color="0.4", linestyle="--", linewidth=1)
        axis.set_xlabel(label)
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate (100 episodes)")
    axes[0].set_ylim(0, 1.02)
    axes[0].text(0, 0.09, "reached at the reset", color="0.3", fontsize=8)
    if len(args.sources) > 1:
        axes[1].legend(loc="lower right", fontsize=8)
    figure.tight_layout()
    figure.savefig(args.target, dpi=130)


if __name__ == "__main__":
    main()
