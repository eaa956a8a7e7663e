"""The command line: `python train.py COMMAND`. Arguments are checked before JAX or MuJoCo is loaded.

Standard output may fail without stopping a command.
"""

import atexit
import contextlib
import dataclasses
import errno
import gc
import importlib
import io
import os
import re
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from rich.console import Console
from rich.text import Text

from mjx_dher import __version__, lookup
from mjx_dher.system import signals

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
MEMORY = ("num_envs", "batch_size", "hidden_sizes", "replay_size", "eval_episodes", "final_episodes")  # settings that need it
TRAINING = ("train", "resume", "sweep")  # commands whose output is on disk, not on the screen
# Characters that control a terminal or reverse its text, except tab and line feed.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


class Answered(SystemExit):
    """The end of a command by --help or invalid arguments, with its exit status."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line. Returns the exit status (2: invalid arguments)."""
    # Skips the final search for reference cycles, which takes half a second after a run.
    atexit.register(gc.freeze)
    argv = list(sys.argv[1:] if argv is None else argv)
    name = argv.pop(0) if argv and argv[0] in COMMANDS else "train"
    lookup.current_folder = True  # for --env module:attribute
    trains = name in TRAINING and not {"--dry-run", "--version"} & set(argv)
    with signals.taken(), _guarded() as stream:
        try:
            ended = _run(name, argv)
        except Answered as error:
            ended, trains = int(error.code or 0), False
        except SystemExit as error:
            _print_error(f"a task or a component has called sys.exit({'' if error.code is None else repr(error.code)})")
            ended = 2
        finally:
            lookup.trusts_files = False
        stream.flush()
    return _status(stream, ended, trains)


def _run(name: str, argv: list[str]) -> int:
    try:
        if argv == ["--version"] and name == "train":
            print(f"mjx-dher {__version__}")
            return 0
        if name == "train" and argv and not argv[0].startswith("-"):
            lookup.check_name("command", argv[0], COMMANDS)
        return run(name, argv, PlainConsole(soft_wrap=True))
    except Exception as error:
        if (reason := sentence(error)) is None:
            raise  # a bug, whose traceback is needed
        _print_error(reason)
        return 2


def _print_error(reason: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # stderr is gone
        for line in reason.splitlines():
            print(f"error: {printable(line)}", file=sys.stderr)


def sentence(error: Exception) -> str | None:
    """Message for a user or system error; None for a bug."""
    if isinstance(error, ValueError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename2 or error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
    if "MemoryError: engine" in str(error):  # from a call of the host in a compiled program
        return _first_line(error).partition("MemoryError: ")[2]
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return f"out of memory ({_first_line(error)}); it depends on {', '.join(MEMORY)}"
    if isinstance(error, RecursionError):
        return f"the input is nested too deeply ({_first_line(error)})"
    return None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def run(name: str, argv: Sequence[str], console: Console) -> int:
    """Runs a command. Returns its exit status."""
    module, function = COMMANDS[name].split(":")
    return int(getattr(importlib.import_module(module), function)(list(argv), console))


def parse(kind: type[Args], argv: Sequence[str], **options: Any) -> Args:
    """Parses the words after a command's name into `kind`, such as EvalArgs. `options` go to `tyro.cli`. Raises ValueError for
    a flag of another library, with our name for it, and for a list in two parts. Of other flags, the last one counts.
    """
    import tyro

    flags = [argument.partition("=")[0].replace("_", "-") for argument in argv if argument.startswith("--")]
    for flag in flags:
        if flag in FOREIGN_FLAGS:
            name, comma, rest = FOREIGN_FLAGS[flag].partition(",")
            raise ValueError(f"{flag} is called {name} here{comma}{rest}")
        if flags.count(flag) > 1 and flag.rpartition(".")[2].lstrip("-").replace("-", "_") in _lists(kind):
            raise ValueError(f"{flag} is given {flags.count(flag)} times; give it once, with all of its values")
    command = kind.__name__.removesuffix("Args").lower()
    prog = lookup.command_name() + ("" if command == "train" else f" {command}")
    try:
        args = tyro.cli(kind, prog=prog, args=argv, **options)
    except SystemExit as error:
        raise Answered(error.code if isinstance(error.code, int | None) else 1) from None
    lookup.trusts_files = getattr(args, "trust", False)
    return args


def _lists(kind: type) -> set[str]:
    """Names of the fields of a dataclass, and of those inside it, that hold several values."""
    fields = set()
    for name, hint in get_type_hints(kind).items():
        if any(get_origin(one) is tuple for one in (hint, *get_args(hint))):
            fields.add(name)
        elif dataclasses.is_dataclass(hint):
            fields |= _lists(hint)  # type: ignore[arg-type]
    return fields


def printable(text: str) -> str:
    """Text with escaped control characters, and escaped bytes of file names that are not valid UTF-8."""
    return _CONTROL.sub(lambda match: repr(match[0])[1:-1], lookup.escaped(text))


class PlainConsole(Console):
    """A console that prints text without markup and with escaped control characters."""

    def __init__(self, **options: Any):
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


class _Guarded:
    """A text stream that drops text that cannot be written, and keeps the first error."""

    def __init__(self, stream: Any):
        self.error: OSError | None = None
        self._closed = stream is None  # closed before this program started
        self._stream = open(os.devnull, "w", encoding="utf-8") if self._closed else stream  # noqa: SIM115

    def write(self, text: str) -> int:
        self._attempt("write", text)
        return len(text)

    def flush(self) -> None:
        self._attempt("flush")

    def _attempt(self, method: str, *args: Any) -> None:
        if self.error is not None:
            return
        try:
            if self._closed and args:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            getattr(self._stream, method)(*args)
        except OSError as error:
            self.error = error
            # Otherwise the interpreter would report an error when it flushes the rest.
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _open_closed() -> None:
    """Opens closed standard streams on /dev/null.

    Otherwise the next opened file would get the number of a standard stream, and output of C libraries would go into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number


@contextlib.contextmanager
def _guarded() -> Iterator[_Guarded]:
    """Guards sys.stdout. Characters that it cannot encode are escaped, and control characters in warnings too."""
    _open_closed()
    before, form = sys.stdout, warnings.formatwarning
    if isinstance(before, io.TextIOWrapper):
        before.reconfigure(errors="backslashreplace")
    stream = _Guarded(before)
    sys.stdout = stream
    warnings.formatwarning = lambda *about, **options: printable(form(*about, **options))
    try:
        yield stream
    finally:
        stream.flush()
        sys.stdout, warnings.formatwarning = before, form


def _status(stream: _Guarded, ended: int, trains: bool) -> int:
    """Exit status of a command that ended with `ended`. Reports lost output.

    A command that trains has still done its work. For others lost output is an error or, if the reader has gone (`| head`),
    the status of SIGPIPE.
    """
    if stream.error is None:
        return ended
    gone = isinstance(stream.error, BrokenPipeError)
    if not gone or trains:
        lost = "later output is lost" if trains else "the output is incomplete"
        _print_error(f"cannot print ({stream.error.strerror}); {lost}")
    return ended if trains or ended else (128 + signal.SIGPIPE if gone else 2)
