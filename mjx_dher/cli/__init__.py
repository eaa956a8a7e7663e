"""The command line: `python train.py COMMAND`. Arguments are checked before JAX or MuJoCo is loaded."""

from __future__ import annotations

import atexit
import contextlib
import gc
import sys
from collections.abc import Sequence

from mjx_dher import __version__, lookup
from mjx_dher.cli import output
from mjx_dher.cli.commands import COMMANDS, run
from mjx_dher.system import signals

MEMORY = ("num_envs", "batch_size", "hidden_sizes", "replay_size", "eval_episodes", "final_episodes")  # settings that need it
TRAINING = ("train", "resume", "sweep")  # commands whose output is on disk, not on the screen


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line. Returns the exit status (2: invalid arguments)."""
    # Skips the final search for reference cycles, which takes half a second after a run.
    atexit.register(gc.freeze)
    argv = list(sys.argv[1:] if argv is None else argv)
    name = argv.pop(0) if argv and argv[0] in COMMANDS else "train"
    lookup.current_folder = True  # for --env module:attribute
    trains = name in TRAINING and not {"--dry-run", "--version"} & set(argv)
    with signals.taken(), output.guarded() as stream:
        try:
            ended = _run(name, argv)
        except SystemExit as error:  # from --help, or invalid arguments
            ended, trains = error.code if isinstance(error.code, int) else 1, False
        finally:
            lookup.trusts_files = False
        stream.flush()
    return output.status(stream, ended, trains)


def _run(name: str, argv: list[str]) -> int:
    try:
        if argv == ["--version"] and name == "train":
            print(f"mjx-dher {__version__}")
            return 0
        if name == "train" and argv and not argv[0].startswith("-"):
            lookup.check_name("command", argv[0], COMMANDS)
        return run(name, argv, output.PlainConsole(soft_wrap=True))
    except Exception as error:
        if (reason := sentence(error)) is None:
            raise  # a bug, whose traceback is needed
        with contextlib.suppress(OSError, ValueError, AttributeError):  # stderr is gone
            for line in reason.splitlines():
                print(f"error: {output.printable(line)}", file=sys.stderr)
        return 2


def sentence(error: Exception) -> str | None:
    """Message for a user or system error; None for a bug."""
    if isinstance(error, ValueError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
    if "MemoryError: engine" in str(error):  # from a call of the host in a compiled program
        return _first_line(error).partition("MemoryError: ")[2]
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return f"out of memory ({_first_line(error)}); it depends on {', '.join(MEMORY)}"
    if isinstance(error, RecursionError):
        return f"the input is nested too deeply ({_first_line(error)})"
    return None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
