"""Intervals of success rates, for the end of every run. Loads no other library. `stats` has the rest."""

import math


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a success rate (Wilson 1927). Raises ValueError if `trials` is not positive, or
    `successes` does not lie in [0, trials].
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"need 0 <= successes <= trials and trials > 0; got {successes} of {trials}")
    z = 1.959963984540054  # not from scipy.stats: every run ends here, and that import takes a second
    rate, spread = successes / trials, z * z / trials
    middle = (rate + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(rate * (1 - rate) / trials + spread / 4 / trials)
    # The lower bound is exactly 0 without a success, and the upper one 1 without a failure, despite rounding.
    return max(0.0, middle - half) if successes else 0.0, min(1.0, middle + half) if successes < trials else 1.0
