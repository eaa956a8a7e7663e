"""A sweep over the machines of a Ray cluster: `sweep --ray`."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from mjx_dher import spec
from mjx_dher.cli.common import make_env, settle_compiler, try_parts
from mjx_dher.cli.fleet_screen import FleetScreen
from mjx_dher.fleet import chunks, cluster, driver, own_code, parcels, plan
from mjx_dher.fleet.chunks import Chunk, Tell
from mjx_dher.fleet.ledger import Ledger
from mjx_dher.fleet.plan import Kind, Node, Request
from mjx_dher.runs.folder.locks import Claims
from mjx_dher.runs.options import Options
from mjx_dher.runs.signals import Stop
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid
from mjx_dher.system import files
from mjx_dher.system.caches import prepare


@dataclasses.dataclass(frozen=True)
class Order:
    """A sweep that a fleet is to train."""

    request: Request
    out: Path
    engine: str
    lanes: int | None
    options: Options
    make_trials: Callable[[str], list[RunSpec]]  # for a preset, cpu or gpu, where the user names none
    announce: Callable[[list[RunSpec]], list[RunSpec]]  # says what there is to do, and returns the trials that have not ended


def train_chunk(chunk: Chunk, tell: Tell) -> list[bytes]:
    """Trains a chunk in a worker of Ray's."""
    settle_compiler(chunk.specs[0].engine)
    prepare()
    return chunks.train(chunk, make_env, tell)


def train(order: Order, console: Console) -> tuple[list[RunSpec], list[RunSpec], int | None]:
    """Trains a sweep on a cluster.

    Returns:
      All trials, those that had not ended before, and the signal that asked for a stop, or None.

    Raises:
      ValueError: the cluster cannot be used as asked for, or a run cannot be trained.
    """
    _stay_on_cpu()
    code = own_code.folder_of(order.make_trials("cpu"))
    with cluster.joined(order.request, code) as tasks:
        resources = tasks.resources()
        kinds = plan.kinds_of(order.request, list(resources.values()), order.engine)
        specs = order.make_trials("gpu" if kinds[0].gpus else "cpu")
        _try_own(specs, order.engine, console)  # JAX starts here: Ray's processes are forked before
        report = lambda text: console.print(text, soft_wrap=True)  # noqa: E731
        todo = order.announce(specs)
        claims = Claims(True, report)
        free = [run for run in todo if claims.is_free(run, grid.folder_of(order.out, run))]
        signum = _train(order, tasks, kinds, free, report, console) if free else None
    return specs, todo, signum


def _train(
    order: Order,
    tasks: cluster.Cluster,
    kinds: Sequence[Kind],
    todo: Sequence[RunSpec],
    report: Callable[[str], None],
    console: Console,
) -> int | None:
    """Trains runs that no other program has; returns the signal that asked for a stop, or None."""
    ledger = Ledger(order.out, [run for together in grid.by_program(todo) for run in together])
    storage = plan.storage_of(order.request, order.out)
    nodes = _looked_at(tasks, kinds, own_code.with_own_parts(todo), storage, ledger.sweep, report)
    report(f"ray: {plan.describe(nodes, kinds)}; {len(todo)} runs to train")
    stop, screen = Stop(console, order.out), FleetScreen(console, todo)
    with stop, contextlib.closing(screen):
        job = driver.Job(
            order.out,
            order.options,
            order.lanes,
            storage,
            chunks.files_digest(),
            kinds,
            _Sizes(order, kinds, nodes, todo),
            train_chunk,
            report,
            screen.show,
            lambda: stop.asked is not None,
        )
        lost = driver.run(tasks, job, ledger)
    if lost:
        raise ValueError(
            f"ray: {len(lost)} tasks were lost {cluster.RETRIES + 1} times each ({'; '.join(lost[:3])}); the same command tries"
            " their runs again"
        )
    if stop.asked is None:
        ledger.close()
        if storage is not None and order.request.storage is None:
            with contextlib.suppress(OSError):  # not empty: runs of the plain command that have not ended
                Path(storage).rmdir()
    return stop.asked


