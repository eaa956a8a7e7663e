import numpy as np
import pytest
import scipy.stats
from conftest import refuses

from mjx_dher import stats


def test_wilson_interval():
    """Newcombe 1998, table I, method 3 (score without continuity correction)."""
    for successes, trials, low, high in [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (29, 29, 0.8830, 1.0),
    ]:
        assert stats.wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)
    for successes, trials in [(1, 0), (5, 4), (-1, 4)]:
        with refuses("successes", "trials", successes, trials):
            stats.wilson_interval(successes, trials)


def test_difference_interval():
    """Newcombe's (1998) example (a): 56 of 70 against 48 of 80 gives 0.0524 to 0.3339."""
    np.testing.assert_allclose(stats.difference_interval(56, 70, 48, 80), (0.0524, 0.3339), atol=5e-5)
    low, high = stats.difference_interval(500, 500, 500, 500)
    assert low < 0 < high
    with refuses("trials", 0):
        stats.difference_interval(1, 0, 1, 2)


SCORES = np.random.default_rng(0).beta(4, 2, (11, 3))


def test_interquartile_mean_by_hand():
    assert stats.interquartile_mean([0, 0.5, 0.7, 100]) == pytest.approx(0.6)
    assert stats.interquartile_mean([3.0]) == 3
    assert stats.interquartile_mean([[0, 0.5], [0.7, 100]]) == pytest.approx(0.6)
    np.testing.assert_allclose(stats.interquartile_mean([[0, 1, 2, 9], [5, 1, 3, 0]], axis=1), [1.5, 2])


def test_bootstrap_interval_agrees_with_scipy():
    """The mean of one task; percentile method. Two bootstraps of 10,000 draws differ by chance: by 2 % of the width here."""
    scores = SCORES[:, 0]
    want = scipy.stats.bootstrap((scores,), np.mean, method="percentile", n_resamples=10_000, rng=1).confidence_interval
    low, high = stats.bootstrap_interval(scores, np.mean)
    assert (low, high) == pytest.approx((want.low, want.high), abs=0.03 * (want.high - want.low))
    assert (low, high) == stats.bootstrap_interval(scores, np.mean)
    narrow = stats.bootstrap_interval(scores, np.mean, level=0.5)
    assert low < narrow[0] < scores.mean() < narrow[1] < high


def test_bootstrap_is_stratified():
    """Tasks far apart: were seeds and tasks drawn together, the mean would vary as the tasks do."""
    scores = np.array([[0.0, 10.0], [0.1, 10.1], [0.0, 10.0], [0.1, 10.1]])
    drawn = []

    def mean(resampled, axis):
        drawn.extend(resampled.reshape(-1, *scores.shape).mean(axis=1))
        return np.mean(resampled, axis=axis)

    low, high = stats.bootstrap_interval(scores, mean)
    assert 5.0 <= low < high <= 5.1
    # Each task's seeds are drawn on their own: one task's best seeds come with the other's worst.
    assert any(a < 0.04 and b > 10.06 for a, b in drawn)


def test_a_95_percent_interval_covers_the_truth_19_times_in_20():
    """300 samples of 20 standard normals; the bootstrap of so few is a little narrow."""
    hits = 0
    for number in range(300):
        low, high = stats.bootstrap_interval(np.random.default_rng(number).normal(size=20), np.mean, repeats=500)
        hits += low < 0 < high
    assert 0.89 < hits / 300 < 0.97


CURVES = [[0.1, 0.5, 0.9, 0.8, 1.0], [0.0, 0.0, 0.2, 0.9, 0.7], [0.0, 0.1, 0.1, 0.1, 0.2]]


def test_a_bound_is_exact_where_all_or_none_succeed():
    """Rounding would leave a little, below which a success rate of 0 then lies."""
    for trials in (1, 10, 13, 100, 500, 1000):
        assert stats.wilson_interval(0, trials)[0] == 0.0
        assert stats.wilson_interval(trials, trials)[1] == 1.0


def test_first_reach_and_those_that_never_do():
    reached = stats.first_reach([10, 20, 30, 40, 50], CURVES, 0.9)
    np.testing.assert_array_equal(reached, [30, 40, np.inf])
    assert np.median(reached) == 40
    low, high = stats.bootstrap_interval(reached, np.median, repeats=1000)
    assert (low, high) == (30, np.inf)
    np.testing.assert_array_equal(stats.first_reach([1], [[0.5]], 0.5), [1])
    with refuses("threshold", "nan"):
        stats.first_reach([1], [[0.5]], np.nan)


