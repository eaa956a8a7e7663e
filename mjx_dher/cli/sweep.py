"""The command `sweep`, and the comparison that it prints."""

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import tyro
from rich.console import Console
from typing_extensions import Doc

from mjx_dher import components, presets, spec
from mjx_dher.cli import parse, settings
from mjx_dher.cli.common import Devices, Screen, join, make_env, settle_compiler, try_components
from mjx_dher.components import doc
from mjx_dher.config import Config, HParams
from mjx_dher.fleet import chunks
from mjx_dher.fleet.chunks import FleetOptions
from mjx_dher.lookup import check_name
from mjx_dher.runs.folder import fingerprint, reading, results, run_folder
from mjx_dher.spec import Engine, Options, RunSpec
from mjx_dher.sweeps import grid
from mjx_dher.system import files, signals
from mjx_dher.system.files import FolderError
from mjx_dher.system.machine import check_platform, prepare
from mjx_dher.validation import check_count, check_devices, check_number

GRID = ("env", "sampler", "weight_kernel", "weight_normalization", "metric", "priority", "generator", "learner", "networks")


SAMPLERS = ("future", "closest", "epsilon_closest", "weighted")  # by default


if TYPE_CHECKING:

    class _Axes: ...

    class _Changes: ...

else:  # all numbers and sizes by name

    def _options(name: str, hints: dict[str, Any], text: str) -> type:
        options = [
            (field, Annotated[hint | None, Doc(text.format(field))], dataclasses.field(default=None))
            for field, hint in hints.items()
        ]
        return dataclasses.make_dataclass(name, options, frozen=True)

    _Axes = _options("_Axes", dict.fromkeys(HParams._fields, tuple[float, ...]), "Values of {}. Default: the preset's.")
    _Changes = _options("_Changes", get_type_hints(Config), "{} instead of the preset's.")


@dataclasses.dataclass(frozen=True)
class SweepArgs:
    """Train every combination of environments, components, numbers and seeds, and compare them.

    Runs that differ in sampler, numbers or seed train in parallel in one compiled program. Each trial is a run folder in
    cells/. Run the same command again to resume a sweep, or a larger one to add trials.
    """

    out: Path
    """Folder of the sweep, for results.csv, finals.csv and comparison.csv (docs/sweeps.md), and cells/."""
    changes: Annotated[_Changes, tyro.conf.arg(name="")]
    sweep: _Axes
    """Numbers to try: --sweep.her-k 2 4 8."""
    options: Annotated[Options, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Options)
    env: Annotated[tuple[str, ...], doc("env", "Environments")] = ("push",)
    engine: Engine = "auto"
    """Physics: native, warp, jax or auto."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments of the environments as NAME=VALUE."""
    sampler: Annotated[tuple[str, ...], doc("sampler", "Samplers of hindsight goals")] = SAMPLERS
    weight_kernel: Annotated[tuple[str, ...], doc("weight_kernel", "Kernels")] = ("linear",)
    weight_normalization: Annotated[tuple[str, ...], doc("weight_normalization", "Normalizations of distances")] = ("mean",)
    metric: Annotated[tuple[str, ...], doc("metric", "Distances between goals")] = ("position",)
    priority: Annotated[tuple[str, ...] | None, doc("priority", "Priorities, by default the preset's")] = None
    generator: Annotated[tuple[str, ...], doc("generator", "Generators of the goals of training episodes")] = ("reset",)
    learner: Annotated[tuple[str, ...] | None, doc("learner", "Learners, by default the preset's")] = None
    networks: Annotated[tuple[str, ...] | None, doc("networks", "Networks, by default the preset's")] = None
    seeds: int = 10
    """Runs per setting. All settings use the same seeds, and so the same initial networks and resets."""
    first_seed: int = 0
    """First seed. The others follow."""
    preset: Literal["auto", presets.Preset] = "auto"
    """Base settings, which other options override: cpu, gpu, frugal, paper, or auto (cpu or gpu)."""
    lanes: int | None = None
    """Most parallel runs. Default: 1 on a CPU, whose cores a run fills, and as many as fit into memory on a GPU."""
    distributed: bool = False
    """Train together with the other processes of this job, which run the same command (docs/scaling.md)."""
    devices: Devices = 1
    """Number of devices, or all. Parallel runs are distributed. With fewer `--lanes` than devices, several share a run."""
    fleet: Annotated[FleetOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=FleetOptions)
    threshold: float = 0.9
    """Success rate for the time to success."""
    baseline: str = "future"
    """Setting to compare with: a sampler, or a setting as named in the table."""
    dry_run: bool = False
    """Print what would be trained, without writing anything."""


