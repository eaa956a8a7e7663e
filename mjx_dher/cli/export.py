"""The command `export`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro
from rich.console import Console

from mjx_dher import lookup
from mjx_dher.cli.commands import parse
from mjx_dher.cli.common import find_run
from mjx_dher.policy import bundled
from mjx_dher.runs.folder import run_folder


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Write a policy as a file for other programs, and check that the file gives the same actions.

    docs/policies.md describes the files. Needs the extra: `pip install -e ".[export]"`.
    """

    run: tyro.conf.Positional[Path]
    """Run folder, or a bundled policy such as push."""
    format: str
    """Format: onnx (a graph from observation and goal to action) or safetensors (only the tensors)."""
    out: Path | None = None
    """File to write, which ends in the format's name. Default: policy.onnx or policy.safetensors in the run folder, or for a
    bundled policy, push.onnx or the like in the current folder."""
    overwrite: bool = False
    """Replace an existing file."""


def export_command(argv: list[str], console: Console) -> int:
    """Writes the policy of a run folder for other programs."""
    from mjx_dher.policy.load import load_plain
    from mjx_dher.tools import export

    args = parse(ExportArgs, argv)
    lookup.check_name("format", args.format, export.FORMATS)
    folder = find_run(args.run, console)
    content, run = run_folder.read_run(folder)
    beside = Path(f"{folder.name}.{args.format}") if bundled.is_shipped(folder) else folder / f"policy.{args.format}"
    out = args.out or beside
    export.check(args.format, out, args.overwrite)
    policy = load_plain(folder, "export")
    if not policy.interface:  # older policy files leave it to the run folder
        policy = dataclasses.replace(policy, interface=content.get("interface", {}))
    difference = export.write(policy, run, args.format, out)
    observation_size, goal_size, action_size = policy.sizes
    console.print(
        f"{run.env}: observation [N, {observation_size}], desired_goal [N, {goal_size}] -> action [N, {action_size}];"
        f" the same actions for {export.CHECKED:,} observations (largest difference {difference:.1g}); wrote {out}"
    )
    return 0
