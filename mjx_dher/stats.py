"""Statistics of success rates, and of scores and learning curves over seeds.

Scores are arrays [S], one number per seed, or [S, K] for K pooled tasks. Learning curves are [S, P] at points x [P] (epochs,
environment steps or seconds). A run that never reaches a threshold has an infinite time; medians and ranks allow for that.

Functions import scipy.stats when called, because that takes a second.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mjx_dher.rates import difference_interval, wilson_interval  # noqa: F401 - public names of this module

Statistic = Callable[..., Any]  # (values, axis=...) -> values without that axis, as np.mean


def interquartile_mean(scores: ArrayLike, axis: int | None = None) -> Any:
    """Mean of the middle half of the scores. A quarter, rounded down, is dropped at each end.

    It is less sensitive to outliers than the mean and uses more data than the median (Agarwal et al. 2021, "Deep Reinforcement
    Learning at the Edge of the Statistical Precipice"). By default it reduces all axes, which pools the tasks. Raises
    ValueError if there are no scores, or some are NaN.
    """
    from scipy.stats import trim_mean

    middle = trim_mean(_scores(scores), 0.25, axis=axis)
    return float(middle) if axis is None else middle


def bootstrap_interval(
    scores: ArrayLike, statistic: Statistic = interquartile_mean, level: float = 0.95, repeats: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Stratified percentile bootstrap interval: seeds are resampled within each task.

    Args:
      scores: scores [S] or [S, K].
      statistic: function (values, axis=...) that reduces one axis, such as np.mean. Tasks are pooled.

    Raises:
      ValueError: there are no scores, `level` does not lie between 0 and 1, or `repeats` is less than 1.
    """
    scores = _scores(scores)
    chosen = _generator(seed, repeats).integers(len(scores), size=(repeats, *scores.shape))
    resampled = np.take_along_axis(scores[None], chosen, axis=1).reshape(repeats, -1)
    low, high = _quantiles(statistic(resampled, axis=1), level)
    return float(low), float(high)


def curve_interval(
    curves: ArrayLike, level: float = 0.95, repeats: int = 2_000, seed: int = 0
) -> tuple[NDArray, NDArray, NDArray]:
    """Pointwise interquartile mean of learning curves, and its percentile bootstrap interval. Whole curves are resampled.

    Args:
      curves: learning curves [S, P].

    Returns:
      Three arrays [P]: the mean, and the lower and upper ends of the interval.

    Raises:
      ValueError: `curves` is not [S, P] or has a NaN, `level` does not lie between 0 and 1, or `repeats` is less than 1.
    """
    from scipy.stats import trim_mean

    curves = np.asarray(curves, float)
    _scores(_curves(np.arange(curves.shape[-1]) if curves.ndim else (), curves)[1])
    chosen = _generator(seed, repeats).integers(len(curves), size=(repeats, len(curves)))
    low, high = _quantiles(trim_mean(curves[chosen], 0.25, axis=1), level)
    return trim_mean(curves, 0.25, axis=0), low, high


def first_reach(x: ArrayLike, curves: ArrayLike, threshold: float) -> NDArray:
    """First point at which each curve is at or above a threshold, shape [S], or infinity if it never is.

    Args:
      x, curves: points [P], and curves [S, P].

    Raises:
      ValueError: x is not [P], `curves` is not [S, P], or the threshold is NaN.
    """
    x, curves = _curves(x, curves)
    if np.isnan(threshold):
        raise ValueError("threshold must be a number; got nan")
    reached = curves >= threshold
    return np.where(reached.any(axis=1), x[reached.argmax(axis=1)], np.inf)


def area_under_curve(x: ArrayLike, curves: ArrayLike) -> NDArray:
    """Mean height [S] of curves [S, P] over points x [P], by the trapezoidal rule. Raises ValueError if x is not [P], has fewer
    than two points, is not finite or does not increase, or `curves` is not [S, P].
    """
    x, curves = _curves(x, curves)
    if len(x) < 2 or not (np.diff(x) > 0).all() or np.isinf(x[-1] - x[0]):
        raise ValueError(f"x must have at least two finite points, in increasing order; got {x}")
    span, power = np.frexp(x[-1] - x[0])
    return np.trapezoid(curves, np.ldexp(x, -power), axis=1) / span


def probability_of_improvement(a: ArrayLike, b: ArrayLike) -> float:
    """Probability that a score of `a` exceeds one of `b`, averaged over tasks. Ties count half.

    For each task it is the Mann-Whitney U statistic divided by the number of pairs (Agarwal et al. 2021). The shapes are [S]
    or [S, K]; the numbers of seeds may differ. Raises ValueError without scores, or if the tasks differ in number.
    """
    a, b = (np.atleast_2d(_scores(scores).T).T for scores in (a, b))
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"a and b must be of the same tasks; got {a.shape[1]} and {b.shape[1]}")
    greater, equal = (compare(a[:, None], b[None]).mean() for compare in (np.greater, np.equal))
    return float(greater + equal / 2)


