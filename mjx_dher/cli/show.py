"""The commands `list`, `check`, `engines`, `doctor` and `completion`. They show components and this machine's state."""

import contextlib
import dataclasses
import importlib
import io
import json
import operator
from functools import reduce
from typing import Annotated, Any, NamedTuple, get_type_hints

import tyro
from rich.console import Console

from mjx_dher import envs, lookup, presets, spec
from mjx_dher.cli import COMMANDS, parse
from mjx_dher.cli.common import make_env, print_table
from mjx_dher.components import COMPONENTS
from mjx_dher.policy import bundled
from mjx_dher.spec import RunSpec
from mjx_dher.system.machine import prepare
from mjx_dher.validation import check_number

ENGINES = {
    "auto": "native on a CPU, warp on an NVIDIA GPU, else jax",
    "native": "MuJoCo C on all cores of the host",
    "jax": "MJX, on any device that JAX supports",
    "warp": "our kernel for NVIDIA GPUs (extra cuda)",
}
PRESETS = {
    "auto": "cpu or gpu, depending on this machine",
    "cpu": "tuned for time to success on two cores, with native",
    "gpu": "tuned for time to success on one NVIDIA GPU, with warp",
    "frugal": "tuned for few environment steps",
    "paper": "the settings of the paper",
}
FIELDS = {  # kinds of components, and their field of RunSpec
    "tasks": "env",
    "samplers": "sampler",
    "kernels": "weight_kernel",
    "normalizations": "weight_normalization",
    "metrics": "metric",
    "priorities": "priority",
    "generators": "generator",
    "learners": "learner",
    "networks": "networks",
}
_NATIVE = "use engine native"
# Changes to an MJCF that let an engine take it, by words of the reason against it.
_CURES = {
    "integrator": 'integrator="Euler"',
    "disable springs": "set stiffness and damping to 0 in place of the flags",
    "noslip": 'noslip_iterations="0"',
    "solver": 'solver="Newton"',
    "without nativeccd": '<flag nativeccd="disable"/>',
    "with nativeccd": '<flag nativeccd="enable"/>',
    "stand_in": "add the geom that it names",
}
KINDS = ("tasks", "engines", "presets", *list(FIELDS)[1:], "policies")


@dataclasses.dataclass(frozen=True)
class ListArgs:
    """List all tasks, engines, presets, components (samplers, learners and so on) and policies, one per line.

    Every component can also be custom, as module:attribute (docs/tutorial.md).
    """

    kinds: tyro.conf.Positional[tuple[str, ...]] = ()
    """Kinds to list, such as tasks. Default: all."""
    json: bool = False
    """Print one JSON object instead: name and line by kind."""


def names(kind: str) -> tuple[str, dict[str, str]]:
    """The option that takes names of this kind, and a line about each name."""
    if kind == "engines":
        return "--engine", ENGINES
    if kind == "presets":
        return "--preset", PRESETS
    if kind == "policies":
        rates = {name: bundled.facts(bundled.FOLDER / name)["here"]["success_rate"] for name in bundled.names()}
        return "in place of RUN", {name: f"bundled: success {rate:.3f}" for name, rate in rates.items()}
    field = FIELDS[kind]
    rows = COMPONENTS[field].items()
    lines = {name: row.line + (f"; reads {', '.join(row.reads)}" if row.reads else "") for name, row in rows}
    return f"--{field.replace('_', '-')}", lines


def list_command(argv: list[str], console: Console) -> int:
    """Lists all names."""
    args = parse(ListArgs, argv)
    for kind in args.kinds:
        lookup.check_name("kind", kind, KINDS)
    chosen = {kind: names(kind) for kind in args.kinds or KINDS}
    if args.json:
        print(json.dumps({kind: lines for kind, (_, lines) in chosen.items()}, indent=2))
        return 0
    width = max(len(name) for _, lines in chosen.values() for name in lines)
    for kind, (option, lines) in chosen.items():
        console.print(f"{kind} ({option})")
        for name, line in lines.items():
            console.print(f"  {name:{width}}  {line}")
    return 0


_HINTS = get_type_hints(RunSpec, include_extras=True)
CheckArgs: Any = dataclasses.make_dataclass(
    "CheckArgs",
    [
        (field.name, _HINTS[field.name], dataclasses.field(default="reach" if field.name == "env" else field.default))
        for field in dataclasses.fields(RunSpec)
        if field.name not in ("demonstrations", "seed", "config", "hparams")
    ],
    frozen=True,
)
CheckArgs.__doc__ = """Test custom components (module:attribute) on random episodes, as `train` does before it starts.

A component is tested with the others: `--sampler weighted` reads a custom kernel, for example. Exits with status 0 if all
pass, else with status 2 and the first error.
"""


