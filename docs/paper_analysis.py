"""Reads learning curves and compares them by seed, for the tables and pictures of the paper's experiment."""

import csv
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from mjx_dher import stats

DOCS = Path(__file__).parent
NAMES = {"push": "Push", "pick_and_place": "PickAndPlace", "slide": "Slide"}
THRESHOLDS = {"push": 0.9, "pick_and_place": 0.9, "slide": 0.6}
LAST = {"push": 10, "pick_and_place": 10, "slide": 20}  # epochs that count as the long term
START, MARGIN = 0.2, 0.02  # success at which a run has begun to learn; largest difference that counts as alike


class Curves(NamedTuple):
    """Success of one setting's seeds after each epoch."""

    seeds: tuple[int, ...]  # S of them
    success: NDArray  # [S, P]


Sweeps = Mapping[tuple[str, str], Curves]  # by sweep and setting


class Difference(NamedTuple):
    """Paired difference of two settings: mean over seeds, Student's t interval at 95 %, and the permutation test's p."""

    each: NDArray  # [S]
    mean: float
    low: float
    high: float
    p: float


def read(path: Path) -> Sweeps:
    """Curves in a CSV, by sweep and setting. A truncated sweep is as long as its shortest run."""
    runs: dict[tuple[str, str], dict[int, list[float]]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            curve = runs.setdefault((row["sweep"], row["setting"]), {}).setdefault(int(row["seed"]), [])
            if int(row["epoch"]) != len(curve) + 1:
                raise ValueError(f"{path}: epoch {row['epoch']} of {row['sweep']}, {row['setting']} is out of order")
            curve.append(float(row["success_rate"]))
    return {name: _curves(by_seed) for name, by_seed in runs.items()}


def _curves(by_seed: dict[int, list[float]]) -> Curves:
    seeds = tuple(sorted(by_seed))
    length = min(map(len, by_seed.values()))
    return Curves(seeds, np.array([by_seed[seed][:length] for seed in seeds]))


def area(curves: Curves, epochs: int | None = None) -> NDArray:
    """Mean success [S] over the (first) epochs, by trapezoids."""
    success = curves.success[:, :epochs]
    return stats.area_under_curve(np.arange(success.shape[1]), success)


def reach(curves: Curves, threshold: float) -> NDArray:
    """First epoch [S] at or above a success rate, or infinity."""
    return stats.first_reach(np.arange(1, curves.success.shape[1] + 1), curves.success, threshold)


def t_interval(scores: NDArray) -> tuple[float, float, float]:
    """Mean of scores [S], and the ends of its Student's t interval at 95 %."""
    mean, half = scores.mean(), t.ppf(0.975, len(scores) - 1) * scores.std(ddof=1) / math.sqrt(len(scores))
    return float(mean), float(mean - half), float(mean + half)


def difference(a: NDArray, b: NDArray) -> Difference:
    """Difference a - b of scores [S] that are paired by seed."""
    each = a - b
    if not np.isfinite(each).all():
        return Difference(each, math.nan, math.nan, math.nan, math.nan)
    return Difference(each, *t_interval(each), stats.paired_p_value(a, b))


def gain(sweeps: Sweeps, sweep: str, setting: str, baseline: str) -> Difference:
    """Gain in mean success over the epochs of a setting against a baseline of the same sweep, paired by the setting's seeds."""
    own = sweeps[sweep, setting]
    return difference(area(own), area(with_seeds(sweeps[sweep, baseline], own.seeds)))


def with_seeds(curves: Curves, seeds: tuple[int, ...]) -> Curves:
    """The curves of some of the seeds. Raises ValueError if one is missing."""
    if missing := set(seeds) - set(curves.seeds):
        raise ValueError(f"the curves lack seeds {sorted(missing)}; they have {curves.seeds}")
    return Curves(seeds, curves.success[[curves.seeds.index(seed) for seed in seeds]])


def sooner(sweeps: Sweeps, sweep: str, threshold: float) -> Difference:
    """Number of epochs by which `weighted` reaches a threshold before `future`."""
    return difference(reach(sweeps[sweep, "future"], threshold), reach(sweeps[sweep, "weighted"], threshold))


def window(sweeps: Sweeps, sweep: str, part: slice) -> Difference:
    """Difference in mean success between `weighted` and `future` in some of the epochs."""
    return difference(*(sweeps[sweep, name].success[:, part].mean(axis=1) for name in ("weighted", "future")))


def table(head: str, rows: list[list[str]]) -> str:
    """Table as Markdown. `head` has its columns' names, separated by |."""
    columns = [name.strip() for name in head.split("|")]
    if wrong := [row for row in rows if len(row) != len(columns)]:
        raise ValueError(f"a row of {len(columns)} columns has {len(wrong[0])} cells: {wrong[0]}")
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def with_tables(page: str, script: str, blocks: Mapping[str, str]) -> str:
    """The page's text with a script's current tables, which have names.

    Raises:
      ValueError: the page has no place for a table.
    """
    for name, text in blocks.items():
        begin, end = f"<!-- {name}: {script} -->\n", f"<!-- end of {name} -->"
        if page.count(begin) != 1 or page.count(end) != 1:
            raise ValueError(f"the page has not one place for {name}")
        new = (begin + text + "\n" + end).replace("\\", r"\\")
        page = re.sub(f"{re.escape(begin)}.*?{re.escape(end)}", new, page, flags=re.DOTALL)
    return page


def signed(d: Difference, digits: int = 3) -> list[str]:
    """Cells of a difference: its mean, its interval and p."""
    return [f"{d.mean:+.{digits}f}", f"{d.low:+.{digits}f} to {d.high:+.{digits}f}", number(d.p)]


def number(p: float) -> str:
    """p to two significant digits."""
    return f"{p:.2f}" if p >= 0.095 else f"{p:.2g}"


def mean_of(scores: NDArray) -> str:
    """Mean of scores [S] with its 95 % interval, as text."""
    return "{:.3f} ({:.3f} to {:.3f})".format(*t_interval(scores))


def median_of(epochs: NDArray) -> str:
    """Median of epochs [S] with its bootstrap interval. Infinite epochs are "never"."""
    values = (np.median(epochs), *stats.bootstrap_interval(epochs, np.median))
    middle, low, high = ("never" if math.isinf(value) else f"{value:g}" for value in values)
    return f"{middle} ({low} to {high})" if middle != "never" or low != "never" else "never"


def load() -> dict[str, Sweeps]:
    """Curves of 2026-11-22 by task; `paper_set.load_set` loads later ones."""
    return {task: read(DOCS / f"paper_{task}_curves.csv") for task in NAMES}
