"""A chunk, the runs of one task, on the node that trains it. Runs inside Ray's workers, and knows nothing of Ray.

A chunk is trained as a small sweep in a scratch folder of the node's own. Its runs come back as bytes. Where there is a
storage, each new checkpoint is copied there with all that belongs to it, beside the training.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import os
import platform
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from mjx_dher import __version__
from mjx_dher.fleet import parcels
from mjx_dher.fleet.parcels import Storage
from mjx_dher.fleet.plan import Node
from mjx_dher.runs.folder import fingerprint, results
from mjx_dher.runs.options import Options
from mjx_dher.runs.program.loop import Progress
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid, sweep
from mjx_dher.system import files
from mjx_dher.types import Env

SCRATCH = "mjx-dher-fleet-"
SECONDS_BETWEEN_WORDS = 1.0  # from a chunk to the driver
STALE = 3600.0  # s, after which a scratch folder that no program has is removed


class Chunk(NamedTuple):
    """Runs of one task."""

    id: str  # a digest of the names of its runs
    sweep: str  # id of the sweep
    specs: tuple[RunSpec, ...]
    options: Options
    lanes: int | None  # runs side by side, at most
    cores: int | None  # that it computes on, where they are fewer than the node's
    storage: str | None
    files: str  # digest of the driver's files of the package


class Told(NamedTuple):
    """What a chunk tells of an epoch."""

    chunk: str
    host: str
    env: str
    runs: int  # side by side
    epoch: int
    num_epochs: int
    done: float  # environment steps of the chunk so far, of all runs
    steps_per_second: float
    success: dict[str, float]  # mean success rate by sampler
    lines: tuple[str, ...]  # for the user


Tell = Callable[[Told], bool]  # returns whether a stop is asked for


def train(chunk: Chunk, make_env: Callable[[RunSpec], Env], tell: Tell) -> list[bytes]:
    """Trains a chunk, from the newest copy in the storage where there is one.

    Returns:
      A parcel for each run, as `parcels.pack` makes it; empty for a run that has not ended, because a stop was asked for.

    Raises:
      ValueError: as `train_runs`.
    """
    words = _Words(chunk, tell)
    with _scratch() as folder, contextlib.ExitStack() as stack:
        place = folder / "chunk"
        place.mkdir()
        storage = Storage(chunk.storage, chunk.sweep, chunk.id) if chunk.storage is not None else None
        if storage is not None:
            for text in storage.restore(place):
                words.report(text)
        mirror = stack.enter_context(Mirror(place, storage, words.report)) if storage is not None else None
        todo = [spec for spec in chunk.specs if not grid.is_done(place, spec)]
        if todo:
            sweep.run(
                place,
                todo,
                make_env,
                options=chunk.options,
                lanes=chunk.lanes,
                should_stop=words.is_stop_asked,
                report=words.report,
                on_epoch=words.on_epoch,
            )
        if mirror is not None:
            mirror.finish()
        folders = [grid.folder_of(place, spec) for spec in chunk.specs]
        return [parcels.pack(own) if results.is_whole(own) else b"" for own in folders]


@contextlib.contextmanager
def _scratch() -> Iterator[Path]:
    """Makes a folder of this node's own, and removes it at the end; with those that killed programs have left."""
    root = Path(tempfile.gettempdir())
    for left in root.glob(f"{SCRATCH}*"):
        with contextlib.suppress(OSError, ValueError):
            if left.stat().st_uid == os.getuid() and time.time() - left.stat().st_mtime > STALE:
                with files.lock(left):
                    shutil.rmtree(left)
    folder = Path(tempfile.mkdtemp(prefix=SCRATCH))
    try:
        with files.lock(folder):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class _Words:
    """What is told to the driver, now and then, and whether it asks for a stop."""

    def __init__(self, chunk: Chunk, tell: Tell):
        self._chunk, self._tell = chunk, tell
        self._host = socket.gethostname()
        self._lines: list[str] = []
        self._stop = False
        self._ended = 0.0  # environment steps of runs that were trained before those that are now
        self._last: Told | None = None
        self._present: Sequence[RunSpec] = ()
        self._told_at = 0.0

    def report(self, text: str) -> None:
        """Keeps a line for the driver; not those about compiling, which every chunk has."""
        if ": compil" not in text:
            self._lines.append(text)

    def on_epoch(self, specs: Sequence[RunSpec], progress: Progress) -> None:
        """Tells the driver of an epoch, at most once a second; of the last one always."""
        if list(specs) != list(self._present) and self._last is not None:
            self._ended = self._last.done
        self._present = specs
        rates: dict[str, list[float]] = {}
        success = progress.metrics["success_rate"]
        for lane, spec in enumerate(specs):
            rates.setdefault(spec.sampler, []).append(float(success[lane] if getattr(success, "ndim", 0) else success))
        self._last = Told(
            self._chunk.id,
            self._host,
            specs[0].env,
            len(specs),
            progress.epoch,
            progress.num_epochs,
            self._ended + len(specs) * progress.env_steps,
            len(specs) * progress.env_steps / progress.epoch / max(progress.epoch_seconds, 1e-9),
            {name: sum(own) / len(own) for name, own in rates.items()},
            (),
        )
        if progress.epoch == progress.num_epochs or time.monotonic() - self._told_at > SECONDS_BETWEEN_WORDS:
            self._say()

    def is_stop_asked(self) -> bool:
        """Returns whether the driver asks for a stop, as of its last answer."""
        return self._stop

    def _say(self) -> None:
        if self._last is not None:
            self._stop = self._tell(self._last._replace(lines=tuple(self._lines[:20])))
            self._lines.clear()
            self._told_at = time.monotonic()


