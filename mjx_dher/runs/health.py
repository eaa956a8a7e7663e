"""Signs that a run has gone bad, in an epoch's metrics."""

from __future__ import annotations

from collections.abc import Mapping

from mjx_dher.config import Config


def failure(metrics: Mapping[str, float], config: Config, finite: bool) -> str | None:
    """Returns why a run cannot go on after an epoch with these metrics; None where it can."""
    del metrics, config
    if not finite:
        return "the networks or normalizers hold numbers that are not finite (smaller actor_lr and critic_lr may help)"
    return None


def warnings(metrics: Mapping[str, float], config: Config) -> dict[str, str]:
    """Returns what a reader should know of an epoch with these metrics, a sentence for each kind of trouble."""
    del metrics, config
    return {}
