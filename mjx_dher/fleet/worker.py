"""Trains a chunk on a node, inside Ray's workers, and converts its run folders to bytes and back. Independent of Ray.

A chunk is trained as a small sweep, in its folder of the storage or in a temporary folder of the node.
"""

import contextlib
import io
import os
import shutil
import socket
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_dher.fleet import chunks
from mjx_dher.fleet.chunks import Chunk
from mjx_dher.runs.folder import results, run_folder
from mjx_dher.runs.loop import Progress
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid
from mjx_dher.system import files, subprocesses
from mjx_dher.system.files import FolderError
from mjx_dher.types import Env

SECONDS_BETWEEN_NEWS = 1.0


class News(NamedTuple):
    """Progress of a chunk."""

    chunk: str
    host: str
    steps: float  # environment steps of all its runs so far
    steps_per_second: float
    success: dict[str, float]  # mean success rate by sampler
    lines: tuple[str, ...]  # for the user


Tell = Callable[[News], bool]  # returns True to stop


def train(chunk: Chunk, make_env: Callable[[RunSpec], Env], tell: Tell) -> list[bytes]:
    """Trains a chunk, from the checkpoints in the storage if there are any. `tell` reports progress, and returns True to stop.

    Returns each run folder as bytes from `pack`, or empty bytes if a run was stopped. Raises ValueError as `train_runs` does,
    or if this node has other code or storage than the driver.
    """
    here = chunks.code_of(chunk.specs)
    names = {**chunk.code, **here}
    wrong = [f"{x} is {here.get(x)}, not {chunk.code.get(x)}" for x in names if here.get(x) != chunk.code.get(x)]
    if wrong:
        raise ValueError(f"ray: node {socket.gethostname()} must have the driver's code: {'; '.join(wrong)}")
    reporter = _Reporter(chunk.id, tell)
    with contextlib.ExitStack() as stack:
        place = chunk.storage or stack.enter_context(subprocesses.temporary_folder("mjx-dher-fleet-"))
        if chunk.storage is not None and not (place / chunks.NAMES_FILE).exists():
            raise ValueError(f"storage must be one folder for all nodes; node {socket.gethostname()} does not see {place}")
        if todo := [spec for spec in chunk.specs if not grid.is_done(place, spec)]:
            grid.train(
                place,
                todo,
                make_env,
                options=chunk.options,
                lanes=chunk.lanes,
                should_stop=lambda: reporter.stop,
                report=reporter.add_line,
                on_epoch=reporter.on_epoch,
            )
        return [pack(grid.folder_of(place, spec)) if grid.is_done(place, spec) else b"" for spec in chunk.specs]


class _Reporter:
    """Reports epochs to the driver, at most once a second, and receives requests to stop."""

    def __init__(self, chunk: str, tell: Tell):
        self.stop = False
        self._chunk, self._tell, self._lines = chunk, tell, list[str]()
        self._present: Sequence[RunSpec] = ()
        self._ended = self._steps = self._told_at = 0.0  # steps of earlier runs, and of the current ones

    def add_line(self, text: str) -> None:
        """Adds a line for the user, unless it is about compiling, which every chunk does."""
        if ": compil" not in text:
            self._lines.append(text)

    def on_epoch(self, specs: Sequence[RunSpec], progress: Progress) -> None:
        """Reports an epoch. The last one is always reported."""
        if list(specs) != list(self._present):
            self._present, self._ended = specs, self._ended + self._steps
        self._steps = len(specs) * progress.env_steps
        if progress.epoch < progress.num_epochs and time.monotonic() - self._told_at < SECONDS_BETWEEN_NEWS:
            return
        rates: dict[str, list[float]] = {}
        for spec, rate in zip(specs, np.atleast_1d(progress.metrics["success_rate"])):
            rates.setdefault(spec.sampler, []).append(float(rate))
        speed = self._steps / progress.epoch / max(progress.epoch_seconds, 1e-9)
        success = {name: sum(own) / len(own) for name, own in rates.items()}
        host, lines = socket.gethostname(), tuple(self._lines[:20])
        self.stop = self._tell(News(self._chunk, host, self._ended + self._steps, speed, success, lines))
        self._lines.clear()
        self._told_at = time.monotonic()


def pin(cores: int) -> None:
    """Restricts this process to `cores` of the node's cores that no other task uses.

    Call it before JAX starts its threads, one per core. Does nothing without free cores.
    """
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else []
    for first in range(0, len(usable) - cores + 1, cores) if cores < len(usable) else ():
        group = Path(tempfile.gettempdir()) / f"mjx-dher-cores-{os.getuid()}" / f"{usable[first]}-{cores}"
        with contextlib.suppress(OSError, ValueError):
            group.mkdir(parents=True, exist_ok=True)
            _held.enter_context(files.lock(group))
            os.sched_setaffinity(0, usable[first : first + cores])
            return


_held = contextlib.ExitStack()  # locks of this process's cores, released when it ends


def pack(folder: Path) -> bytes:
    """A run folder as bytes: all files except its lock and checkpoints."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in files.inside(folder, folder.rglob("*")):
            name = path.relative_to(folder)
            if path.is_file() and name.parts[0] != run_folder.CHECKPOINTS and not files.is_lock(path):
                entry = zipfile.ZipInfo(name.as_posix())  # without a time, so that equal runs give equal bytes
                archive.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED, compresslevel=1)
    return buffer.getvalue()


def unpack(folder: Path, spec: RunSpec, parcel: bytes) -> bool:
    """Writes an ended trial into its folder, result.json last, so that the run is complete or not ended.

    An ended run that is already there stays unchanged, and the result is False. Raises FolderError if another process uses the
    folder, it is not writable, or the bytes are not this complete trial.
    """
    try:
        files.make_folder(folder)
        with files.lock(folder), zipfile.ZipFile(io.BytesIO(parcel)) as archive:
            if results.is_done(folder, spec):
                return False
            content = {name: archive.read(name) for name in archive.namelist()}  # checks their checksums
            (folder / run_folder.RESULT_FILE).unlink(missing_ok=True)
            for path in folder.iterdir():  # left by a run without Ray, or by a killed driver
                if not files.is_lock(path):
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            archive.extractall(folder, [name for name in content if name != run_folder.RESULT_FILE])
            files.flush_all(folder)
            files.write(folder / run_folder.RESULT_FILE, content[run_folder.RESULT_FILE])
    except OSError as error:
        raise FolderError(f"{folder} cannot be written to ({error.strerror or error}); run the same command again") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, KeyError, NotImplementedError, RuntimeError) as error:
        raise FolderError(f"{folder}: the returned run is damaged ({error})") from error
    if (problem := results.trial_problem(folder, spec)) is not None:
        raise FolderError(f"the returned run is damaged: {problem}")
    return True
