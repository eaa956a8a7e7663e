"""The command `doctor`."""

from __future__ import annotations

import dataclasses
import json

from rich.console import Console

from mjx_dher.cli.commands import parse
from mjx_dher.validation import check_number


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
