"""The command `transfer`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro
from rich.console import Console

from mjx_dher.cli.commands import parse
from mjx_dher.cli.common import check_play, find_run, make_env, print_summary, read_run, settle_compiler
from mjx_dher.runs.folder import run_folder
from mjx_dher.system.caches import keep_compiled_programs


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
    """Physics here: native, jax, warp or auto. Default: the run's."""


def transfer_command(argv: list[str], console: Console) -> int:
    """Plays the policy of a run folder in the original task."""
    args = parse(TransferArgs, argv)
    check_play(args.seed, args.engine, args.episodes)
    folder = find_run(args.run, console)
    run = read_run(folder, console)
    settle_compiler(args.engine or run.engine)
    from mjx_dher.evaluate import play_policy, summarize
    from mjx_dher.policy.load import check_fits, load_plain
    from mjx_dher.stats import difference_interval
    from mjx_dher.system.limits import usable_cores
    from mjx_dher.tools import transfer

    policy = load_plain(folder, "transfer")
    if args.set_up:
        environment = transfer.default_environment()
        console.print(f"the originals' environment is in {environment}; setting it up if necessary ...", soft_wrap=True)
        transfer.set_up(environment)
    python = args.python or transfer.interpreter(transfer.default_environment())
    name = transfer.check_original(run.env, python)
    keep_compiled_programs()
    if run.env_kwargs:
        console.print(f"trained with {' '.join(run.env_kwargs)}; played without them in both tasks", soft_wrap=True)
    env = make_env(dataclasses.replace(run, env_kwargs=()), args.engine)
    check_fits(policy, env)
    console.print(f"{name}, {args.episodes} episodes ...")
    theirs = transfer.play_apart(folder, python, args.episodes, args.seed, workers=usable_cores())
    summary_original = summarize(theirs["success"], theirs["reset_success"], theirs["ret"])
    print_summary(summary_original, console)
    console.print(f"{run.env} here, {args.episodes} episodes, physics {run_folder.engine_name(env)} ...")
    here = play_policy(env, policy, args.episodes, args.seed)
    summary_here = summarize(*here[:4])
    print_summary(summary_here, console)
    low, high = difference_interval(
        int(theirs["success"].sum()), len(theirs["success"]), int(here.success.sum()), len(here.success)
    )
    difference = summary_original["success_rate"] - summary_here["success_rate"]
    console.print(f"there minus here {difference:+.3f} (95 % interval {low:+.3f} to {high:+.3f})")
    return 0
