"""The command `completion`."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import operator
from functools import reduce
from typing import Annotated, Any, Literal, get_args

import tyro
from rich.console import Console

from mjx_dher import lookup
from mjx_dher.cli.commands import COMMANDS, parse

Shell = Literal["bash", "zsh", "tcsh"]


@dataclasses.dataclass(frozen=True)
class CompletionArgs:
    """Print what makes a shell complete the commands and options of `mjx-dher`.

    bash: mjx-dher completion bash > ~/.local/share/bash-completion/completions/mjx-dher
    zsh: mjx-dher completion zsh > ~/.zfunc/_mjx-dher, with ~/.zfunc in fpath before compinit
    """

    shell: tyro.conf.Positional[str]
    """Shell: bash, zsh or tcsh."""


def completion_command(argv: list[str], console: Console) -> int:
    """Prints a shell's completion."""
    args = parse(CompletionArgs, argv)
    lookup.check_name("shell", args.shell, get_args(Shell))
    print(script(args.shell), end="")
    return 0


def script(shell: str) -> str:
    """Returns the completion of `mjx-dher` for a shell, as tyro writes it."""
    every: Any = reduce(operator.or_, (_subcommand(name) for name in COMMANDS))
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        tyro.cli(every, prog="mjx-dher", args=["--tyro-print-completion", shell], config=(tyro.conf.OmitArgPrefixes,))
    return printed.getvalue()


def _subcommand(name: str) -> Any:
    module = importlib.import_module(COMMANDS[name].partition(":")[0])
    owner = getattr(module, f"{name.capitalize()}Args")
    return Annotated[owner, tyro.conf.subcommand(name)]
