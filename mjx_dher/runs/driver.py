"""The run driver: trains one run, or many side by side, into run folders.

Runs that differ in seed, sampler, weight kernel, metric or HParams are *lanes* of one vmapped program. A lane follows the same
draws as that run alone. `train`, `resume` and `sweep` all call `train_runs`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_dher import config as config_lib
from mjx_dher import spec as spec_lib
from mjx_dher import trainer
from mjx_dher.host import files
from mjx_dher.host.files import FolderError
from mjx_dher.learners.stored import StoredPolicy
from mjx_dher.runs import loop, play, run_folder, sinks
from mjx_dher.runs import program as program_lib
from mjx_dher.runs.lane_checkpoints import LaneCheckpoints
from mjx_dher.runs.loop import Progress, Start
from mjx_dher.runs.options import Options
from mjx_dher.runs.program import Program
from mjx_dher.runs.run_folder import DIVERGED, FINISHED
from mjx_dher.runs.sinks import Sink
from mjx_dher.spec import RunSpec
from mjx_dher.types import Env

STOPPED = "stopped"
_are_finite = jax.jit(jax.vmap(trainer.is_finite))


class Result(NamedTuple):
    """Outcome of a run."""

    folder: Path
    status: str  # finished, diverged or stopped
    epoch: int  # epochs that have ended
    num_epochs: int
    content: dict[str, Any]  # of result.json; empty for a run that was stopped


def _no_sinks(spec: RunSpec, folder: Path) -> Sequence[Sink]:
    return ()


@dataclasses.dataclass(frozen=True)
class _Session:
    """Arguments of `train_runs` that do not belong to single runs."""

    env: Env
    options: Options
    should_stop: Callable[[], bool]
    report: Callable[[str], None]
    on_epoch: Callable[[Sequence[RunSpec], Progress], None]
    make_sinks: Callable[[RunSpec, Path], Sequence[Sink]]
    shared: Path
    restart: bool


def train_runs(
    env: Env,
    specs: Sequence[RunSpec],
    folders: Sequence[Path],
    *,
    options: Options | None = None,
    lanes: int | None = None,
    shared: Path | None = None,
    restart: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    report: Callable[[str], None] = lambda text: None,
    on_epoch: Callable[[Sequence[RunSpec], Progress], None] = lambda specs, progress: None,
    make_sinks: Callable[[RunSpec, Path], Sequence[Sink]] = _no_sinks,
) -> list[Result]:
    """Trains runs that can share a program, as many side by side as can be, each into a folder of its own.

    A run whose folder has a checkpoint goes on from it. A run whose learner is no longer finite has diverged: it ends there,
    alone, and its result says so.

    Args:
      env: the environment that all of them play in.
      specs: descriptions; all must agree in `RunSpec.program`.
      folders: run folders, one each; they are made where they do not exist.
      options: evaluation, checkpoints, logs; the defaults where None.
      lanes: runs side by side, at most; by default one on a CPU, whose cores one run fills, and elsewhere what memory holds.
      shared: folder for the checkpoints of runs side by side; "unfinished" beside the first run's folder where None.
      restart: whether runs whose checkpoints cannot be used begin anew, instead of raising.
      should_stop: asked after every epoch; True ends training, with a checkpoint.
      report: called with a line about each program and checkpoint.
      on_epoch: called after every epoch of those side by side, after the last one when their results are written.
      make_sinks: makes further sinks for a run's metrics.

    Returns:
      A Result each; fewer than `specs` where training was stopped before their turn.

    Raises:
      ValueError: a run that cannot be trained, or memory that does not suffice for one alone.
      FolderError: a folder that another program is at work on, or that cannot be written to.
    """
    options = options or Options()
    options.check()
    for spec in specs:
        spec_lib.validate(spec, (spec.env,), env.episode_length)
    if len({spec.program for spec in specs}) != 1 or len(specs) != len(folders):
        raise ValueError("train_runs takes one or more runs that agree in RunSpec.program, and a folder for each")
    _refuse_busy(folders)
    if lanes is None and jax.default_backend() == "cpu":
        lanes = 1
    shared = folders[0].parent / "unfinished" if shared is None else shared
    session = _Session(env, options, should_stop, report, on_epoch, make_sinks, shared, restart)
    program = program_lib.compile_runs(env, specs, lanes, options.final_episodes, report)
    results: list[Result] = []
    for first in range(0, len(specs), program.lanes):
        chunk = slice(first, first + program.lanes)
        if first and should_stop():
            break
        with _claimed(folders[chunk]):
            results += _train(session, program, specs[chunk], folders[chunk])
    return results


def _refuse_busy(folders: Sequence[Path]) -> None:
    """Raises FolderError for a folder that another program is at work on: now, not when all is compiled."""
    for folder in folders:
        if (folder / run_folder.LOCK).exists():
            with files.lock(folder, run_folder.LOCK):
                pass


@contextlib.contextmanager
def _claimed(folders: Sequence[Path]) -> Iterator[None]:
    """Keeps other programs off these folders, which are made. An error of the file system names the folder."""
    with contextlib.ExitStack() as stack:
        try:
            for folder in folders:
                folder.mkdir(parents=True, exist_ok=True)
                stack.enter_context(files.lock(folder, run_folder.LOCK))
            yield
            for folder in folders:
                (folder / run_folder.LOCK).unlink(missing_ok=True)
        except OSError as error:
            raise FolderError(f"{folders[0]} cannot be written to ({error}); {last_checkpoint(folders[0])}") from error


def last_checkpoint(folder: Path) -> str:
    """Returns what an error says of the checkpoint that a run has left."""
    paths = run_folder.checkpoints(folder)
    return f"`train.py resume {folder}` goes on from {paths[0]}" if paths else "there is no checkpoint"


def _train(session: _Session, program: Program, specs: Sequence[RunSpec], folders: Sequence[Path]) -> list[Result]:
    """Trains runs side by side, from their start or their checkpoint, to their end or until a stop is asked for."""
    options = session.options
    keep = options.keep if program.lanes == 1 else 1
    checkpoints = LaneCheckpoints(folders, program.lanes, session.shared, keep, session.restart, session.report)
    keys, hparams = program_lib.stack(specs, program.choices, program.lanes)
    start = checkpoints.restore(functools.partial(program.compiled.init, keys, hparams))
    diverged: dict[int, int] = {}  # lane -> epoch
    with contextlib.ExitStack() as stack:
        logs = [_open(stack, session, program.lanes, start, *run) for run in zip(specs, folders)]
        for progress in loop.run(session.env, specs[0].config, program.compiled, start):
            diverged |= _newly_diverged(progress, len(specs), diverged)
            _log(progress, logs, diverged)
            if progress.epoch == progress.num_epochs or len(diverged) == len(specs):
                break
            if program.lanes == 1:
                _save_policy(program, jax.device_get(progress.state.learner), specs[0], folders[0])
            session.on_epoch(specs, progress)
            if session.should_stop():
                session.report(f"saved {checkpoints.save(progress)}")
                return [Result(folder, STOPPED, progress.epoch, progress.num_epochs, {}) for folder in folders]
            if options.checkpoint_every and progress.epoch % options.checkpoint_every == 0:
                checkpoints.try_save(progress)
    results = _finish(session, program, progress, specs, folders, diverged)
    if len(diverged) < len(specs):
        checkpoints.clear()
    session.on_epoch(specs, progress)
    return results


def _open(stack: contextlib.ExitStack, session: _Session, lanes: int, start: Start, spec: RunSpec, folder: Path) -> list[Sink]:
    """Writes config.json of a run that begins, and opens the sinks for its metrics."""
    if start.epoch == 0:
        engine = run_folder.engine_name(session.env)
        run_folder.create(folder, spec, engine, {**dataclasses.asdict(session.options), "lanes": lanes})
    steps = start.epoch * config_lib.steps_per_epoch(spec.config, session.env.episode_length)
    opened = [*sinks.open_sinks(folder, session.options.log, start.epoch, steps), *session.make_sinks(spec, folder)]
    for sink in opened:
        stack.callback(sink.close)
    return opened


def _newly_diverged(progress: Progress, lanes: int, diverged: dict[int, int]) -> dict[int, int]:
    """Returns the lanes whose learner has just become not finite, with the epoch."""
    learner = progress.state.learner
    batched = progress.state.env_steps.ndim > 0
    finite = np.atleast_1d(_are_finite(learner) if batched else trainer.is_finite(learner))
    return {lane: progress.epoch for lane in range(lanes) if not finite[lane] and lane not in diverged}


def _log(progress: Progress, logs: Sequence[Sequence[Sink]], diverged: dict[int, int]) -> None:
    """Writes an epoch's metrics of each run that has not diverged."""
    metrics = {name: np.atleast_1d(values) for name, values in progress.metrics.items()}
    for lane, opened in enumerate(logs):
        if lane not in diverged:
            row = sinks.row(progress, {name: float(values[lane]) for name, values in metrics.items()})
            for sink in opened:
                sink.write(row)