class Mirror(threading.Thread):
    """Thread that copies a chunk's folder into the storage whenever it has a new checkpoint or a new result.

    Args:
      folder: of the chunk.
      storage: where to.
      report: called with a line about a copy that could not be made. The training goes on.
    """

    def __init__(self, folder: Path, storage: Storage, report: Callable[[str], None]):
        super().__init__(daemon=True)
        self._folder, self._storage, self._report = folder, storage, report
        self._ended = threading.Event()
        self._copied = self._state()

    def __enter__(self) -> Mirror:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self.join()

    def finish(self) -> None:
        """Ends the thread, with a last copy of what is there."""
        self._ended.set()
        self.join()
        self._copy()

    def run(self) -> None:
        """Looks for something new until the end."""
        while not self._ended.wait(0.2):
            self._copy()

    def _state(self) -> frozenset[str]:
        """Returns what is worth a copy: checkpoints and results, by name."""
        patterns = ("cells/*/checkpoints/epoch-*", "unfinished/*/checkpoints/epoch-*", "cells/*/result.json")
        return frozenset(str(path) for pattern in patterns for path in self._folder.glob(pattern))

    def _copy(self) -> None:
        state = self._state()
        if state <= self._copied:  # nothing is new; an old checkpoint may have gone
            return
        staged = self._folder.with_name("copy")
        try:
            shutil.rmtree(staged, ignore_errors=True)
            parcels.stage(self._folder, staged)
            self._storage.save(staged)
            self._copied = state
        except FileNotFoundError:
            return  # a checkpoint has just gone, for a newer one
        except Exception as error:  # clients of object stores raise errors of their own, of many kinds
            self._copied = state  # the next checkpoint is the next try
            self._report(f"a checkpoint could not be copied to the storage ({error})")
        finally:
            shutil.rmtree(staged, ignore_errors=True)


def versions() -> dict[str, str]:
    """Returns the versions that decide what a run computes; `files` is a digest of the package's own files."""
    libraries = {name: metadata.version(name) for name in ("jax", "jaxlib", "mujoco", "numpy")}
    return {"mjx_dher": __version__, "files": files_digest(), "python": platform.python_version(), **libraries}


