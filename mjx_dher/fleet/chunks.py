"""Options of a sweep on a Ray cluster, and its chunks: runs of a task, resources and code. Loads neither Ray nor JAX."""

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mjx_dher import __version__, import_paths
from mjx_dher.lookup import require_extra
from mjx_dher.runs.folder import fingerprint
from mjx_dher.spec import Options, RunSpec, custom_components
from mjx_dher.sweeps import grid
from mjx_dher.system import files
from mjx_dher.validation import check_count, host_and_port

LOCAL = "local"
NAMES_FILE = "chunk.json"  # names of a chunk's runs, in its folder of the storage
MOST_RUNS = {"gpu": 64, "cpu": 8}  # per chunk, to limit the cost of a lost node


@dataclasses.dataclass(frozen=True)
class FleetOptions:
    """Options of a sweep on a Ray cluster."""

    ray: str | None = None
    """Train on a Ray cluster: local (all GPUs or cores of this machine), auto (this machine's cluster) or HOST:PORT of a
    cluster's head (docs/scaling.md). Needs the extra ray."""
    ray_cpus: int | None = None
    """Train on CPUs with this many cores per task. Default: one GPU per task, or all cores of a node without GPUs."""
    ray_chunk: int | None = None
    """Runs per task. Default: as many as keep the whole cluster busy."""
    storage: Path | None = None
    """Folder shared by all nodes, for checkpoints. A lost node then costs at most one interval."""

    def check(self) -> None:
        """Raises ValueError for an invalid option, before Ray is loaded."""
        if self.ray is None:
            for name in ("ray_cpus", "ray_chunk", "storage"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name} needs --ray local, auto or HOST:PORT; got {getattr(self, name)} without it")
            return
        if self.ray not in (LOCAL, "auto"):
            host_and_port("ray", self.ray, "local, auto (this machine's cluster), or HOST:PORT of a head")
        for name in ("ray_cpus", "ray_chunk"):
            if getattr(self, name) is not None:
                check_count(name, getattr(self, name))
        if self.storage is not None:
            is_url = ":" in str(self.storage).partition("/")[0]
            if is_url or (self.storage.exists() and not self.storage.is_dir()):
                raise ValueError(f"storage must be a folder; got {str(self.storage)!r}")
        require_extra("--ray", "ray", "ray")


