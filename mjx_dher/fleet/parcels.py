"""Run folders as bytes, for the way from a node to the driver, and a chunk's folder as a file in the storage."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import tarfile
import tempfile
import uuid
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mjx_dher.runs.folder import results, run_folder
from mjx_dher.system import files
from mjx_dher.system.files import FolderError

KEPT = 2  # copies of a chunk in the storage: where the newest is damaged, the one before is used


def pack(folder: Path) -> bytes:
    """Returns a run folder as bytes: all files but its lock and its checkpoints."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder)
            if path.is_file() and name.parts[0] not in (files.LOCK, run_folder.CHECKPOINTS):
                entry = zipfile.ZipInfo(name.as_posix())  # without a time: the same run gives the same bytes
                archive.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED, compresslevel=1)
    return buffer.getvalue()


def deliver(folder: Path, parcel: bytes) -> bool:
    """Writes a run that has ended into its folder, result.json last, so that the run is there whole or has not ended.

    Args:
      folder: the run's, made where it does not exist.
      parcel: what `pack` gave.

    Returns:
      Whether it was written: False where the run has ended there already.

    Raises:
      FolderError: another program is at work on the folder, it cannot be written to, or the parcel is not of a whole run.
    """
    try:
        files.make_folder(folder)
        with files.lock(folder):
            if results.is_whole(folder):
                return False
            content = _unpacked(folder, parcel)
            _empty(folder)
            _write_run(folder, content)
    except OSError as error:
        raise FolderError(f"{folder} cannot be written to ({error.strerror or error}); the same command goes on") from error
    if (problem := results.result_problem(folder)) is not None:
        raise FolderError(f"what came back of a run is not whole: {problem}")
    return True


def _empty(folder: Path) -> None:
    """Removes what an attempt without Ray, or one that was killed, has left."""
    (folder / run_folder.RESULT_FILE).unlink(missing_ok=True)
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != files.LOCK:
            path.unlink()


def _unpacked(folder: Path, parcel: bytes) -> dict[str, bytes]:
    """Returns the files of a parcel by name."""
    try:
        with zipfile.ZipFile(io.BytesIO(parcel)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}  # their checksums are looked at
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise FolderError(f"what came back of {folder.name} is damaged ({error})") from error


def _write_run(folder: Path, content: dict[str, bytes]) -> None:
    """Writes files by name, result.json last."""
    result = content.pop(run_folder.RESULT_FILE, None)
    for name, data in content.items():
        _write(folder, name, data)
    if result is not None:
        files.flush_all(folder)
        _write(folder, run_folder.RESULT_FILE, result)
        files.flush(folder)