def test_area_under_curve():
    np.testing.assert_allclose(stats.area_under_curve([0, 1, 3], [[0, 1, 1], [1, 1, 1]]), [2.5 / 3, 1])
    with refuses("x", "increasing"):
        stats.area_under_curve([0, 0], [[1, 1]])
    with refuses("x", "curves", (2,), (1, 3)):
        stats.area_under_curve([0, 1], [[1, 1, 1]])


def test_probability_of_improvement():
    """By hand, and as rliable defines it: the mean over tasks of Mann-Whitney's U divided by the pairs."""
    assert stats.probability_of_improvement([1, 2, 3], [0, 2]) == pytest.approx(4.5 / 6)
    assert stats.probability_of_improvement([np.inf, 1.0], [np.inf, 2.0]) == pytest.approx((0.5 + 1 + 0 + 0) / 4)
    other = np.random.default_rng(1).beta(3, 2, (8, 3)).round(1)
    mine = SCORES.round(1)
    want = np.mean([scipy.stats.mannwhitneyu(mine[:, k], other[:, k]).statistic / (11 * 8) for k in range(3)])
    assert stats.probability_of_improvement(mine, other) == pytest.approx(want)
    low, high = stats.improvement_interval(mine, other, repeats=500)
    assert low < want < high
    with refuses("tasks", 3, 2):
        stats.probability_of_improvement(mine, other[:, :2])


@pytest.mark.parametrize("tasks", [1, 3])
def test_the_interval_of_improvement_is_that_of_resampled_scores(tasks):
    """Each task's scores are drawn on their own, those of `a` first, as a plain loop draws them."""
    rng = np.random.default_rng(1)
    a, b = SCORES[:4, :tasks].round(1), rng.beta(3, 2, (7, tasks)).round(1)
    drawn = np.random.default_rng(0).integers(np.repeat([4, 7], [4 * tasks, 7 * tasks]), size=(50, 11 * tasks))
    found = []
    for line in drawn:
        of_a, of_b = line[: 4 * tasks].reshape(4, tasks), line[4 * tasks :].reshape(7, tasks)
        found.append(stats.probability_of_improvement(a[of_a, range(tasks)], b[of_b, range(tasks)]))
    want = np.quantile(found, [0.025, 0.975], method="inverted_cdf")
    np.testing.assert_allclose(stats.improvement_interval(a, b, repeats=50), want, atol=1e-12)


def test_paired_p_value_by_hand():
    assert stats.paired_p_value([1, 2, 3], [0, 1, 2]) == pytest.approx(2 / 8)
    assert stats.paired_p_value([1, 2], [1, 2]) == 1
    # Differences 3, 1 and -1: of the eight sign flips, six have a sum of at least 3 in absolute value.
    assert stats.paired_p_value([3, 1, 0], [0, 0, 1]) == pytest.approx(6 / 8)
    # Equal differences: only two of 2^16 changes of sign are as extreme, and of a hundred random ones
    # only the scores themselves.
    assert stats.paired_p_value(np.ones(16), np.zeros(16)) == pytest.approx(2 / 2**16)
    assert stats.paired_p_value(np.ones(16), np.zeros(16), repeats=100) == pytest.approx(1 / 100)
    # Differences -0.2, 0.3, -0.3 and 0.2 sum to 0: all flips are at least as large, whatever rounding makes of their sums.
    assert stats.paired_p_value([0.4, 0.8, 0.0, 0.5], [0.6, 0.5, 0.3, 0.3]) == 1
    with refuses("finite"):
        stats.paired_p_value([np.inf, 1], [1, 2])
    for a, b in (([1, 2, 3], [1, 2]), ([1], [2])):
        with refuses("a", "b", "[S]"):
            stats.paired_p_value(a, b)


