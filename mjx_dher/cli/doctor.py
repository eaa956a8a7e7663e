"""The command `doctor`."""

from __future__ import annotations

import dataclasses
import json

from rich.console import Console

from mjx_dher.cli.commands import parse


@dataclasses.dataclass(frozen=True)
class DoctorArgs:
    """Say what works on this machine, for a report of a fault: versions, devices, engines, ways to draw, folders.

    Ends with status 0 if at least one engine works, else with 1.
    """

    json: bool = False
    """Print one JSON object instead."""
    seconds: float = 180.0
    """Time that each engine and each way to draw may take. Warp compiles its kernels, once a machine, for a minute or more."""


def doctor_command(argv: list[str], console: Console) -> int:
    """Says what works on this machine."""
    from mjx_dher.tools import doctor

    args = parse(DoctorArgs, argv)
    doctor.check(args.seconds)
    if not args.json:
        console.print("trying the engines and the ways to draw ...")
    report = doctor.examine(args.seconds)
    if args.json:
        print(json.dumps(report, indent=2))
    else:
        for line in doctor.lines(report):
            console.print(line, soft_wrap=True)
    return 0 if doctor.some_engine_works(report) else 1
