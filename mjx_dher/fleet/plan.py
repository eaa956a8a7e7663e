"""What a fleet is asked for, what its nodes have, and how many runs a task takes. Loads neither Ray nor JAX."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mjx_dher import lookup
from mjx_dher.config import check_count
from mjx_dher.system.files import FolderError

LOCAL = "local"
PLACES = ("auto", "gpu", "cpu", "both")
REMOTE = ("gs://", "s3://", "az://")  # what etils reads through fsspec
# Runs that a task on a CPU trains one after the other: they share one compilation, and are what a lost node costs.
TURNS = 8


class Request(NamedTuple):
    """Wishes of the command line."""

    ray: str  # local, auto or HOST:PORT
    on: str = "auto"  # one of PLACES
    cpus: int | None = None  # cores of a task on a CPU
    chunk: int | None = None  # runs of a task
    storage: str | None = None  # folder for checkpoints that all nodes see


class Kind(NamedTuple):
    """Kind of task by what it takes of a node."""

    name: str  # gpu or cpu
    gpus: int
    cpus: int

    def slots(self, resources: Mapping[str, float]) -> int:
        """Returns how many of these tasks a node with such resources takes at once."""
        by_cpus = int(resources.get("CPU", 0) // self.cpus) if self.cpus else 1 << 20
        return min(by_cpus, int(resources.get("GPU", 0) // self.gpus)) if self.gpus else by_cpus


class Node(NamedTuple):
    """Node of the cluster, as a task on it saw it."""

    id: str
    host: str
    versions: dict[str, str]  # of the package, of its files, of libraries
    sources: dict[str, str]  # own code, as `identity.sources` gives it
    hardware: str  # names of its processors; nodes with other ones differ in speed
    gpu_bytes: int | None  # memory of its smallest GPU
    storage: str | None  # what is wrong with the storage there; None: nothing
    resources: dict[str, float]
    speed: float = 1.0  # of its slots, beside one another


def check(request: Request) -> None:
    """Refuses wishes that cannot be met, before Ray is loaded.

    Raises:
      ValueError: names the option, and what is allowed.
    """
    if request.ray not in (LOCAL, "auto"):
        host, _, port = request.ray.rpartition(":")
        if "://" in request.ray or not host or not (port.isdecimal() and 0 < int(port) < 65536):
            raise ValueError(
                "ray must be local (this machine), auto (the cluster that this machine is part of), or HOST:PORT of that"
                f" cluster's head; got {request.ray!r}"
            )
    lookup.check_name("ray_on", request.on, PLACES)
    for field, value in (("ray_cpus", request.cpus), ("ray_chunk", request.chunk)):
        if value is not None:
            check_count(field, value)
    if request.cpus is not None and request.on == "gpu":
        raise ValueError("ray_cpus is for tasks on CPUs: it goes with --ray-on cpu, both or auto; got --ray-on gpu")
    if request.storage is not None:
        _check_storage(request.storage)
    lookup.require_extra("--ray", "ray", "ray")


def _check_storage(storage: str) -> None:
    if not storage or ("://" in storage and not storage.startswith(REMOTE)) or "\0" in storage:
        raise ValueError(f"storage must be a folder, or begin with {', '.join(REMOTE)}; got {storage!r}")
    if storage.startswith(REMOTE) and not re.match(r"\w+://[^/]+", storage):
        raise ValueError(f"storage must name a bucket, such as gs://bucket/folder; got {storage!r}")
    path = Path(storage)
    if not storage.startswith(REMOTE) and (path.is_symlink() or path.exists()) and not path.is_dir():
        raise FolderError(f"storage: {storage} is there already and is no folder")


def storage_of(request: Request, out: Path) -> str | None:
    """Returns where checkpoints go: where the user says, on this machine alone into the sweep's folder, else nowhere."""
    if request.storage is None:
        return str(out.absolute() / "unfinished") if request.ray == LOCAL else None
    return request.storage if request.storage.startswith(REMOTE) else os.path.abspath(request.storage)


