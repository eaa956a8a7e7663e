"""Files: written whole or not at all, locked, checked before anything slow happens."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # not on Windows, where two programs on one run are not told apart
    fcntl = None  # type: ignore[assignment]


class FolderError(ValueError):
    """A folder that is no run of this program, is damaged, or must not be written to."""


def check_file(out: Path, endings: Iterable[str], overwrite: bool) -> None:
    """Refuses a file that cannot or must not be written, before anything slow has happened.

    Raises:
      FolderError: it ends in none of `endings`, is a folder, is there already (without `overwrite`), or its folder is not.
    """
    endings = tuple(endings)
    if out.suffix.lower() not in endings:
        raise FolderError(f"out must end in {', '.join(endings)}; got {str(out)!r}")
    if out.is_dir():
        raise FolderError(f"out: {out} is a folder")
    if out.exists() and not overwrite:
        raise FolderError(f"out: {out} is there already; name another file or give --overwrite")
    if not out.parent.is_dir():
        raise FolderError(f"out: there is no folder {out.parent}")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes `content` as JSON, whole or not at all."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")


@contextlib.contextmanager
def lock(path: Path, name: str, wait: bool = False) -> Iterator[None]:
    """Keeps other programs off the folder `path`. The system lets go of the lock when this one ends, however it ends.

    Args:
      path: the folder, of a run as a rule.
      name: a file in it that no one puts another in the place of; it is made where it is not there.
      wait: until the other one is done.

    Raises:
      FolderError: another program is at work there.
    """
    with (path / name).open("a") as file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except OSError:
                raise FolderError(f"{path} is being trained by another program") from None
        yield


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A path to write to that takes the place of `path` when it is complete; until then, what was there stays.

    After an error it stays for good, and nothing is left of the new.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
