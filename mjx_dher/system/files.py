"""Files and folders: locks, writes that survive a power cut, and early checks."""

import contextlib
import errno
import itertools
import json
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_dher.system import machine, signals

if TYPE_CHECKING:
    from filelock import BaseFileLock

LARGEST_JSON = 8 << 20  # bytes
LONGEST_LINE = 100_000  # bytes; the module csv reads fields of 131,072
PARTIAL = ".partial"  # suffix of a file that is being written, after its name and the number of the process
LOCK = ".lock"  # name of a folder's lock file
_MARKER = f"{LOCK}.soft"  # name on a file system without locks
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)  # filelock itself marks the folder for ENOSYS
_NO_FLUSH = (errno.EINVAL, errno.EBADF, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)  # of a folder: CIFS, AFS, some of FUSE

_LARGEST_BLOCK = 1 << 16  # bytes; NFS reports its message size as block size


class FolderError(ValueError):
    """A folder is not a run of this program, is damaged, or must not be written to."""


class BusyError(FolderError):
    """Another process is using a folder."""


def inside(folder: Path, paths: Iterable[Path]) -> list[Path]:
    """Sorted paths in a folder. Links to other places are rejected. Raises FolderError if a path is a link to elsewhere."""
    paths, root = sorted(paths), Path(os.path.realpath(folder))
    for path in paths:
        if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(root):
            raise FolderError(f"{path} is a link that leads out of {folder}: remove it, or replace it by a copy")
    return paths


def read_json(file: Path) -> Any:
    """Content of a JSON file. Raises FileNotFoundError if there is none, and FolderError if it is larger than LARGEST_JSON, is
    not JSON, or cannot be read.
    """
    if file.exists() and not file.is_file():
        raise FolderError(f"{file} is not a file")  # reading a FIFO would block
    try:
        with file.open("rb") as stream:
            content = stream.read(LARGEST_JSON + 1)
        if len(content) > LARGEST_JSON:
            raise ValueError(f"it is larger than {LARGEST_JSON >> 20} MB")
        value = json.loads(content.decode())
        json.dumps(value, ensure_ascii=False).encode()  # raises for half a surrogate pair, which cannot be printed
        return value
    except FileNotFoundError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise FolderError(f"{file} cannot be read ({error})") from error


def whole_lines(file: Path) -> list[str]:
    """Lines of a text file, up to the first without an end within `LONGEST_LINE` bytes. Empty if there is no file. Raises
    FolderError if it is a folder or a FIFO.
    """
    if file.exists() and not file.is_file():
        raise FolderError(f"{file} is not a file")  # reading a FIFO would block
    lines: list[bytes] = []
    with contextlib.suppress(FileNotFoundError), file.open("rb") as stream:
        read = iter(lambda: stream.readline(LONGEST_LINE), b"")
        lines = [*itertools.takewhile(lambda line: line.endswith(b"\n"), read)]
    return [line.decode(errors="replace") for line in lines]


@contextlib.contextmanager
def lock(folder: Path, wait: bool = False) -> Iterator[None]:
    """Locks a folder against other processes and other threads. The owner can lock it again.

    The system releases the lock when this process ends. The file stays, because unlinking it could give the lock to two
    processes. On a file system without locks, a file that names this process marks the folder.

    Raises:
      BusyError: another process holds the lock, and `wait` is False.
      FolderError: a link in the folder leads elsewhere, so a file there could be written or deleted.
      OSError: the folder does not exist or cannot be written to.
    """
    from filelock import FileLock, Timeout

    path, timeout = folder.absolute() / LOCK, -1 if wait else 0
    is_new = not path.exists()
    held: BaseFileLock = FileLock(path, timeout=timeout, is_singleton=True)
    try:
        with naming(path):
            held.acquire()
    except Timeout:
        raise BusyError(f"{folder} is being trained by another process") from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        if is_new:
            path.unlink(missing_ok=True)
        held = _mark(folder, timeout)
    try:
        inside(folder, (path for path in folder.iterdir() if path.suffix != PARTIAL))
        yield
    finally:
        held.release()


