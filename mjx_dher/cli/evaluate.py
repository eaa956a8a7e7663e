"""The command `eval`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro
from rich.console import Console

from mjx_dher import envs
from mjx_dher.cli.common import check_engine, print_summary, read_run, settle_compiler
from mjx_dher.config import check_count
from mjx_dher.host.caches import keep_compiled_programs
from mjx_dher.runs import run_folder


@dataclasses.dataclass(frozen=True)
class EvalArgs:
    """Evaluate the policy of a run folder again."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    episodes: int = 500
    """Episodes to play."""
    seed: int = 1
    """Seed of the starts and goals."""
    engine: str | None = None
    """Physics: native, jax, warp or auto; the run's own unless given."""


def eval_command(argv: list[str], console: Console) -> int:
    """Evaluates the policy of a run folder."""
    args = tyro.cli(EvalArgs, prog="train.py eval", args=argv)
    check_count("episodes", args.episodes)
    check_engine(args.engine)
    run = read_run(args.run, console)
    settle_compiler(args.engine or run.engine)
    from mjx_dher.runs.load import check_fits, load_policy
    from mjx_dher.runs.play import play, summarize

    policy = load_policy(args.run)
    keep_compiled_programs()
    env = envs.make(run.env, engine=args.engine or run.engine)
    check_fits(policy, env)
    console.print(f"{run.env}: {args.episodes} episodes, seed {args.seed}, physics {run_folder.engine_name(env)} ...")
    print_summary(summarize(*play(env, policy, args.episodes, args.seed)), console)
    return 0
