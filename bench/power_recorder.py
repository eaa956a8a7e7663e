"""A power cut, as POSIX allows it to be: what was not flushed by `fsync` is gone.

`install` makes this process keep, in another folder, what each file held and which names each folder had when they were last
flushed; `rebuild` makes of that what a disk would have after a cut. A disk may also have more than was flushed, in no order:
a name before the content of its file, a length before the bytes. `rebuild` with random numbers makes one of these, too. Deleted
files are moved aside, so that no number of an inode is used again.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import shutil
import stat
from pathlib import Path


def install(root: Path, store: Path) -> None:
    """Records what is flushed in `root`, whose present names are taken for flushed. Both folders exist, on one disk."""
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

    os.fsync, os.replace, os.rename, os.unlink, os.remove, os.rmdir = record, put, put, aside, aside, aside_empty
    shutil.rmtree = lambda path, *args, **kwargs: (
        aside(path, ignore_errors=True) if Path(path).absolute().is_relative_to(root) else rmtree(path, *args, **kwargs)
    )
    descriptor = os.open(root, os.O_RDONLY)
    record(descriptor)
    os.close(descriptor)


def rebuild(root: Path, store: Path, target: Path, rng: random.Random | None = None) -> None:
    """Makes in `target` what of `root` was flushed; with `rng`, of some files and folders what they have come to since."""
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
    """What a file has: what was flushed, or all, a part, or only the length of what was written since."""
    flushed = kept.read_bytes() if kept.exists() else b""
    if rng is None or path is None:
        return flushed
    written = path.read_bytes()
    cut = written[: rng.randint(min(len(flushed), len(written)), len(written))]
    return rng.choice((flushed, written, cut, flushed + bytes(max(0, len(written) - len(flushed)))))
