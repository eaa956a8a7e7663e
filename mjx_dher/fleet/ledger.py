"""The driver's own notes in the folder of a sweep: its id, and which runs are together in a task that has not ended.

A driver that is started anew hands out these tasks first, as they were: their checkpoints are those of these runs side by side.
"""

from __future__ import annotations

import json
import uuid
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path

from mjx_dher.runs.folder import fingerprint
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError

FILE = "fleet.json"


class Ledger:
    """Runs that wait, in order, and the notes about those that are with a task.

    Args:
      folder: of the sweep.
      specs: runs that are to be trained, in the order of the grid.
    """

    def __init__(self, folder: Path, specs: Iterable[RunSpec]):
        self._path = folder / FILE
        waiting = {fingerprint.trial_name(spec): spec for spec in specs}
        self.sweep, chunks = _read(self._path)
        self._out: dict[str, list[str]] = {}
        self._earlier: deque[tuple[str, tuple[RunSpec, ...]]] = deque()
        self._names: dict[str, list[str]] = {}  # of earlier tasks, with the runs that have ended
        for chunk, names in chunks.items():
            left = [waiting.pop(name) for name in names if name in waiting]
            if left:  # under the digest that it had: its copies in the storage go by that
                self._earlier.append((chunk, tuple(left)))
                self._names[chunk] = names
        self._waiting = deque(waiting.values())

    @property
    def waits(self) -> int:
        """Number of runs that wait."""
        return len(self._waiting) + sum(len(specs) for _, specs in self._earlier)

    def take(self, size: Callable[[RunSpec], int]) -> tuple[str, tuple[RunSpec, ...]]:
        """Takes the next runs that share a program; returns their digest and them. At least one must wait.

        Args:
          size: how many of runs like this one a task takes.
        """
        if self._earlier:
            chunk, specs = self._earlier.popleft()
            names = self._names.pop(chunk)
        else:
            own = [self._waiting.popleft()]
            most, program = size(own[0]), own[0].program
            while self._waiting and len(own) < most and self._waiting[0].program == program:
                own.append(self._waiting.popleft())
            specs = tuple(own)
            names = [fingerprint.trial_name(spec) for spec in specs]
            chunk = fingerprint.sha256_of(names)[:16]
        self._out[chunk] = names
        self._write()
        return chunk, specs

    def ended(self, chunk: str) -> None:
        """Forgets a task that has ended."""
        self._out.pop(chunk, None)
        self._write()

    def _write(self) -> None:
        """Writes the notes: the tasks that are out, and those of before that wait for their turn."""
        files.write_json(self._path, {"schema": 1, "id": self.sweep, "chunks": {**self._out, **self._names}})

    def close(self) -> None:
        """Removes the notes: every run has ended."""
        self._path.unlink(missing_ok=True)


def _read(path: Path) -> tuple[str, dict[str, list[str]]]:
    """Returns the sweep's id, and the runs of each task by its digest: those of an earlier start, or new ones.

    Raises:
      FolderError: they are damaged.
    """
    try:
        content = json.loads(path.read_text())
        chunks = {str(chunk): [str(name) for name in names] for chunk, names in content["chunks"].items()}
        return str(content["id"]), chunks
    except FileNotFoundError:
        return uuid.uuid4().hex[:12], {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        hint = "remove it, and the sweep goes on with the runs that have not ended"
        raise FolderError(f"{path} is damaged ({error}); {hint}") from error
