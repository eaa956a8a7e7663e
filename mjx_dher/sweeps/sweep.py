"""Many runs: every environment, sampler, number and seed of a grid, side by side in as few compiled programs as there can be.

Runs that differ in seed, sampler, weight kernel or HParams are *lanes* of one vmapped program; environments are programs of
their own. A lane follows the same draws as that run alone. A run is a *cell* of the grid: a run folder, named after its
settings and a digest of them, with a result once it has ended; so a sweep that was cut short, or made larger, trains what is
missing. Those side by side when it was cut short go on from their checkpoint, which they share.
"""

from __future__ import annotations

import collections
import concurrent.futures
import contextlib
import csv
import dataclasses
import functools
import hashlib
import itertools
import json
import math
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from mjx_dher import config as config_lib
from mjx_dher.config import Config, HParams
from mjx_dher.host import files
from mjx_dher.host.files import FolderError
from mjx_dher.runs import run_folder
from mjx_dher.runs.run_folder import RunConfig

if TYPE_CHECKING:
    from mjx_dher.runs.sinks import Sink
    from mjx_dher.trainer import Compiled, Metrics, Progress, Start, Train, TrainState
    from mjx_dher.types import PRNGKey

CELLS = "cells"
UNFINISHED = "unfinished"
_NAMES = "cells.json"
LOCK = "lock"
RESULTS = "results.csv"
FINALS = "finals.csv"

# Where only some of the built-in samplers read a setting, the others' cells do not differ in it.
_READ_BY = {
    "temperature": ("weighted",),
    "weight_kernel": ("weighted",),
    "epsilon": ("epsilon_closest",),
    "metric": ("closest", "epsilon_closest", "weighted"),
}

