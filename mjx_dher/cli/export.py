"""The command `export`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro
from rich.console import Console

from mjx_dher import names
from mjx_dher.runs import run_folder


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Write the policy of a run folder as a file for other programs, and check that the file gives the same actions.

    docs/policies.md describes the files. Needs the extra: `pip install -e ".[export]"`.
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    format: str
    """Format: onnx (a graph from observation and goal to action) or safetensors (the tensors alone)."""
    out: Path | None = None
    """File to write, which ends in the format's name; policy.onnx or policy.safetensors in the run folder unless given."""
    overwrite: bool = False
    """Replacement of an existing `out`."""


def export_command(argv: list[str], console: Console) -> int:
    """Writes the policy of a run folder for other programs."""
    from mjx_dher.runs.load import check_plain, load_policy
    from mjx_dher.tools import export

    args = tyro.cli(ExportArgs, prog=f"{names.program()} export", args=argv)
    names.check_name("format", args.format, export.FORMATS)
    run = run_folder.read_spec(args.run)
    out = args.out or args.run / f"policy.{args.format}"
    export.check(args.format, out, args.overwrite)
    policy = load_policy(args.run)
    check_plain(policy, run, "export")
    difference = export.write(policy, run, args.format, out)
    observation_size, goal_size, action_size = export.sizes(policy)
    console.print(
        f"{run.env}: observation [N, {observation_size}], desired_goal [N, {goal_size}] -> action [N, {action_size}];"
        f" the same actions for {export.CHECKED:,} observations (largest difference {difference:.1g}); wrote {out}",
        soft_wrap=True,
    )
    return 0