@functools.cache
def files_digest() -> str:
    """Returns ten digits that stand for all files of the package that decide what it computes."""
    package = Path(files.__file__).parents[1]
    spec = importlib.util.find_spec("mjx_dher.envs")  # in the package, or beside it in a checkout
    envs = Path(spec.origin).parent if spec is not None and spec.origin else package / "envs"
    paths = {path.relative_to(package).as_posix(): path for path in package.rglob("*") if envs not in path.parents}
    paths |= {f"envs/{path.relative_to(envs).as_posix()}": path for path in envs.rglob("*")}
    digest = hashlib.sha256()
    for name, path in sorted(paths.items()):
        if path.suffix in (".py", ".cu", ".xml"):
            digest.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}".encode())
    return digest.hexdigest()[:10]


def inspect(
    node: str, resources: dict[str, float], specs: Sequence[RunSpec], storage: str | None, sweep_id: str, token: str
) -> Node:
    """Returns what there is on the node that this runs on; starts neither JAX nor the GPU.

    Args:
      node: its id.
      resources: its resources.
      specs: runs, one for each set of own code.
      storage: place to try; None: none.
      sweep_id: id of the sweep.
      token: what the driver has put there.
    """
    sources: dict[str, str] = {}
    for spec in specs:
        for field, source in fingerprint.sources(spec).items():
            sources[f"{field} {getattr(spec, field)}"] = source
    wrong = parcels.probe(storage, sweep_id, token) if storage is not None else None
    gpus = _gpus() if resources.get("GPU", 0) else []
    hardware = f"{', '.join(sorted({name for name, _ in gpus})) or _cpu_name()}"
    smallest = min((amount for _, amount in gpus), default=None)
    return Node(node, socket.gethostname(), versions(), sources, hardware, smallest, wrong, dict(resources))


def _gpus() -> list[tuple[str, int]]:
    """Returns name and bytes of memory of each GPU, as NVIDIA's driver tells; none where it does not."""
    command = ["nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader,nounits"]
    try:
        lines = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.splitlines()
        return [(line.rpartition(",")[0].strip(), int(line.rpartition(",")[2]) << 20) for line in lines if line.strip()]
    except (OSError, ValueError, subprocess.SubprocessError):
        return []


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
    return f"{model}, {os.cpu_count()} cores"


def measure() -> float:
    """Returns how fast JAX multiplies matrices here, in products of 256 x 256 a second: the best of three tries."""
    import jax
    import jax.numpy as jnp

    chain = jax.jit(lambda x: jax.lax.fori_loop(0, 200, lambda i, y: jnp.tanh(y @ x), x))
    matrices = jax.random.normal(jax.random.key(0), (16, 256, 256)) / 16
    jax.block_until_ready(chain(matrices))
    seconds = []
    for _ in range(3):
        started = time.perf_counter()
        jax.block_until_ready(chain(matrices))
        seconds.append(time.perf_counter() - started)
    return 16 * 200 / min(seconds)


def pin(cores: int) -> None:
    """Gives this process `cores` of the node's cores that no other process of a fleet has, as long as it runs.

    Call it before JAX starts its threads, of which it starts one for each core that it may use. Where all groups of cores are
    taken, or the system has no such thing, nothing happens.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    usable = sorted(os.sched_getaffinity(0))
    if cores >= len(usable):
        return
    for first in range(0, len(usable) - cores + 1, cores):
        group = Path(tempfile.gettempdir()) / f"mjx-dher-cores-{os.getuid()}" / f"{usable[first]}-{cores}"
        with contextlib.suppress(OSError, ValueError):
            group.mkdir(parents=True, exist_ok=True)
            _held.enter_context(files.lock(group))
            os.sched_setaffinity(0, usable[first : first + cores])
            return


_held = contextlib.ExitStack()  # locks of this process's cores, which the system releases when it ends