# HParams, and which of a program's samplers a lane uses; see samplers.one_of.
Lane = collections.namedtuple("Lane", (*HParams._fields, "choice"))  # type: ignore[misc]


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of a sweep."""

    config: Config
    hparams: HParams
    seed: int

    @property
    def choice(self) -> tuple[str, str, str]:
        """What `samplers.make` takes."""
        return self.config.sampler, self.config.weight_kernel, self.config.metric

    @property
    def name(self) -> str:
        """Of its folder: what it is, to be read, and a digest of all that it depends on."""
        settings = [run_folder.SCHEMA, dataclasses.asdict(self.config), self.hparams._asdict(), self.seed]
        digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:10]
        env, sampler = run_folder.in_a_path(self.config.env), run_folder.in_a_path(self.config.sampler)
        return f"{env}-{sampler}-s{self.seed}-{digest}"


def cells(configs: Iterable[Config], hparams: Iterable[Sequence[HParams]], seeds: Sequence[int]) -> list[Cell]:
    """All combinations, seed by seed, so that what is to be compared ends together; settings that a sampler does not read
    are put to those of the first, and what is then the same is there once.

    Args:
      configs: environments, samplers, kernels; the first of an environment lends the others what they do not read.
      hparams: for each config, its numbers.
      seeds: of every setting.
    """
    settings: dict[tuple[Config, HParams], None] = {}
    first: dict[str, tuple[Config, HParams]] = {}
    for static, points in zip(configs, hparams):
        for point in points:
            base, numbers = first.setdefault(static.env, (static, point))
            changes = {name: getattr(base, name) for name in ("weight_kernel", "metric") if not reads(static.sampler, name)}
            same = {name: getattr(numbers, name) for name in ("temperature", "epsilon") if not reads(static.sampler, name)}
            settings[dataclasses.replace(static, **changes), point._replace(**same)] = None
    grouped = itertools.groupby(settings, key=lambda setting: setting[0].env)
    return [Cell(*setting, seed) for _, group in grouped for setting, seed in _seed_by_seed(list(group), seeds)]


def _seed_by_seed(settings: list[tuple[Config, HParams]], seeds: Sequence[int]) -> Iterator[tuple[tuple[Config, HParams], int]]:
    return ((setting, seed) for seed in seeds for setting in settings)


def reads(sampler: str, name: str) -> bool:
    """Whether the setting `name` makes a difference to runs with this sampler."""
    return sampler not in config_lib.SAMPLERS or sampler in _READ_BY.get(name, (sampler,))


def share(found: Sequence[Cell], number: int, of: int) -> list[Cell]:
    """Of `of` shares that differ by a cell at most in each environment, the one with this number, from 1.

    Neighbours stay together, so a share has all settings of some seeds, which are compared, and trains them side by side.
    """
    grouped = (list(group) for _, group in itertools.groupby(found, key=lambda cell: cell.config.env))
    return [cell for group in grouped for cell in group[len(group) * (number - 1) // of : len(group) * number // of]]


def is_done(folder: Path, cell: Cell) -> bool:
    """Whether the cell has been trained."""
    return (_path(folder, cell) / run_folder.RESULT_FILE).exists()


def run(
    folder: Path,
    todo: Sequence[Cell],
    make_env: Callable[[Config], Any],
    lanes: int | None = None,
    final_episodes: int = 500,
    checkpoint_every: int = 0,
    on_program: Callable[[str], None] = lambda text: None,
    on_epoch: Callable[[Sequence[Cell], Progress], None] = lambda cells, progress: None,
) -> None:
    """Trains the cells. Each one's curve is in its folder after every epoch, its result when its lanes have ended.

    Args:
      folder: of the sweep; it is made where it is not there.
      todo: cells, in order. Neighbours that can share a program do.
      make_env: makes the environment of a Config.
      lanes: side by side at most; by default one on a CPU, whose cores one run fills, and elsewhere what its memory holds.
      final_episodes: of the evaluation that ends each run.
      checkpoint_every: epochs between checkpoints of those side by side; 0: only when the sweep is stopped.
      on_program: called with a line about each program, before it is compiled and after, and about checkpoints.
      on_epoch: called after every epoch of those side by side, after the last one when their results are written. It stops
        the sweep by raising KeyboardInterrupt.

    Raises:
      ValueError: a setting that cannot run, or a ring that does not fit into memory even alone.
    """
    import jax

    (folder / CELLS).mkdir(parents=True, exist_ok=True)
    if lanes is None and jax.default_backend() == "cpu":
        lanes = 1
    settings = _Settings(folder, lanes, final_episodes, checkpoint_every, on_program, on_epoch)
    for static, group in itertools.groupby(todo, key=lambda cell: _shared(cell.config)):
        _run_group(make_env(static), list(group), settings)


# The last evaluation of runs side by side, compiled.
Evaluate = Callable[["TrainState", "PRNGKey"], "Metrics"]


class _Settings(NamedTuple):
    """What `run` was called with, for all of its programs."""

    folder: Path
    lanes: int | None
    final_episodes: int
    checkpoint_every: int
    on_program: Callable[[str], None]
    on_epoch: Callable[[Sequence[Cell], Progress], None]


def _shared(static: Config) -> Config:
    """What runs must agree in to be lanes of one program."""
    return dataclasses.replace(static, sampler="future", weight_kernel="linear", metric="position")


def _run_group(env: Any, group: list[Cell], settings: _Settings) -> None:
    """Trains cells that can share a program, as many side by side as can be."""
    import jax

    from mjx_dher import samplers, trainer

    static = group[0].config
    config_lib.validate(static, group[0].hparams, env.episode_length)
    choices = list(dict.fromkeys(cell.choice for cell in group))
    program = trainer.make_train(env, static, samplers.one_of([samplers.make(*choice) for choice in choices]))
    trainer.check_memory(program.replay_bytes, static)
    compiled, evaluate, size = _compile(env, program, group, choices, settings)
    for start in range(0, len(group), size):
        chunk = group[start : start + size]
        keys, hparams = _stack(chunk, choices, size)
        with _locked(settings.folder, chunk):
            progress = _train(env, chunk, size, compiled, functools.partial(compiled.init, keys, hparams), settings)
            final_keys = jax.vmap(lambda key: jax.random.fold_in(key, 1))(keys)
            final = jax.device_get(evaluate.result()(progress.state, final_keys))
            trainer.check_steps(env)
            _end(chunk, progress, final, settings)
        settings.on_epoch(chunk, progress)


@contextlib.contextmanager
def _locked(folder: Path, chunk: Sequence[Cell]) -> Iterator[None]:
    """Keeps other programs off these cells; their folders are made."""
    with contextlib.ExitStack() as stack:
        for cell in chunk:
            _path(folder, cell).mkdir(exist_ok=True)
            stack.enter_context(files.lock(_path(folder, cell), LOCK))
        yield
        for cell in chunk:
            (_path(folder, cell) / LOCK).unlink(missing_ok=True)


def _compile(
    env: Any, program: Train, group: list[Cell], choices: list[tuple[str, str, str]], settings: _Settings
) -> tuple[Compiled, concurrent.futures.Future[Evaluate], int]:
    """The program for as many lanes as there may be and memory holds, its last evaluation, and how many lanes they are.

    The last evaluation may still be compiling, in a thread, while the runs are trained.
    """
    import jax

    from mjx_dher import trainer
    from mjx_dher.host import memory

    @jax.jit
    @jax.vmap
    def evaluate(state: TrainState, key: PRNGKey) -> Metrics:
        return trainer.evaluate_state(env, program.networks, state, key, settings.final_episodes)

    name = group[0].config.env
    size = min(len(group), settings.lanes or len(group))
    available = memory.available_bytes()
    if available is not None:  # the rings alone must fit before the compiler is asked
        size = max(1, min(size, int(available / program.replay_bytes)))
    while True:
        size = math.ceil(len(group) / math.ceil(len(group) / size))  # chunks of equal size
        together = f"{size} runs side by side" if size > 1 else "one run at a time"
        settings.on_program(f"{name}: compiling for {together}, of {len(group)} ...")
        started = time.perf_counter()
        keys, hparams = _stack(group, choices, size)
        compiled = trainer.compile_program(program, keys, hparams)
        trainer.check_steps(env)
        needed = f"{memory.format_bytes(compiled.nbytes)} of memory"
        settings.on_program(f"{name}: compiled in {time.perf_counter() - started:.1f} s; {needed}")
        if available is None or compiled.nbytes <= available or size == 1:
            lowered = evaluate.lower(jax.eval_shape(jax.vmap(program.init), keys, hparams), keys)
            pool = concurrent.futures.ThreadPoolExecutor(1)
            last = cast("concurrent.futures.Future[Evaluate]", pool.submit(trainer.compile_lowered, lowered))
            # It is not needed before the runs have ended; but compiling takes memory, too, to try kernels in.
            pool.shutdown(wait=available is None or compiled.nbytes > available / 2)
            return compiled, last, size
        size = min(size - 1, max(1, int(0.95 * size * available / compiled.nbytes)))


def _train(
    env: Any, chunk: Sequence[Cell], size: int, compiled: Compiled, init: Callable[[], TrainState], settings: _Settings
) -> Progress:
    """Trains cells side by side, from their start or the checkpoint that they were left with, to their end."""
    from mjx_dher import trainer
    from mjx_dher.runs import sinks

    folder = settings.folder
    unfinished = _Unfinished(folder, chunk, size, settings.on_program)
    with contextlib.ExitStack() as stack:
        begin = unfinished.restore(init)
        opened = [stack.enter_context(_begin(folder, cell, run_folder.engine_name(env), size, begin.epoch)) for cell in chunk]
        for progress in trainer.run(env, chunk[0].config, compiled, begin):
            counts = {name: getattr(progress, name) for name in sinks.COUNTS}
            for lane, sink in enumerate(opened):
                sink.write({**counts, **{name: float(values[lane]) for name, values in progress.metrics.items()}})
            if progress.epoch == progress.num_epochs:
                continue  # what they leave comes first
            try:
                settings.on_epoch(chunk, progress)
            except KeyboardInterrupt:
                unfinished.save(progress)
                raise
            if settings.checkpoint_every and progress.epoch % settings.checkpoint_every == 0:
                unfinished.save(progress)
    return progress


def _end(chunk: Sequence[Cell], progress: Progress, final: dict[str, Any], settings: _Settings) -> None:
    """Writes what cells that have ended leave: policies and the last evaluations."""
    import jax

    from mjx_dher import policy, trainer

    learners = jax.device_get(progress.state.learner)
    lanes = len(learners.num_updates)
    last = {"epochs": progress.epoch, "env_steps": progress.env_steps, "wall_seconds": progress.wall_seconds, "lanes": lanes}
    for lane, cell in enumerate(chunk):
        path, learner = _path(settings.folder, cell), jax.tree.map(lambda x, lane=lane: x[lane], learners)
        policy.from_learner(learner, cell.hparams).save(path / run_folder.POLICY_FILE)
        result = {name: trainer.to_float(values[lane]) for name, values in final.items()}
        # Last of all: the cell is done when this is there.
        files.write_json(path / run_folder.RESULT_FILE, {**last, **result, "episodes": settings.final_episodes})
    _clear(settings.folder)


class _Unfinished:
    """The checkpoint of cells that are trained side by side, in a folder named after them.

    Args:
      folder: of the sweep.
      chunk: the cells.
      size: lanes, of which the last ones may repeat the last cell.
      say: called with a line about what was found or could not be done.
    """

    def __init__(self, folder: Path, chunk: Sequence[Cell], size: int, say: Callable[[str], None]):
        self.names, self.say = [cell.name for cell in chunk], say
        digest = hashlib.sha256(json.dumps([size, *self.names]).encode()).hexdigest()[:10]
        self.folder = folder / UNFINISHED / digest

    def restore(self, init: Callable[[], TrainState]) -> Start:
        """Where these cells go on from: what `init` makes, if there is no checkpoint that can be used."""
        import jax

        from mjx_dher import trainer
        from mjx_dher.runs import checkpoint

        state = init()
        if not run_folder.checkpoints(self.folder):
            return trainer.Start(state)
        template, hparams = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state), state.hparams
        del state  # there may be no memory for two
        try:
            found = checkpoint.restore(self.folder, template)
        except FolderError as error:
            self.say(f"{error}; training these runs from their start")
            return trainer.Start(init())
        self.say(f"going on after epoch {found.epoch}")
        # A lane's number for its sampler depends on which others there still are.
        return trainer.Start(dataclasses.replace(found.state, hparams=hparams), found.epoch, found.wall_seconds)

    def save(self, progress: Progress) -> None:
        """A checkpoint in place of the one before. One that cannot be written is said to be so, and costs nothing else."""
        from mjx_dher.runs import checkpoint

        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            files.write_json(self.folder / _NAMES, {"cells": self.names})
            checkpoint.save(self.folder, progress.state, progress.epoch, progress.wall_seconds, keep=1)
        except (OSError, checkpoint.CheckpointError) as error:
            self.say(str(error))


def _clear(folder: Path) -> None:
    """Removes the checkpoints of cells that have all ended. Those of others stay: another program may be at work on them."""
    done = {path.parent.name for path in (folder / CELLS).glob(f"*/{run_folder.RESULT_FILE}")}
    for path in (folder / UNFINISHED).glob(f"*/{_NAMES}"):
        if done.issuperset(json.loads(path.read_text())["cells"]):
            shutil.rmtree(path.parent, ignore_errors=True)
    with contextlib.suppress(OSError):  # not empty, or not there
        (folder / UNFINISHED).rmdir()


def _stack(group: Sequence[Cell], choices: Sequence[tuple[str, str, str]], size: int) -> tuple[Any, Any]:
    """Keys [size] and Lanes of [size] each; where there are fewer cells, the last is repeated."""
    import jax
    import jax.numpy as jnp

    padded = [group[min(i, len(group) - 1)] for i in range(size)]
    numbers = [Lane._make((*cell.hparams, choices.index(cell.choice))) for cell in padded]
    keys = jnp.stack([jax.random.key(cell.seed) for cell in padded])
    return keys, jax.tree.map(lambda *x: jnp.array(x, jnp.float32), *numbers)


def _path(folder: Path, cell: Cell) -> Path:
    return folder / CELLS / cell.name


def _begin(folder: Path, cell: Cell, engine: str, lanes: int, epochs: int) -> contextlib.closing[Sink]:
    """Writes the cell's config.json, and makes the sink for its curve, of which `epochs` are there already."""
    from mjx_dher.runs import sinks

    path = _path(folder, cell)
    run_folder.create(path, RunConfig(cell.config, cell.hparams, cell.seed, engine), {"lanes": lanes})
    return contextlib.closing(sinks.CsvSink(path / run_folder.METRICS_FILE, epochs))


