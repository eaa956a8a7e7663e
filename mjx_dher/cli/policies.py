"""The commands `eval`, `render`, `transfer` and `export`, which use a trained policy."""

import dataclasses
import json
import math
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from mjx_dher import envs, lookup
from mjx_dher.cli import PlainConsole, common, parse, settings
from mjx_dher.cli.common import EnvKwargs, Physics, Trust
from mjx_dher.lookup import check_name
from mjx_dher.policy import bundled
from mjx_dher.runs.folder import reading, run_folder
from mjx_dher.spec import ENGINES, RunSpec, to_arguments, to_texts
from mjx_dher.system.machine import check_platform, keep_compiled_programs
from mjx_dher.validation import check_count, check_seed


def check_play(seed: int, engine: str | None, episodes: int = 1, env_kwargs: Sequence[str] = ()) -> None:
    """Raises ValueError for an invalid option of a command that plays episodes."""
    check_count("episodes", episodes)
    check_seed(seed)
    if engine is not None:
        check_name("engine", engine, ENGINES)
    to_arguments(env_kwargs)


def played_env(run: RunSpec, engine: str | None) -> Any:
    """Makes the environment to play a run's policy in. A run of warp plays on native if JAX has no GPU."""
    import jax

    on_cpu = engine is None and run.engine == "warp" and jax.default_backend() == "cpu"
    return common.make_env(run, "auto" if on_cpu else engine)


def changed_arguments(run: RunSpec, env_kwargs: Sequence[str]) -> RunSpec:
    """Run whose environment's arguments are updated with `env_kwargs`."""
    return dataclasses.replace(run, env_kwargs=to_texts({**run.env_arguments, **to_arguments(env_kwargs)}))


def find_run(run: Path, console: Console) -> Path:
    """Finds a run folder or bundled policy, and says which it is if it could be either. Raises FolderError if it is neither."""
    path = bundled.find(run)
    if bundled.is_shipped(path):
        console.print(f"{run}: the bundled policy; its card is {path / bundled.CARD}")
    elif str(run) in bundled.names():
        console.print(f"{run}: the run in the current folder, not the bundled policy of this name")
    return path


def read_run(path: Path, console: Console) -> RunSpec:
    """Reads the description of the run in `path`, and prints which custom source files have changed since. Raises FolderError
    if it is not a run folder, or it is damaged.
    """
    content, spec = reading.read_run(path)
    for text in reading.changed_code(content, spec):
        console.print(f"since {path} was trained: {text}")
    return spec


@dataclasses.dataclass(frozen=True)
class EvalArgs:
    """Evaluate the policies of run folders, or bundled policies, one after the other."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or bundled policies such as push."""
    episodes: int = 500
    """Episodes to play."""
    seed: int = 1
    """Seed of the starts and goals."""
    engine: Physics = None
    env_kwargs: EnvKwargs = ()
    trust: Trust = False
    json: bool = False
    """Print one line of JSON per run instead, and remarks to standard error."""


def eval_command(argv: list[str], console: Console) -> int:
    """Evaluates the policies of run folders."""
    args = parse(EvalArgs, argv)
    if not args.runs:
        raise ValueError("eval needs one or more run folders or bundled policies; got none")
    check_play(args.seed, args.engine, args.episodes, args.env_kwargs)
    remarks = PlainConsole(stderr=True, soft_wrap=True) if args.json else console
    folders = [find_run(run, remarks) for run in args.runs]
    runs = [changed_arguments(read_run(folder, remarks), args.env_kwargs) for folder in folders]
    for run in runs:
        common.settle_compiler(args.engine or run.engine)
    from mjx_dher.policy.load import check_fits, load_policy

    policies = [load_policy(folder) for folder in folders]  # all, before any is played
    keep_compiled_programs()
    key_of = operator.attrgetter("env", "engine", "env_kwargs")
    made = {key: played_env(run, args.engine) for key, run in {key_of(run): run for run in runs}.items()}
    for run, policy in zip(runs, policies):
        check_fits(policy, made[key_of(run)])
    for path, run, policy in zip(args.runs, runs, policies):
        _evaluate(args, path, run, policy, made[key_of(run)], console)
    return 0