def check_command(argv: list[str], console: Console) -> int:
    """Tests custom components."""
    run = presets.preset("cpu", **vars(parse(CheckArgs, argv)))
    spec.validate(run)
    if not spec.custom_components(run):
        raise ValueError("check needs one or more components as module:attribute; all of these are built in")
    prepare()
    from mjx_dher.testing import verdicts

    for line in verdicts.check(make_env(run), [run], again=True):
        console.print(line)
    return 0


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
    import mujoco

    args = parse(EnginesArgs, argv)
    engine = "native" if envs.takes_engine(args.env) else "auto"
    model = getattr(envs.make(args.env, engine=engine, **spec.to_arguments(args.env_kwargs)), "model", None)
    if not isinstance(model, mujoco.MjModel):
        raise ValueError(f"env {args.env!r} must have an attribute `model`, a mujoco.MjModel")
    verdicts = explain(model)
    if args.json:
        print(json.dumps([{**verdict._asdict(), "supported": not verdict.reason} for verdict in verdicts], indent=2))
    else:
        rows = [(each.engine, "no" if each.reason else "yes", each.reason, each.cure) for each in verdicts]
        print_table(("engine", "supported", "reason", "cure"), rows, console)
    return 0


class Verdict(NamedTuple):
    """Whether an engine supports a model."""

    engine: str  # native, jax, warp fused or warp graph
    reason: str  # "" if it does
    cure: str


def explain(model: Any) -> list[Verdict]:
    """Tries every engine, and both paths of warp, on a model. Without a GPU, warp is tried on the CPU."""
    return [
        _verdict(model, "native", "mjx_dher.envs.Simulator, or MuJoCo itself"),
        _verdict(model, "jax", _NATIVE),
        _verdict(model, "warp", "engine warp takes the path graph", path="fused", allow_cpu=True),
        _verdict(model, "warp", _NATIVE, path="graph", allow_cpu=True),
    ]


def _verdict(model: Any, engine: str, otherwise: str, **options: Any) -> Verdict:
    from mjx_dher.envs.engines import make_engine

    name = f"{engine} {options['path']}" if options else engine
    try:
        make_engine(engine, model, 1, **options)
    except ValueError as error:
        reason, _, cure = str(error).partition("; ")
        if cure and cure != _NATIVE:
            return Verdict(name, reason, cure)
        cures = [cure for words, cure in _CURES.items() if words in reason]
        return Verdict(name, reason, "; or ".join([*cures, otherwise]))
    return Verdict(name, "", "")


@dataclasses.dataclass(frozen=True)
class DoctorArgs:
    """Show what works on this machine, for a bug report: versions, devices, engines, drawing backends and folders.

    Exits with status 0 if at least one engine works, else with status 1.
    """

    json: bool = False
    """Print one JSON object instead."""
    seconds: float = 180.0
    """Time limit of each test. Warp compiles its kernels once per machine, for a minute or more."""


def doctor_command(argv: list[str], console: Console) -> int:
    """Shows what works on this machine."""
    from mjx_dher.tools import doctor

    args = parse(DoctorArgs, argv)
    check_number("seconds", args.seconds, "(0, 3600]", float)
    if not args.json:
        console.print("trying the engines and the drawing backends ...")
    report = doctor.examine(args.seconds)
    if args.json:
        print(json.dumps(report, indent=2))
    else:
        for line in doctor.lines(report):
            console.print(line)
    return 0 if any(map(doctor.works, report["engines"].values())) else 1


@dataclasses.dataclass(frozen=True)
class CompletionArgs:
    """Print a shell script that completes the commands and options of `mjx-dher`.

    bash: mjx-dher completion bash > ~/.local/share/bash-completion/completions/mjx-dher
    zsh: mjx-dher completion zsh > ~/.zfunc/_mjx-dher, with ~/.zfunc in fpath before compinit
    """

    shell: tyro.conf.Positional[str]
    """Shell: bash, zsh or tcsh."""


def completion_command(argv: list[str], console: Console) -> int:
    """Prints a shell's completion."""
    args = parse(CompletionArgs, argv)
    lookup.check_name("shell", args.shell, ("bash", "zsh", "tcsh"))
    print(completion(args.shell), end="")
    return 0


def completion(shell: str) -> str:
    """Completion of `mjx-dher` for a shell, generated by tyro."""

    def subcommand(name: str) -> Any:
        module = importlib.import_module(COMMANDS[name].partition(":")[0])
        return Annotated[getattr(module, f"{name.capitalize()}Args"), tyro.conf.subcommand(name)]

    every: Any = reduce(operator.or_, map(subcommand, COMMANDS))
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        tyro.cli(every, prog="mjx-dher", args=["--tyro-print-completion", shell], config=(tyro.conf.OmitArgPrefixes,))
    return printed.getvalue()
