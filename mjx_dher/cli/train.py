"""The command `train`."""

import argparse
import contextlib
import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from mjx_dher import lookup, presets, spec
from mjx_dher.cli import common, parse
from mjx_dher.cli.common import VIEW_PORT, Devices, Screen, make_env, settle_compiler
from mjx_dher.lookup import check_name
from mjx_dher.presets import PRESETS, Preset
from mjx_dher.runs.folder import fingerprint, run_folder
from mjx_dher.spec import Options, RunSpec, to_texts
from mjx_dher.system import files, signals
from mjx_dher.system.files import FolderError
from mjx_dher.system.machine import check_platform, prepare
from mjx_dher.validation import check_all, check_devices


@dataclasses.dataclass(frozen=True)
class TrainArgs:
    """Train a policy with an off-policy learner and Hindsight Experience Replay.

    Other commands: `resume RUN` resumes a run, `eval RUN` evaluates runs, `view RUN` shows one in the browser, `demo` shows a
    bundled policy, `render RUN` draws episodes, `transfer RUN` plays a run in the original task, `export RUN` writes its
    policy for other programs, `sweep` trains and compares many runs, `plot DIR` draws curves, `report DIR` writes a report of
    a run or a sweep, `list` lists all tasks and components, `check` tests custom components, `engines ENV` shows the engines
    for a task, `doctor` tests this machine, `completion SHELL` prints a shell's completion, `--version` prints the version.
    See `eval --help` and so on.
    """

    spec: RunSpec
    preset: Literal["auto", Preset] = "auto"
    """Base settings, which other options override: cpu or gpu (tuned for time to success), auto (cpu or gpu), frugal (few
    environment steps) or paper (the paper's settings; see docs/results.md)."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """Run folder, or a config.json, to use as base settings instead of a preset. Other options override them."""
    out: Path | None = None
    """Run folder to write, never overwritten. Default: a new one under runs/."""
    trust: bool = False
    """Use code and data that --config names even if you have not trained with them on this machine."""
    dry_run: bool = False
    """Print what would be trained, and the memory that it needs, without writing anything."""
    curve: bool = True
    """Picture of the learning curve, curve.png, at the end, where Matplotlib is installed (extra plot)."""
    view: bool = False
    """Show the policy in the browser after each epoch. Needs the extra view."""
    view_port: int = VIEW_PORT
    """Port of that page; 0 means any free port."""
    distributed: bool = False
    """Train together with the other processes of this job: the same command on each (docs/scaling.md)."""
    devices: Devices = 1
    """Number of devices, or all, that share the run: its environments, ring and batches in equal parts."""
    options: Options = dataclasses.field(default_factory=Options)


def train_command(argv: list[str], console: Console) -> int:
    """Trains a policy and writes a run folder."""
    args = parse_train_args(argv, console.print)
    if args.dry_run:
        return _dry_run(args, console)
    viewer = _viewer(args.view_port) if args.view else None
    settle_compiler(args.spec.engine)
    own = {"seed": args.spec.seed, "sources": fingerprint.sources(args.spec), "devices": args.devices}
    described = {**fingerprint.settings(args.spec), **dataclasses.asdict(args.options), **own}
    screen = common.join(args.distributed, described, console)
    from mjx_dher.parallel import processes

    with contextlib.ExitStack() as stack:
        folder = Path(processes.broadcast(lambda: str(_claim(stack, args.out, args.spec, resumes=args.distributed))))
        prepare()
        env = make_env(args.spec)
        common.try_components([args.spec], screen, env)
        after_epoch = stack.enter_context(viewer(folder, screen)) if viewer and processes.leads() else lambda: None
        return train_into(env, args.spec, folder, args.options, args.curve, screen, args.devices, after_epoch)


def _viewer(port: int) -> Callable[[Path, Console], contextlib.AbstractContextManager[Callable[[], None]]]:
    """The viewer of a run in training. Raises ValueError if the page cannot be served."""
    from mjx_dher.cli import view
    from mjx_dher.viewer import address

    free = address.check(view.Page().host, port)
    return lambda folder, console: view.beside(folder, free, console)


def _dry_run(args: TrainArgs, console: Console) -> int:
    """Prints what would be trained. Makes the environment, but compiles and writes nothing."""
    from mjx_dher.cli import settings

    settings.check_out(args.out)
    settle_compiler(args.spec.engine)
    check_platform()
    env = make_env(args.spec)
    memory = settings.memory_lines(env, [args.spec], None, 1 if args.distributed else args.devices)
    for title, values in fingerprint.groups(args.spec).items():
        console.print(f"{title}: {'; '.join(f'{name} {fingerprint.text(x)}' for name, x in values.items())}")
    amount = settings.amount(args.spec.config, env.episode_length)
    for line in (amount, *memory, "one program to train, one for the last evaluation; nothing was written"):
        console.print(line)
    return 0


def parse_train_args(argv: list[str], report: Callable[[str], None] = lambda text: None) -> TrainArgs:
    """Parses the arguments of `train`, and checks them before JAX, CUDA or MuJoCo is loaded.

    `report` is called with the origin of the settings, if they come from a file. Raises ValueError for invalid arguments.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)  # arguments that decide the defaults of the others
    # One without its value is an error of the whole parser.
    early.add_argument("--preset", default="auto", nargs="?", const="auto")
    early.add_argument("--env", default="push", nargs="?", const="push")
    early.add_argument("--learner", nargs="?")
    early.add_argument("--config", type=Path, nargs="?")
    chosen, _ = early.parse_known_args(argv)
    check_name("preset", chosen.preset, ("auto", *PRESETS))
    if chosen.config is not None:
        if chosen.preset != "auto":
            raise ValueError("config and preset cannot be combined; pass one of them")
        from mjx_dher.cli import settings

        base, options, notes = settings.load(chosen.config)
        args = _parse(argv, TrainArgs(base, options=options), f"those of {chosen.config}")
        run = args.spec
        if run.env == base.env:
            merged = to_texts({**base.env_arguments, **run.env_arguments})
            untyped = {text for text in merged if text in base.env_kwargs}.difference(argv)
            # Arguments of the file need trust, although the environment's name was typed.
            run = dataclasses.replace(run, env=base.env if untyped else run.env, env_kwargs=merged)
        run, ignored = _without_unread(base, run)
        for line in (*notes, settings.changes(base, run), *ignored):
            report(line)
        return dataclasses.replace(args, spec=run)

    def parse_preset(preset: Any) -> tuple[TrainArgs, list[str]]:
        base = presets.preset(preset, chosen.env, chosen.learner)
        args = _parse(argv, TrainArgs(base), f"those of preset {preset} for {chosen.env}")
        run, ignored = _without_unread(base, args.spec)
        return dataclasses.replace(args, spec=run, preset=preset), ignored

    # Finding the machine's preset starts CUDA, so invalid arguments are rejected before, except with --help.
    on_cpu = None if chosen.preset != "auto" or {"-h", "--help"} & set(argv) else parse_preset("cpu")
    preset = presets.machine_preset() if chosen.preset == "auto" else chosen.preset
    args, ignored = on_cpu if on_cpu is not None and preset == "cpu" else parse_preset(preset)
    for line in ignored:
        report(line)
    return args


