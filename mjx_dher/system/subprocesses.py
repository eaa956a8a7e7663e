"""Subprocesses: their output, their folders, and the reason for a failure in one line."""

import contextlib
import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

from mjx_dher.system import signals

PACKAGE = Path(__file__).resolve().parents[1]  # the folder mjx_dher


class Answer(NamedTuple):
    """Output of an ended subprocess."""

    out: str
    err: str
    failure: str | None  # one line; None if the program succeeded

    def last_json(self) -> Any:
        return json.loads(self.out.splitlines()[-1])


@contextlib.contextmanager
def temporary_folder(prefix: str, parent: str | None = None) -> Iterator[Path]:
    """Makes a private folder, which is removed at the end of the block."""
    folder = tempfile.TemporaryDirectory(prefix=prefix, dir=parent, ignore_cleanup_errors=True)
    with signals.cleaning(folder.cleanup):
        yield Path(folder.name)


@contextlib.contextmanager
def started(command: Sequence[str], variables: Mapping[str, str] | None = None) -> Iterator[subprocess.Popen[str]]:
    """Starts a subprocess, with `variables` added to its environment, and kills it at the end of the block.

    Its output goes to files, because a process stops at a full pipe. It has its own session, so it does not receive signals
    for this process's group.
    """
    environment = {**os.environ, **(variables or {})}
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as out,
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as err,
        subprocess.Popen(command, env=environment, stdout=out, stderr=err, text=True, start_new_session=True) as process,
        signals.cleaning(lambda: kill(process)),
    ):
        process.stdout, process.stderr = out, err
        yield process


def kill(process: subprocess.Popen[Any]) -> None:
    """Kills a process that leads a session, and the processes that it has started in it."""
    with contextlib.suppress(OSError):  # all have ended
        os.killpg(process.pid, signal.SIGKILL)


def leaders() -> list[int]:
    """Child processes that lead their own session. Needs Linux."""
    with contextlib.suppress(OSError):
        return [pid for pid in signals.children() if os.getsid(pid) == pid]
    return []


def kill_sessions(more: Sequence[int] = ()) -> None:
    """Kills all processes in the sessions of `leaders` and of `more`, which may have ended."""
    first = [*leaders(), *more]  # they start the others
    with contextlib.suppress(OSError):
        for pid in (*first, *(int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal())):
            with contextlib.suppress(OSError):  # it has just ended
                if os.getsid(pid) in first:
                    os.kill(pid, signal.SIGKILL)


def answer(process: subprocess.Popen[str], seconds: float | None = None) -> Answer:
    """Waits for a subprocess to end, and kills it after `seconds`."""
    failure = None
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        kill(process)
        process.wait()
        failure = f"did not end within {seconds:g} s"
    out, err = (_written(file) for file in (process.stdout, process.stderr))
    last = (err.strip().splitlines() or [""])[-1]
    return Answer(out, err, failure or (f"exit status {process.returncode}: {last}" if process.returncode else None))


def _written(file: IO[str] | None) -> str:
    assert file is not None
    file.seek(0)
    return file.read()


def ask(command: Sequence[str], variables: Mapping[str, str] | None = None, seconds: float | None = None) -> Answer:
    """Runs a subprocess to its end; see `started` and `answer`. Failing to start is a failure too."""
    try:
        with started(command, variables) as process:
            return answer(process, seconds)
    except OSError as error:
        return Answer("", "", str(error))
