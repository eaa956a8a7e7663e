"""The command `engines`."""

from __future__ import annotations

import dataclasses
import json

import mujoco
import tyro
from rich.console import Console

from mjx_dher import envs
from mjx_dher.cli.commands import parse
from mjx_dher.cli.common import print_table
from mjx_dher.spec import to_arguments


@dataclasses.dataclass(frozen=True)
class EnginesArgs:
    """Show which physics engines support the model of a task, and for each other one the reason and a fix."""

    env: tyro.conf.Positional[str]
    """Task, or module:attribute."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments of the task, as name=value."""
    json: bool = False
    """Print one JSON object instead."""


def engines_command(argv: list[str], console: Console) -> int:
    """Shows which engines support a task's model."""
    args = parse(EnginesArgs, argv)
    env = envs.make(args.env, engine="native" if envs.takes_engine(args.env) else "auto", **to_arguments(args.env_kwargs))
    model = getattr(env, "model", None)
    if not isinstance(model, mujoco.MjModel):
        raise ValueError(f"env {args.env!r} must have an attribute `model`, a mujoco.MjModel")
    from mjx_dher.envs.engines.explain import explain

    verdicts = explain(model)
    if args.json:
        print(json.dumps([{**verdict._asdict(), "supported": not verdict.reason} for verdict in verdicts], indent=2))
        return 0
    rows = [(each.engine, "no" if each.reason else "yes", each.reason, each.cure) for each in verdicts]
    print_table(("engine", "supported", "reason", "cure"), rows, console)
    return 0