def _parse(argv: list[str], default: TrainArgs, origin: str) -> TrainArgs:
    head = f"{inspect.getdoc(TrainArgs)}\n\nDefaults below are {origin}."
    args = parse(TrainArgs, argv, description=head, default=default, config=(tyro.conf.OmitArgPrefixes,))
    check_all((spec.validate, args.spec), (args.options.check,), (check_devices, args.devices), (_check_out, args))
    return args


def _check_out(args: TrainArgs) -> None:
    if args.distributed and args.out is None:
        raise ValueError("out must name the run folder with --distributed, so that the same command can resume it; got none")


def _without_unread(base: RunSpec, run: RunSpec) -> tuple[RunSpec, list[str]]:
    """Run with the values of `base` for settings that its components do not read, and lines about ignored settings."""
    kept = fingerprint.with_unread_of(base, run)
    old, new = fingerprint.settings(kept), fingerprint.settings(run)
    ignored = [f"{name} {fingerprint.text(new[name])}" for name in new if new[name] != old[name]]
    lines = [f"ignored, because no component of this run reads it: {', '.join(ignored)}"] if ignored else []
    if run.priority != base.priority and not run.hparams.priority_fraction:
        lines.append(f"priority {run.priority} has no effect at priority_fraction 0; add --priority-fraction 0.5, for example")
    return kept, lines


