"""The command line: `train` (the default command), `resume`, `eval`, `render` and `transfer`.

`sweep` and `plot` are in `cli_sweep`, `export` in `cli_export`, `doctor` in `cli_doctor`.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from mjx_dher import config, envs, names, presets
from mjx_dher.cli import doctor as cli_doctor
from mjx_dher.cli import export as cli_export
from mjx_dher.cli import sweep as cli_sweep
from mjx_dher.config import Config, HParams
from mjx_dher.host import files
from mjx_dher.host.caches import keep_compiled_programs, prepare
from mjx_dher.host.files import FolderError
from mjx_dher.runs import run_folder, sinks
from mjx_dher.runs.run_folder import RunConfig
from mjx_dher.runs.stopping import Stop

if TYPE_CHECKING:
    from mjx_dher.envs import GoalEnv
    from mjx_dher.policy import Policy
    from mjx_dher.rollout import Outcome
    from mjx_dher.runs.sinks import Sink
    from mjx_dher.trainer import Progress, Start, TrainState

FINAL_EPISODES = 500
EVAL_CHUNK = 500  # episodes evaluated at once


@dataclasses.dataclass(frozen=True)
class TrainArgs:
    """Train a policy with DDPG and Hindsight Experience Replay.

    Other commands: `resume RUN` goes on with a run that was stopped, `eval RUN` evaluates one again, `render RUN` draws it,
    `transfer RUN` plays it in the original Fetch task, `export RUN` writes its policy for other programs, `sweep` trains and
    compares many runs, `plot DIR` draws a sweep, `doctor` says what works on this machine (see `eval --help` and so on).
    """

    config: Annotated[Config, tyro.conf.arg(name="")]
    hparams: Annotated[HParams, tyro.conf.arg(name="")]
    preset: str = "auto"
    """cpu or gpu (tuned for time to success there), auto (the one for this machine) or paper (the paper's settings); other
    options override it."""
    seed: int = 0
    """Of everything random."""
    out: Path | None = None
    """Run folder to write; a fresh one under runs/ unless given. Never overwrites."""
    final_episodes: int = FINAL_EPISODES
    """Episodes of the last evaluation."""
    checkpoint_every: int = 10
    """Epochs between checkpoints, from which `resume` goes on; 0: only when the run is stopped (Ctrl-C, SIGTERM)."""
    keep: int = 2
    """Checkpoints to keep, the newest; they are deleted when the run has ended."""
    log: tuple[str, ...] = ()
    """Where the metrics go beside metrics.csv: jsonl, tensorboard, wandb."""


@dataclasses.dataclass(frozen=True)
class ResumeArgs:
    """Go on with a run that was stopped, or killed, from its newest checkpoint that is whole.

    With the engine that it had, on a CPU, it ends as if it had never stopped, to the bit.
    """

    run: tyro.conf.Positional[Path]
    """The run folder."""
    engine: str | None = None
    """Physics: native, jax, warp or auto; the run's own unless given."""
    final_episodes: int | None = None
    """Episodes of the last evaluation; as the run was started with unless given."""
    checkpoint_every: int | None = None
    """Epochs between checkpoints, or 0; as the run was started with unless given."""
    keep: int | None = None
    """Checkpoints to keep; as the run was started with unless given."""
    log: tuple[str, ...] | None = None
    """Where the metrics go beside metrics.csv: jsonl, tensorboard, wandb; as the run was started with unless given."""


@dataclasses.dataclass(frozen=True)
class EvalArgs:
    """Evaluate the policy of a run folder again."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    episodes: int = FINAL_EPISODES
    """Episodes to play."""
    seed: int = 1
    """Of the starts and goals."""
    engine: str | None = None
    """Physics: native, jax, warp or auto; the run's own unless given."""


@dataclasses.dataclass(frozen=True)
class RenderArgs:
    """Play the policy of a run folder, or a task with random actions, and draw it: a video, or stills side by side.

    Needs no screen (EGL or OSMesa draw; MUJOCO_GL chooses) but the extra: `pip install -e ".[video]"`.
    """

    out: Path
    """File to write: .mp4, .gif or .png (stills of the first episode). Its folder must be there."""
    run: tyro.conf.Positional[Path | None] = None
    """The run folder; or else give --env."""
    env: str | None = None
    """Without a run folder: the environment (a name, or module:attribute), played with uniformly random actions."""
    episodes: int = 4
    """Episodes to play, one after the other."""
    seed: int = 1
    """Of the starts, the goals and the random actions."""
    engine: str | None = None
    """Physics: native, jax, warp or auto; the run's own unless given."""
    width: int = 640
    """Of a picture, pixels."""
    height: int = 480
    """Of a picture, pixels."""
    overwrite: bool = False
    """Replace `out` if it is there already."""


@dataclasses.dataclass(frozen=True)
class TransferArgs:
    """Play the policy of a run folder, unchanged, in the original task of gymnasium-robotics and here, and compare.

    The original needs an older MuJoCo, and so an environment of its own: --set-up makes it once.
    """

    run: tyro.conf.Positional[Path]
    """The run folder."""
    episodes: int = FINAL_EPISODES
    """Episodes to play, there and here."""
    seed: int = 1000
    """Of the first episode there (the next ones follow), and of those here."""
    set_up: bool = False
    """Make the originals' environment in the user's cache folder, if it is not there yet (a download of 200 MB)."""
    python: Path | None = None
    """The Python of an environment that has the original tasks; the one that --set-up makes unless given."""
    engine: str | None = None
    """Physics here: native, jax, warp or auto; the run's own unless given."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status (2: the arguments were refused)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    commands: dict[str, Callable[[list[str], Console], int]] = {
        "train": train_command,
        "resume": resume_command,
        "eval": eval_command,
        "render": render_command,
        "transfer": transfer_command,
        "export": cli_export.export_command,
        "sweep": cli_sweep.sweep_command,
        "plot": cli_sweep.plot_command,
        "doctor": cli_doctor.doctor_command,
    }
    name = argv.pop(0) if argv and argv[0] in commands else "train"
    if "" not in sys.path:  # the current folder, for --env module:attribute; last, so that it hides nothing
        sys.path.append("")
    try:
        if name == "train" and argv and not argv[0].startswith("-"):
            names.check_name("command", argv[0], commands)
        return commands[name](argv, Console(highlight=False, markup=False))
    except ValueError as error:
        for line in str(error).splitlines():
            print(f"error: {line}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # whoever read the output has gone, as in `train.py --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else the interpreter complains when it flushes
        return 128 + signal.SIGPIPE
    except KeyboardInterrupt:  # outside of training, which ends in order
        print("stopped", file=sys.stderr)
        return 128 + signal.SIGINT


def train_command(argv: list[str], console: Console) -> int:
    """`train`: trains a policy and writes a run folder."""
    args = parse_train_args(argv)
    folder = run_folder.choose(args.out, args.config, args.seed)
    prepare()
    env = envs.make(args.config.env, engine=args.config.engine)
    run = RunConfig(config=args.config, hparams=args.hparams, seed=args.seed, engine=run_folder.engine_name(env))
    options = {name: getattr(args, name) for name in _OPTIONS}
    training = _Training(env, run, folder, options, console)
    return training(lambda: run_folder.create(folder, run, {"preset": args.preset, **options}))


def resume_command(argv: list[str], console: Console) -> int:
    """`resume RUN`: goes on with a run that was stopped."""
    args = tyro.cli(ResumeArgs, prog="train.py resume", args=argv)
    _check_engine(args.engine)
    started = run_folder.read_content(args.run)
    run = run_folder.to_config(args.run, started)
    defaults = {field.name: field.default for field in dataclasses.fields(TrainArgs)}
    options = {name: getattr(args, name) for name in _OPTIONS}
    options = {name: started.get(name, defaults[name]) if value is None else value for name, value in options.items()}
    _check_options(**options)
    if (args.run / run_folder.RESULT_FILE).exists():
        raise FolderError(f"{args.run} has ended; there is nothing to go on with")
    run_folder.checkpoints_to_resume(args.run)
    prepare()
    ran = run.engine if run.engine in config.ENGINES else run.config.engine  # "none": the environment has none
    env = envs.make(run.config.env, engine=args.engine or ran)
    return _Training(env, run, args.run, options, console)()


def _check_engine(engine: str | None) -> None:
    if engine is not None:
        names.check_name("engine", engine, config.ENGINES)


_OPTIONS = ("final_episodes", "checkpoint_every", "keep", "log")


def _check_options(final_episodes: int, checkpoint_every: int, keep: int, log: Sequence[str]) -> None:
    """Raises ValueError where one of _OPTIONS cannot be used."""
    sinks.check(log)
    config.check_count("final_episodes", final_episodes)
    config.check_count("keep", keep)
    config.check_every("checkpoint_every", checkpoint_every)


def parse_train_args(argv: list[str]) -> TrainArgs:
    """The arguments of `train`, checked without loading JAX or MuJoCo.

    Raises:
      ValueError: one or more of them cannot be used.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default="auto")
    early.add_argument("--env", default="push")
    chosen, _ = early.parse_known_args(argv)
    names.check_name("preset", chosen.preset, ("auto", *presets.PRESETS))
    preset = presets.machine_preset() if chosen.preset == "auto" else chosen.preset
    base, hparams = presets.preset(preset, chosen.env)
    args = tyro.cli(TrainArgs, prog="train.py", args=argv, default=TrainArgs(config=base, hparams=hparams))
    args = dataclasses.replace(args, preset=preset)
    checks = (
        lambda: names.check_name("env", args.config.env, envs.list_envs(), own=True),
        lambda: config.validate(args.config, args.hparams),
        lambda: _check_options(**{name: getattr(args, name) for name in _OPTIONS}),
    )
    problems = [problem for problem in map(_problem, checks) if problem]
    if problems:
        raise ValueError("\n".join(problems))
    return args


