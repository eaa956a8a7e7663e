"""Driver of a sweep on a cluster: submits chunks, and writes returned runs into the sweep's folder."""

import dataclasses
import shutil
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mjx_dher.fleet import chunks, worker
from mjx_dher.fleet.chunks import Chunk, Task
from mjx_dher.fleet.cluster import LostError, Running, Work
from mjx_dher.fleet.worker import News
from mjx_dher.spec import Options, RunSpec
from mjx_dher.sweeps import grid
from mjx_dher.system.files import BusyError

SECONDS_TO_WAIT = 0.5  # for a chunk to end, between checks for news


class State(NamedTuple):
    """Progress of the sweep."""

    ended: int  # runs ended since this start
    running: frozenset[str]  # submitted chunks
    slots: int  # current number of parallel chunks
    news: Sequence[News]  # since the last state


@dataclasses.dataclass(frozen=True)
class Job:
    """A sweep to train."""

    folder: Path  # folder of the sweep
    chunks: Sequence[tuple[RunSpec, ...]]
    options: Options
    lanes: int | None
    task: Task
    storage: Path | None
    code: dict[str, str]
    work: Work
    report: Callable[[str], None]
    show: Callable[[State], None]
    should_stop: Callable[[], bool]


def run(cluster: Any, job: Job) -> list[str]:
    """Trains the chunks of a job on a `cluster.Cluster`. Returns one line per chunk that was lost for good.

    Slightly more chunks than slots are submitted, for clusters that grow on demand. A lost chunk is trained again from its
    checkpoints in the storage, or without storage from the start. Errors of the training are raised again. Runs that have ended
    by then are written.
    """
    waiting, running, begun = deque(job.chunks), list[Running](), set[str]()
    lost: list[str] = []
    ended, stopping = 0, False
    while running or (waiting and not stopping):
        slots = sum(map(job.task.slots, cluster.resources()))
        while waiting and not stopping and len(running) < slots + 2:
            chunk = chunks.make(waiting.popleft(), job.options, job.lanes, job.task, job.storage, job.code)
            running.append(cluster.submit(chunk, job.task, job.work))
        for one in cluster.wait(running, SECONDS_TO_WAIT):
            running.remove(one)
            try:
                ended += _deliver(job, one.chunk, cluster.result(one))
            except LostError as error:
                lost.append(str(error))
        news = cluster.look(stopping)
        begun |= {one.chunk for one in news}
        for line in (f"{one.host}: {line}" for one in news for line in one.lines):
            job.report(line)
        job.show(State(ended, frozenset(one.chunk.id for one in running), slots, news))
        if not stopping and job.should_stop():
            stopping = True
            for one in running:
                if one.chunk.id not in begun:  # it may be compiling, which need not be awaited
                    cluster.cancel(one)
            running = [one for one in running if one.chunk.id in begun]
    return lost


def _deliver(job: Job, chunk: Chunk, parcels: Sequence[bytes]) -> int:
    """Writes the ended runs of a chunk, and removes its checkpoints if all have ended. Returns their number."""
    written = 0
    for spec, parcel in zip(chunk.specs, parcels):
        folder = grid.folder_of(job.folder, spec)
        try:
            if parcel:
                worker.unpack(folder, spec, parcel)
                written += 1
        except BusyError as error:  # a process without Ray trains it
            job.report(f"{folder} was not written: {error}")
    if written == len(chunk.specs) and chunk.storage is not None:
        shutil.rmtree(chunk.storage, ignore_errors=True)
    return written
