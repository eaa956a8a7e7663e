"""All commands with their modules, and the parser of their arguments."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, TypeVar

from rich.console import Console

from mjx_dher import lookup

Args = TypeVar("Args")

# Function (argv, console) -> exit status of each command. Its module also has the class of its arguments, such as EvalArgs.
COMMANDS = {
    "train": "mjx_dher.cli.train:train_command",
    "resume": "mjx_dher.cli.resume:resume_command",
    "eval": "mjx_dher.cli.policies:eval_command",
    "render": "mjx_dher.cli.policies:render_command",
    "view": "mjx_dher.cli.view:view_command",
    "demo": "mjx_dher.cli.view:demo_command",
    "transfer": "mjx_dher.cli.policies:transfer_command",
    "export": "mjx_dher.cli.policies:export_command",
    "sweep": "mjx_dher.cli.sweep:sweep_command",
    "plot": "mjx_dher.cli.report:plot_command",
    "report": "mjx_dher.cli.report:report_command",
    "list": "mjx_dher.cli.show:list_command",
    "check": "mjx_dher.cli.show:check_command",
    "engines": "mjx_dher.cli.show:engines_command",
    "doctor": "mjx_dher.cli.show:doctor_command",
    "completion": "mjx_dher.cli.show:completion_command",
}
# Our flags, and their names in other libraries.
_FOREIGN = {
    "--actor-lr and --critic-lr": "--learning-rate --lr",
    "--actor-lr": "--policy-lr",
    "--critic-lr": "--q-lr",
    "--replay-size": "--buffer-size --replay-buffer-size --max-replay-size",
    "--polyak, which is 1 - tau: tau 0.05 is --polyak 0.95": "--tau --soft-target-tau",
    "--gamma": "--discount --discounting",
    "--num-envs": "--n-envs",
    "--total-steps, of all environments": "--total-timesteps --num-timesteps --n-timesteps --total-env-steps --timesteps",
    "--her-k": "--n-sampled-goal",
    "--sampler": "--goal-selection-strategy",
    "--updates-per-cycle, for the num_envs episodes of a cycle together": "--gradient-steps --train-freq",
    "--target-period": "--target-update-interval",
    "--noise-std": "--exploration-noise --action-noise",
    "--entropy-weight": "--ent-coef",
    "--num-critics": "--n-critics",
    "--dropped-quantiles, of each critic": "--top-quantiles-to-drop-per-net",
    "--hidden-sizes": "--net-arch",
    "--env": "--env-id",
    "--learner": "--algo",
    "--log wandb": "--track",
    "--log tensorboard": "--tensorboard-log",
    "--eval-episodes": "--n-eval-episodes",
}
FOREIGN_FLAGS = {theirs: ours for ours, flags in _FOREIGN.items() for theirs in flags.split()}


def run(name: str, argv: Sequence[str], console: Console) -> int:
    """Runs a command. Returns its exit status."""
    module, function = COMMANDS[name].split(":")
    return int(getattr(importlib.import_module(module), function)(list(argv), console))


def parse(kind: type[Args], argv: Sequence[str], **options: Any) -> Args:
    """Parses the words after a command's name into `kind`, such as EvalArgs. `options` are those of `tyro.cli`. Raises
    ValueError for a flag of another library. The message names ours.
    """
    import tyro

    for argument in argv:
        flag = argument.partition("=")[0].replace("_", "-")
        if flag in FOREIGN_FLAGS:
            name, comma, rest = FOREIGN_FLAGS[flag].partition(",")
            raise ValueError(f"{flag} is called {name} here{comma}{rest}")
    command = kind.__name__.removesuffix("Args").lower()
    prog = lookup.command_name() + ("" if command == "train" else f" {command}")
    args = tyro.cli(kind, prog=prog, args=argv, **options)
    lookup.trusts_files = getattr(args, "trust", False)
    return args
