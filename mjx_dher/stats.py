"""Statistics of outcomes: success rates, and many seeds of several settings.

Scores are arrays [S] of one number a seed, or [S, K] where K tasks are pooled. Learning curves are [S, P], at points x [P]
(epochs, environment steps or seconds). A run that never gets somewhere took infinitely long: medians and ranks then stay what
they are.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Statistic = Callable[[NDArray], float]

EXACT_UP_TO = 14  # pairs whose 2^n changes of sign are all tried


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a success rate (Wilson 1927); z = 1.96 for 95 %.

    Raises:
      ValueError: no trials, or successes not among them.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"need 0 <= successes <= trials and trials > 0; got {successes} of {trials}")
    rate = successes / trials
    spread = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    centre = rate + z * z / (2 * trials)
    scale = 1 + z * z / trials
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def difference_interval(successes_a: int, trials_a: int, successes_b: int, trials_b: int) -> tuple[float, float]:
    """95 % interval of the difference a - b of two success rates: Newcombe's hybrid of Wilson's (Newcombe 1998, method 10).

    Raises:
      ValueError: no trials, or successes not among them.
    """
    low_a, high_a = wilson_interval(successes_a, trials_a)
    low_b, high_b = wilson_interval(successes_b, trials_b)
    a, b = successes_a / trials_a, successes_b / trials_b
    return a - b - math.hypot(a - low_a, high_b - b), a - b + math.hypot(high_a - a, b - low_b)


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores: a quarter of them (rounded down) is left out at either end.

    Less swayed by outliers than the mean, less wasteful than the median (Agarwal et al. 2021, "Deep Reinforcement Learning at
    the Edge of the Statistical Precipice"). Scores of several tasks are pooled.

    Raises:
      ValueError: no scores.
    """
    ordered = np.sort(_scores(scores), axis=None)
    return float(ordered[_middle(len(ordered))].mean())


