"""Comparison of bench/bakeoff.py's arms with the first of them: rows of a table, and forest plots."""

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bakeoff_arms import Arm
from numpy.typing import NDArray
from scipy.stats import t

from mjx_dher import stats

ALPHA, POWER = 0.05, 0.8


class Scores(NamedTuple):
    """Results of an arm's runs, by seed; all [S]."""

    seeds: tuple[int, ...]
    area: NDArray  # mean success over the epochs
    final: NDArray  # success of the last policy
    steps: NDArray  # environment steps to the threshold; infinite where it is never reached
    failed: int


class Row(NamedTuple):
    """Comparison of an arm with the baseline, for a learner and task. Differences are paired by seed, intervals at 95 %."""

    learner: str
    task: str
    arm: str
    seeds: int
    failed: int
    mean_success: float
    final: float
    steps_to_threshold: float  # median; infinite if half of the seeds or more never reach it
    difference: float  # of mean success
    low: float
    high: float
    final_difference: float
    better: float  # probability that a seed of the arm has more mean success than one of the baseline
    better_low: float
    better_high: float
    p_value: float
    p_corrected: float  # by Holm's method, over all arms of a learner and task; the p of one that has not been run counts as 1
    p_joint: float  # by joint flips (`stats.westfall_young`), over all arms that have been run; decides nothing
    smallest_effect: float  # that would be seen four times in five, for this spread of the differences
    claim: str
    source: str
    each: Mapping[int, float]  # differences of mean success, by seed


def smallest_effect(spread: float, seeds: int, tests: int) -> float:
    """Mean difference for which the permutation test has p <= 0.05 / tests with probability 0.8. NaN: there is none.

    `spread` is the standard deviation of the differences, which are assumed normal: 2,000 draws. Holm's method holds the
    smallest of `tests` p-values to that level. Beyond 12 seeds, 4,096 sign patterns are drawn, too.
    """
    if seeds < 2 or 2.0 ** (1 - seeds) > ALPHA / tests:
        return math.nan
    return _smallest_effect(seeds, tests) * spread


@functools.cache
def _smallest_effect(seeds: int, tests: int) -> float:
    rng = np.random.default_rng(0)
    drawn = rng.normal(size=(2000, seeds))
    if seeds <= 12:  # the first difference keeps its sign: flipping all of them changes only the sign of their sum
        every = np.array(list(itertools.product((1,), *(seeds - 1) * [(1, -1)])))
    else:
        every = rng.choice((1, -1), size=(4096, seeds))
    flipped, changed, sums = drawn @ every.T, every.sum(axis=1), drawn.sum(axis=1, keepdims=True)
    # An effect moves the data's sum, then positive, by `seeds` times itself, and a flip's by `changed`. Up to `last` the flip's
    # is as large.
    with np.errstate(divide="ignore", invalid="ignore"):
        last = np.fmax((flipped - sums) / (seeds - changed), -(flipped + sums) / (seeds + changed))
    last[:, np.abs(changed) == seeds] = np.inf  # the data itself, or all of it flipped
    rank = len(every) - 1 - int(ALPHA / tests * len(every) + 1e-9)  # all above it may be as large
    needed = np.partition(last, rank, axis=1)[:, rank]
    return float(np.quantile(needed, POWER, method="inverted_cdf"))


def compare(learner: str, task: str, scores: dict[str, Scores], arms: Sequence[Arm], tests: int | None = None) -> list[Row]:
    """One row per arm with scores, each against the first of `arms` on their common seeds.

    p is corrected over `tests` comparisons (`corrected`). Default: all of `arms`, including those without scores.
    """
    base, tests = scores[arms[0].name], len(arms) - 1 if tests is None else tests
    return corrected([_row(learner, task, arm, scores[arm.name], base, tests) for arm in arms if arm.name in scores], tests)