def _claim(stack: contextlib.ExitStack, out: Path | None, spec: RunSpec, resumes: bool) -> Path:
    """Locks a run's folder in `stack`: a new one, or if the command `resumes`, one with the same run. Raises FolderError if it
    holds something else, or the run has ended.
    """
    if not resumes or out is None or not (out / run_folder.CONFIG_FILE).exists():
        return stack.enter_context(run_folder.claim_new(out, spec))
    from mjx_dher.runs.folder import reading, results

    stack.enter_context(files.lock(out))
    reading.check_same(out, spec)
    if results.has_result(out) and results.read_result(out)["status"] != run_folder.FAILED:
        raise FolderError(f"out: {out} holds this run, and it has ended")
    return out


def train_into(
    env: Any,
    run: RunSpec,
    folder: Path,
    options: Options,
    curve: bool,
    console: Console,
    devices: Devices,
    after_epoch: Callable[[], None] = lambda: None,
) -> int:
    """Trains into `folder`, from its checkpoint if there is one."""
    from mjx_dher.parallel import processes
    from mjx_dher.runs import driver

    console.print(f"{run.env}, sampler {run.sampler}, seed {run.seed}; writing to {folder}")
    before: list[float] = []
    if (folder / run_folder.CONFIG_FILE).exists():
        from mjx_dher.runs.folder import results

        before = [row["success_rate"] for row in results.read_metrics(folder)]
    screen = Screen(console, [run], before)
    curve = curve and processes.leads()

    def on_epoch(specs: Any, progress: Any) -> None:
        screen.show(specs, progress)
        if curve:
            from mjx_dher.tools import figures

            figures.preload()
        after_epoch()

    common.warn_of_tau(run.hparams.polyak, console)
    with contextlib.closing(screen):
        (result,) = driver.train_runs(
            env,
            [run],
            [folder],
            options=options,
            devices=devices,
            should_stop=signals.are_asked,
            report=console.print,
            on_epoch=on_epoch,
        )
    if result.status == driver.STOPPED:
        console.print(
            f"stopped after epoch {result.epoch} of {result.num_epochs}; the policy so far is in {folder}, and"
            f" `{lookup.command_name()} resume {folder}` resumes"
        )
        return 128 + processes.highest(signals.asked() or 0)
    signals.forget()
    if result.status == run_folder.FAILED:
        _draw(folder, curve, console)
        raise ValueError(f"epoch {result.epoch}: {result.content['reason']}; {run_folder.last_checkpoint(folder)}")
    common.print_summary(result.content, console)
    console.print(f"run folder: {folder}")
    _draw(folder, curve, console)
    return 0


def _draw(folder: Path, curve: bool, console: Console) -> None:
    """Draws the curve of an ended run, or reports that it cannot be drawn."""
    if not curve:
        return
    from mjx_dher.runs.folder import results
    from mjx_dher.tools import curves, figures

    if not (figures.is_there() and results.read_metrics(folder)):
        return
    picture = folder / f"{curves.CURVE}.png"
    try:
        figures.write(curves.draw_curve(curves.read_curve(folder)), picture)
        console.print(f"learning curve: {picture}")
    except Exception as error:  # the run itself has succeeded
        console.print(f"the learning curve could not be drawn ({type(error).__name__}: {error})")