def read(folder: Path) -> list[dict[str, Any]]:
    """The finished cells of a sweep: config, hparams, seed, engine, lanes; curve, lists by column; final, the last evaluation.

    Raises:
      FolderError: no sweep, none finished, or a folder that cannot be read.
    """
    paths = sorted(path.parent for path in (folder / CELLS).glob(f"*/{run_folder.RESULT_FILE}"))
    if not paths:
        raise FolderError(f"{folder} holds no finished run of a sweep")
    found = [_read_cell(path) for path in paths]
    key = lambda c: (c["config"]["env"], c["config"]["sampler"], str(c["config"]), str(c["hparams"]), c["seed"])  # noqa: E731
    return sorted(found, key=key)


def _read_cell(path: Path) -> dict[str, Any]:
    run = run_folder.read_config(path)
    try:
        result = json.loads((path / run_folder.RESULT_FILE).read_text())
        with (path / run_folder.METRICS_FILE).open() as file:
            rows = list(csv.DictReader(file))
        curve = {name: [_number(row[name]) for row in rows] for name in rows[0]}
        names = ("success_rate", "reset_success_rate", "return_mean", "episodes")
        return {
            "config": dataclasses.asdict(run.config),
            "hparams": run.hparams._asdict(),
            "seed": run.seed,
            "engine": run.engine,
            "lanes": result["lanes"],
            "final": {name: result[name] for name in names},
            "curve": curve,
        }
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise FolderError(f"{path} is not a finished run of a sweep ({type(error).__name__}: {error})") from error