def parse_sweep_args(argv: list[str], report: Callable[[str], None] = lambda text: None) -> tuple[SweepArgs, list[RunSpec]]:
    """Parses the arguments of `sweep` and makes its trials, before JAX or MuJoCo is loaded.

    `report` is called with the ignored options, which no trial reads. Raises ValueError for invalid arguments.
    """
    for flag in argv:
        if (name := flag.partition("=")[0].lstrip("-").replace("-", "_")) in HParams._fields and flag.startswith("--"):
            dashed = name.replace("_", "-")
            raise ValueError(f"--{dashed} is called --sweep.{dashed} here, and takes one or more values to try")
    default = SweepArgs(tyro.MISSING, changes=_Changes(), sweep=_Axes())
    args = parse(SweepArgs, argv, default=default)
    _check(args)
    preset: str = "cpu" if args.preset == "auto" else args.preset
    args = _without_unread(args, trials_of(args, preset), report)
    if args.preset == "auto" and args.fleet.ray is None:  # else the preset is known once the cluster is joined
        trials_of(args, preset)  # raises for invalid ones before CUDA starts
        preset = presets.machine_preset()
    return args, trials_of(args, preset)


def _without_unread(args: SweepArgs, trials: list[RunSpec], report: Callable[[str], None]) -> SweepArgs:
    """Reports components, sizes and numbers that no trial reads, and drops the sizes and numbers."""
    groups: dict[str, Any] = {"changes": args.changes, "sweep": args.sweep}
    read = [fingerprint.settings(run) for run in trials]
    default = {field.name: field.default for field in dataclasses.fields(args)}
    given = [name for name in GRID if getattr(args, name) != default[name]]
    given += [name for own in groups.values() for name, value in vars(own).items() if value is not None]
    unread = {name: None for name in given if not any(components.reads(settings, name) for settings in read)}
    if unread:
        report(f"ignored, because no component of these runs reads it: {', '.join(unread)}")
    if args.priority and not any(run.hparams.priority_fraction for run in trials):
        report("priority has no effect at priority_fraction 0; add --sweep.priority-fraction 0.5, for example")
    for group, own in groups.items():
        groups[group] = dataclasses.replace(own, **{name: None for name in unread if hasattr(own, name)})
    return dataclasses.replace(args, **groups)


def _check(args: SweepArgs) -> None:
    """Raises ValueError for an argument that is invalid with any preset."""
    for field in GRID:
        if getattr(args, field) == ():
            raise ValueError(f"{field} must be one or more names; got none")
    for field, values in vars(args.sweep).items():
        if values == ():
            raise ValueError(f"sweep.{field} must be one or more numbers; got none")
    samplers = dict.fromkeys([*components.COMPONENTS["sampler"], *args.sampler])
    check_name("baseline, up to its first comma,", args.baseline.partition(",")[0], tuple(samplers))
    check_count("seeds", args.seeds)
    check_number("first_seed", args.first_seed, f"[0, {2**32 - args.seeds}]")
    if args.lanes is not None:
        check_count("lanes", args.lanes)
    check_devices(args.devices)
    args.options.check()
    args.options.check_many()
    check_number("threshold", args.threshold, "(0, 1]", float)
    args.fleet.check()
    if args.fleet.ray is not None and (args.devices != 1 or args.distributed):
        raise ValueError("devices and distributed cannot be combined with ray, where each task has its own device")
    if args.fleet.ray is not None and args.dry_run:
        raise ValueError("dry_run cannot be combined with ray: try the command without --ray")
    run_folder.check_place(args.out)
    if args.out.is_dir() and any(args.out.iterdir()) and not (args.out / grid.CELLS).is_dir():
        raise FolderError(f"out: {args.out} holds something other than a sweep; pass a new or empty folder")
    files.inside(args.out, [*args.out.glob("*"), *args.out.glob("*/*")])