def _write(folder: Path, name: str, data: bytes) -> None:
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FolderError(f"what came back of a run names {name!r}, outside of its folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.atomic_write(path) as partial:
        partial.write_bytes(data)
        files.flush(partial)


class Storage:
    """Copies of a chunk's folder where all nodes see them.

    A copy is a tar file, and a second file with its size and SHA-256, which is written after it: a copy without is not used.
    Object stores have neither locks nor renames, and need none here.
    """

    def __init__(self, root: str, sweep: str, chunk: str):
        from etils import epath

        self._sweep: Any = epath.Path(root) / f"fleet-{sweep}"
        self._folder: Any = self._sweep / chunk

    def _copies(self) -> list[str]:
        """Returns the names of whole copies, the newest first."""
        if not self._folder.exists():
            return []
        return sorted((path.name.removesuffix(".json") for path in self._folder.glob("*.json")), reverse=True)

    def save(self, folder: Path) -> None:
        """Writes a copy of a folder, and removes all but the newest `KEPT`.

        Raises:
          OSError: it cannot be written; or what the client of an object store raises.
        """
        copies = self._copies()
        number = int(copies[0].partition("-")[0]) + 1 if copies else 1
        name = f"{number:06d}-{uuid.uuid4().hex[:8]}"  # two nodes that both think the chunk is theirs write two files
        self._folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder.parent) as local:
            with tarfile.open(fileobj=local, mode="w") as archive:
                archive.add(folder, arcname=".")
            size = local.tell()
            local.seek(0)
            digest = hashlib.file_digest(local, "sha256").hexdigest()
            local.seek(0)
            with (self._folder / f"{name}.tar").open("wb") as remote:
                shutil.copyfileobj(local, remote, 1 << 22)
        (self._folder / f"{name}.json").write_text(json.dumps({"bytes": size, "sha256": digest}))
        for old in copies[KEPT - 1 :]:
            for ending in (".json", ".tar"):
                with contextlib.suppress(FileNotFoundError):
                    (self._folder / f"{old}{ending}").unlink()

    def restore(self, folder: Path) -> list[str]:
        """Unpacks the newest whole copy, if there is one, into an empty folder; returns what was wrong with newer ones."""
        refused: list[str] = []
        for name in self._copies():
            with tempfile.TemporaryFile(dir=folder.parent) as local:
                try:
                    content = json.loads((self._folder / f"{name}.json").read_text())
                    with (self._folder / f"{name}.tar").open("rb") as remote:
                        shutil.copyfileobj(remote, local, 1 << 22)
                    local.seek(0)
                    if hashlib.file_digest(local, "sha256").hexdigest() != content["sha256"]:
                        raise FolderError("SHA-256 differs")
                    local.seek(0)
                    with tarfile.open(fileobj=local) as archive:
                        archive.extractall(folder, filter="data")
                    return refused
                except Exception as error:  # clients of object stores raise errors of their own, of many kinds
                    refused.append(f"the copy {name} of these runs is damaged ({error})")
        return refused

    def clear(self) -> None:
        """Removes the chunk's copies, and the sweep's folder where it is empty."""
        with contextlib.suppress(Exception):  # as an object store's client raises them; the copies cost room alone
            if self._folder.exists():
                self._folder.rmtree()
            if not any(self._sweep.iterdir()):
                self._sweep.rmdir()


def probe(root: str, sweep: str, token: str | None) -> str | None:
    """Tries the storage out: writes a file, reads it back, and looks for what the driver wrote.

    Args:
      root: of the storage.
      sweep: id of the sweep.
      token: what the driver has written; None: this is the driver.

    Returns:
      What is wrong with it; None: nothing.
    """
    try:
        from etils import epath

        folder: Any = epath.Path(root) / f"fleet-{sweep}"
        folder.mkdir(parents=True, exist_ok=True)
        own = folder / f"probe-{uuid.uuid4().hex}"
        own.write_text("x")
        back = own.read_text()
        own.unlink()
        if back != "x":
            return f"{root} does not give back what is written to it"
        if token is not None and not (folder / token).exists():
            return f"{root} is not where this machine sees it: it must be the same folder for every node"
    except Exception as error:  # clients of object stores raise errors of their own, of many kinds
        return f"{root} cannot be written to ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
    return None


@contextlib.contextmanager
def shown(root: str, sweep: str) -> Iterator[str]:
    """Leaves a file in the storage for nodes to look for while the block runs; yields its name.

    Raises:
      ValueError: the storage cannot be written to from here.
    """
    from etils import epath

    was_there = True
    with contextlib.suppress(Exception):  # the trial that follows says what is wrong
        was_there = epath.Path(root).exists()
    if (wrong := probe(root, sweep, None)) is not None:
        raise ValueError(f"storage: {wrong}")
    token: Any = epath.Path(root) / f"fleet-{sweep}" / f"seen-{uuid.uuid4().hex}"
    token.write_text("x")
    try:
        yield token.name
    finally:
        with contextlib.suppress(Exception):
            token.unlink()
            if not any(token.parent.iterdir()):
                token.parent.rmdir()
            if not was_there and not any(token.parent.parent.iterdir()):
                token.parent.parent.rmdir()


def stage(folder: Path, target: Path) -> None:
    """Makes a copy of a chunk's folder that stays as it is while training goes on: checkpoints as hard links.

    Raises:
      OSError: a checkpoint was removed meanwhile, for a newer one.
    """
    for root, folders, own in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".partial-")]
        place = target / Path(root).relative_to(folder)
        place.mkdir(parents=True, exist_ok=True)
        in_checkpoint = run_folder.CHECKPOINTS in Path(root).relative_to(folder).parts
        for name in own:
            if name == files.LOCK or name.endswith(".partial"):
                continue
            if in_checkpoint:
                os.link(Path(root, name), place / name)
            else:
                shutil.copy2(Path(root, name), place / name)
