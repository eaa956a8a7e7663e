"""A Ray cluster: joins or starts one, trains chunks as its tasks, and writes their runs into the sweep's folder."""

import contextlib
import logging
import os
import secrets
import shutil
import socket
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mjx_dher.fleet import chunks, worker
from mjx_dher.fleet.chunks import LOCAL, Chunk
from mjx_dher.fleet.worker import News, Tell
from mjx_dher.sweeps import grid
from mjx_dher.system import signals, subprocesses
from mjx_dher.system.files import BusyError
from mjx_dher.validation import host_and_port

RETRIES = 5  # for a chunk whose worker or node was lost
SECONDS_TO_ANSWER = 20.0  # for the head of a cluster
SECONDS_TO_WAIT = 0.5  # for a chunk to end, between checks for news
LONG_PATH = 27  # characters; in longer folders, paths of Ray's sockets exceed the system's limit of 107
STORE_BYTES = 200 << 20  # object store of a local cluster; the rest goes to disk
# Files next to custom code that no node needs, as in .gitignore. Each node has its own package.
NOT_SENT = ["/mjx_dher", "/envs", ".git", "__pycache__", "/runs", "/sweeps", ".venv", "venv", ".caches"]
NOT_SENT += ["*.npz", "*.mp4", "*.gif", "checkpoints"]

Work = Callable[[Chunk, Tell], list[bytes]]


class Running(NamedTuple):
    """A chunk that Ray runs or will run."""

    chunk: Chunk
    ref: Any


class LostError(Exception):
    """The worker or node of a chunk was lost more often than it is retried."""


class Board:
    """Actor that passes news from chunks to the driver, and requests to stop to the chunks."""

    def __init__(self) -> None:
        self._stop = False
        self._news: dict[str, News] = {}

    def tell(self, news: News) -> bool:
        """Takes news of a chunk. Returns True if it should stop."""
        before = self._news.get(news.chunk)
        self._news[news.chunk] = news if before is None else news._replace(lines=(*before.lines, *news.lines)[-20:])
        return self._stop

    def look(self, stop: bool) -> list[News]:
        """News since the last call. Passes on whether to stop."""
        self._stop = stop
        news, self._news = list(self._news.values()), {}
        return news