def test_westfall_young_by_hand():
    """Of two comparisons, three seeds each. All eight flips: |sum| of 1, 2, 3 and of 1, 1, -1, by t."""
    first, second = [1.0, 2.0, 3.0], [1.0, 1.0, -1.0]
    # |t| of the first: 3.46 for the two flips with all signs alike, else 1.31 (sum 4), 0.56 (2) or 0 (0), two flips each.
    # |t| of the second: 0.5 for sums of 1 (six flips), infinite for sums of 3 (two flips, in which the first sums to 0).
    assert stats.westfall_young([first]) == [pytest.approx(2 / 8)] == [stats.paired_p_value(first, np.zeros(3))]
    # 3.46 or more: two flips of the first, two of the second. 0.5 or more: all eight flips of the second.
    assert stats.westfall_young([second, first]) == pytest.approx([1.0, 4 / 8])
    # Without its third seed, the second has an infinite t in four flips.
    assert stats.westfall_young([first, [*second[:2], np.nan]])[0] == pytest.approx(4 / 8)
    for wrong in (first, [[1.0, np.inf]], [[1.0, np.nan]], np.zeros((1, 1))):
        with pytest.raises(ValueError, match="differences"):
            stats.westfall_young(wrong)


def test_westfall_young_is_no_stricter_than_holm_and_keeps_the_error_rate():
    rng = np.random.default_rng(0)
    wrong = 0
    for _ in range(300):
        differences = rng.normal(size=(6, 8)) + rng.normal(size=8)  # dependent, and no effect
        wrong += min(stats.westfall_young(differences)) < 0.05
    assert wrong / 300 < 0.08  # 0.05, and two and a half standard errors
    effects = rng.normal(size=(6, 10)) + 2 * np.arange(6)[:, None]
    p_values = [stats.paired_p_value(row, np.zeros(10)) for row in effects]
    assert np.mean(stats.westfall_young(effects)) < np.mean(stats.holm(p_values))


def test_holm():
    """Holm's procedure by hand: the least times 3, the next times 2 and not below it, the last as it is."""
    assert stats.holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert stats.holm([0.5, 0.6]) == [1, 1]
    assert stats.holm([]) == []
    assert stats.holm([0.01, 0.03], tests=4) == stats.holm([0.01, 0.03, 1, 1])[:2] == pytest.approx([0.04, 0.09])
    with refuses("p-values", 2, 1):
        stats.holm([0.01, 0.03], tests=1)
    with refuses("[0, 1]", 1.1):
        stats.holm([0.1, 1.1])


@pytest.mark.parametrize("unit", [1e200, 1e-200])
def test_no_product_of_scores_overflows_or_vanishes(unit):
    """The squares of these scores, and areas under such curves, are no floats."""
    scores = unit * np.arange(1.0, 6)
    assert stats.paired_p_value(scores, np.zeros(5)) == 2 / 2**5
    assert stats.westfall_young([scores, scores / unit]) == [2 / 2**5] * 2
    assert stats.area_under_curve(scores, [scores]) == pytest.approx([3 * unit], rel=1e-12)


def test_points_and_numbers_of_tests_that_are_not_finite_are_refused():
    for x in ([0, np.nan], [0, np.inf]):
        with refuses("x", "finite"):
            stats.area_under_curve(x, [[1, 1]])
    with refuses("p-values", "nan"):
        stats.holm([0.1], tests=np.nan)


@pytest.mark.parametrize("scores", [[], [np.nan, 1], np.zeros((2, 2, 2))])
def test_what_are_no_scores_is_refused(scores):
    with refuses("scores"):
        stats.interquartile_mean(scores)


def test_curve_interval_is_the_interval_of_each_point():
    curves = np.random.default_rng(1).random((9, 4))
    middle, low, high = stats.curve_interval(curves, repeats=20_000)
    for point in range(4):
        assert middle[point] == pytest.approx(stats.interquartile_mean(curves[:, point]))
        want = stats.bootstrap_interval(curves[:, point])
        assert (low[point], high[point]) == pytest.approx(want, abs=0.04 * (want[1] - want[0]))
    with refuses("curves", "[S, P]"):
        stats.curve_interval(curves[0])
    with refuses("scores must be numbers", "nan"):
        stats.curve_interval(np.where(curves == curves.max(), np.nan, curves))
    with refuses("level", 1.0):
        stats.curve_interval(curves, level=1.0)
    with refuses("repeats", 0):
        stats.curve_interval(curves, repeats=0)
