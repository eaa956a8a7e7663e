"""The run driver: trains one run, or many in parallel, into run folders.

Runs that differ only in `spec._LANE_FIELDS` are *lanes* of one vmapped program. A lane gives the same result as the run alone.
`train`, `resume` and `sweep` all call `train_runs`.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_dher import config as config_lib
from mjx_dher import evaluate
from mjx_dher import spec as spec_lib
from mjx_dher.contract import robot_interface
from mjx_dher.parallel import mesh, processes
from mjx_dher.runs import loop
from mjx_dher.runs import program as program_lib
from mjx_dher.runs.folder import fingerprint, lane_checkpoints, loggers, run_folder
from mjx_dher.runs.folder.lane_checkpoints import LaneCheckpoints, Schedule
from mjx_dher.runs.folder.loggers import Sink
from mjx_dher.runs.folder.run_folder import FAILED, FINISHED, Claims, Run, named
from mjx_dher.runs.loop import Progress
from mjx_dher.runs.program import Program
from mjx_dher.spec import Options, RunSpec
from mjx_dher.system import files, signals
from mjx_dher.types import Env

STOPPED = "stopped"


class Result(NamedTuple):
    """Outcome of a run."""

    folder: Path
    status: str  # finished, failed or stopped
    epoch: int  # epochs that have ended
    num_epochs: int
    content: dict[str, Any]  # content of result.json; empty for a stopped run


@dataclasses.dataclass(frozen=True)
class _Session:
    """Arguments of `train_runs` that do not belong to single runs."""

    env: Env
    options: Options
    should_stop: Callable[[], bool]
    report: Callable[[str], None]
    on_epoch: Callable[[Sequence[RunSpec], Progress], None]
    shared: Path
    sweep: bool
    devices: int


@dataclasses.dataclass
class _Watch:
    """Failures and warnings of parallel runs."""

    specs: Sequence[RunSpec]
    folders: Sequence[Path]
    report: Callable[[str], None]
    failed: dict[int, tuple[int, str]]  # epoch and reason of each failed lane; updated in place
    configs: Sequence[bytes]  # contents of config.json, in the process that writes
    warned: set[tuple[int, str]] = dataclasses.field(default_factory=set)

    def look(self, progress: Progress, rows: Sequence[dict[str, float]]) -> None:
        """Records the lanes that failed in an epoch, and reports each kind of warning once. Raises FolderError as
        `check_folders` does.
        """
        self.check_folders()
        finite = np.atleast_1d(progress.finite)
        for lane, (spec, folder, row) in enumerate(zip(self.specs, self.folders, rows)):
            name = f"{folder.name}: " if len(self.specs) > 1 else ""
            if lane in self.failed:
                continue
            if reason := loggers.failure(row, spec.config, bool(finite[lane])):
                self.failed[lane] = progress.epoch, reason
                self.report(f"{name}failed in epoch {progress.epoch}: {reason}")
                continue
            for kind, text in loggers.warnings(row, spec.config).items():
                if (lane, kind) not in self.warned:
                    self.warned.add((lane, kind))
                    self.report(f"{name}epoch {progress.epoch}: {text}")

    def check_folders(self) -> None:
        """Raises FolderError if a folder is gone or replaced, because writing to the open metrics.csv raises nothing then."""
        for folder, config in zip(self.folders, self.configs):
            run_folder.check_in_place(folder, config)


def train_runs(
    env: Env,
    specs: Sequence[RunSpec],
    folders: Sequence[Path],
    *,
    options: Options | None = None,
    lanes: int | None = None,
    devices: int | str = 1,
    shared: Path | None = None,
    sweep: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    report: Callable[[str], None] = lambda text: None,
    on_epoch: Callable[[Sequence[RunSpec], Progress], None] = lambda specs, progress: None,
) -> list[Result]:
    """Trains runs that share a program, as many in parallel as possible, each into its own folder.

    A run whose folder has a checkpoint resumes from it. A failed run (`loggers.failure`) ends without the others, and its
    result has the reason.

    Args:
      specs: descriptions, which must agree in `RunSpec.program`.
      folders: run folders, one per run. Missing ones are made.
      lanes: most parallel runs. Default: one on a CPU, whose cores one run fills, otherwise as many as fit into memory.
      devices: number of devices, or "all". Parallel runs are distributed among them. If there are fewer runs than devices,
        several devices share a run; in a sweep, if there are fewer `lanes`.
      shared: folder for the checkpoints of parallel runs. Default: "unfinished" next to the first run's folder.
      sweep: whether to skip runs that have ended or that another process trains, and to restart runs whose checkpoints are
        unusable, instead of raising an error.
      should_stop: called after every epoch. True stops training with a checkpoint.
      report: called with a line about each program and checkpoint.
      on_epoch: called after every epoch of the parallel runs, the last time when their results are written.

    Returns:
      One Result per run. Fewer if training was stopped or runs were skipped.

    Raises:
      ValueError: a run cannot be trained, memory or devices are insufficient, the devices do not divide the sizes, or
        `stop_at` or `keep_end` is given for several runs.
      FolderError: a run has ended, another process trains it, or its folder is not writable, in a run's checkpoints, or moved.
    """
    options, folders = options or Options(), [Path(folder) for folder in folders]
    _check_runs(env, specs, folders, options, sweep)
    placed_on = mesh.find(devices)
    shared = folders[0].parent / "unfinished" if shared is None else shared
    asked = lambda: processes.any_process(should_stop())  # noqa: E731
    session = _Session(env, options, asked, report, on_epoch, shared, sweep, max(1, len(placed_on)))
    claims = Claims(sweep, report, processes.broadcast(lambda: lane_checkpoints.groups(shared, folders)))
    free = processes.broadcast(lambda: [claims.is_free(*run) for run in zip(specs, folders)])
    waiting = [run for run, is_free in zip(zip(specs, folders), free) if is_free]
    if not waiting:
        return []
    if len(waiting) == 1 and not sweep:  # before compilation
        saved = [run_folder.epoch_of(path) for path in run_folder.checkpoints(waiting[0][1])]
        _is_trained(env, *waiting[0], saved)
    with contextlib.nullcontext() if processes.is_alone() else signals.held(report, shared.parent):  # others would wait
        own, most = [spec for spec, _ in waiting], mesh.most_lanes(lanes, placed_on)
        alike = claims.largest(waiting)
        program = program_lib.compile_runs(env, own, most, options.final_episodes, report, placed_on, sweep, alike)
        processes.check_equal({"lanes": program.lanes})  # by default they depend on memory
        return _train_in_turn(session, program, claims, waiting)


def _is_trained(env: Env, spec: RunSpec, folder: Path, saved: Sequence[int]) -> bool:
    """Whether a run with `keep_end` was cut after its last checkpoint, so that only the last evaluation is left.

    `saved` are the epochs of its checkpoints. Raises ValueError if it has ended.
    """
    last = config_lib.num_epochs(spec.config, env.episode_length)
    if max(saved, default=0) == last and not (folder / run_folder.RESULT_FILE).exists():
        from mjx_dher.runs.folder import reading

        if reading.read_spec(folder).config.total_steps == spec.config.total_steps:  # and not shortened for this resume
            return True
    loop.refuse_ended(spec.config, env.episode_length, saved)
    return False


def _check_runs(env: Env, specs: Sequence[RunSpec], folders: Sequence[Path], options: Options, sweep: bool) -> None:
    """Raises ValueError or FolderError for invalid options or folders, and runs that cannot be trained or share no program."""
    options.check()
    if sweep or len(specs) > 1:
        options.check_many()
    for spec in specs:
        spec_lib.validate(spec, env.episode_length)
    for folder in folders:
        run_folder.check_place(folder)
    if len({spec.program for spec in specs}) != 1 or len({folder.absolute() for folder in folders}) != len(specs):
        raise ValueError("train_runs needs one or more runs that agree in RunSpec.program, each with its own folder")


def _train_in_turn(session: _Session, program: Program, claims: Claims, waiting: Sequence[Run]) -> list[Result]:
    """Trains runs, as many in parallel as the program has lanes, until all are trained or a stop is requested."""
    results: list[Result] = []
    while waiting and not (results and session.should_stop()):
        with contextlib.ExitStack() as stack:
            claimed, waiting = _claim(claims, stack, waiting, program.lanes)
            if not claimed:
                break
            specs, folders = zip(*claimed)
            with named(folders[0]), signals.held(session.report, folders[0] if not session.sweep else session.shared.parent):
                results += _train(session, program, specs, folders)
    return results


def _claim(claims: Claims, stack: contextlib.ExitStack, waiting: Sequence[Run], lanes: int) -> tuple[list[Run], list[Run]]:
    """Claims runs for the first process. Returns the claimed and the waiting ones."""
    places = {run[1]: place for place, run in enumerate(waiting)}
    decide = lambda: [[places[folder] for _, folder in runs] for runs in claims.claim(stack, waiting, lanes)]  # noqa: E731
    claimed, left = processes.broadcast(decide)
    return [waiting[place] for place in claimed], [waiting[place] for place in left]


def _train(session: _Session, program: Program, specs: Sequence[RunSpec], folders: Sequence[Path]) -> list[Result]:
    """Trains parallel runs from their start or checkpoint, to their end or until a stop is requested."""
    options = session.options
    keep = options.keep if program.lanes == 1 else 1
    physics, flags = run_folder.engine_name(session.env), fingerprint.jax_flags()
    runs = [fingerprint.identity(spec, physics, fingerprint.sources(spec), flags) for spec in specs]
    checkpoints = LaneCheckpoints(folders, program.lanes, session.shared, keep, session.sweep, session.report, runs)
    keys, hparams = program_lib.stack(specs, program.choices, program.lanes)
    num_epochs = config_lib.num_epochs(specs[0].config, session.env.episode_length)
    will_save = 0 < options.checkpoint_every < num_epochs
    start = checkpoints.restore(functools.partial(program.compiled.init, keys, hparams), will_save)
    trained = _is_trained(session.env, specs[0], folders[0], [start.epoch])
    report_once = functools.cache(session.report)
    with contextlib.ExitStack() as stack:
        ended = [min(start.epoch, checkpoints.failed.get(lane, (start.epoch + 1,))[0] - 1) for lane in range(len(specs))]
        own = [*zip(ended, specs, folders, runs)] if processes.leads() else []
        with run_folder.kept_unless_opened(folders if own else ()):
            logs = [_open(stack, session, program.lanes, *run) for run in own]
        configs = [(folder / run_folder.CONFIG_FILE).read_bytes() for folder in folders[: len(own)]]
        watch = _Watch(specs, folders, session.report, checkpoints.failed, configs)
        success = processes.broadcast(lambda: run_folder.success_rates(folders[0], start.epoch))  # for stop_at, of a single run
        schedule = Schedule(options.checkpoint_every)
        trained |= options.is_reached(success)
        progress = loop.resumed(session.env, specs[0].config, start)
        for progress in () if trained else loop.run(session.env, specs[0].config, program.compiled, start):
            rows = _rows(progress, len(specs))
            watch.look(progress, rows)
            for lane, (row, opened) in enumerate(zip(rows, logs)):
                for sink in opened if lane not in watch.failed else ():
                    sink.write(row)
            success.append(rows[0]["success_rate"])
            if progress.epoch == progress.num_epochs or len(watch.failed) == len(specs) or options.is_reached(success):
                break
            if program.lanes == 1:
                learner = processes.collect(progress.state.learner)
                try:
                    _save_policy(session.env, program, learner, specs[0], folders[0], runs[0])
                except OSError as error:  # the run can continue
                    report_once(f"cannot write the policy ({error})")
            session.on_epoch(specs, progress)
            if session.should_stop():
                session.report(f"saved {checkpoints.save(progress)}")
                return [Result(folder, STOPPED, progress.epoch, progress.num_epochs, {}) for folder in folders]
            if processes.any_process(schedule.is_due(progress.epoch)):
                with schedule.saving():
                    checkpoints.try_save(progress)
    if progress.epoch < progress.num_epochs and options.is_reached(success):
        session.report(f"stop_at {options.stop_at:g} is reached after epoch {progress.epoch} of {progress.num_epochs}")
    if options.keep_end and not watch.failed:
        checkpoints.try_save(progress)
    ended_runs = _finish(session, program, progress, runs, watch)
    if len(watch.failed) < len(specs):
        checkpoints.clear(options.keep_end)
    if not trained:
        session.on_epoch(specs, progress)
    return ended_runs


def _open(
    stack: contextlib.ExitStack, session: _Session, lanes: int, ended: int, spec: RunSpec, folder: Path, run: dict[str, Any]
) -> list[Sink]:
    """Writes config.json of a run that starts, or resumes with other settings or options, and opens its metrics' sinks.

    `ended` is the number of epochs in its metrics.
    """
    digest, earlier = fingerprint.digest(run), []
    if ended:
        from mjx_dher.runs.folder import results

        earlier = results.earlier_digests(folder, digest)
    placed = {"lanes": lanes} if session.devices == 1 else {"lanes": lanes, "devices": session.devices}
    extra = {**dataclasses.asdict(session.options), **placed, "interface": robot_interface(session.env)}
    run_folder.write_config(folder, spec, run["physics"], extra, earlier, resumes=ended > 0)
    steps = ended * config_lib.steps_per_epoch(spec.config, session.env.episode_length)
    opened = loggers.open_sinks(folder, session.options.log, ended, steps, digest)
    for sink in opened:
        stack.callback(sink.close)
    return opened


def _rows(progress: Progress, lanes: int) -> list[dict[str, float]]:
    """Metrics of an epoch, per run."""
    metrics = {name: np.atleast_1d(values) for name, values in progress.metrics.items()}
    return [loggers.metrics_row(progress, {name: float(x[lane]) for name, x in metrics.items()}) for lane in range(lanes)]


def _save_policy(env: Env, program: Program, learner: Any, spec: RunSpec, folder: Path, run: dict[str, Any]) -> None:
    """Writes the policy of a run's learner, as NumPy arrays if possible, else as the learner's state.

    The learner is None in processes that do not write.
    """
    if learner is None:
        return
    policy = program.learner.export(learner, spec.hparams)
    if policy is None:
        from mjx_dher.policy.learner_policy import LearnerPolicy

        policy = LearnerPolicy(program.learner, learner, spec.hparams, program.spec)
    run_folder.save_policy(folder, dataclasses.replace(policy, interface=robot_interface(env)), run)


def _finish(
    session: _Session, program: Program, progress: Progress, runs: Sequence[dict[str, Any]], watch: _Watch
) -> list[Result]:
    """Writes the policies and results of ended runs. result.json comes last, because it marks a run as done."""
    outcome: Any = None
    specs, folders, failed = watch.specs, watch.folders, watch.failed
    learners = processes.collect(progress.state.learner)
    if len(failed) < len(specs):
        keys, _ = program_lib.stack(specs, program.choices, program.lanes)
        episodes = session.options.final_episodes
        outcome = program_lib.evaluate(session.env, program, progress.state, keys, episodes)
    watch.check_folders()
    results = []
    for lane, (spec, folder) in enumerate(zip(specs, folders)):
        if processes.leads():
            if lane not in failed:
                learner = program_lib.lane_of(learners, lane, program.lanes)
                _save_policy(session.env, program, learner, spec, folder, runs[lane])
                files.flush(folder / run_folder.POLICY_FILE)
            loggers.flush_logs(folder)
    for lane, folder in enumerate(folders):  # together, because a kill in between would make the others resume
        epoch, reason = failed.get(lane, (progress.epoch, ""))
        content = {
            "status": FAILED if reason else FINISHED,
            "reason": reason,
            "epochs": epoch,
            "env_steps": progress.env_steps // progress.epoch * epoch,
            "wall_seconds": progress.wall_seconds,
            "lanes": program.lanes,
            "digest": fingerprint.digest(runs[lane]),
        }
        if not reason:
            content |= evaluate.summarize(*(x[lane] for x in outcome[:4]))
        if processes.leads():
            files.write_json(folder / run_folder.RESULT_FILE, content)
        results.append(Result(folder, str(content["status"]), epoch, progress.num_epochs, content))
    return results
