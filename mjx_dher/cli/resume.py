"""The command `resume`."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from mjx_dher import envs, lookup, spec
from mjx_dher.cli import common, parse, settings
from mjx_dher.cli.common import Devices, Physics, Trust, make_env, settle_compiler
from mjx_dher.cli.train import train_into
from mjx_dher.runs.folder import fingerprint, reading, results, run_folder
from mjx_dher.spec import Options, RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError
from mjx_dher.system.machine import prepare
from mjx_dher.validation import check_devices


@dataclasses.dataclass(frozen=True)
class ResumeArgs:
    """Resume a run that was stopped or killed, from its newest undamaged checkpoint.

    On a CPU with the same engine, the result is bit-identical to an uninterrupted run. A finished run can resume with a larger
    --total-steps if it was trained with --keep-end. Options default to their last values.
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    engine: Physics = None
    trust: Trust = False
    distributed: bool = False
    """Train together with the other processes of this job: the same command on each (docs/scaling.md)."""
    devices: Devices | None = None
    """Number of devices, or all, that share the run. Default: as before."""
    total_steps: int | None = None
    """Environment steps of the whole run, including earlier ones. Default: as before."""
    curve: bool = True
    """Picture of the learning curve, curve.png, at the end, where Matplotlib is installed (extra plot)."""
    options: Annotated[Options, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Options)


def resume_command(argv: list[str], console: Console) -> int:
    """Resumes a run."""
    asked = parse(ResumeArgs, argv)  # to find the run
    content = reading.read_config(asked.run)
    args = parse(ResumeArgs, argv, default=dataclasses.replace(asked, options=settings.options_of(content)))
    if args.engine is not None:
        lookup.check_name("engine", args.engine, spec.ENGINES)
    if args.devices is not None:
        check_devices(args.devices)
    settle_compiler(args.engine or content["physics"])
    described = {name: str(value) for name, value in vars(args).items()} | {"digest": content["digest"]}
    screen = common.join(args.distributed, described, console)
    from mjx_dher.parallel import processes

    with contextlib.ExitStack() as stack:
        processes.broadcast(lambda: stack.enter_context(files.lock(args.run)))
        run, options = _to_resume(args, asked.options.stop_at, content, screen)
        prepare()
        env = make_env(run, args.engine or (content["physics"] if envs.takes_engine(run.env) else None))
        common.try_components([run], screen, env)
        devices = content.get("devices", 1) if args.devices is None else args.devices
        return train_into(env, run, args.run, options, args.curve, screen, devices)


def _to_resume(args: ResumeArgs, stop_at: float | None, content: dict[str, Any], console: Console) -> tuple[RunSpec, Options]:
    """The run in a locked folder and its options, with the changes of the command line.

    `stop_at` is the command line's. A reached value does not stop the run again unless it is passed again. Raises FolderError
    if the run has ended, has no checkpoint, or its settings were edited.
    """
    run, options = reading.to_spec(args.run, content), args.options
    edits = reading.edited(args.run, content, run)
    if refused := [text for name, text in edits.items() if name not in fingerprint.MAY_CHANGE]:
        raise FolderError(
            f"{args.run / run_folder.CONFIG_FILE} was edited, but a run resumes with its original settings:"
            f" {'; '.join(refused)}"
        )
    reading.check_written(args.run, content, run)
    if args.total_steps is not None:
        run = run.replace(total_steps=args.total_steps)
    spec.validate(run)
    options.check()
    if results.has_result(args.run) and (result := results.read_result(args.run))["status"] != run_folder.FAILED:
        _check_ended(args, run, stop_at, result)
        options = dataclasses.replace(options, stop_at=stop_at)
    if content.get("lanes", 1) > 1 and not run_folder.checkpoints(args.run) and results.failure_of(args.run) is None:
        raise FolderError(f"{args.run} was trained side by side with other runs of a sweep: the sweep's command resumes them")
    results.checkpoints_to_resume(args.run)
    if run.config.total_steps != content["config"]["total_steps"] and run.hparams.lr_end != 1:
        console.print(
            f"learning rates fall to {run.hparams.lr_end:g} of their start over the whole run. Its length has changed: they"
            " continue from their value at this point of a run of the new length"
        )
    for text in reading.changed_versions(content):
        console.print(f"since {args.run} began: {text}")
    told = "; ".join(f"{name} {fingerprint.text(value)}" for name, value in vars(options).items())
    console.print(f"resuming {args.run}: total_steps {run.config.total_steps}; {told}")
    return run, options


def _check_ended(args: ResumeArgs, run: RunSpec, stop_at: float | None, result: dict[str, Any]) -> None:
    """Raises FolderError if an ended run cannot resume."""
    if not run_folder.checkpoints(args.run):
        raise FolderError(
            f"{args.run} has ended; there is nothing to resume: --keep-end would have kept its last checkpoint."
            f" `{lookup.command_name()} --config {args.run} --total-steps N` trains a longer one from the start"
        )
    if not results.can_go_on(args.run, run.config.total_steps):
        raise FolderError(
            f"{args.run} has ended after {result['env_steps']:,} environment steps; total_steps must be larger to resume it;"
            f" got {run.config.total_steps}"
        )
    if args.total_steps is None and stop_at is None:
        raise FolderError(
            f"{args.run} has ended after {result['env_steps']:,} environment steps, at its stop_at {args.options.stop_at}:"
            " pass --total-steps, or another --stop-at, to resume"
        )