def _evaluate(args: EvalArgs, path: Path, run: RunSpec, policy: Any, env: Any, console: Console) -> None:
    """Plays the policy of one run and prints the summary."""
    from mjx_dher.evaluate import play_policy, summarize
    from mjx_dher.testing.trial import attempt

    physics = run_folder.engine_name(env)
    play = lambda: summarize(*attempt("an episode", play_policy, env, policy, args.episodes, args.seed)[:4])  # noqa: E731
    if args.json:
        head = {"run": str(path), "env": run.env, "env_kwargs": run.env_arguments, "physics": physics, "seed": args.seed}
        summary = play()
        plain = {name: None if isinstance(x, float) and not math.isfinite(x) else x for name, x in summary.items()}
        print(json.dumps({**head, **plain}), flush=True)
        return
    where = f"{path}: " if len(args.runs) > 1 else ""
    console.print(f"{where}{run.env}: {args.episodes} episodes, seed {args.seed}, physics {physics} ...", soft_wrap=True)
    common.print_summary(play(), console)


@dataclasses.dataclass(frozen=True)
class RenderArgs:
    """Draw episodes of a run's or bundled policy, or of random actions, as a video or as stills.

    Needs no screen: EGL or OSMesa draws, as set by MUJOCO_GL. Needs the extra `video`.
    """

    out: Path
    """File to write: .mp4, .gif or .png (stills of the first episode). Its folder must exist."""
    run: tyro.conf.Positional[Path | None] = None
    """Run folder, or a bundled policy such as push. Alternatively pass --env."""
    env: str | None = None
    """Environment (a name, or module:attribute) to play with uniformly random actions, instead of a run."""
    episodes: int = 4
    """Episodes to play, one after the other."""
    seed: int = 1
    """Seed of the starts, the goals and the random actions."""
    env_kwargs: EnvKwargs = ()
    engine: Physics = None
    trust: Trust = False
    width: int = 640
    """Width in pixels."""
    height: int = 480
    """Height in pixels."""
    overwrite: bool = False
    """Replace an existing file."""


def render_command(argv: list[str], console: Console) -> int:
    """Draws episodes of a run's policy, or of random actions."""
    from mjx_dher.policy.load import load_policy
    from mjx_dher.tools import render

    args = parse(RenderArgs, argv)
    render.check_output(args.out, args.width, args.height, args.overwrite)
    settings.check_writable(args.out.parent)
    check_play(args.seed, args.engine, args.episodes, args.env_kwargs)
    if args.run is not None and args.env is None:
        folder = find_run(args.run, console)
        played, policy = read_run(folder, console), load_policy(folder)
    elif args.env is not None and args.run is None:
        lookup.check_name("env", args.env, envs.list_envs(), custom=True)
        played, policy = RunSpec(env=args.env), None
    else:
        raise ValueError(f"render needs either a run folder or --env (one of {', '.join(envs.list_envs())})")
    _draw(changed_arguments(played, args.env_kwargs), policy, args, console)
    return 0


def _draw(played: RunSpec, policy: Any, args: RenderArgs, console: Console) -> None:
    """Plays episodes and writes their pictures. Without a policy, actions are random."""
    from mjx_dher.contract import step_seconds
    from mjx_dher.policy.load import check_fits
    from mjx_dher.tools import render

    render.ffmpeg()
    gl = render.choose_gl()
    check_platform()
    env: Any = played_env(played, args.engine)  # Any: a GoalEnv need not have a model
    if policy is not None:
        check_fits(policy, env)
    import jax
    import jax.numpy as jnp

    def act(obs, key):
        if policy is None:
            return jax.random.uniform(key, (args.episodes, env.action_size), minval=-1.0, maxval=1.0)
        return policy.forward(obs["observation"], obs["desired_goal"], jnp)

    console.print(
        f"{played.env}: {args.episodes} episodes{'' if policy else ' of random actions'}, seed {args.seed},"
        f" physics {run_folder.engine_name(env)}, drawn with {gl} ...",
        soft_wrap=True,
    )
    qpos, goals, success = render.record_episodes(env, act, args.seed, args.episodes)
    pictures, fps = (env, qpos, goals, args.width, args.height), 1 / step_seconds(env)
    frames = [render.stills(*pictures)] if args.out.suffix.lower() == ".png" else render.film(*pictures, fps)
    render.write_frames(args.out, frames, fps)
    console.print(f"success in {int(success.sum())} of {args.episodes}; wrote {args.out}", soft_wrap=True)


