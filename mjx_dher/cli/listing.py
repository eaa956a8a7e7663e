"""The command `list`: names of all tasks, components, engines, presets and policies."""

from __future__ import annotations

import dataclasses
import json

import tyro
from rich.console import Console

from mjx_dher import lookup
from mjx_dher.cli.commands import parse
from mjx_dher.components import COMPONENTS
from mjx_dher.policy import bundled

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
