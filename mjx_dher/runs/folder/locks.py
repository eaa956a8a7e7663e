"""Locks of run folders, so that only one process trains a run."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from mjx_dher import lookup
from mjx_dher.runs.folder import results, run_folder
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import BusyError, FolderError

Run = tuple[RunSpec, Path]  # and its folder


@dataclasses.dataclass(frozen=True)
class Claims:
    """One process's claims on runs."""

    sweep: bool  # skip runs that have ended or that another process trains, instead of raising
    report: Callable[[str], None]

    def is_free(self, spec: RunSpec, folder: Path) -> bool:
        """Whether to train a run, as far as known before compilation. Raises FolderError if not, except in a sweep."""
        if not folder.exists():
            return True
        try:
            with named(folder), files.lock(folder):
                return self._is_due(spec, folder)
        except BusyError:
            if not self.sweep:
                raise
            return False

    def claim(self, stack: contextlib.ExitStack, waiting: Sequence[Run], lanes: int) -> tuple[list[Run], list[Run]]:
        """Makes and locks the folders of the first `lanes` runs that have not ended and that no other process trains.

        Returns the claimed runs and the waiting ones, with other processes' runs last. Ended runs are in neither. Raises
        FolderError if a folder is not writable or, except in a sweep, if a run has ended or another process trains it.
        """
        claimed: list[Run] = []
        busy: list[Run] = []
        for number, (spec, folder) in enumerate(waiting):
            if len(claimed) == lanes:
                return claimed, [*waiting[number:], *busy]
            try:
                with named(folder), contextlib.ExitStack() as attempt:
                    attempt.enter_context(files.made(folder))
                    attempt.enter_context(files.lock(folder))
                    if self._is_due(spec, folder):
                        claimed.append((spec, folder))
                        stack.enter_context(attempt.pop_all())
            except BusyError:
                if not self.sweep:
                    raise
                busy.append((spec, folder))
        return claimed, busy

    def _is_due(self, spec: RunSpec, folder: Path) -> bool:
        """Whether to train a locked run. Raises FolderError if not, except in a sweep."""
        if not self.sweep and (folder / run_folder.CONFIG_FILE).exists():
            run_folder.check_same(folder, spec)
        if not results.has_result(folder):
            return True
        problem = results.trial_problem(folder, spec) if self.sweep else results.result_problem(folder, with_policy=False)
        if self.sweep and problem is not None:
            self.report(f"{problem}; training it again")
        if self.sweep:
            return problem is not None
        if problem is None and results.can_go_on(folder, spec.config.total_steps):
            return True
        raise FolderError(problem or f"{folder} has ended; there is nothing to resume")


@contextlib.contextmanager
def named(folder: Path) -> Iterator[None]:
    """Converts an OSError to a FolderError that names the folder and its last checkpoint."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise FolderError(f"{folder} cannot be written to ({reason}); {last_checkpoint(folder)}") from error


def last_checkpoint(folder: Path) -> str:
    """Part of an error message about the run's newest checkpoint."""
    paths = run_folder.checkpoints(folder)
    return f"`{lookup.command_name()} resume {folder}` resumes from {paths[0]}" if paths else "there is no checkpoint"
