"""The commands `train` and `resume`."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from mjx_dher import envs, presets, spec
from mjx_dher.cli.common import Screen, check_engine, print_summary, refuse_foreign_flags, settle_compiler, try_parts
from mjx_dher.host import files
from mjx_dher.host.caches import prepare
from mjx_dher.host.files import FolderError
from mjx_dher.names import check_name
from mjx_dher.presets import PRESETS
from mjx_dher.runs import identity, results, run_folder
from mjx_dher.runs.options import Options
from mjx_dher.runs.stopping import Stop
from mjx_dher.spec import RunSpec


@dataclasses.dataclass(frozen=True)
class TrainArgs:
    """Train a policy with an off-policy learner and Hindsight Experience Replay.

    Other commands: `resume RUN` goes on with a run that was stopped, `eval RUN` evaluates one again, `render RUN` draws it,
    `transfer RUN` plays it in the original Fetch task, `export RUN` writes its policy for other programs, `sweep` trains and
    compares many runs, `plot DIR` draws a sweep, `check` tries out parts of your own, `doctor` says what works on this machine
    (see `eval --help` and so on).
    """

    spec: RunSpec
    preset: Literal["auto", "cpu", "gpu", "paper"] = "auto"
    """Settings that other options override: cpu or gpu (tuned for time to success there), auto (the one for this machine) or
    paper (the paper's settings)."""
    out: Path | None = None
    """Run folder to write; a fresh one under runs/ unless given. Never overwrites."""
    options: Options = dataclasses.field(default_factory=Options)


@dataclasses.dataclass(frozen=True)
class ResumeArgs:
    """Go on with a run that was stopped, or killed, from its newest checkpoint that is whole.

    With the engine that it had, on a CPU, it ends as if it had never stopped, to the bit.
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    engine: str | None = None
    """Physics: native, jax, warp or auto; the run's own unless given."""
    total_steps: int | None = None
    """Environment steps of the whole run, those that were made included; as the run was started with unless given."""
    final_episodes: int | None = None
    """Episodes of the last evaluation; as the run was started with unless given."""
    checkpoint_every: int | None = None
    """Epochs between checkpoints, or 0; as the run was started with unless given."""
    keep: int | None = None
    """Checkpoints to keep; as the run was started with unless given."""
    log: tuple[str, ...] | None = None
    """Logs beside metrics.csv: jsonl, tensorboard, wandb; as the run was started with unless given."""
    stop_at: float | None = None
    """Success rate that ends the run; as the run was started with unless given."""


def train_command(argv: list[str], console: Console) -> int:
    """Trains a policy and writes a run folder."""
    args = parse_train_args(argv)
    with run_folder.claim_new(args.out, args.spec) as folder:
        settle_compiler(args.spec.engine)
        prepare()
        env = envs.make(args.spec.env, engine=args.spec.engine)
        try_parts(env, [args.spec], console)
        return _train(env, args.spec, folder, args.options, console)


def resume_command(argv: list[str], console: Console) -> int:
    """Goes on with a run that was stopped."""
    refuse_foreign_flags(argv)
    args = tyro.cli(ResumeArgs, prog="train.py resume", args=argv)
    check_engine(args.engine)
    content = run_folder.read_content(args.run)
    with files.lock(args.run):
        run, options = _to_resume(args, content, console)
        settle_compiler(args.engine or content["physics"])
        prepare()
        ran = content["physics"] if content["physics"] in spec.ENGINES else run.engine  # "none": the environment has none
        return _train(envs.make(run.env, engine=args.engine or ran), run, args.run, options, console)


def _to_resume(args: ResumeArgs, content: dict[str, Any], console: Console) -> tuple[RunSpec, Options]:
    """Returns the run in a folder, which is locked, with what may be other than it was; refuses other changes by name.

    Raises:
      FolderError: the run has ended, has no checkpoint, or its settings were edited.
      ValueError: an option that cannot be used.
    """
    run = run_folder.to_spec(args.run, content)
    edits = run_folder.edited(args.run, content, run)
    if refused := [text for name, text in edits.items() if name not in identity.MAY_CHANGE]:
        raise FolderError(
            f"{args.run / run_folder.CONFIG_FILE} is not as the run wrote it, and a run goes on with what it began with:"
            f" {'; '.join(refused)}"
        )
    if args.total_steps is not None:
        run = dataclasses.replace(run, config=dataclasses.replace(run.config, total_steps=args.total_steps))
    spec.validate(run, envs.list_envs())
    names = [field.name for field in dataclasses.fields(Options)]
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    options = Options(**{**{name: content[name] for name in names if name in content}, **given})
    options.check()
    if results.exists(args.run) and results.read(args.run)["status"] != run_folder.FAILED:
        raise FolderError(f"{args.run} has ended; there is nothing to go on with")
    run_folder.checkpoints_to_resume(args.run)
    told = "; ".join(f"{name} {getattr(options, name)}" for name in names if name != "log")
    console.print(f"going on with {args.run}: total_steps {run.config.total_steps}; {told}", soft_wrap=True)
    return run, dataclasses.replace(options, log=tuple(options.log))


def parse_train_args(argv: list[str]) -> TrainArgs:
    """Returns the arguments of `train`, checked before JAX, and with it CUDA, or MuJoCo is loaded.

    Raises:
      ValueError: one or more of them cannot be used.
    """
    refuse_foreign_flags(argv)
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default="auto")
    early.add_argument("--env", default="push")
    early.add_argument("--learner")
    chosen, _ = early.parse_known_args(argv)
    check_name("preset", chosen.preset, ("auto", *PRESETS))
    if chosen.preset != "auto":
        return _parse(argv, chosen.preset, chosen)
    args = _parse(argv, "cpu", chosen)
    preset = presets.machine_preset()
    return args if preset == "cpu" else _parse(argv, preset, chosen)


def _parse(argv: list[str], preset: Any, chosen: argparse.Namespace) -> TrainArgs:
    default = TrainArgs(presets.preset(preset, chosen.env, chosen.learner))
    args = tyro.cli(TrainArgs, prog="train.py", args=argv, default=default, config=(tyro.conf.OmitArgPrefixes,))
    problems = []
    for check in (lambda: spec.validate(args.spec, envs.list_envs()), args.options.check):
        try:
            check()
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise ValueError("\n".join(problems))
    return dataclasses.replace(args, preset=preset)


def _train(env: Any, run: RunSpec, folder: Path, options: Options, console: Console) -> int:
    """Trains into `folder`; goes on where it has a checkpoint."""
    from mjx_dher.runs import driver
    from mjx_dher.runs.claims import last_checkpoint

    console.print(f"{run.env}, sampler {run.sampler}, seed {run.seed}; writing to {folder}", soft_wrap=True)
    stop, screen = Stop(console, folder), Screen(console, [run])
    try:
        with stop:
            (result,) = driver.train_runs(
                env,
                [run],
                [folder],
                options=options,
                should_stop=lambda: stop.asked is not None,
                report=lambda text: console.print(text, soft_wrap=True),
                on_epoch=screen.show,
            )
    finally:
        screen.close()
    if result.status == driver.STOPPED:
        console.print(
            f"stopped after epoch {result.epoch} of {result.num_epochs}; the policy so far is in {folder}, and"
            f" `train.py resume {folder}` goes on",
            soft_wrap=True,
        )
        return 128 + (stop.asked or 0)
    if result.status == run_folder.FAILED:
        raise ValueError(f"epoch {result.epoch}: {result.content['reason']}; {last_checkpoint(folder)}")
    print_summary(result.content, console)
    console.print(f"run folder: {folder}", soft_wrap=True)
    return 0
