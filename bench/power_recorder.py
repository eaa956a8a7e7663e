"""Simulates a power cut within the limits of POSIX: data not flushed by `fsync` may be lost.

`install` makes this process keep, in another folder, the content of each file and the names in each folder at the last flush.
`rebuild` makes from these the contents of a disk after a cut. A disk may also keep unflushed data in any order: a name before
the content of its file, a length before the bytes. `rebuild` with random numbers makes such a disk. Deleted files are moved
aside, so that no inode number is reused.
"""

import itertools
import json
import os
import random
import shutil
import stat
from pathlib import Path


def install(root: Path, store: Path) -> None:
    """Records flushes in `root`, whose present names count as flushed. Both folders exist, on one disk."""
    fsync, replace, rmtree, unlink, rmdir = os.fsync, os.replace, shutil.rmtree, os.unlink, os.rmdir
    (store / "trash").mkdir()
    numbers = itertools.count()

    def keep(name, write):
        partial = store / f"partial{next(numbers)}"
        write(partial)
        replace(partial, store / name)

    def record(descriptor):
        status = os.fstat(descriptor)
        if stat.S_ISDIR(status.st_mode):
            entries = {entry.name: (entry.inode(), entry.is_dir()) for entry in os.scandir(f"/proc/self/fd/{descriptor}")}
            keep(f"folder{status.st_ino}", lambda path: path.write_text(json.dumps(entries)))
        else:
            keep(f"file{status.st_ino}", lambda path: shutil.copyfile(f"/proc/self/fd/{descriptor}", path))
        fsync(descriptor)

    def aside(path, *args, **kwargs):
        if Path(path).absolute().is_relative_to(root) and os.path.lexists(path):
            replace(path, store / "trash" / str(next(numbers)))
        elif kwargs.get("ignore_errors") is None:
            unlink(path, *args, **kwargs)

    def aside_empty(path, *args, **kwargs):
        inside = Path(path).absolute().is_relative_to(root) and Path(path).is_dir() and not os.listdir(path)
        (aside if inside else rmdir)(path, *args, **kwargs)

    def put(source, target, **kwargs):
        if Path(target).absolute().is_relative_to(root) and os.path.isfile(target):
            os.link(target, store / "trash" / str(next(numbers)))
        replace(source, target, **kwargs)

    os.fsync, os.replace, os.rename, os.unlink, os.remove, os.rmdir = record, put, put, aside, aside, aside_empty  # type: ignore[assignment]
    shutil.rmtree = lambda path, *args, **kwargs: (  # type: ignore[assignment]
        aside(path, ignore_errors=True) if Path(path).absolute().is_relative_to(root) else rmtree(path, *args, **kwargs)
    )
    descriptor = os.open(root, os.O_RDONLY)
    record(descriptor)
    os.close(descriptor)


def rebuild(root: Path, store: Path, target: Path, rng: random.Random | None = None) -> None:
    """Rebuilds the flushed state of `root` in `target`. With `rng`, some files and folders have later, unflushed states."""
    now = {path.lstat().st_ino: path for place in (root, store / "trash") for path in (place, *place.rglob("*"))}
    _rebuild(root.stat().st_ino, store, target, now, rng)


def _rebuild(inode: int, store: Path, target: Path, now: dict[int, Path], rng: random.Random | None) -> None:
    target.mkdir()
    listing = store / f"folder{inode}"
    entries = json.loads(listing.read_text()) if listing.exists() else {}
    if rng is not None and inode in now and rng.random() < 0.5:
        entries = {entry.name: (entry.inode(), entry.is_dir()) for entry in os.scandir(now[inode])}
    for name, (number, is_folder) in entries.items():
        if is_folder:
            _rebuild(number, store, target / name, now, rng)
        else:
            (target / name).write_bytes(_content(store / f"file{number}", now.get(number), rng))


def _content(kept: Path, path: Path | None, rng: random.Random | None) -> bytes:
    """A file's content: the flushed part only, or with all, a part, or only the length of the later data."""
    flushed = kept.read_bytes() if kept.exists() else b""
    if rng is None or path is None:
        return flushed
    written = path.read_bytes()
    cut = written[: rng.randint(min(len(flushed), len(written)), len(written))]
    return rng.choice((flushed, written, cut, flushed + bytes(max(0, len(written) - len(flushed)))))