def trials_of(args: SweepArgs, preset: str) -> list[RunSpec]:
    """All trials of the grid. Raises ValueError if one of them cannot run."""
    specs, plain = [], []
    changes = {name: value for name, value in vars(args.changes).items() if value is not None}
    axes = {name: values for name, values in vars(args.sweep).items() if values is not None}
    parts = [list(dict.fromkeys(getattr(args, field) or (None,))) for field in GRID]
    for env, *choice in itertools.product(*parts):
        named = {field: part for field, part in zip(GRID[1:], choice) if part is not None}
        learns = {field: part for field, part in named.items() if field in ("learner", "networks")}
        # A run's unread settings do not depend on the rest of the grid, so that a larger one has the same run.
        make = functools.partial(presets.preset, preset, env, engine=args.engine, env_kwargs=args.env_kwargs)
        base, unread = make(**named).replace(**changes), make(**learns).replace(**changes)
        for point in itertools.product(*axes.values()):
            run = base.replace(**dict(zip(axes, point)))
            spec.validate(run)
            specs.append(run)
            plain.append(unread)
    return grid.trials(specs, range(args.first_seed, args.first_seed + args.seeds), plain)


def sweep_command(argv: list[str], console: Console) -> int:
    """Trains a grid of runs."""
    args, trials = parse_sweep_args(argv, console.print)
    if args.dry_run:
        return _dry_run(args, trials, console)
    if args.fleet.ray is not None:
        from mjx_dher.cli import fleet

        return _end(args, *fleet.train(args, console), signals.asked() or 0, console)
    settle_compiler(args.engine)
    described = {name: value for name, value in dataclasses.asdict(args).items() if name != "out"}
    screen = join(args.distributed, {**described, "trials": [*map(fingerprint.trial_name, trials)]}, console)
    return _sweep(args, trials, screen)


def _sweep(args: SweepArgs, trials: list[RunSpec], console: Console) -> int:
    """Trains a grid of runs. The first of several processes decides and writes."""
    from mjx_dher.parallel import processes

    places = {trial: place for place, trial in enumerate(trials)}
    with contextlib.ExitStack() as stack:

        def begin() -> list[int]:
            stack.enter_context(files.made(args.out / grid.CELLS))
            settings.check_writable(args.out / grid.CELLS)
            return [places[trial] for trial in announce(args, trials, console)]

        todo = [trials[place] for place in processes.broadcast(begin)]
        if todo:
            _train(args, todo, console)
        number = processes.highest(signals.asked() or 0)
        return int(processes.broadcast(lambda: _end(args, trials, todo, number, console)))


def announce(args: SweepArgs, trials: list[RunSpec], console: Console) -> list[RunSpec]:
    """Prints the number of runs. Returns the trials that have not ended."""
    for text in grid.changed_files(args.out, trials):
        console.print(text, soft_wrap=True)
    todo = [trial for trial in trials if not grid.is_done(args.out, trial)]
    done = f"; {len(trials) - len(todo)} of them are done already" if len(todo) < len(trials) else ""
    console.print(f"{len(trials)} runs{done}; writing to {args.out}", soft_wrap=True)
    ended = (reading.read_config(grid.folder_of(args.out, trial)) for trial in set(trials).difference(todo))
    own = args.options.final_episodes
    if other := {content.get("final_episodes", own) for content in ended} - {own}:
        console.print(f"final_episodes: done runs keep theirs, which had {', '.join(map(str, sorted(other)))}", soft_wrap=True)
    return todo


