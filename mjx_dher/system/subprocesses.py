"""Programs run in processes of their own: their output, and in one line why they failed."""

from __future__ import annotations

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
    """Output of a program that has ended."""

    out: str
    err: str
    failure: str | None  # one line; None if the program succeeded

    def last_json(self) -> Any:
        """Returns the JSON value in the last line of `out`."""
        return json.loads(self.out.splitlines()[-1])


@contextlib.contextmanager
def started(command: Sequence[str], variables: Mapping[str, str] | None = None) -> Iterator[subprocess.Popen[str]]:
    """Starts a program, with `variables` added to this one's environment, and kills it at the end of the block.

    Its output goes to files, because a program stops at a full pipe that nobody reads. It has a session of its own: a signal to
    this program's group is this program's to answer.
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
    """Kills a program that leads a session, and those that it has started there."""
    with contextlib.suppress(OSError):  # all have ended
        os.killpg(process.pid, signal.SIGKILL)


def leaders() -> list[int]:
    """Programs that this one has started, in sessions of their own. Needs Linux."""
    with contextlib.suppress(OSError):
        return [pid for pid in signals.children() if os.getsid(pid) == pid]
    return []


def kill_sessions(more: Sequence[int] = ()) -> None:
    """Kills the processes, of any parent, in the sessions of `leaders` and of those given, which may have ended."""
    first = [*leaders(), *more]  # they start the others
    with contextlib.suppress(OSError):
        for pid in (*first, *(int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal())):
            with contextlib.suppress(OSError):  # it has just ended
                if os.getsid(pid) in first:
                    os.kill(pid, signal.SIGKILL)


def answer(process: subprocess.Popen[str], seconds: float | None = None) -> Answer:
    """Waits for a program to end, and kills it after that many `seconds`."""
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
    """Runs a program to its end; see `started` and `answer`. A program that cannot be started is a failure, too."""
    try:
        with started(command, variables) as process:
            return answer(process, seconds)
    except OSError as error:
        return Answer("", "", str(error))
