"""Writes the tables of docs/scaling.md and their picture from docs/scaling_runs.csv: `python docs/make_scaling_figure.py`.

The file has the rows of bench/scaling.py on one machine. `weak` has as many times the environments and the batch as devices.
"""

import csv
from collections import defaultdict

from paper_analysis import DOCS, NAMES, table, with_tables

PAGE, DATA, PICTURE = DOCS / "scaling.md", DOCS / "scaling_runs.csv", DOCS / "images" / "scaling.png"
SCRIPT = "docs/make_scaling_figure.py"
ONE = "environments, batch, units | GPUs | more work: env steps/s | of one's | the same: env steps/s | of one's"
Key = tuple[str, ...]  # kind, task, environments, batch, units


def read() -> dict[Key, dict[int, tuple[float, int]]]:
    """Seconds of an epoch and steps per second, by row of the table and number of devices."""
    found: dict[Key, dict[int, tuple[float, int]]] = defaultdict(dict)
    with DATA.open(newline="") as file:
        for row in csv.DictReader(file):
            key = (row["what"], row["task"], row["environments"], row["batch"], row["units"])
            found[key][int(row["devices"])] = float(row["seconds"]), int(row["steps_per_second"])
    return dict(found)


def blocks() -> dict[str, str]:
    """Tables of the page, each with its name."""
    runs, lanes, one = read(), [], []
    for (kind, task, *sizes), each in runs.items():
        least = min(each)
        if kind == "lanes":
            seconds = [f"{each[n][0]:.2f}" if n in each else "" for n in (1, 2, 4, 8)]
            lanes.append([NAMES[task], *seconds, f"{each[8][1] / each[least][1]:.2f} of {8 // least}"])
        elif kind == "weak":
            strong = runs["strong", task, *sizes]
            name = ", ".join(f"{int(size):,}" for size in sizes)
            for n in each:
                steps = [cell for own in (each, strong) for cell in (f"{own[n][1]:,}", f"{own[n][1] / own[1][1]:.2f}")]
                one.append([name if n == 1 else "", str(n), *steps])
    head = "40 runs on each GPU | one GPU: s an epoch | two | four | eight | steps per second of eight against the fewest"
    return {"lanes": table(head, lanes), "one": table(ONE, one)}


def with_table(page: str) -> str:
    """The page's text with the current tables."""
    return with_tables(page, SCRIPT, blocks())


def draw() -> None:
    """Draws steps per second over devices, relative to one device."""
    import matplotlib.pyplot as plt

    runs = read()
    figure, axes = plt.subplots(1, 2, figsize=(8.0, 3.4), layout="constrained", sharey=True)
    labels = {"weak": "more work", "strong": "the same work", "lanes": "runs side by side"}
    lines = {"weak": "-", "strong": ":", "lanes": "-"}
    colours = ("#1b62a5", "#d97706", "#2e7d4f")
    for axis, kinds in zip(axes, (("lanes",), ("weak", "strong"))):
        axis.plot([1, 8], [1, 8], color="#8a8f98", linewidth=0.8)
        for kind in kinds:
            for colour, (key, each) in zip(colours, ((k, e) for k, e in runs.items() if k[0] == kind)):
                least = min(each)
                name = NAMES[key[1]] if kind == "lanes" else f"{int(key[2]):,} envs, {key[4]} units, {labels[kind]}"
                ratios = [least * each[n][1] / each[least][1] for n in each]
                axis.plot(list(each), ratios, lines[kind], marker="o", color=colour, label=name)
        axis.set(xscale="log", yscale="log", xlabel="GPUs", xticks=[1, 2, 4, 8], yticks=[1, 2, 4, 8])
        axis.set_xticklabels(["1", "2", "4", "8"])
        axis.set_yticklabels(["1", "2", "4", "8"])
        axis.minorticks_off()
        axis.legend(fontsize=7, frameon=False, loc="lower left" if len(kinds) > 1 else "upper left")
    axes[0].set(ylim=(0.15, 9.0), title="Runs side by side", ylabel="steps per second, of one GPU's")
    axes[1].set(title="One run of Push")
    figure.savefig(PICTURE, dpi=120)


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
    draw()
