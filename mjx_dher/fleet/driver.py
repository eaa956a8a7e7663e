"""The driver of a fleet: hands chunks out, takes their runs in, until every run of the sweep is in its folder."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from mjx_dher.fleet import parcels
from mjx_dher.fleet.chunks import Chunk, Told
from mjx_dher.fleet.cluster import Flying, Outcome, Work
from mjx_dher.fleet.ledger import Ledger
from mjx_dher.fleet.plan import Kind
from mjx_dher.runs.options import Options
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid
from mjx_dher.system.files import BusyError

SECONDS_TO_WAIT = 0.5  # for a chunk to end, between looks at all else


class Tasks(Protocol):
    """What the driver asks of a cluster."""

    def resources(self) -> dict[str, dict[str, float]]:
        """Returns the resources of each node that is alive."""
        ...

    def submit(self, chunk: Chunk, kind: Kind, work: Work) -> Flying:
        """Hands a chunk out."""
        ...

    def wait(self, flying: Sequence[Flying], seconds: float) -> list[Flying]:
        """Returns the chunks that have ended."""
        ...

    def collect(self, flying: Flying) -> Outcome:
        """Returns what came of a chunk."""
        ...

    def cancel(self, flying: Flying) -> None:
        """Takes a chunk back."""
        ...

    def look(self, stop: bool) -> list[Told]:
        """Returns what chunks have told."""
        ...


class State(NamedTuple):
    """Where a fleet is, for the screen."""

    ended: int  # runs, since this start
    waiting: int
    flying: frozenset[str]  # chunks that are with Ray
    slots: int  # chunks that the cluster takes at once, now
    told: Sequence[Told]  # since the last state


@dataclasses.dataclass(frozen=True)
class Job:
    """What is to be done, and how."""

    folder: Path  # of the sweep
    options: Options
    lanes: int | None
    storage: str | None
    files: str  # digest of the package's
    kinds: Sequence[Kind]
    size: Callable[[Kind, RunSpec], int]  # runs of a task
    work: Work
    report: Callable[[str], None]
    show: Callable[[State], None]
    should_stop: Callable[[], bool]


def run(tasks: Tasks, job: Job, ledger: Ledger) -> list[str]:
    """Trains the runs of a ledger; returns a line for each chunk that was lost for good.

    A chunk that is lost costs what it had trained since the last copy in the storage, and without a storage all of it. Runs
    are written as their chunk ends, each whole or not at all.

    Raises:
      ValueError: what the training of a chunk has raised. What has ended by then is written.
    """
    flying: list[Flying] = []
    begun: set[str] = set()  # chunks that have told something
    lost: list[str] = []
    ended = 0
    stopping = False
    while flying or (ledger.waits and not stopping):
        room = {kind: sum(map(kind.slots, tasks.resources().values())) for kind in job.kinds}
        if not stopping:
            flying += _hand_out(tasks, job, ledger, flying, room)
        for one in tasks.wait(flying, SECONDS_TO_WAIT):
            flying.remove(one)
            outcome = tasks.collect(one)
            if outcome.lost is not None:
                lost.append(outcome.lost)
                continue
            delivered = [_deliver(job, spec, parcel) for spec, parcel in zip(one.chunk.specs, outcome.parcels)]
            ended += sum(delivered)
            if all(delivered):
                _forget(ledger, one.chunk)
        told = tasks.look(stopping)
        begun |= {one.chunk for one in told}
        for line in (f"{one.host}: {line}" for one in told for line in one.lines):
            job.report(line)
        job.show(State(ended, ledger.waits, frozenset(one.chunk.id for one in flying), sum(room.values()), told))
        if not stopping and job.should_stop():
            stopping = True
            for one in flying:
                if one.chunk.id not in begun:
                    tasks.cancel(one)
    return lost


def _hand_out(tasks: Tasks, job: Job, ledger: Ledger, flying: Sequence[Flying], room: dict[Kind, int]) -> list[Flying]:
    """Hands out chunks until each kind has one for every slot and some that wait, for a cluster that grows on demand."""
    new: list[Flying] = []
    for kind in job.kinds:
        out = sum(one.kind == kind for one in flying)
        while ledger.waits and out < room[kind] + 2:
            number, specs = ledger.take(functools.partial(job.size, kind))
            cores = kind.cpus if not kind.gpus else None
            chunk = Chunk(number, ledger.sweep, specs, job.options, job.lanes, cores, job.storage, job.files)
            new.append(tasks.submit(chunk, kind, job.work))
            out += 1
    return new


def _deliver(job: Job, spec: RunSpec, parcel: bytes) -> bool:
    """Writes a run that has come back; returns whether it has ended and is written."""
    if not parcel:
        return False
    folder = grid.folder_of(job.folder, spec)
    try:
        parcels.deliver(folder, parcel)
    except BusyError as error:  # a program without Ray trains it: the other runs are not to suffer for that
        job.report(f"{folder}: what came back was not written: {error}")
        return False
    return True


def _forget(ledger: Ledger, chunk: Chunk) -> None:
    """Removes what was kept to go on with a chunk."""
    ledger.ended(chunk.id)
    if chunk.storage is not None:
        parcels.Storage(chunk.storage, chunk.sweep, chunk.id).clear()
