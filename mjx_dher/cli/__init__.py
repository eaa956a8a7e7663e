"""The command line: `python train.py COMMAND`, a file a command. No JAX or MuJoCo before the arguments have been checked."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Sequence

from rich.console import Console

from mjx_dher import names

# Each command, and the function (argv, console) -> exit status.
COMMANDS = {
    "train": "mjx_dher.cli.train:train_command",
    "resume": "mjx_dher.cli.train:resume_command",
    "eval": "mjx_dher.cli.evaluate:eval_command",
    "render": "mjx_dher.cli.render:render_command",
    "transfer": "mjx_dher.cli.transfer:transfer_command",
    "export": "mjx_dher.cli.export:export_command",
    "sweep": "mjx_dher.cli.sweep:sweep_command",
    "plot": "mjx_dher.cli.sweep:plot_command",
    "check": "mjx_dher.cli.check:check_command",
    "doctor": "mjx_dher.cli.doctor:doctor_command",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status (2: the arguments were refused)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    name = argv.pop(0) if argv and argv[0] in COMMANDS else "train"
    if "" not in sys.path:  # the current folder, for --env module:attribute; last, so that it hides nothing
        sys.path.append("")
    try:
        if name == "train" and argv and not argv[0].startswith("-"):
            names.check_name("command", argv[0], COMMANDS)
        module, function = COMMANDS[name].split(":")
        command = getattr(importlib.import_module(module), function)
        return command(argv, Console(highlight=False, markup=False))
    except ValueError as error:
        for line in str(error).splitlines():
            print(f"error: {line}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # whoever read the output has gone, as in `train.py --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else the interpreter complains when it flushes
        return 128 + signal.SIGPIPE
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # outside of training, which ends in order
        print("stopped", file=sys.stderr)
        return 128 + signal.SIGINT
