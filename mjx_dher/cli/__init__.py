"""The command line: `python train.py COMMAND`. Arguments are checked before JAX or MuJoCo is loaded."""

import atexit
import contextlib
import gc
import importlib
import sys
from collections.abc import Sequence
from typing import Any, TypeVar

from rich.console import Console

from mjx_dher import __version__, lookup
from mjx_dher.cli import output
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
