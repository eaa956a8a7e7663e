"""Results of ended runs, with checks that their files are complete, and claims of runs to train."""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mjx_dher import lookup
from mjx_dher.runs.folder import contents, loggers, run_folder
from mjx_dher.runs.folder.run_folder import FAILED, FINISHED
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import BusyError, FolderError

Run = tuple[RunSpec, Path]  # and its folder


def has_result(folder: Path) -> bool:
    """Whether the run has a result, damaged or not."""
    return (folder / run_folder.RESULT_FILE).exists()


def read_result(folder: Path) -> dict[str, Any]:
    """Reads the result of an ended run. Raises FolderError if it is missing, damaged or belongs to another run."""
    path = folder / run_folder.RESULT_FILE
    with run_folder.checked(path):
        content = {"reason": "", **files.read_json(path)}
        numbers = {name: value for name, value in content.items() if value is not None}
        contents.check(numbers, contents.RESULT_FINISHED if content["status"] == FINISHED else contents.RESULT)
    if content["digest"] != (digest := run_folder.read_config(folder)["digest"]):
        other = f"its digest is {content['digest']}, but {run_folder.CONFIG_FILE} has {digest}"
        raise FolderError(f"{path} is of a run with other settings: {other}")
    return content


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Reads metrics.csv, all lines of which must belong to the run in `folder`. Raises FolderError if it is not a run folder,
    or a line is missing, invalid or belongs to another run.
    """
    path, content = folder / run_folder.METRICS_FILE, run_folder.read_config(folder)
    rows = loggers.read_rows(path, run_folder.digests(content))
    strange = {row.get(loggers.DIGEST) for row in rows} - {content["digest"]}
    if strange and "earlier" not in content:
        warnings.warn(
            f"{path} has lines with digest {', '.join(map(str, strange))}, but {run_folder.CONFIG_FILE} {content['digest']};"
            " its version kept no earlier digests, so the lines may belong to another run",
            stacklevel=2,
        )
    return rows


def earlier_digests(folder: Path, digest: str) -> list[str]:
    """Digests that a run had before it resumed with `digest`."""
    content, lines = run_folder.read_config(folder), [row[loggers.DIGEST] for row in read_metrics(folder)]
    known = run_folder.digests(content) or [*dict.fromkeys(lines), content["digest"]]
    return [one for one, after in zip(known, [*known[1:], digest]) if one != after]


def can_go_on(folder: Path, total_steps: int) -> bool:
    """Whether an ended run can resume: it failed or made fewer than `total_steps`, and it has a checkpoint. Raises FolderError
    if its result is damaged.
    """
    result = read_result(folder)
    due = result["status"] == FAILED or result["env_steps"] < total_steps
    return due and bool(run_folder.checkpoints(folder))


def result_problem(folder: Path, with_policy: bool = True) -> str | None:
    """Reason why a run with a result is invalid: files are damaged or belong to other runs. None if it is valid.

    A run can resume without its policy, so the policy may be left out of the check.
    """
    try:
        result = read_result(folder)
        content, spec = run_folder.read_run(folder)
        rows = read_metrics(folder)
        if with_policy and result["status"] == FINISHED:
            if not (folder / run_folder.POLICY_FILE).exists():
                return f"{folder} has no {run_folder.POLICY_FILE}"
            if other := run_folder.foreign(content, spec, run_folder.read_policy_settings(folder)):
                return f"{folder / run_folder.POLICY_FILE} is of a run with other settings: {other}"
    except FolderError as error:
        return str(error)
    epochs = result["epochs"] - (result["status"] == FAILED)  # the epoch that failed has no line
    if len(rows) != epochs:
        return f"{folder / run_folder.METRICS_FILE} has complete lines of {len(rows)} of {epochs} epochs"
    if rows and rows[-1].get(loggers.DIGEST) != content["digest"]:
        return (
            f"{folder / run_folder.METRICS_FILE} ends with the digest {rows[-1].get(loggers.DIGEST)}, not {content['digest']}"
        )
    return None


def trial_problem(folder: Path, spec: RunSpec) -> str | None:
    """Reason why a trial with a result is invalid, or its folder holds another trial. None if it is valid."""
    try:
        run_folder.check_same(folder, spec, ("physics",))
    except FolderError as error:
        return str(error)
    return result_problem(folder)


def is_done(folder: Path, spec: RunSpec) -> bool:
    """Whether a trial of a sweep has ended with valid files."""
    return has_result(folder) and trial_problem(folder, spec) is None


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
        if not has_result(folder):
            return True
        problem = trial_problem(folder, spec) if self.sweep else result_problem(folder, with_policy=False)
        if self.sweep and problem is not None:
            self.report(f"{problem}; training it again")
        if self.sweep:
            return problem is not None
        if problem is None and can_go_on(folder, spec.config.total_steps):
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