def _number(text: str) -> int | float:
    return int(text) if text.isdigit() else float(text)


def write_tables(folder: Path, cells: Sequence[dict[str, Any]]) -> None:
    """Writes results.csv, results.npz and finals.csv of the cells that `read` gave; docs/sweeps.md describes the columns."""
    import numpy as np

    results: list[dict[str, Any]] = []
    finals: list[dict[str, Any]] = []
    for cell in cells:
        static = {name: value for name, value in cell["config"].items() if name not in ("engine", "hidden_sizes")}
        sizes = "x".join(map(str, cell["config"]["hidden_sizes"]))
        settings = {**static, "hidden_sizes": sizes, "engine": cell["engine"], **cell["hparams"], "seed": cell["seed"]}
        curve = cell["curve"]
        for index in range(len(curve["epoch"])):
            results.append({**settings, "lanes": cell["lanes"], **{name: values[index] for name, values in curve.items()}})
        last = {name: curve[name][-1] for name in ("epoch", "env_steps", "updates", "wall_seconds")}
        finals.append({**settings, "lanes": cell["lanes"], **last, **cell["final"]})
    _write_csv(folder / RESULTS, results)
    _write_csv(folder / FINALS, finals)
    columns = {name: np.array([row[name] for row in results]) for name in results[0]}
    with files.atomic_write(folder / "results.npz") as partial, partial.open("wb") as file:
        np.savez_compressed(file, **columns)  # type: ignore[arg-type]


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    with files.atomic_write(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), restval="")
        writer.writeheader()
        writer.writerows(rows)