@contextlib.contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Makes a sweep's folder and locks it against a second driver; removes what is empty again where nothing was trained.

    Raises:
      BusyError: another driver has it.
      FolderError: it cannot be written to.
    """
    missing = [path for path in (out / grid.CELLS, out, *out.parents) if not path.exists()]
    try:
        files.make_folder(out / grid.CELLS)
        with files.lock(out):
            yield
    finally:
        kept = {path.name for path in (*out.glob("*"), *(out / grid.CELLS).glob("*"))} - {files.LOCK, grid.CELLS}
        if missing and not kept:
            (out / files.LOCK).unlink(missing_ok=True)
            for path in missing:
                with contextlib.suppress(OSError):  # something is in it
                    path.rmdir()


def _stay_on_cpu() -> None:
    """Keeps JAX of this process off the GPUs, which the tasks are to have."""
    import jax

    jax.config.update("jax_platforms", "cpu")


def _try_own(specs: Sequence[RunSpec], engine: str, console: Console) -> None:
    """Tries out parts of the user's own on this machine, before a cluster is asked for anything."""
    for _, group in itertools.groupby(specs, key=lambda run: run.env):
        own = list({dataclasses.replace(run, seed=0): None for run in group})
        if any(map(spec.custom_components, own)):
            settle_compiler(engine)
            try_parts(_env_here(own[0]), own, console)


def _env_here(run: RunSpec) -> Any:
    """Makes an environment on this machine, whose sizes are those of any engine."""
    return make_env(run, "native" if run.engine == "warp" else None)


def _looked_at(
    tasks: cluster.Cluster,
    kinds: Sequence[Kind],
    specs: Sequence[RunSpec],
    storage: str | None,
    sweep: str,
    report: Callable[[str], None],
) -> list[Node]:
    """Returns the nodes that take tasks, with their speeds where they are not alike.

    Raises:
      ValueError: one of them cannot take part, or the storage cannot be used.
    """
    here = chunks.inspect("", {}, specs, None, sweep, "")
    taking = [node for node, own in tasks.resources().items() if any(kind.slots(own) for kind in kinds)]
    with parcels.shown(storage, sweep) if storage is not None else contextlib.nullcontext("") as token:
        nodes = tasks.inspect(taking, specs, storage, sweep, token)
    if wrong := plan.problems(nodes, here.versions, here.sources):
        raise ValueError("\n".join(wrong[:5]))
    for line in plan.other_libraries(nodes, here.versions):
        report(f"ray: {line}")
    if len({node.hardware for node in nodes}) == 1:
        return nodes
    kind = kinds[0]
    speeds = [tasks.measure(node, kind) if kind.slots(node.resources) else 0.0 for node in nodes]
    slowest = min((speed for speed in speeds if speed), default=1.0)
    return [node._replace(speed=(speed or slowest) / slowest) for node, speed in zip(nodes, speeds)]


class _Sizes:
    """Number of runs of a task, for each kind and program."""

    def __init__(self, order: Order, kinds: Sequence[Kind], nodes: Sequence[Node], todo: Sequence[RunSpec]):
        self._request, self._lanes, self._nodes = order.request, order.lanes, nodes
        self._runs: dict[RunSpec, int] = {}
        for run in todo:
            self._runs[run.program] = self._runs.get(run.program, 0) + 1
        self._speeds = {kind: plan.speeds(nodes, kind) for kind in kinds}
        self._known: dict[tuple[Kind, RunSpec], int] = {}

    def __call__(self, kind: Kind, run: RunSpec) -> int:
        key = kind, run.program
        if key not in self._known:
            fitting = plan.lanes_that_fit(self._nodes, _ring_bytes(run)) if kind.gpus and not self._request.chunk else None
            most = plan.most_of(kind, self._request, self._lanes, fitting)
            runs, all_speeds = self._runs[run.program], [x for speeds in self._speeds.values() for x in speeds]
            self._known[key] = self._request.chunk or plan.chunk_size(runs, all_speeds, most)
        return self._known[key]


def _ring_bytes(run: RunSpec) -> int:
    from mjx_dher.runs.program import program

    return program.make_loop(_env_here(run), run, program.choices_of([run])).replay_bytes
