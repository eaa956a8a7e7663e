"""The command `eval`."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from mjx_dher.cli import common
from mjx_dher.cli.commands import parse
from mjx_dher.cli.common import EnvKwargs, Physics, Trust, make_env, print_summary
from mjx_dher.cli.output import PlainConsole
from mjx_dher.runs.folder import run_folder
from mjx_dher.spec import RunSpec
from mjx_dher.system.caches import keep_compiled_programs


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
    common.check_play(args.seed, args.engine, args.episodes, args.env_kwargs)
    remarks = PlainConsole(stderr=True, soft_wrap=True) if args.json else console
    folders = [common.find_run(run, remarks) for run in args.runs]
    runs = [common.changed_arguments(common.read_run(folder, remarks), args.env_kwargs) for folder in folders]
    for run in runs:
        common.settle_compiler(args.engine or run.engine)
    from mjx_dher.policy.load import load_policy

    policies = [load_policy(folder) for folder in folders]  # all, before any is played
    keep_compiled_programs()
    for path, run, policy in zip(args.runs, runs, policies):
        _evaluate(args, path, run, policy, console)
    return 0


def _evaluate(args: EvalArgs, path: Path, run: RunSpec, policy: Any, console: Console) -> None:
    """Plays the policy of one run and prints the summary."""
    from mjx_dher.evaluate import play_policy, summarize
    from mjx_dher.policy.load import check_fits

    env = make_env(run, args.engine)
    check_fits(policy, env)
    physics = run_folder.engine_name(env)
    if args.json:
        head = {"run": str(path), "env": run.env, "env_kwargs": run.env_arguments, "physics": physics, "seed": args.seed}
        summary = summarize(*play_policy(env, policy, args.episodes, args.seed)[:4])
        plain = {name: None if isinstance(x, float) and not math.isfinite(x) else x for name, x in summary.items()}
        print(json.dumps({**head, **plain}), flush=True)
        return
    where = f"{path}: " if len(args.runs) > 1 else ""
    console.print(f"{where}{run.env}: {args.episodes} episodes, seed {args.seed}, physics {physics} ...", soft_wrap=True)
    print_summary(summarize(*play_policy(env, policy, args.episodes, args.seed)[:4]), console)
