"""The command `check`."""

from __future__ import annotations

import dataclasses
from typing import Any, get_type_hints

from rich.console import Console

from mjx_dher import presets, spec
from mjx_dher.cli.commands import parse
from mjx_dher.cli.common import make_env
from mjx_dher.spec import RunSpec
from mjx_dher.system.caches import prepare

_HINTS = get_type_hints(RunSpec, include_extras=True)
CheckArgs: Any = dataclasses.make_dataclass(
    "CheckArgs",
    [
        (field.name, _HINTS[field.name], dataclasses.field(default="reach" if field.name == "env" else field.default))
        for field in dataclasses.fields(RunSpec)
        if field.name not in ("seed", "config", "hparams")
    ],
    frozen=True,
)
CheckArgs.__doc__ = """Test custom components (module:attribute) on random episodes, as `train` does before it starts.

A component is tested with the others: `--sampler weighted` reads a custom kernel, for example. Exits with status 0 if all
pass, else with status 2 and the first error.
"""


def check_command(argv: list[str], console: Console) -> int:
    """Tests custom components."""
    args = parse(CheckArgs, argv)
    run = presets.preset("cpu", **vars(args))
    spec.validate(run)
    if not spec.custom_components(run):
        raise ValueError("check needs one or more components as module:attribute; all of these are built in")
    prepare()
    from mjx_dher.testing import verdicts

    for line in verdicts.check(make_env(run), [run], again=True):
        console.print(line)
    return 0