def _mark(folder: Path, timeout: float) -> "BaseFileLock":
    """Locks a folder on a file system without locks."""
    from filelock import SoftFileLock, Timeout

    warnings.warn("the file system has no locks: folders in use are marked by files", stacklevel=2)
    held = SoftFileLock(folder.absolute() / _MARKER, timeout=timeout, is_singleton=True)
    try:
        held.acquire()
    except Timeout:
        raise BusyError(f"{folder} is being trained by another process; if not, delete {held.lock_file}") from None
    return held


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Makes and locks a folder, and removes it if the block leaves nothing in it. Raises BusyError if another process holds the
    lock, and FolderError if the folder is not empty.
    """

    def unlink_lock() -> None:
        if folder.is_dir() and not is_used(folder):  # it may have been moved
            (folder / LOCK).unlink(missing_ok=True)  # nobody waits for it, because the folder is removed too

    with made(folder):
        if not (folder / LOCK).exists():  # otherwise another process may use it, which `lock` reports
            _refuse_used(folder)  # before a lock file is left in someone else's folder
        with lock(folder), signals.cleaning(unlink_lock):
            _refuse_used(folder)
            yield


def _refuse_used(folder: Path) -> None:
    if is_used(folder):
        raise FolderError(f"out: {folder} exists and is never overwritten; pass a new or empty folder")


def is_used(folder: Path) -> bool:
    """Whether a folder contains anything other than its lock file."""
    return not all(map(is_lock, folder.iterdir()))


def is_lock(path: Path) -> bool:
    """Whether a file is the lock file of its folder."""
    return path.name == LOCK or path.name.startswith(_MARKER)


def make_folder(folder: Path) -> list[Path]:
    """Makes a folder and its missing parents, such that they survive a power cut. Returns the new folders."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in missing:
            flush(path.parent)
    except OSError:
        _remove_empty(missing)
        raise
    return missing


@contextlib.contextmanager
def made(folder: Path) -> Iterator[None]:
    """Makes a folder and its missing parents. Removes those that are empty at the end."""
    missing = make_folder(folder)
    with signals.cleaning(lambda: _remove_empty(missing)):
        yield


def _remove_empty(folders: Iterable[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):  # something is in it
            folder.rmdir()


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Adds the path to an OSError without a file name, such as from writing and flushing."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def flush(path: Path) -> None:
    """Flushes a file to disk, or the names in a folder if the file system supports it."""
    with naming(path):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        except OSError as error:
            if not (error.errno in _NO_FLUSH and path.is_dir()):
                raise
        finally:
            os.close(descriptor)


def flush_all(folder: Path) -> None:
    """Flushes everything in a folder to disk, deepest first."""
    for root, _, names in os.walk(folder, topdown=False):
        for name in names:
            flush(Path(root, name))
        flush(Path(root))


def lack_of_space(folder: Path, sizes: Sequence[int]) -> str | None:
    """Reason why files of these sizes, in bytes, do not fit on the disk of a folder, or None if they do."""
    folder = folder.absolute()
    disk = os.statvfs(next(path for path in (folder, *folder.parents) if path.is_dir()))
    block = min(disk.f_frsize or 1, _LARGEST_BLOCK)
    needed, free = sum(-(-size // block) * block for size in sizes), disk.f_bavail * disk.f_frsize
    if needed > free and disk.f_blocks:  # otherwise the file system's size is unknown or unlimited
        return f"{machine.format_bytes(needed)}, but only {machine.format_bytes(free)} of the disk are free"
    if disk.f_files and len(sizes) > disk.f_favail:
        return f"{len(sizes)} files, but the disk can have only {disk.f_favail} more"
    return None


def remove(path: Path) -> None:
    """Removes a folder with its content. Removes only the link if it is one."""
    if path.is_symlink():
        path.unlink()
    else:
        shutil.rmtree(path)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes `content` as JSON, like `write`. Numbers that are not finite become null."""
    write(path, f"{json.dumps(_without_nan(content), indent=2, allow_nan=False, ensure_ascii=False)}\n".encode())


def write(path: Path, content: bytes) -> None:
    """Writes a file atomically, such that it survives a power cut."""
    with atomic_write(path) as partial:
        partial.write_bytes(content)
        flush(partial)
    flush(path.parent)


def _without_nan(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _without_nan(value) for name, value in content.items()}
    return None if isinstance(content, float) and not abs(content) < float("inf") else content


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a path to write to, which replaces `path` when the block ends. Of two programs, the last one to end wins.

    After an error, `path` is unchanged and the new file is deleted. So are those that killed processes have left.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}{PARTIAL}")
    with signals.cleaning(lambda: partial.unlink(missing_ok=True)), naming(path):
        for left in path.parent.iterdir():
            pid = left.name.removeprefix(f"{path.name}.").removesuffix(PARTIAL)
            if left.name == f"{path.name}.{pid}{PARTIAL}" and pid.isdecimal() and (left == partial or not _runs(int(pid))):
                left.unlink(missing_ok=True)
        yield partial
        partial.replace(path)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # another user's; no process has such a number
        return True
    return True