def kinds_of(request: Request, resources: Sequence[Mapping[str, float]], engine: str) -> list[Kind]:
    """Returns the kinds of task for a cluster whose nodes have these resources.

    Raises:
      ValueError: no node has what is asked for, or CPUs and GPUs would train with different engines.
    """
    gpus = sum(int(node.get("GPU", 0)) for node in resources)
    cores = [int(node.get("CPU", 0)) for node in resources if node.get("CPU", 0) >= 1]
    wants_cpu = request.on in ("cpu", "both") or (request.on == "auto" and (request.cpus is not None or not gpus))
    wants_gpu = request.on in ("gpu", "both") or (request.on == "auto" and not wants_cpu)
    kinds = [Kind("gpu", 1, 1 if cores else 0)] if wants_gpu else []
    if wants_cpu:
        kinds.append(Kind("cpu", 0, request.cpus or min(cores, default=1)))
    for kind in kinds:
        if not any(kind.slots(node) for node in resources):
            asked = "a GPU" if kind.gpus else f"{kind.cpus} CPUs (ray_cpus)"
            have = "; ".join(f"{int(node.get('CPU', 0))} CPUs, {int(node.get('GPU', 0))} GPUs" for node in resources)
            raise ValueError(f"ray: no node of the cluster has {asked} for a task; its nodes have {have or 'nothing'}")
    if len(kinds) > 1 and engine == "auto":
        raise ValueError("ray_on both: CPUs and GPUs would train with different engines; name one, --engine native or jax")
    return kinds


def problems(nodes: Sequence[Node], versions: Mapping[str, str], sources: Mapping[str, str]) -> list[str]:
    """Returns what is wrong with nodes: another version of the package, other own code, storage that is not theirs."""
    told = []
    for node in nodes:
        for name in ("mjx_dher", "files"):
            if node.versions.get(name) != versions[name]:
                what = "mjx-dher" if name == "mjx_dher" else "files of mjx-dher with the digest"
                have, own = node.versions.get(name, "none"), versions[name]
                hint = "install the same version on every node"
                told.append(f"ray: node {node.host} has {what} {have}, and this machine {own}: {hint}")
                break
        for field, source in sources.items():
            if node.sources.get(field) != source:
                own = node.sources.get(field, "no such module")
                told.append(f"{field}: node {node.host} has {own} where this machine has {source}")
        if node.storage is not None:
            told.append(f"storage: node {node.host}: {node.storage}")
    return list(dict.fromkeys(told))


def other_libraries(nodes: Sequence[Node], versions: Mapping[str, str]) -> list[str]:
    """Returns a line for each library that nodes have in another version than this machine; results then agree to rounding."""
    lines = []
    for name in sorted(set(versions) - {"mjx_dher", "files"}):
        others = {node.versions.get(name) for node in nodes} - {versions[name]}
        if others:
            lines.append(f"{name} is {versions[name]} here and {', '.join(sorted(map(str, others)))} on other nodes")
    return lines


def speeds(nodes: Sequence[Node], kind: Kind) -> list[float]:
    """Returns the speed of each slot of a kind."""
    return [node.speed for node in nodes for _ in range(kind.slots(node.resources))]


def lanes_that_fit(nodes: Sequence[Node], ring_bytes: int) -> int | None:
    """Returns how many runs' replay rings half of the smallest GPU's memory holds; None where that memory is not known.

    The other half is for what an epoch computes with. A task whose program takes more trains its runs in turns.
    """
    known = [node.gpu_bytes for node in nodes if node.gpu_bytes]
    return max(1, int(min(known) / 2 / max(1, ring_bytes))) if known else None


def chunk_size(runs: int, slot_speeds: Sequence[float], most: int | None) -> int:
    """Returns how many runs a task takes, so that all slots have work until the end.

    The slowest slot takes one task in the time in which a slot twice as fast takes two. All tasks are of one size, because
    each number of lanes is a program of its own.

    Args:
      runs: that are to be trained, at least 1.
      slot_speeds: of each slot; not empty.
      most: runs of a task, at most; None: no limit.
    """
    share = math.ceil(runs * min(slot_speeds) / sum(slot_speeds) - 1e-9)
    return share if most is None or share <= most else math.ceil(share / math.ceil(share / most))


def most_of(kind: Kind, request: Request, lanes: int | None, fitting: int | None) -> int | None:
    """Returns how many runs a task of a kind takes at most: by memory and --lanes on a GPU, a few in turn on a CPU."""
    if not kind.gpus:
        return TURNS * (lanes or 1)
    limits = [number for number in (lanes, fitting) if number is not None]
    return min(limits) if limits else None


def describe(nodes: Sequence[Node], kinds: Sequence[Kind]) -> str:
    """Returns a line about the cluster: "4 nodes, 4 tasks at once of 1 CPU each"."""
    told = []
    for kind in kinds:
        slots = sum(kind.slots(node.resources) for node in nodes)
        takes = "a GPU" if kind.gpus else f"{kind.cpus} {'CPU' if kind.cpus == 1 else 'CPUs'}"
        told.append(f"{slots} {'task' if slots == 1 else 'tasks'} at once with {takes} each")
    return f"{len(nodes)} {'node' if len(nodes) == 1 else 'nodes'}: {', '.join(told)}"


def failure_of(name: str, error: Any) -> str:
    """Returns why a chunk was lost, for a reader: the first sentence of what Ray says of it."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{name}: {lines[0] if lines else 'no reason given'}"
