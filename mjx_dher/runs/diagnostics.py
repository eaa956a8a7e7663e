"""Failures and warnings derived from an epoch's metrics."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mjx_dher.config import Config
from mjx_dher.runs.loop import Progress
from mjx_dher.spec import RunSpec


def failure(metrics: Mapping[str, float], config: Config, finite: bool) -> str | None:
    """Why a run fails after an epoch with these metrics, or None. `finite` tells whether all of the learner's floats are."""
    if not finite:
        return "the networks or normalizers have numbers that are not finite (smaller actor_lr and critic_lr may help)"
    episodes = config.num_envs * config.cycles_per_epoch
    if metrics["discarded_episodes"] >= episodes:
        return (
            f"all {episodes} episodes were discarded, so nothing can be learned: the environment reports `failed`, or an"
            " observation, a goal, an action or a reward is not finite"
        )
    if metrics["bad_success"] > 0:
        return f"success must be 0 or 1; in {metrics['bad_success']:.3g} of the episodes it is not"
    if metrics["no_goal_share"] >= 1:
        return "the sampler offers no hindsight goal for any transition: its weights are all 0, NaN or infinite"
    return None


def warnings(metrics: Mapping[str, float], config: Config) -> dict[str, str]:
    """Warning sentences about an epoch, by metric."""
    episodes = config.num_envs * config.cycles_per_epoch
    sentences = {
        "discarded_episodes": f"{metrics['discarded_episodes']:.0f} of {episodes} episodes were discarded: the environment"
        " reports `failed`, or a number in them is not finite",
        "bad_rewards": f"{metrics['bad_rewards']:.3g} of the rewards lie outside the environment's reward range, which"
        " bounds the learner's targets",
        "no_goal_share": f"the sampler offers no goal for {metrics['no_goal_share']:.3g} of the transitions to relabel;"
        " these keep their own",
    }
    return {name: text for name, text in sentences.items() if metrics[name] > 0}


@dataclasses.dataclass
class Watch:
    """Failures and warnings of parallel runs."""

    specs: Sequence[RunSpec]
    folders: Sequence[Path]
    report: Callable[[str], None]
    failed: dict[int, tuple[int, str]]  # epoch and reason of each failed lane; updated in place
    warned: set[tuple[int, str]] = dataclasses.field(default_factory=set)

    def look(self, progress: Progress, rows: Sequence[dict[str, float]]) -> None:
        """Records the lanes that failed in an epoch, and reports each kind of warning once."""
        finite = np.atleast_1d(progress.finite)
        for lane, (spec, folder, row) in enumerate(zip(self.specs, self.folders, rows)):
            name = f"{folder.name}: " if len(self.specs) > 1 else ""
            if lane in self.failed:
                continue
            if reason := failure(row, spec.config, bool(finite[lane])):
                self.failed[lane] = progress.epoch, reason
                self.report(f"{name}failed in epoch {progress.epoch}: {reason}")
                continue
            for kind, text in warnings(row, spec.config).items():
                if (lane, kind) not in self.warned:
                    self.warned.add((lane, kind))
                    self.report(f"{name}epoch {progress.epoch}: {text}")
