"""Files and folders: atomic writes, locks, and checks before anything slow happens."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows, where two programs may write to one run unnoticed
    fcntl = None  # type: ignore[assignment]


class FolderError(ValueError):
    """Error for a folder that is no run of this program, is damaged, or must not be written to."""


def check_file(out: Path, endings: Iterable[str], overwrite: bool) -> None:
    """Checks that the file `out` can and may be written, to fail before anything slow happens.

    Raises:
      FolderError: `out` ends in none of `endings`, is a folder, exists (without `overwrite`), or its folder does not exist.
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
    """Writes `content` as JSON, atomically."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")


@contextlib.contextmanager
def lock(path: Path, name: str, wait: bool = False) -> Iterator[None]:
    """Locks the folder `path` against other programs. The system releases the lock when this process ends, however it ends.

    Args:
      path: the folder, as a rule that of a run.
      name: a file in the folder that is never replaced; it is created if it does not exist.
      wait: whether to wait until another program releases the lock.

    Raises:
      FolderError: another program holds the lock, and `wait` is False.
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
    """Yields a path to write to, which replaces `path` once the block ends.

    After an error `path` stays as it was, and the new file is deleted.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
