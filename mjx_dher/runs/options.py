"""Options of training that do not change what a run computes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from mjx_dher.runs.folder import loggers
from mjx_dher.validation import check_count, check_number


@dataclasses.dataclass(frozen=True)
class Options:
    """Evaluation, checkpoints and logs of runs."""

    final_episodes: int = 500
    """Episodes of the last evaluation."""
    checkpoint_every: int = 10
    """Epochs between checkpoints, from which a run resumes; 0: none. There is also one after 2 minutes, then every 10,
    and one when the run is stopped (Ctrl-C, SIGTERM, SIGHUP)."""
    keep: int = 2
    """Newest checkpoints to keep (one, if runs are side by side). They are deleted when the run has ended."""
    keep_end: bool = False
    """Checkpoint of the end, kept, from which `resume --total-steps` makes a single run longer; as large as the replay ring."""
    log: tuple[str, ...] = ()
    """Logs beside metrics.csv: jsonl, tensorboard, wandb."""
    stop_at: float | None = None
    """Success rate that ends a run early, as the mean of its last three evaluations."""

    def check(self, installed: bool = True) -> None:
        """Raises ValueError for an invalid option, or, if they must be `installed`, for a log whose package is missing."""
        check_count("final_episodes", self.final_episodes)
        check_number("checkpoint_every", self.checkpoint_every, "[0, 1000000]")
        check_count("keep", self.keep)
        if not isinstance(self.keep_end, bool):
            raise ValueError(f"keep_end must be true or false; got {self.keep_end!r}")
        loggers.check_logs(self.log, installed)
        if self.stop_at is not None:
            check_number("stop_at", self.stop_at, "(0, 1]", float)

    def check_many(self) -> None:
        """Raises ValueError for an option that only a single run can have."""
        if self.stop_at is not None:
            raise ValueError("stop_at ends one run alone: the runs of a sweep are compared epoch by epoch")
        if self.keep_end:
            raise ValueError("keep_end is for one run alone: a sweep with another total_steps has runs of its own")

    def is_reached(self, success_rates: Sequence[float]) -> bool:
        """Whether a run has reached `stop_at`, given the success rates of its epochs."""
        last = success_rates[-3:]
        return self.stop_at is not None and len(last) == 3 and sum(last) / 3 >= self.stop_at
