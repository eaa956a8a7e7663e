"""A sweep on a Ray cluster: `sweep --ray`."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from mjx_dher.cli.common import SECONDS_PER_LINE, clock, make_env, settle_compiler, try_components
from mjx_dher.cli.sweep import SweepArgs, announce, trials_of
from mjx_dher.fleet import chunks, cluster, worker
from mjx_dher.fleet.chunks import LOCAL, Chunk, FleetOptions
from mjx_dher.fleet.worker import News, Tell
from mjx_dher.runs.folder import fingerprint, run_folder
from mjx_dher.runs.folder.run_folder import Claims
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid
from mjx_dher.system import files, signals
from mjx_dher.system.machine import prepare

SECONDS_WITHOUT_NEWS = 8.0  # after a signal; then the cluster is gone


def storage_of(fleet: FleetOptions, out: Path) -> Path | None:
    """Folder for checkpoints: the user's, or one in the sweep's folder `out` if all tasks run on this machine."""
    if fleet.storage is None and fleet.ray != LOCAL:
        return None
    root = fleet.storage or out / "unfinished"
    return (root / f"fleet-{fingerprint.sha256_of(str(out.absolute()))[:10]}").absolute()


def train_chunk(chunk: Chunk, tell: Tell) -> list[bytes]:
    """Trains a chunk in a Ray worker."""
    settle_compiler(chunk.specs[0].engine)
    prepare()
    return worker.train(chunk, make_env, tell)


def train(args: SweepArgs, console: Console) -> tuple[list[RunSpec], list[RunSpec]]:
    """Trains a sweep on a cluster, whose machines decide the preset if the user names none. Returns all trials, and those that
    had not ended before. Raises ValueError if the cluster cannot be used, or a run cannot be trained.
    """
    import jax

    jax.config.update("jax_platforms", "cpu")  # the GPUs are for the tasks
    storage, named = storage_of(args.fleet, args.out), args.preset != "auto"
    code = chunks.custom_code(trials_of(args, args.preset if named else "cpu"))
    with cluster.joined(str(args.fleet.ray), code) as ray:
        task = chunks.task_of(args.fleet.ray_cpus, ray.resources())
        trials = trials_of(args, args.preset if named else "gpu" if task.gpus else "cpu")
        settle_compiler(args.engine)
        try_components(trials, console, on_cpu=True)  # JAX starts here, after Ray has forked its processes
        report = lambda text: console.print(text, soft_wrap=True)  # noqa: E731
        if storage is not None:
            try:
                files.make_folder(storage)
            except OSError as error:
                raise ValueError(f"storage: {storage.parent} cannot be written to ({error.strerror})") from error
        files.make_folder(args.out / grid.CELLS)
        with files.lock(args.out):
            todo = announce(args, trials, console)
            claims = Claims(True, report)
            free = [run for run in todo if claims.is_free(run, grid.folder_of(args.out, run))]
            if free:
                _train(args, storage, ray, task, trials, free, report, console)
    return trials, todo


def _train(
    args: SweepArgs,
    storage: Path | None,
    ray: cluster.Cluster,
    task: chunks.Task,
    trials: Sequence[RunSpec],
    todo: Sequence[RunSpec],
    report: Callable[[str], None],
    console: Console,
) -> None:
    """Trains runs that no other process trains, until a signal requests a stop."""
    nodes = [node for node in ray.resources() if task.slots(node)]
    slots = sum(map(task.slots, nodes))
    report(
        f"ray: {len(nodes)} nodes, {slots} parallel tasks, each with {task.gpus} GPUs and {task.cpus} CPUs; {len(todo)} runs"
    )
    before = chunks.unfinished(storage, trials, todo)
    others = [run for run in todo if not any(run in chunk for chunk in before)]
    shares = [*before, *chunks.split(others, task, slots, args.lanes, args.fleet.ray_chunk)]
    code = chunks.code_of(todo)
    parts = [chunks.make(share, args.options, args.lanes, task, storage, code) for share in shares]
    screen = _Screen(console, todo)
    for run in todo:  # the nodes write the folders
        run_folder.record_names(run)
    with signals.held(report, args.out, SECONDS_WITHOUT_NEWS) as held:

        def show(state: cluster.State) -> None:
            held.alive()
            screen.show(state)

        lost = cluster.train(ray, args.out, parts, train_chunk, report, show, signals.are_asked)
    if lost:
        tries = cluster.RETRIES + 1
        raise ValueError(f"ray: {len(lost)} tasks were lost {tries} times ({'; '.join(lost[:3])}); run the same command again")
    if storage is not None:
        chunks.clear(storage, args.out)


class _Screen:
    """Progress of all nodes, as occasional lines."""

    def __init__(self, console: Console, specs: Sequence[RunSpec]):
        self._console, self._runs = console, len(specs)
        self._steps = sum(run.config.total_steps for run in specs) / max(1, len(specs))  # mean of a run
        self._news: dict[str, News] = {}  # by chunk
        self._started = self._printed = time.monotonic()

    def show(self, state: cluster.State) -> None:
        """Prints a line if it is time for one."""
        self._news = {name: one for name, one in self._news.items() if name in state.running}
        self._news |= {one.chunk: one for one in state.news if one.chunk in state.running}
        now = time.monotonic()
        if now - self._printed > SECONDS_PER_LINE or state.ended == self._runs:
            self._console.print(self._line(state, now), soft_wrap=True, highlight=False)
            self._printed = now

    def _line(self, state: cluster.State, now: float) -> str:
        news = self._news.values()
        done = state.ended * self._steps + sum(one.steps for one in news)
        share = min(1.0, done / max(1.0, self._runs * self._steps))
        eta = clock((now - self._started) * (1 - share) / share) if share else "not known yet"
        rates: dict[str, list[float]] = {}
        for name, rate in ((name, rate) for one in news for name, rate in one.success.items()):
            rates.setdefault(name, []).append(rate)
        success = "".join(f"  {name} {sum(own) / len(own):.2f}" for name, own in rates.items())
        busy = f"{len(news)} of {state.slots} tasks train on {len({one.host for one in news})} hosts"
        speed = sum(one.steps_per_second for one in news)
        return f"{share:.0%}  {state.ended} of {self._runs} runs have ended; {busy}  {speed:,.0f} steps/s{success}  ETA {eta}"
