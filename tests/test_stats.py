import numpy as np
import pytest

from mjx_dher import stats


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # Newcombe 1998, table I, method 3 (score without continuity correction)
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (29, 29, 0.8830, 1.0),
    ],
)
def test_wilson_interval(successes, trials, low, high):
    assert stats.wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (5, 4), (-1, 4)])
def test_what_is_no_success_rate_is_refused(successes, trials):
    with pytest.raises(ValueError, match="need 0 <= successes <= trials"):
        stats.wilson_interval(successes, trials)


def test_difference_interval():
    """Newcombe's (1998) example (a): 56 of 70 against 48 of 80 gives 0.0524 to 0.3339."""
    np.testing.assert_allclose(stats.difference_interval(56, 70, 48, 80), (0.0524, 0.3339), atol=5e-5)
    low, high = stats.difference_interval(500, 500, 500, 500)
    assert low < 0 < high
    with pytest.raises(ValueError, match="trials"):
        stats.difference_interval(1, 0, 1, 2)