def _end(args: SweepArgs, trials: list[RunSpec], todo: list[RunSpec], number: int, console: Console) -> int:
    """Writes the tables of ended trials and reports the others. `number` is the number of a stop signal, or 0. Returns 2 if all
    trials failed, as `train` does.
    """
    left = [trial for trial in todo if not grid.is_done(args.out, trial)]
    if left and number:
        ended = len(trials) - len(left)
        console.print(f"stopped; {ended} runs are done; run the same command again for the other {len(left)}")
        return 128 + number
    signals.forget()
    if len(left) == len(trials):
        raise files.BusyError(f"{args.out}: another process is training all {len(left)} runs")
    _write_tables(args, console)
    if left:
        raise files.BusyError(
            f"{args.out}: another process is training {len(left)} of the {len(trials)} runs, which are not in the tables;"
            " run the same command again when it has ended"
        )
    unfinished = args.out / "unfinished"
    for storage in unfinished.glob("fleet-*"):  # a driver that still trains holds the lock
        with contextlib.suppress(OSError, files.FolderError), files.lock(args.out):
            chunks.clear(storage, args.out)
    with contextlib.suppress(OSError):  # it does not exist, or has storages
        unfinished.rmdir()
    statuses = {results.read_result(grid.folder_of(args.out, trial))["status"] for trial in trials}
    return 2 if statuses == {run_folder.FAILED} else 0


def _dry_run(args: SweepArgs, trials: list[RunSpec], console: Console) -> int:
    """Prints the programs and runs of a sweep. Makes environments, but compiles and writes nothing."""
    settings.check_writable(args.out)
    todo = [trial for trial in trials if not grid.is_done(args.out, trial)]
    console.print(f"{len(trials)} runs, {len(trials) - len(todo)} of them done already")
    settle_compiler(args.engine)
    check_platform()
    groups = grid.by_program(todo)
    for group in groups:
        program = group[0].program
        env = make_env(program)
        memory = settings.memory_lines(env, group, args.lanes, 1 if args.distributed else args.devices, sweep=True)
        samplers = ", ".join(dict.fromkeys(run.sampler for run in group))
        console.print(f"{program.env}, learner {program.learner}: {len(group)} runs; samplers {samplers}", soft_wrap=True)
        for line in (settings.amount(program.config, env.episode_length, len(group)), *memory):
            console.print(f"  {line}", soft_wrap=True)
    lanes = args.lanes or "one on a CPU, as many as fit into memory on a GPU"
    console.print(f"programs: {len(groups)}; parallel runs: {lanes}; nothing was written", soft_wrap=True)
    return 0


def _train(args: SweepArgs, todo: list[RunSpec], console: Console) -> None:
    """Trains trials until a signal requests a stop."""
    prepare()
    try_components(todo, console)
    with contextlib.closing(Screen(console, todo)) as screen:
        grid.train(
            args.out,
            todo,
            make_env,
            options=args.options,
            lanes=args.lanes,
            devices=args.devices,
            should_stop=signals.are_asked,
            report=lambda text: console.print(text, soft_wrap=True),
            on_epoch=screen.show,
        )


def _write_tables(args: SweepArgs, console: Console) -> None:
    from mjx_dher.cli.report import compare
    from mjx_dher.sweeps import comparison, tables

    with files.lock(args.out / grid.CELLS, wait=True):  # another process may be writing them
        trials = tables.read(args.out)
        tables.write(args.out, trials)
        compare(args.out, comparison.groups(trials), args.baseline, args.threshold, console)
    console.print(f"wrote {tables.RESULTS}, {tables.FINALS} and {comparison.COMPARISON} in {args.out}", soft_wrap=True)
