"""Training options that do not affect a run's result."""

import dataclasses
from collections.abc import Sequence

from mjx_dher.runs.folder import loggers
from mjx_dher.validation import check_count, check_number


@dataclasses.dataclass(frozen=True)
class Options:
    """Evaluation, checkpoints and logs of runs."""

    final_episodes: int = 500
    """Episodes of the final evaluation."""
    checkpoint_every: int = 10
    """Epochs between checkpoints; 0 disables this. A checkpoint is also written after 2 minutes, then every 10 minutes, and
    when the run is stopped (Ctrl-C, SIGTERM, SIGHUP)."""
    keep: int = 2
    """Newest checkpoints to keep (one for parallel runs). They are deleted when the run has ended."""
    keep_end: bool = False
    """Keep the last checkpoint, so that `resume --total-steps` can extend the run. It is as large as the replay ring."""
    log: tuple[str, ...] = ()
    """Logs in addition to metrics.csv: jsonl, tensorboard, wandb."""
    stop_at: float | None = None
    """Stop a run early at this success rate, averaged over the last three evaluations."""

    def check(self, installed: bool = True) -> None:
        """Raises ValueError for an invalid option, or for a log whose package is missing, if packages must be `installed`."""
        check_count("final_episodes", self.final_episodes)
        check_number("checkpoint_every", self.checkpoint_every, "[0, 1000000]")
        check_count("keep", self.keep)
        if not isinstance(self.keep_end, bool):
            raise ValueError(f"keep_end must be true or false; got {self.keep_end!r}")
        loggers.check_logs(self.log, installed)
        if self.stop_at is not None:
            check_number("stop_at", self.stop_at, "(0, 1]", float)

    def check_many(self) -> None:
        """Raises ValueError for an option that only a single run supports."""
        if self.stop_at is not None:
            raise ValueError("stop_at is only for a single run, because the runs of a sweep are compared epoch by epoch")
        if self.keep_end:
            raise ValueError("keep_end is only for a single run: a sweep with another total_steps has other runs")

    def is_reached(self, success_rates: Sequence[float]) -> bool:
        """Whether a run with these success rates per epoch has reached `stop_at`."""
        last = success_rates[-3:]
        return self.stop_at is not None and len(last) == 3 and sum(last) / 3 >= self.stop_at
