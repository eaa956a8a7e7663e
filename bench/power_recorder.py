"""A power cut, as POSIX allows it to be: what was not flushed by `fsync` is gone.

`install` makes this process keep, in another folder, what each file held and which names each folder had when they were last
flushed; `rebuild` makes of that what a disk would have after a cut. Deleted files are moved aside, so that no number of an
inode is used again.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import stat
from pathlib import Path


def install(root: Path, store: Path) -> None:
    """Records what is flushed in `root`, whose present names are taken for flushed. Both folders exist, on one disk."""
    fsync, replace, rmtree, unlink = os.fsync, os.replace, shutil.rmtree, os.unlink
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

    def put(source, target, **kwargs):
        if Path(target).absolute().is_relative_to(root) and os.path.isfile(target):
            os.link(target, store / "trash" / str(next(numbers)))
        replace(source, target, **kwargs)

    os.fsync, os.replace, os.rename, os.unlink, os.remove = record, put, put, aside, aside
    shutil.rmtree = lambda path, *args, **kwargs: (
        aside(path, ignore_errors=True) if Path(path).absolute().is_relative_to(root) else rmtree(path, *args, **kwargs)
    )
    descriptor = os.open(root, os.O_RDONLY)
    record(descriptor)
    os.close(descriptor)


def rebuild(root: Path, store: Path, target: Path) -> None:
    """Makes in `target` what of `root` was flushed."""
    _rebuild(root.stat().st_ino, store, target)


def _rebuild(inode: int, store: Path, target: Path) -> None:
    target.mkdir()
    listing = store / f"folder{inode}"
    entries = json.loads(listing.read_text()) if listing.exists() else {}
    for name, (number, is_folder) in entries.items():
        content = store / f"file{number}"
        if is_folder:
            _rebuild(number, store, target / name)
        elif content.exists():
            shutil.copyfile(content, target / name)
        else:
            (target / name).write_bytes(b"")
