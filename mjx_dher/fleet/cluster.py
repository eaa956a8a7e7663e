"""All that is asked of Ray: to join or start a cluster, to look at its nodes, and to run chunks as tasks."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mjx_dher.fleet import chunks, plan
from mjx_dher.fleet.chunks import Chunk, Told
from mjx_dher.fleet.plan import LOCAL, Kind, Node, Request
from mjx_dher.spec import RunSpec
from mjx_dher.system import subprocesses

RETRIES = 5  # of a chunk whose worker or node was lost
SECONDS_TO_ANSWER = 20.0  # that a cluster has
SECONDS_TO_LOOK = 180.0  # that nodes have to tell what they are; four on two busy cores needed more than 60
STORE_BYTES = 200 << 20  # of the object store of a cluster that is started here; what does not fit goes to the disk
# Parts of the folder with own code that no node needs, as .gitignore names them. The package is each node's own.
NOT_SENT = (
    "/mjx_dher",
    "/envs",
    ".git",
    "__pycache__",
    "/runs",
    "/sweeps",
    ".venv",
    "venv",
    ".caches",
    "*.npz",
    "*.mp4",
    "*.gif",
)

Work = Callable[[Chunk, Callable[[Told], bool]], list[bytes]]


class Flying(NamedTuple):
    """Chunk that was handed to Ray."""

    chunk: Chunk
    kind: Kind
    refs: list[Any]  # of its head, and of a parcel for each run


class Outcome(NamedTuple):
    """End of a chunk: its parcels, to be fetched one by one, or why there are none."""

    parcels: Iterator[bytes]
    lost: str | None = None  # the worker or the node was lost, more often than there are retries


class Board:
    """Actor that chunks tell their progress, and that tells them whether to stop. What it knows can be lost."""

    def __init__(self) -> None:
        self._stop = False
        self._told: dict[str, Told] = {}

    def tell(self, told: Told) -> bool:
        """Takes what a chunk tells; returns whether a stop is asked for."""
        before = self._told.get(told.chunk)
        self._told[told.chunk] = told if before is None else told._replace(lines=(*before.lines, *told.lines)[-20:])
        return self._stop

    def look(self, stop: bool) -> list[Told]:
        """Returns what was told since the last look; passes on whether a stop is asked for."""
        self._stop = stop
        told, self._told = list(self._told.values()), {}
        return told


@contextlib.contextmanager
def joined(request: Request, code: Path | None) -> Iterator[Cluster]:
    """Joins a cluster, or starts one on this machine, for as long as the block runs.

    Args:
      request: wishes of the user.
      code: folder with own code, which nodes get; None: there is none.

    Raises:
      ValueError: nobody answers at the address, this machine is no part of that cluster, versions of Ray or Python differ, or
        the code cannot be sent.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anyone
    if request.ray != LOCAL:
        _check_answers(request.ray)
    import ray

    runtime: dict[str, Any] = {} if code is None else {"working_dir": str(code), "excludes": list(NOT_SENT)}
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR, "runtime_env": runtime}
    if request.ray == LOCAL:
        options |= {"include_dashboard": False, "object_store_memory": STORE_BYTES}
    try:
        ray.init(address=request.ray, **options)
    except Exception as error:  # Ray raises errors of many kinds, and this is where a user's mistakes end up
        ray.shutdown()
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise ValueError(f"ray: the cluster at {request.ray} cannot be joined ({first})") from error
    try:
        yield Cluster()
    finally:
        ray.shutdown()


def _check_answers(address: str) -> None:
    """Raises ValueError unless the head of a cluster answers at an address, within seconds."""
    hint = "start one with `ray start --head`, and this machine's part of it with `ray start --address=HOST:PORT`"
    if address != "auto":
        host, _, port = address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=SECONDS_TO_ANSWER).close()
        except OSError as error:
            raise ValueError(f"ray: nobody answers at {address} ({error.strerror or error}); {hint}") from error
    arguments = [] if address == "auto" else ["--address", address]
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", *arguments]
    answer = subprocesses.ask(command, seconds=SECONDS_TO_ANSWER)
    if answer.failure is not None:
        where = "of which this machine is a part" if address == "auto" else f"whose head is {address}"
        raise ValueError(f"ray: there is no cluster {where} ({answer.failure}); {hint}")


