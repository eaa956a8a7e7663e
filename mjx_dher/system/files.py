"""Files and folders: locks, writes that survive a power cut, and checks before anything slow happens."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

LOCK = ".lock"  # name of the file in a folder by which it is locked


class FolderError(ValueError):
    """Error for a folder that is no run of this program, is damaged, or must not be written to."""


class BusyError(FolderError):
    """Error for a folder that another program is at work on."""


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


@contextlib.contextmanager
def lock(folder: Path, wait: bool = False) -> Iterator[None]:
    """Locks a folder against other programs, and other threads of this one. Who has the lock can take it again.

    The system releases the lock when this process ends, however it ends. The file stays: who unlinks a file by which others
    lock gives the lock to two of them.

    Args:
      folder: it must exist.
      wait: whether to wait until another program releases the lock.

    Raises:
      BusyError: another program holds the lock, and `wait` is False.
      OSError: the folder does not exist or cannot be written to.
    """
    from filelock import FileLock, Timeout

    held = FileLock(folder.absolute() / LOCK, timeout=-1 if wait else 0, is_singleton=True)
    try:
        held.acquire()
    except Timeout:
        raise BusyError(f"{folder} is being trained by another program") from None
    try:
        yield
    finally:
        held.release()


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Makes a folder, locks it, and removes it again where the block has left nothing in it.

    Raises:
      BusyError: another program holds the lock.
      FolderError: it holds something already.
      OSError: it cannot be made or written to.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder)
    try:
        if not (folder / LOCK).exists():  # else another program may be at work on it, which says more
            _refuse_used(folder)  # before a lock is left in what is someone else's
        with lock(folder):
            _refuse_used(folder)
            try:
                yield
            finally:
                if not is_used(folder):
                    (folder / LOCK).unlink(missing_ok=True)  # none will wait for it: the folder goes, too
    finally:
        for path in missing:
            with contextlib.suppress(OSError):  # something is in it
                path.rmdir()


def _refuse_used(folder: Path) -> None:
    if is_used(folder):
        raise FolderError(f"out: {folder} is there already and is never overwritten; name a new or empty folder")


def is_used(folder: Path) -> bool:
    """Returns whether a folder holds anything but the file by which it is locked."""
    return any(path.name != LOCK for path in folder.iterdir())


def make_folder(folder: Path) -> None:
    """Makes a folder, and those above it that are missing, so that they survive a power cut."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        flush(path.parent)


def flush(path: Path) -> None:
    """Flushes a file's content, or the names in a folder, onto the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def flush_all(folder: Path) -> None:
    """Flushes everything in a folder onto the disk, what is deepest first."""
    for root, _, names in os.walk(folder, topdown=False):
        for name in names:
            flush(Path(root, name))
        flush(Path(root))


def remove(path: Path) -> None:
    """Removes a folder with all that is in it; of a link, the link alone."""
    if path.is_symlink():
        path.unlink()
    else:
        shutil.rmtree(path)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes `content` as JSON, atomically, so that it survives a power cut; what is not finite becomes null."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(_without_nan(content), indent=2, allow_nan=False) + "\n")
        flush(partial)
    flush(path.parent)


def _without_nan(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _without_nan(value) for name, value in content.items()}
    return None if isinstance(content, float) and not abs(content) < float("inf") else content


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a path to write to, which replaces `path` once the block ends.

    After an error `path` stays as it was, and the new file is deleted.
    """
    partial = path.with_name(path.name + ".partial")
    partial.unlink(missing_ok=True)  # what a kill has left, or a link, through which another file would be written
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