@dataclasses.dataclass(frozen=True)
class TransferArgs:
    """Compare a policy's success in the original gymnasium-robotics task with its success here.

    The original task needs an older MuJoCo, and so its own environment, which --set-up makes once.
    """

    run: tyro.conf.Positional[Path]
    """Run folder, or a bundled policy such as push."""
    episodes: int = 500
    """Episodes to play in each task."""
    seed: int = 1000
    """Seed of the first original episode (episode i uses seed + i) and of the episodes played here."""
    set_up: bool = False
    """Make the Python environment of the originals in the user's cache folder, if missing (a 200 MB download)."""
    python: Path | None = None
    """Python of an environment that has the original tasks. Default: the one from --set-up."""
    engine: str | None = None
    """Physics here: native, jax, warp or auto. Default: the run's, or native for warp without a GPU."""


def transfer_command(argv: list[str], console: Console) -> int:
    """Plays the policy of a run folder in the original task."""
    args = parse(TransferArgs, argv)
    check_play(args.seed, args.engine, args.episodes)
    folder = find_run(args.run, console)
    run = read_run(folder, console)
    common.settle_compiler(args.engine or run.engine)
    from mjx_dher.evaluate import play_policy, summarize
    from mjx_dher.policy.load import check_fits, load_plain
    from mjx_dher.rates import difference_interval
    from mjx_dher.system.machine import usable_cores
    from mjx_dher.tools import transfer

    policy = load_plain(folder, "transfer")
    if args.set_up and run.env in transfer.ORIGINALS:  # otherwise `check_original` raises
        environment = transfer.default_environment()
        console.print(f"the originals' environment is in {environment}; setting it up if necessary ...", soft_wrap=True)
        transfer.set_up(environment)
    python = args.python or transfer.interpreter(transfer.default_environment())
    name = transfer.check_original(run.env, python)
    keep_compiled_programs()
    if run.env_kwargs:
        console.print(f"trained with {' '.join(run.env_kwargs)}; played without them in both tasks", soft_wrap=True)
    env = played_env(dataclasses.replace(run, env_kwargs=()), args.engine)
    check_fits(policy, env)
    console.print(f"{name}, {args.episodes} episodes ...")
    theirs = transfer.play_apart(folder, python, args.episodes, args.seed, workers=usable_cores())
    summary_original = summarize(theirs["success"], theirs["reset_success"], theirs["ret"])
    common.print_summary(summary_original, console)
    console.print(f"{run.env} here, {args.episodes} episodes, physics {run_folder.engine_name(env)} ...")
    here = play_policy(env, policy, args.episodes, args.seed)
    summary_here = summarize(*here[:4])
    common.print_summary(summary_here, console)
    low, high = difference_interval(
        int(theirs["success"].sum()), len(theirs["success"]), int(here.success.sum()), len(here.success)
    )
    difference = summary_original["success_rate"] - summary_here["success_rate"]
    console.print(f"there minus here {difference:+.3f} (95 % interval {low:+.3f} to {high:+.3f})")
    return 0


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Write a policy as a file for other programs, and check that the file gives the same actions.

    docs/policies.md describes the files. Needs the extra `export`.
    """

    run: tyro.conf.Positional[Path]
    """Run folder, or a bundled policy such as push."""
    format: str
    """Format: onnx (a graph from observation and goal to action) or safetensors (only the tensors)."""
    out: Path | None = None
    """File to write, which ends in the format's name. Default: policy.onnx or policy.safetensors in the run folder, or for a
    bundled policy, push.onnx or the like in the current folder."""
    overwrite: bool = False
    """Replace an existing file."""


def export_command(argv: list[str], console: Console) -> int:
    """Writes the policy of a run folder for other programs."""
    from mjx_dher.policy.load import load_plain
    from mjx_dher.tools import export

    args = parse(ExportArgs, argv)
    lookup.check_name("format", args.format, export.FORMATS)
    folder = find_run(args.run, console)
    content, run = reading.read_run(folder)
    beside = Path(f"{folder.name}.{args.format}") if bundled.is_shipped(folder) else folder / f"policy.{args.format}"
    out = args.out or beside
    export.check(args.format, out, args.overwrite)
    policy = load_plain(folder, "export")
    if not policy.interface:  # older policy files leave it to the run folder
        policy = dataclasses.replace(policy, interface=content.get("interface", {}))
    difference = export.write(policy, run, args.format, out)
    observation_size, goal_size, action_size = policy.sizes
    console.print(
        f"{run.env}: observation [N, {observation_size}], desired_goal [N, {goal_size}] -> action [N, {action_size}];"
        f" the same actions for {export.CHECKED:,} observations (largest difference {difference:.1g}); wrote {out}"
    )
    return 0