@contextlib.contextmanager
def joined(address: str, code: Path | None) -> Iterator["Cluster"]:
    """Joins a cluster (auto or HOST:PORT), or starts one on this machine (local), for the duration of the block.

    `code` is a folder with custom code, which is sent to the nodes. Raises ValueError if there is no such cluster, this machine
    does not belong to it, or the code cannot be sent.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    options: dict[str, Any] = {"runtime_env": {} if code is None else {"working_dir": str(code), "excludes": NOT_SENT}}
    started: list[int] = []  # Ray's processes, whose workers outlive them by seconds
    with contextlib.ExitStack() as stack:
        if address == LOCAL:
            parent = os.environ.get("RAY_TMPDIR", tempfile.gettempdir())
            parent = parent if len(parent) < LONG_PATH else "/tmp"
            private = stack.enter_context(subprocesses.temporary_folder("ray-", parent))
            stack.enter_context(signals.cleaning(lambda: subprocesses.kill_sessions(started)))
            place = f"{private}/ray"  # inside a private folder, because Ray opens its folder to all users
            options |= {"include_dashboard": False, "object_store_memory": STORE_BYTES, "_temp_dir": place}
            # Ray then listens only on 127.0.0.1, and only processes with this token can call it.
            os.environ.update({"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "token"})
            os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
        else:
            _check_answers(address)
        import ray

        stack.callback(ray.shutdown)
        try:
            with _sessions_of_their_own():
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **options)
        except Exception as error:  # Ray raises many kinds of errors
            raise ValueError(f"ray: the cluster at {address} cannot be joined ({_first_line(error)})") from error
        started.extend(subprocesses.leaders() if address == LOCAL else ())
        signals.take_back()
        yield Cluster()


@contextlib.contextmanager
def _sessions_of_their_own() -> Iterator[None]:
    """Starts processes in their own sessions during the block, so that signals to this group do not reach them."""
    _starting.append(True)
    try:
        yield
    finally:
        _starting.clear()


_starting: list[bool] = []
os.register_at_fork(after_in_child=lambda: os.setsid() if _starting else None)


def _check_answers(address: str) -> None:
    """Raises ValueError unless the head of a cluster answers at an address within seconds."""
    where = [] if address == "auto" else ["--address", address]
    failure = None
    if where:
        try:
            socket.create_connection(host_and_port("ray", address), timeout=SECONDS_TO_ANSWER).close()
        except OSError as error:
            failure = error.strerror or str(error)
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", *where]
    failure = failure or subprocesses.ask(command, seconds=SECONDS_TO_ANSWER).failure
    if failure is not None:
        hint = "start one with `ray start --head`, and this machine's part of it with `ray start --address=HOST:PORT`"
        raise ValueError(f"ray: no cluster answers at {address} ({failure}); {hint}")


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


class Cluster:
    """A joined cluster."""

    def __init__(self) -> None:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._ray = ray
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        self._board: Any = ray.remote(Board).options(num_cpus=0, max_restarts=-1, scheduling_strategy=here).remote()

    def resources(self) -> list[dict[str, float]]:
        return [node["Resources"] for node in self._ray.nodes() if node["Alive"]]

    def submit(self, chunk: Chunk, work: Work) -> Running:
        """Submits a chunk to Ray, which runs it when a node has room, and again if a worker or node is lost."""
        task = chunk.task
        options: dict[str, Any] = {"num_cpus": task.cpus, "num_gpus": task.gpus, "max_retries": RETRIES}
        if task.gpus:
            options["max_calls"] = 1  # a process releases a GPU's memory when it ends
        else:
            options["runtime_env"] = {"env_vars": {"JAX_PLATFORMS": "cpu"}}
        remote = self._ray.remote(_run).options(name=f"chunk {chunk.id}", **options)
        return Running(chunk, remote.remote(chunk, work, self._board))

    def wait(self, running: Sequence[Running], seconds: float) -> list[Running]:
        by_ref = {one.ref: one for one in running}
        ended, _ = self._ray.wait(list(by_ref), num_returns=1, timeout=seconds)
        return [by_ref[ref] for ref in ended]

    def result(self, running: Running) -> list[bytes]:
        """Runs of an ended chunk, from `worker.train`. Empty if it was cancelled. Raises LostError if its worker or node was
        lost too often, and errors of its training.
        """
        errors = self._ray.exceptions
        try:
            return list(self._ray.get(running.ref))
        except errors.TaskCancelledError:
            return []
        except errors.RayTaskError as error:
            cause = getattr(error, "cause", None)
            if isinstance(cause, (ImportError, AttributeError)) and "mjx_dher" in str(cause):
                raise ValueError(
                    f"ray: a node has another version of mjx-dher ({cause}); install the same on every node"
                ) from error
            raise (cause if isinstance(cause, Exception) else error) from error
        except errors.RayError as error:
            raise LostError(f"{running.chunk.id}: {_first_line(error)}") from error

    def cancel(self, running: Running) -> None:
        self._ray.cancel(running.ref, force=False)

    def look(self, stop: bool) -> list[News]:
        """News of chunks. Passes on whether to stop."""
        try:
            return list(self._ray.get(self._board.look.remote(stop), timeout=3))
        except self._ray.exceptions.RayError:  # the actor is restarting
            return []


def _run(chunk: Chunk, work: Work, board: Any) -> list[bytes]:
    import ray

    def tell(news: News) -> bool:
        try:
            return bool(ray.get(board.tell.remote(news), timeout=5))
        except ray.exceptions.RayError:  # nobody listens; training continues
            return False

    if not chunk.task.gpus:
        worker.pin(chunk.task.cpus)
    return work(chunk, tell)


class State(NamedTuple):
    """Progress of the sweep."""

    ended: int  # runs ended since this start
    running: frozenset[str]  # submitted chunks
    slots: int  # current number of parallel chunks
    news: Sequence[News]  # since the last state


def train(
    cluster: Cluster,
    folder: Path,
    parts: Sequence[Chunk],
    work: Work,
    report: Callable[[str], None],
    show: Callable[[State], None],
    should_stop: Callable[[], bool],
) -> list[str]:
    """Trains the chunks of a sweep in `folder`. Returns one line per chunk that was lost for good.

    Slightly more chunks than slots are submitted, for clusters that grow on demand. A lost chunk is trained again from its
    checkpoints in the storage, or without storage from the start. Errors of the training are raised again. Runs that have ended
    by then are written.
    """
    waiting, running, begun = deque(parts), list[Running](), set[str]()
    lost: list[str] = []
    ended, stopping = 0, False
    while running or (waiting and not stopping):
        slots = sum(map(parts[0].task.slots, cluster.resources()))
        while waiting and not stopping and len(running) < slots + 2:
            chunks.make_folder(waiting[0])
            running.append(cluster.submit(waiting.popleft(), work))
        for one in cluster.wait(running, SECONDS_TO_WAIT):
            running.remove(one)
            try:
                ended += _deliver(folder, one.chunk, cluster.result(one), report)
            except LostError as error:
                lost.append(str(error))
        news = cluster.look(stopping)
        begun |= {one.chunk for one in news}
        for line in (f"{one.host}: {line}" for one in news for line in one.lines):
            report(line)
        show(State(ended, frozenset(one.chunk.id for one in running), slots, news))
        if not stopping and should_stop():
            stopping = True
            for one in running:
                if one.chunk.id not in begun:  # it may be compiling, which need not be awaited
                    cluster.cancel(one)
            running = [one for one in running if one.chunk.id in begun]
    return lost


def _deliver(folder: Path, chunk: Chunk, parcels: Sequence[bytes], report: Callable[[str], None]) -> int:
    """Writes the ended runs of a chunk, and removes its checkpoints if all have ended. Returns the number of new ones."""
    ended = new = 0
    for spec, parcel in zip(chunk.specs, parcels):
        place = grid.folder_of(folder, spec)
        try:
            if parcel:
                new += worker.unpack(place, spec, parcel)
                ended += 1
        except BusyError as error:  # a process without Ray trains it
            report(f"{place} was not written: {error}")
    if ended == len(chunk.specs) and chunk.storage is not None:
        shutil.rmtree(chunk.storage, ignore_errors=True)
    return new