class _Training:
    """One run of the `train` or `resume` command, with what its signal handler needs to see.

    Args:
      env: what to train in.
      run: what the run was started with.
      folder: of the run.
      options: _OPTIONS by name.
      console: to print to.
    """

    def __init__(self, env: GoalEnv, run: RunConfig, folder: Path, options: dict[str, Any], console: Console):
        self.env, self.run, self.folder, self.options, self.console = env, run, folder, options, console
        self.stop = Stop(console, folder)

    def __call__(self, create: Callable[[], None] | None = None) -> int:
        """Trains; `create` makes the folder of a new run, and without it the one that is there is resumed."""
        import jax

        from mjx_dher import trainer
        from mjx_dher.host import memory

        run, console = self.run, self.console
        program = trainer.make_train(self.env, run.config)
        trainer.check_memory(program.replay_bytes, run.config)
        if create is not None:
            create()
        with files.lock(self.folder, run_folder.CONFIG_FILE):
            start = None if create is not None else self._restore(trainer.state_template(program))
            console.print(
                f"{run.config.env}, sampler {run.config.sampler}, seed {run.seed}; physics {run_folder.engine_name(self.env)},"
                f" learner on {jax.devices()[0].device_kind}; replay ring {memory.format_bytes(program.replay_bytes)};"
                f" writing to {self.folder}",
                soft_wrap=True,
            )
            try:
                with self.stop:
                    last, learned = self._train(start)
            except OSError as error:
                raise FolderError(f"{self.folder} cannot be written to ({error}); {self._last()}") from error
            if last.epoch < last.num_epochs:
                console.print(
                    f"stopped after epoch {last.epoch} of {last.num_epochs}; the policy so far is in {self.folder}, and"
                    f" `train.py resume {self.folder}` goes on",
                    soft_wrap=True,
                )
                return 128 + (self.stop.asked or 0)
            outcome = play(self.env, learned, self.options["final_episodes"], run.seed + 1)
            result = report(outcome.success, outcome.reset_success, outcome.ret, console)
            ended = {"epochs": last.epoch, "env_steps": last.env_steps, "wall_seconds": last.wall_seconds, **result}
            files.write_json(self.folder / run_folder.RESULT_FILE, ended)
            shutil.rmtree(self.folder / run_folder.CHECKPOINTS, ignore_errors=True)
        console.print(f"run folder: {self.folder}", soft_wrap=True)
        return 0

    def _restore(self, template: TrainState) -> Start:
        from mjx_dher import trainer
        from mjx_dher.runs import checkpoint

        found = checkpoint.restore(self.folder, template)
        for why in found.refused:
            self.console.print(f"not used: {why}", soft_wrap=True)
        self.console.print(f"going on from {found.path}", soft_wrap=True)
        return trainer.Start(found.state, found.epoch, found.wall_seconds)

    def _train(self, start: Start | None) -> tuple[Progress, Policy]:
        """Trains to the end or until a stop is asked for, writing metrics, policies and checkpoints; the last of each."""
        from mjx_dher import policy, trainer
        from mjx_dher.runs import checkpoint

        run, every = self.run, self.options["checkpoint_every"]
        opened: list[Sink] = []
        try:
            for progress in trainer.train(self.env, run.config, run.hparams, run.seed, self._on_compile, start):
                if not trainer.is_finite(progress.state.learner):
                    raise ValueError(
                        f"epoch {progress.epoch}: the networks or normalizers hold numbers that are not finite, so training"
                        f" was stopped (smaller actor_lr and critic_lr may help); {self._last()}"
                    )
                if not opened:
                    ended = start.epoch if start else 0
                    steps = ended * (progress.env_steps // progress.epoch)
                    opened = [
                        *sinks.open_sinks(self.folder, self.options["log"], ended, steps),
                        sinks.ConsoleSink(self.console, progress.num_epochs),
                    ]
                learned = policy.from_learner(progress.state.learner, run.hparams)
                learned.save(self.folder / run_folder.POLICY_FILE)
                for sink in opened:
                    sink.write(_row(progress))
                stop = self.stop.asked is not None
                if progress.epoch < progress.num_epochs and (stop or (every and progress.epoch % every == 0)):
                    keep = self.options["keep"]
                    path = checkpoint.save(self.folder, progress.state, progress.epoch, progress.wall_seconds, keep)
                    if stop:
                        self.console.print(f"saved {path}", soft_wrap=True)
                if stop:
                    break
        finally:
            for sink in opened:
                sink.close()
        return progress, learned

    def _last(self) -> str:
        """What is left, for an error."""
        found = run_folder.checkpoints(self.folder)
        return f"`train.py resume {self.folder}` goes on from {found[0]}" if found else "there is no checkpoint"

    def _on_compile(self, seconds: float | None) -> None:
        if seconds is None:
            self.console.print("compiling the training loop (physics, replay, learner, evaluation) ...")
        else:
            self.console.print(f"compiled in {seconds:.1f} s")


def eval_command(argv: list[str], console: Console) -> int:
    """`eval RUN`: evaluates the policy of a run folder."""
    args = tyro.cli(EvalArgs, prog="train.py eval", args=argv)
    config.check_count("episodes", args.episodes)
    _check_engine(args.engine)
    run = run_folder.read_config(args.run)
    from mjx_dher.runs.load import load_policy

    policy = load_policy(args.run)
    env = envs.make(run.config.env, engine=args.engine or run.config.engine)
    console.print(f"{run.config.env}: {args.episodes} episodes, seed {args.seed}, physics {run_folder.engine_name(env)} ...")
    outcome = play(env, policy, args.episodes, args.seed)
    report(outcome.success, outcome.reset_success, outcome.ret, console)
    return 0


def render_command(argv: list[str], console: Console) -> int:
    """`render`: draws episodes of a run's policy, or of random actions."""
    from mjx_dher.tools import render

    args = tyro.cli(RenderArgs, prog="train.py render", args=argv)
    render.check(args.out, args.width, args.height, args.overwrite)
    config.check_count("episodes", args.episodes)
    _check_engine(args.engine)
    if args.run is not None and args.env is None:
        from mjx_dher.runs.load import load_policy

        played, policy = run_folder.read_config(args.run).config, load_policy(args.run)
    elif args.env is not None and args.run is None:
        names.check_name("env", args.env, envs.list_envs(), own=True)
        played, policy = Config(env=args.env), None
    else:
        raise ValueError(f"render takes either a run folder or --env (one of {', '.join(envs.list_envs())})")
    render.ffmpeg()
    gl = render.choose_gl()
    env: Any = envs.make(played.env, engine=args.engine or played.engine)  # Any: a GoalEnv need not have a model
    import jax
    import jax.numpy as jnp

    def act(obs, key):
        if policy is None:
            return jax.random.uniform(key, (args.episodes, env.action_size), minval=-1.0, maxval=1.0)
        return policy.forward(obs["observation"], obs["desired_goal"], jnp)

    console.print(
        f"{played.env}: {args.episodes} episodes{'' if policy else ' of random actions'}, seed {args.seed},"
        f" physics {run_folder.engine_name(env)}, drawn with {gl} ..."
    )
    qpos, goals, success = render.play(env, act, args.seed, args.episodes)
    pictures = (env.model, qpos, goals, args.width, args.height)
    render.write(args.out, [render.stills(*pictures)] if args.out.suffix.lower() == ".png" else render.film(*pictures))
    console.print(f"success in {int(success.sum())} of {args.episodes}; wrote {args.out}", soft_wrap=True)
    return 0


def transfer_command(argv: list[str], console: Console) -> int:
    """`transfer RUN`: plays the policy of a run folder in the original task."""
    args = tyro.cli(TransferArgs, prog="train.py transfer", args=argv)
    _check_engine(args.engine)
    config.check_count("episodes", args.episodes)
    run = run_folder.read_config(args.run)
    from mjx_dher.envs.engines.native import usable_cores
    from mjx_dher.runs.load import load_policy
    from mjx_dher.stats import difference_interval
    from mjx_dher.tools import originals

    policy = load_policy(args.run)
    environment = originals.default_environment()
    if args.set_up:
        console.print(f"the originals' environment is in {environment}; setting it up if need be ...", soft_wrap=True)
        originals.set_up(environment)
    python = args.python or originals.interpreter(environment)
    name = originals.check(run.config.env, python)
    env = envs.make(run.config.env, engine=args.engine or run.config.engine)
    console.print(f"{name}, {args.episodes} episodes ...")
    there = originals.play_apart(args.run, python, args.episodes, args.seed, workers=usable_cores())
    report_there = report(there["success"], there["reset_success"], there["ret"], console)
    console.print(f"{run.config.env} here, {args.episodes} episodes, physics {run_folder.engine_name(env)} ...")
    here = play(env, policy, args.episodes, args.seed)
    report_here = report(here.success, here.reset_success, here.ret, console)
    low, high = difference_interval(
        int(there["success"].sum()), len(there["success"]), int(here.success.sum()), len(here.success)
    )
    difference = report_there["success_rate"] - report_here["success_rate"]
    console.print(f"there minus here {difference:+.3f} (95 % interval {low:+.3f} to {high:+.3f})")
    return 0


def play(env: GoalEnv, policy: Policy, num_episodes: int, seed: int) -> Outcome:
    """The outcomes [num_episodes] of `policy` in `env`, as NumPy arrays."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from mjx_dher.evaluate import evaluate
    from mjx_dher.trainer import check_steps

    keep_compiled_programs()
    chunk = min(num_episodes, EVAL_CHUNK)

    @jax.jit
    def run(key):
        return evaluate(env, lambda obs: policy.forward(obs["observation"], obs["desired_goal"], jnp), key, chunk)

    keys = jax.random.split(jax.random.key(seed), -(-num_episodes // chunk))
    outcomes = [jax.device_get(run(key)) for key in keys]
    check_steps(env)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:num_episodes], *outcomes)


def report(success: Any, reset_success: Any, ret: Any, console: Console) -> dict[str, Any]:
    """Prints success with its interval, success at reset and mean return of episodes (arrays [N]); returns them."""
    from mjx_dher.stats import wilson_interval

    trials = len(success)
    low, high = wilson_interval(int(success.sum()), trials)
    result = {
        "episodes": trials,
        "success_rate": float(success.mean()),
        "success_low": low,
        "success_high": high,
        "reset_success_rate": float(reset_success.mean()),
        "return_mean": float(ret.mean()),
    }
    console.print(
        f"success {result['success_rate']:.3f} (95 % interval {low:.3f} to {high:.3f}, {trials} episodes);"
        f" already at reset {result['reset_success_rate']:.3f}; mean return {result['return_mean']:.2f}",
        soft_wrap=True,
    )
    return result


def _row(progress: Progress) -> dict[str, Any]:
    """What the sinks take, in the order of metrics.csv."""
    from mjx_dher.host import memory

    steps, updates = progress.env_steps / progress.epoch, progress.updates / progress.epoch  # all epochs are alike
    found = dict(progress.metrics)
    return {
        "epoch": progress.epoch,
        "env_steps": progress.env_steps,
        "updates": progress.updates,
        "wall_seconds": progress.wall_seconds,
        "success_rate": found.pop("success_rate"),
        "return_mean": found.pop("return_mean"),
        "reset_success_rate": found.pop("reset_success_rate"),
        **found,
        "steps_per_second": steps / progress.epoch_seconds,
        "updates_per_second": updates / progress.epoch_seconds,
        "memory_bytes": memory.used_bytes() or math.nan,
    }


def _problem(check: Callable[[], None]) -> str | None:
    try:
        check()
    except ValueError as error:
        return str(error)
    return None