def _save_policy(program: Program, learner: Any, spec: RunSpec, folder: Path) -> None:
    """Writes the policy of a run's learner, given as NumPy arrays; as the learner's state where NumPy cannot compute it."""
    policy = program.learner.export(learner, spec.hparams)
    stored = StoredPolicy(program.learner, learner, spec.hparams, program.sizes) if policy is None else policy
    stored.save(folder / run_folder.POLICY_FILE)


def _finish(
    session: _Session,
    program: Program,
    progress: Progress,
    specs: Sequence[RunSpec],
    folders: Sequence[Path],
    diverged: dict[int, int],
) -> list[Result]:
    """Writes what runs leave that have ended: policies and results. result.json comes last: with it a run is done."""
    outcome: Any = None
    learners = jax.device_get(progress.state.learner)
    if len(diverged) < len(specs):
        keys, _ = program_lib.stack(specs, program.choices, program.lanes)
        outcome = program_lib.evaluate(session.env, program, progress.state, keys, session.options.final_episodes)
    results = []
    for lane, (spec, folder) in enumerate(zip(specs, folders)):
        epoch = diverged.get(lane, progress.epoch)
        content = {
            "status": DIVERGED if lane in diverged else FINISHED,
            "epochs": epoch,
            "env_steps": progress.env_steps // progress.epoch * epoch,
            "wall_seconds": progress.wall_seconds,
            "lanes": program.lanes,
        }
        if lane not in diverged:
            _save_policy(program, program_lib.lane_of(learners, lane, program.lanes), spec, folder)
            content |= play.summarize(*(x[lane] for x in outcome))
        files.write_json(folder / run_folder.RESULT_FILE, content)
        results.append(Result(folder, str(content["status"]), epoch, progress.num_epochs, content))
    return results