class Cluster:
    """A cluster that this program has joined."""

    def __init__(self) -> None:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._ray, self._affinity = ray, NodeAffinitySchedulingStrategy
        here = self._affinity(ray.get_runtime_context().get_node_id(), soft=True)
        board = ray.remote(Board).options(num_cpus=0, max_restarts=-1, scheduling_strategy=here)
        self._board: Any = board.remote()
        self._tasks: dict[tuple[Kind, Work], Any] = {}

    def resources(self) -> dict[str, dict[str, float]]:
        """Returns the resources of each node that is alive, by its id."""
        return {node["NodeID"]: node["Resources"] for node in self._ray.nodes() if node["Alive"]}

    def inspect(self, ids: Sequence[str], specs: Sequence[RunSpec], storage: str | None, sweep: str, token: str) -> list[Node]:
        """Returns what there is on nodes, all at once.

        Raises:
          ValueError: a node has not this version of the package, or does not answer.
        """
        task, all_resources = self._ray.remote(chunks.inspect), self.resources()
        hosts = {node["NodeID"]: node["NodeManagerHostname"] for node in self._ray.nodes()}
        asked = {}
        for node in ids:
            options = {"num_cpus": 0, "max_retries": 1, "scheduling_strategy": self._affinity(node, soft=False)}
            asked[node] = task.options(**options).remote(node, all_resources[node], list(specs), storage, sweep, token)
        nodes = []
        for node, ref in asked.items():
            try:
                nodes.append(self._ray.get(ref, timeout=SECONDS_TO_LOOK))
            except (self._ray.exceptions.TaskUnschedulableError, self._ray.exceptions.NodeDiedError):
                continue  # the node has just gone
            except self._ray.exceptions.GetTimeoutError:
                raise ValueError(f"ray: node {hosts[node]} has not answered within {SECONDS_TO_LOOK:g} s") from None
            except self._ray.exceptions.RayError as error:
                raise ValueError(f"ray: node {hosts[node]} {_reason(error)}") from error
        if not nodes:
            raise ValueError("ray: the nodes of the cluster have gone while they were looked at; try again")
        return nodes

    def measure(self, node: Node, kind: Kind) -> float:
        """Returns how fast a slot of a node is; 0 where it is busy for longer than anyone waits."""
        strategy = self._affinity(node.id, soft=False)
        task = self._ray.remote(chunks.measure).options(**self._options(kind), scheduling_strategy=strategy)
        ref = task.remote()
        try:
            return float(self._ray.get(ref, timeout=SECONDS_TO_LOOK))
        except self._ray.exceptions.RayError:  # the time-out is one of them
            self._ray.cancel(ref, force=True)
            return 0.0

    def _options(self, kind: Kind) -> dict[str, Any]:
        """Returns what a task of a kind takes. Those on CPUs have processes of their own, whose JAX starts no GPU."""
        variables = {} if kind.gpus else {"JAX_PLATFORMS": "cpu"}
        calls = 1 if kind.gpus else 0  # a process gives a GPU's memory back when it ends; 0: processes are used again
        runtime = {"runtime_env": {"env_vars": variables}} if variables else {}
        return {"num_cpus": kind.cpus, "num_gpus": kind.gpus, "max_calls": calls, **runtime}

    def submit(self, chunk: Chunk, kind: Kind, work: Work) -> Flying:
        """Hands a chunk to Ray, which runs it where there is room, and again where a worker or a node is lost."""
        if (kind, work) not in self._tasks:
            options = {**self._options(kind), "max_retries": RETRIES}
            self._tasks[kind, work] = self._ray.remote(**options)(_run)
        task = self._tasks[kind, work].options(num_returns=1 + len(chunk.specs), name=f"chunk {chunk.id}")
        return Flying(chunk, kind, task.remote(chunk, work, self._board))

    def wait(self, flying: Sequence[Flying], seconds: float) -> list[Flying]:
        """Returns the chunks that have ended, or were lost, within so many seconds."""
        heads = {one.refs[0]: one for one in flying}
        ended, _ = self._ray.wait(list(heads), num_returns=len(heads), timeout=0)
        if not ended:
            ended, _ = self._ray.wait(list(heads), num_returns=1, timeout=seconds)
        return [heads[ref] for ref in ended]

    def collect(self, flying: Flying) -> Outcome:
        """Returns the parcels of a chunk that has ended.

        Raises:
          Exception: what its training has raised, as it would without Ray.
        """
        errors = self._ray.exceptions
        try:
            self._ray.get(flying.refs.pop(0))
            return Outcome(self._fetched(flying))
        except errors.TaskCancelledError:
            return Outcome(iter([b""] * len(flying.chunk.specs)))
        except errors.RayTaskError as error:
            cause = getattr(error, "cause", None)
            raise (cause if isinstance(cause, Exception) else error) from error
        except errors.RayError as error:
            return Outcome(iter(()), plan.failure_of(flying.chunk.id, error))

    def _fetched(self, flying: Flying) -> Iterator[bytes]:
        while flying.refs:
            yield self._ray.get(flying.refs.pop(0))  # one at a time, so that no more than one is held here

    def cancel(self, flying: Flying) -> None:
        """Takes back a chunk that has not begun."""
        self._ray.cancel(flying.refs[0], force=False)

    def look(self, stop: bool) -> list[Told]:
        """Returns what chunks have told; passes on whether a stop is asked for."""
        try:
            return list(self._ray.get(self._board.look.remote(stop), timeout=5))
        except self._ray.exceptions.RayError:  # it was lost, and is being made anew
            return []


def _reason(error: Exception) -> str:
    text = str(error)
    if "No module named 'mjx_dher" in text or ("mjx_dher" in text and "AttributeError" in text):
        return "has no mjx-dher, or another version of it: install the same version on every node"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return f"cannot be looked at ({lines[-1] if lines else type(error).__name__})"


def _run(chunk: Chunk, work: Work, board: Any) -> tuple[Any, ...]:
    """Trains a chunk in a worker of Ray's; returns its host and a parcel for each run."""
    import ray

    def tell(told: Told) -> bool:
        try:
            return bool(ray.get(board.tell.remote(told), timeout=5))
        except ray.exceptions.RayError:  # nobody listens; the training goes on
            return False

    if chunk.files != chunks.files_digest():  # a node that has come since the driver looked
        host, own = socket.gethostname(), chunks.files_digest()
        raise ValueError(f"ray: node {host} has files of mjx-dher with the digest {own}, and the driver {chunk.files}")
    if chunk.cores is not None:
        chunks.pin(chunk.cores)
    return (socket.gethostname(), *work(chunk, tell))