def bootstrap_interval(
    scores: ArrayLike,
    statistic: Statistic = interquartile_mean,
    level: float = 0.95,
    repeats: int = 10_000,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic of scores [S] or [S, K], stratified: seeds are drawn anew within each task.

    Args:
      scores: [S] or [S, K].
      statistic: of an array like `scores`.
      level: share of repeats within the interval.
      repeats: times that the seeds are drawn.
      seed: of the draws, so that the same scores have the same interval.

    Raises:
      ValueError: no scores, or a level not between 0 and 1.
    """
    scores = _scores(scores)
    rng = np.random.default_rng(seed)
    drawn = np.array([statistic(_redrawn(scores, rng)) for _ in range(repeats)])
    return _percentiles(drawn, level)


def curve_interval(
    curves: ArrayLike, level: float = 0.95, repeats: int = 2_000, seed: int = 0
) -> tuple[NDArray, NDArray, NDArray]:
    """The interquartile mean of learning curves [S, P] at each point, and its percentile bootstrap interval: three of [P].

    Whole curves are drawn anew, and the interval is each point's own.

    Raises:
      ValueError: curves that are not [S, P], or a level not between 0 and 1.
    """
    curves = np.asarray(curves, float)
    _curves(np.arange(curves.shape[-1]) if curves.ndim else (), curves)
    num_seeds = len(curves)
    middle = _middle(num_seeds)
    rng = np.random.default_rng(seed)
    drawn = np.sort(curves[rng.integers(num_seeds, size=(repeats, num_seeds))], axis=1)[:, middle].mean(axis=1)
    low, high = _quantiles(drawn, level)
    return np.sort(curves, axis=0)[middle].mean(axis=0), low, high


def first_reach(x: ArrayLike, curves: ArrayLike, threshold: float) -> NDArray:
    """[S] the first of the points x [P] at which each of the curves [S, P] is at the threshold or above; infinite if none is.

    Raises:
      ValueError: as many points as each curve has are needed.
    """
    x, curves = _curves(x, curves)
    reached = curves >= threshold
    return np.where(reached.any(axis=1), x[reached.argmax(axis=1)], np.inf)


def area_under_curve(x: ArrayLike, curves: ArrayLike) -> NDArray:
    """[S] the mean height of each of the curves [S, P] between the first and the last of the points x [P] (trapezoids).

    Raises:
      ValueError: as many points as each curve has are needed, two at least, in rising order.
    """
    x, curves = _curves(x, curves)
    if len(x) < 2 or (np.diff(x) <= 0).any():
        raise ValueError(f"x must have two points at least, in rising order; got {x}")
    return np.trapezoid(curves, x, axis=1) / (x[-1] - x[0])


def probability_of_improvement(a: ArrayLike, b: ArrayLike) -> float:
    """How likely a score of `a` is to be greater than one of `b`, ties counting half; the mean over tasks.

    For each task it is the Mann-Whitney statistic divided by the number of pairs (Agarwal et al. 2021). Shapes [S] or [S, K];
    the number of seeds may differ.

    Raises:
      ValueError: no scores, or different tasks.
    """
    a, b = (np.atleast_2d(_scores(scores).T).T for scores in (a, b))
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"a and b must be of the same tasks; got {a.shape[1]} and {b.shape[1]}")
    greater, equal = (compare(a[:, None], b[None]).mean() for compare in (np.greater, np.equal))
    return float(greater + equal / 2)


def improvement_interval(
    a: ArrayLike, b: ArrayLike, level: float = 0.95, repeats: int = 2_000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of `probability_of_improvement`, seeds of `a` and of `b` drawn anew within each task.

    Raises:
      ValueError: as there, or a level not between 0 and 1.
    """
    a, b = _scores(a), _scores(b)
    rng = np.random.default_rng(seed)
    drawn = [probability_of_improvement(_redrawn(a, rng), _redrawn(b, rng)) for _ in range(repeats)]
    return _percentiles(np.array(drawn), level)


def paired_p_value(a: ArrayLike, b: ArrayLike, repeats: int = 100_000, seed: int = 0) -> float:
    """Two-sided p value of the mean difference of paired scores [S], by changing signs: were a and b alike, each pair's
    difference would be as likely to be the other way round (Fisher 1935).

    All changes of sign are tried for up to 14 pairs, else `repeats` random ones (and the one observed).

    Raises:
      ValueError: no pairs, scores that are not finite, or a different number of them.
    """
    a, b = _scores(a), _scores(b)
    if a.shape != b.shape or a.ndim != 1:
        raise ValueError(f"a and b must be as many scores [S], seed by seed; got shapes {a.shape} and {b.shape}")
    difference = a - b
    if not np.isfinite(difference).all():
        raise ValueError("a and b must be finite: a time to a threshold that was never reached has no difference")
    if len(difference) <= EXACT_UP_TO:
        signs = np.array(list(itertools.product((1, -1), repeat=len(difference))))
    else:
        signs = np.random.default_rng(seed).choice((1, -1), (repeats, len(difference)))
        signs[0] = 1
    # A hair less than the observed one, so that rounding does not tell equal means apart.
    observed = abs(difference.mean()) * (1 - 1e-12)
    return float(np.mean(np.abs(signs @ difference) / len(difference) >= observed))


def holm(p_values: Sequence[float]) -> list[float]:
    """The p values of several comparisons, adjusted so that the chance of any false one stays what it says (Holm 1979).

    Raises:
      ValueError: a value that is no probability.
    """
    if not all(0 <= p <= 1 for p in p_values):
        raise ValueError(f"p values must lie in [0, 1]; got {list(p_values)}")
    adjusted, least = [0.0] * len(p_values), 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        least = max(least, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = least
    return adjusted


def _middle(count: int) -> slice:
    """Of that many sorted scores, those that are left when a quarter (rounded down) is cut off at either end."""
    return slice(count // 4, count - count // 4)


def _scores(scores: ArrayLike) -> NDArray:
    scores = np.asarray(scores, float)
    if scores.size == 0 or scores.ndim not in (1, 2) or np.isnan(scores).any():
        raise ValueError(f"scores must be numbers [S] or [S, K], at least one; got shape {scores.shape}, {scores}")
    return scores


def _curves(x: ArrayLike, curves: ArrayLike) -> tuple[NDArray, NDArray]:
    x, curves = np.asarray(x, float), np.asarray(curves, float)
    if x.ndim != 1 or curves.ndim != 2 or curves.shape[1] != len(x) or curves.size == 0:
        raise ValueError(f"x must be [P] and curves [S, P]; got shapes {x.shape} and {curves.shape}")
    return x, curves


def _redrawn(scores: NDArray, rng: np.random.Generator) -> NDArray:
    """As many seeds, drawn with replacement, of each task apart."""
    return np.take_along_axis(scores, rng.integers(len(scores), size=scores.shape), axis=0)


def _percentiles(drawn: NDArray, level: float) -> tuple[float, float]:
    low, high = _quantiles(drawn, level)
    return float(low), float(high)


def _quantiles(drawn: NDArray, level: float) -> tuple[NDArray, NDArray]:
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1; got {level}")
    # Whole draws, not between two of them: times to a threshold can be infinite.
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2], axis=0, method="inverted_cdf")
    return low, high