class Task(NamedTuple):
    """Resources of a task on a node."""

    gpus: int
    cpus: int

    def slots(self, resources: Mapping[str, float]) -> int:
        """Number of tasks that fit on a node with these resources."""
        by_cpus = int(resources.get("CPU", 0) // self.cpus) if self.cpus else 1 << 20
        return min(by_cpus, int(resources.get("GPU", 0) // self.gpus)) if self.gpus else by_cpus


class Chunk(NamedTuple):
    """Runs of one task."""

    id: str  # digest of the names of its runs
    specs: tuple[RunSpec, ...]
    options: Options
    lanes: int | None  # most parallel runs
    task: Task
    storage: Path | None  # the chunk's folder, shared by all nodes
    code: dict[str, str]  # the driver's `code_of`


def task_of(cpus: int | None, nodes: Sequence[Mapping[str, float]]) -> Task:
    """Resources of a task: one GPU if there are any, else `cpus` or a node's cores. Raises ValueError if no node has them."""
    cores = [int(node["CPU"]) for node in nodes if node.get("CPU", 0) >= 1]
    if cpus is None and any(node.get("GPU", 0) >= 1 for node in nodes):
        task = Task(1, 1 if cores else 0)
    else:
        task = Task(0, cpus or min(cores, default=1))
    if not any(map(task.slots, nodes)):
        have = "; ".join(f"{int(node.get('CPU', 0))} CPUs, {int(node.get('GPU', 0))} GPUs" for node in nodes)
        raise ValueError(f"ray: no node has {task.gpus} GPUs and {task.cpus} CPUs for a task; nodes have {have or 'nothing'}")
    return task


def split(specs: Sequence[RunSpec], task: Task, slots: int, lanes: int | None, size: int | None) -> list[tuple[RunSpec, ...]]:
    """Splits runs, grouped by program, into chunks of equal size, so that all slots are busy until the end.

    A chunk has `size` runs, by default as many as fill the cluster's parallel `slots`, and trains at most `lanes` at once.
    """
    chunks: list[tuple[RunSpec, ...]] = []
    most = (lanes or MOST_RUNS["gpu"]) if task.gpus else MOST_RUNS["cpu"] * (lanes or 1)
    for group in grid.by_program(specs):
        share = math.ceil(len(group) / max(1, slots))
        own = size or math.ceil(share / math.ceil(share / most))
        chunks += [tuple(group[start : start + own]) for start in range(0, len(group), own)]
    return chunks


def unfinished(storage: Path | None, specs: Sequence[RunSpec], todo: Sequence[RunSpec]) -> list[tuple[RunSpec, ...]]:
    """Chunks that an earlier driver left in the storage. They stay together, because their runs share checkpoints."""
    by_name, waiting = {fingerprint.trial_name(spec): spec for spec in specs}, set(todo)
    stored = []
    for path in sorted(storage.glob(f"*/{NAMES_FILE}")) if storage is not None else ():
        with contextlib.suppress(OSError, ValueError, TypeError):  # if damaged, its runs start over
            chunk = tuple(by_name[name] for name in files.read_json(path) if name in by_name)
            stored.append(chunk)
    earlier, taken = [], set[RunSpec]()
    for chunk in sorted(stored, key=len, reverse=True):  # sweeps of other sizes may have left the same run in two
        if waiting & set(chunk) and taken.isdisjoint(chunk):
            earlier.append(chunk)
            taken |= set(chunk)
    return earlier


def make(
    specs: tuple[RunSpec, ...], options: Options, lanes: int | None, task: Task, storage: Path | None, code: dict[str, str]
) -> Chunk:
    """Makes a chunk, whose folder will be in the storage."""
    own = fingerprint.sha256_of([fingerprint.trial_name(spec) for spec in specs])[:16]
    return Chunk(own, specs, options, lanes, task, None if storage is None else storage / own, code)


def make_folder(chunk: Chunk) -> None:
    """Makes the folder of a chunk, if it has one, with the names of its runs for `unfinished`."""
    if chunk.storage is not None:
        files.make_folder(chunk.storage)
        names = [fingerprint.trial_name(spec) for spec in chunk.specs]
        files.write(chunk.storage / NAMES_FILE, json.dumps(names).encode())


def clear(storage: Path, sweep: Path) -> None:
    """Removes the chunks in a storage whose runs have all ended in the sweep, and the storage if nothing is left in it."""
    from mjx_dher.runs.folder import lane_checkpoints  # loads JAX

    lane_checkpoints.remove_ended(storage, NAMES_FILE, sweep / grid.CELLS)


def code_of(specs: Sequence[RunSpec]) -> dict[str, str]:
    """Versions and digests of the code behind the runs: the package, and files of custom components."""
    own = {f"{field} {getattr(run, field)}": text for run in specs for field, text in fingerprint.sources(run).items()}
    flags = {name: str(value) for name, value in fingerprint.jax_flags().items()}
    return {"version of mjx_dher": __version__, "files of mjx_dher": _files_digest(), **flags, **own}


@functools.cache
def _files_digest() -> str:
    """Digest of the package's files that affect a run's result."""
    package, digest = Path(files.__file__).parents[1], hashlib.sha256()
    paths = {
        os.path.relpath(os.path.join(root, name), package): Path(root, name)
        for root, _, names in os.walk(package, followlinks=True)  # mjx_dher/envs is a link in a checkout
        for name in names
        if name.endswith((".py", ".cu", ".xml"))
    }
    for name, path in sorted(paths.items()):
        digest.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}".encode())
    return digest.hexdigest()[:10]


def custom_code(specs: Sequence[RunSpec]) -> Path | None:
    """Folder from which custom components are imported, and which nodes need, or None if all are installed. Raises ValueError
    if there is more than one folder.
    """
    roots: dict[Path, str] = {}
    for spec in specs:
        for field in custom_components(spec):
            value = str(getattr(spec, field))
            module = import_paths.find_module(value.partition(":")[0].partition(".")[0])
            if module is not None:
                place = Path([*(module.submodule_search_locations or ()), module.origin or ""][0]).absolute()
                if not {"site-packages", "dist-packages"} & set(place.parts):
                    roots.setdefault(place.parent, f"{field} {value} in {place.parent}")
    if len(roots) > 1:
        raise ValueError(f"ray: custom code must lie in one folder, or be installed; got {'; '.join(roots.values())}")
    return next(iter(roots), None)
