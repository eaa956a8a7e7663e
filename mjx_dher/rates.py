"""Intervals of success rates. Loads only `math`, because every run uses it at its end."""

import math


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a success rate (Wilson 1927). Raises ValueError if `trials` is not positive, or
    `successes` does not lie in [0, trials].
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"need 0 <= successes <= trials and trials > 0; got {successes} of {trials}")
    z = 1.959963984540054  # not from scipy.stats, which takes a second to load
    rate, spread = successes / trials, z * z / trials
    middle = (rate + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(rate * (1 - rate) / trials + spread / 4 / trials)
    # The lower bound is exactly 0 without a success, and the upper one 1 without a failure, despite rounding.
    return max(0.0, middle - half) if successes else 0.0, min(1.0, middle + half) if successes < trials else 1.0


def difference_interval(successes_a: int, trials_a: int, successes_b: int, trials_b: int) -> tuple[float, float]:
    """Newcombe's 95 % interval of the difference a - b of two success rates (Newcombe 1998, method 10).

    Returns:
      Low and high end.

    Raises:
      ValueError: as in `wilson_interval`.
    """
    low_a, high_a = wilson_interval(successes_a, trials_a)
    low_b, high_b = wilson_interval(successes_b, trials_b)
    a, b = successes_a / trials_a, successes_b / trials_b
    return a - b - math.hypot(a - low_a, high_b - b), a - b + math.hypot(high_a - a, b - low_b)