def corrected(rows: Sequence[Row], tests: int) -> list[Row]:
    """The rows with p corrected over `tests` comparisons together (`stats.holm`)."""
    tested = [number for number, row in enumerate(rows) if not math.isnan(row.p_value)]
    alone = stats.holm([rows[number].p_value for number in tested], tests)
    seeds = sorted({seed for number in tested for seed in rows[number].each})
    each = [[rows[number].each.get(seed, math.nan) for seed in seeds] for number in tested]
    by_row = dict(zip(tested, zip(alone, stats.westfall_young(each) if each else [])))
    return [row._replace(p_corrected=by_row[n][0], p_joint=by_row[n][1]) if n in by_row else row for n, row in enumerate(rows)]


def _row(learner: str, task: str, arm: Arm, own: Scores, base: Scores, tests: int) -> Row:
    common = [seed for seed in own.seeds if seed in base.seeds]
    nan = math.nan
    paired: dict[str, Any] = {}
    if own is not base and len(common) > 1:
        mine, theirs = ([scores.seeds.index(seed) for seed in common] for scores in (own, base))
        difference = own.area[mine] - base.area[theirs]
        half = float(t.ppf(0.975, len(common) - 1) * difference.std(ddof=1) / math.sqrt(len(common)))
        better_low, better_high = stats.improvement_interval(own.area, base.area)
        paired = {
            "difference": float(difference.mean()),
            "low": float(difference.mean()) - half,
            "high": float(difference.mean()) + half,
            "final_difference": float((own.final[mine] - base.final[theirs]).mean()),
            "better": stats.probability_of_improvement(own.area, base.area),
            "better_low": better_low,
            "better_high": better_high,
            "each": dict(zip(common, difference.tolist())),
            "p_value": stats.paired_p_value(own.area[mine], base.area[theirs]),
            "smallest_effect": smallest_effect(float(difference.std(ddof=1)), len(common), max(tests, 1)),
        }
    empty: dict[str, Any] = dict.fromkeys(
        ("difference", "low", "high", "final_difference", "better", "better_low", "better_high", "p_value", "smallest_effect"),
        nan,
    )
    return Row(
        learner=learner,
        task=task,
        arm=arm.name,
        seeds=len(own.seeds),
        failed=own.failed,
        mean_success=float(own.area.mean()),
        final=float(own.final.mean()),
        steps_to_threshold=float(np.median(own.steps)),
        p_corrected=nan,
        p_joint=nan,
        claim=arm.claim,
        source=arm.source,
        **({"each": {}} | empty | paired),
    )


def forest(rows: Sequence[Row], path: Path, baseline: str) -> None:
    """Draws the paired differences of a task's arms from the baseline, with intervals and corrected p, one panel per
    learner.
    """
    import matplotlib.pyplot as plt

    learners = list(dict.fromkeys(row.learner for row in rows))
    names = list(dict.fromkeys(row.arm for row in rows if row.arm != baseline))
    height = 1.3 + 0.3 * max(len(names), 1)
    figure, axes = plt.subplots(1, len(learners), figsize=(5.2 * len(learners), height), sharey=True, squeeze=False)
    for axis, learner in zip(axes[0], learners):
        for row in rows:
            if row.learner != learner or math.isnan(row.difference):
                continue
            place = names.index(row.arm)
            shown = "black" if row.p_corrected < ALPHA else "0.5"
            around = [[row.difference - row.low], [row.high - row.difference]]
            axis.errorbar(row.difference, place, xerr=around, fmt="o", color=shown, capsize=3, markersize=4)
            axis.annotate(
                f"p {row.p_corrected:.2g}", (1.01, place), xycoords=("axes fraction", "data"), fontsize=7, va="center"
            )
        axis.axvline(0.0, color="0.6", linewidth=0.8)
        axis.set_title(learner, fontsize=10)
        axis.set_xlabel(f"mean success over epochs, difference to {baseline}")
        axis.grid(axis="x", alpha=0.2)
    axes[0][0].set_yticks(range(len(names)), names)
    axes[0][0].invert_yaxis()
    figure.suptitle(f"{rows[0].task}: paired by seed, 95 % intervals;\nblack where p corrected < {ALPHA}", fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)