def improvement_interval(
    a: ArrayLike, b: ArrayLike, level: float = 0.95, repeats: int = 2_000, seed: int = 0
) -> tuple[float, float]:
    """Stratified percentile bootstrap interval of `probability_of_improvement`.

    Args:
      a, b: scores [S] or [S, K]. Their numbers of seeds may differ.

    Raises:
      ValueError: as in `probability_of_improvement`, `level` does not lie between 0 and 1, or `repeats` is less than 1.
    """
    a, b = _scores(a), _scores(b)
    rng = _generator(seed, repeats)
    probability_of_improvement(a, b)  # raises if they cannot be compared
    a, b = (scores[:, None] if scores.ndim == 1 else scores for scores in (a, b))  # [A, K], [B, K]
    wins = np.greater(a[:, None], b[None]) + np.equal(a[:, None], b[None]) / 2  # [A, B, K]
    drawn = rng.integers(np.repeat([len(a), len(b)], [a.size, b.size]), size=(repeats, a.size + b.size))
    column, tasks = np.arange(a.size + b.size), a.shape[1]
    place = drawn * tasks + column % tasks + a.size * (column >= a.size) + column.size * np.arange(repeats)[:, None]
    times = np.bincount(place.ravel(), minlength=place.size).reshape(place.shape)  # how often a score was drawn
    of_a, of_b = (np.reshape(part, (repeats, -1, tasks)) for part in np.split(times, [a.size], axis=1))
    resampled = np.einsum("rbk,rbk->r", np.einsum("rak,abk->rbk", of_a, wins), of_b) / wins.size
    low, high = _quantiles(resampled, level)
    return float(low), float(high)


def paired_p_value(a: ArrayLike, b: ArrayLike, repeats: int = 100_000, seed: int = 0) -> float:
    """Two-sided p-value of the mean difference of paired scores, by a sign-flip permutation test.

    Under the null hypothesis, the sign of each difference is random (Fisher 1935). The test is exact if 2^S is at most
    `repeats`; otherwise that many sign flips are drawn, and the scores themselves are one of them.

    Args:
      a, b: scores [S] of the same seeds.
      repeats: largest number of sign flips.

    Raises:
      ValueError: the shapes differ or are not [S], or some scores are not finite.
    """
    a, b = _scores(a), _scores(b)
    if a.shape != b.shape or a.ndim != 1 or len(a) < 2:
        raise ValueError(f"a and b must be paired scores [S] of at least two seeds; got shapes {a.shape} and {b.shape}")
    if not np.isfinite(a - b).all():
        raise ValueError("a and b must be finite: a time to a threshold that was never reached has no difference")
    return westfall_young([a - b], repeats, seed)[0]


def holm(p_values: Sequence[float], tests: int | None = None) -> list[float]:
    """Adjusts the p-values of several comparisons by Holm's method, which controls the familywise error rate (Holm 1979).

    Args:
      p_values: p-values of the comparisons made so far.
      tests: number of planned comparisons. Missing ones count as p = 1, so later results never increase earlier ones.

    Raises:
      ValueError: a p-value does not lie in [0, 1], or there are more than `tests`.
    """
    tests = len(p_values) if tests is None else tests
    if not all(0 <= p <= 1 for p in p_values):
        raise ValueError(f"p-values must lie in [0, 1]; got {list(p_values)}")
    if not tests >= len(p_values):
        raise ValueError(f"there are {len(p_values)} p-values, which is more than {tests} tests")
    adjusted, least = [0.0] * len(p_values), 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        least = max(least, min(1.0, (tests - rank) * p_values[index]))
        adjusted[index] = least
    return adjusted


def westfall_young(differences: ArrayLike, repeats: int = 100_000, seed: int = 0) -> list[float]:
    """Adjusts several paired comparisons together by step-down maxT sign flips (Westfall and Young 1993, algorithm 4.1).

    A seed's differences flip together, so dependent comparisons cost less than under `holm`, and the p-value floor of few seeds
    does not grow with the number of comparisons. All sign flips are tried if 2^S is at most `repeats`.

    Args:
      differences: paired differences [M, S] of M comparisons, NaN if a comparison lacks a seed.
      repeats: largest number of sign flips.

    Returns:
      M adjusted two-sided p-values.

    Raises:
      ValueError: `differences` is not [M, S], is infinite, or a comparison has fewer than two seeds.
    """
    values = np.asarray(differences, float)
    if values.ndim != 2 or np.isinf(values).any() or (np.isfinite(values).sum(axis=1) < 2).any():
        raise ValueError(f"differences must be [M, S], finite or NaN, with at least two seeds each; got {values}")
    number, seeds, values = np.isfinite(values).sum(axis=1), values.shape[1], np.nan_to_num(values)
    values = np.ldexp(values, -np.frexp(np.abs(values).max(1, initial=0, keepdims=True))[1])  # so that squares are floats
    if 2**seeds <= repeats:
        signs = 1 - 2 * (np.arange(2**seeds)[:, None] >> np.arange(seeds) & 1)
    else:
        signs = _generator(seed, repeats).choice(np.array([-1, 1], np.int8), size=(repeats, seeds))
        signs[0] = 1  # the data itself
    # A monotone function of |t|: a flip does not change the sum of squares.
    scale = np.sqrt(number * np.square(values).sum(axis=1))
    share = np.minimum(np.abs(signs @ values.T) / np.where(scale > 0, scale, 1), 1)  # [flips, M]
    with np.errstate(divide="ignore"):
        t = share * np.sqrt((number - 1) / (1 - share**2))
    order = np.argsort(-t[0], kind="stable")
    largest = np.maximum.accumulate(t[:, order[::-1]], axis=1)[:, ::-1]  # of a comparison and all with a smaller statistic
    # Flips with equal sums are ties, although rounding of the scores makes some sums smaller.
    p_values = np.maximum.accumulate((largest >= t[0, order] * (1 - 1e-9) - 1e-9).mean(axis=0))
    return [float(p_values[rank]) for rank in np.argsort(order)]


def _generator(seed: int, repeats: int) -> np.random.Generator:
    if not repeats >= 1:
        raise ValueError(f"repeats must be 1 or more; got {repeats!r}")
    return np.random.default_rng(seed)


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


def _quantiles(values: NDArray, level: float) -> tuple[NDArray, NDArray]:
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1; got {level}")
    # No interpolation between two values: times to a threshold can be infinite.
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0, method="inverted_cdf")
    return low, high
