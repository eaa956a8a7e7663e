"""History of speed: measures this machine and appends one line to bench/history.jsonl, or draws the history.

    python bench/record.py [--repeats 5] [--out bench/history.jsonl] [--anyway]
    python bench/record.py --draw

A line has the commit, the date, the machine, the versions, and the figures: environment steps per second of a rollout of Push,
updates per second of DDPG and of the learners of PickAndPlace and Slide with the machine's preset, and the seconds of `python
train.py` from Enter to its first epoch, before and after compilation. It takes ten minutes. A busy machine or a working tree
with changes is an error, because the line would not describe the commit; with `--anyway` the line has a remark instead.

--draw writes history.md and history.svg next to the file (extra `plot`).
"""

import argparse
import datetime
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
HISTORY = Path(__file__).parent / "history.jsonl"
BUSY = 0.15  # of the cores, by the load of the last minute; beyond it other programs affect the figures
# Description and digits of the figures by name.
FIGURES = {
    "env_steps_per_second": ("environment steps a second", 0),
    "updates_per_second": ("updates a second, ddpg", 0),
    "cold_start_seconds": ("seconds to the first epoch, nothing compiled", 1),
    "warm_start_seconds": ("seconds to the first epoch", 1),
    "pick_and_place_updates_per_second": ("updates a second, PickAndPlace", 0),
    "slide_updates_per_second": ("updates a second, Slide", 0),
}
FIRST = list(FIGURES)[:4]  # that all lines have
FIELDS = ("date", "commit", "remarks", "machine", "versions", "setup", "figures")


def git(*arguments: str) -> str:
    """Output of a git command on this checkout."""
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def remarks_of(load: float, cores: int, changes: str) -> list[str]:
    """Reasons why a line would not describe this commit on an idle machine."""
    busy = [f"machine busy: load {load:.2f} on {cores} cores"] if load > BUSY * cores else []
    return busy + (["working tree with changes"] if changes else [])


def read(path: Path) -> list[dict[str, Any]]:
    """All lines of a history, oldest first. Exits if one is invalid."""
    entries = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines() if path.exists() else [], start=1):
        try:
            entry = json.loads(line)
            missing = [name for name in FIELDS if name not in entry]
            numbers = {**dict.fromkeys(FIRST), **entry["figures"]}
            wrong = [name for name, number in numbers.items() if name in FIGURES and not 0 < float(number) < math.inf]
            if missing or wrong:
                raise ValueError(f"without {', '.join(missing + wrong)}")
        except (ValueError, KeyError, TypeError) as error:
            raise SystemExit(f"{path}, line {number}: not an entry ({type(error).__name__}: {error})") from error
        entries.append(entry)
    return sorted(entries, key=lambda entry: str(entry["date"]))


def measure(repeats: int) -> tuple[dict[str, float], dict[str, Any]]:
    """The figures, and their settings. Start-up is measured first, because it needs the GPU's memory."""
    import startup

    from mjx_dher import config, presets

    preset = startup.machine_preset()
    spec = presets.preset(preset, "push", learner="ddpg")
    run = spec.config
    steps = str(2 * config.steps_per_epoch(run, 50))
    alike = ("--learner", "ddpg", "--augmentation", "none")  # as in earlier records
    command = ["--env", "push", "--preset", preset, *alike, "--total-steps", steps, "--no-curve"]
    with tempfile.TemporaryDirectory() as home:
        starts = [startup.measure(command, home)["to the first epoch"] for _ in range(1 + repeats)]

    import jax
    import learner as learner_bench
    import throughput

    from mjx_dher import learners, samplers
    from mjx_dher.envs.engines import resolve_engine

    engine = resolve_engine("auto")
    rates = [throughput.measure("push", engine, run.num_envs, "auto", False, 3)[1] for _ in range(repeats)]

    def updating(spec: Any) -> Any:
        made = learners.make(spec.learner, spec.config, learner_bench.SPEC, spec.networks)
        return learner_bench.Timed(made, spec.config.batch_size, 1, samplers.make("future"), 50)

    timed = updating(spec)
    updates = [1 / timed.seconds()[0] for _ in range(repeats)]
    others = [1 / updating(presets.preset(preset, task)).seconds()[0] for task in ("pick_and_place", "slide")]
    medians = (statistics.median(rates), statistics.median(updates), starts[0], statistics.median(starts[1:]), *others)
    setup = {"preset": preset, "engine": engine, "num_envs": run.num_envs, "batch_size": run.batch_size, "repeats": repeats}
    spread = {name: [float(f"{x:.4g}") for x in (min(many), max(many))] for name, many in zip(FIGURES, (rates, updates))}
    return dict(zip(FIGURES, medians)), {**setup, "lowest_and_highest": spread, "device": jax.devices()[0].device_kind}


def record(path: Path, repeats: int, anyway: bool) -> dict[str, Any]:
    """Measures, and appends a line to the file."""
    from timing import cpu

    import mjx_dher
    from mjx_dher.system.machine import usable_cores

    read(path)  # raises for an invalid file, before anything is measured
    remarks = remarks_of(os.getloadavg()[0], usable_cores(), git("status", "--porcelain"))
    if remarks and not anyway:
        raise SystemExit(f"not recorded: {'; '.join(remarks)} (--anyway records it with that remark)")
    figures, setup = measure(repeats)
    versions = {name: metadata.version(name) for name in ("jax", "mujoco", "numpy")}
    entry = {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "commit": git("rev-parse", "--short=12", "HEAD"),
        "remarks": remarks,
        "machine": f"{setup.pop('device')}; {cpu()}, {usable_cores()} cores",
        "versions": {"mjx_dher": mjx_dher.__version__, "python": platform.python_version(), **versions},
        "setup": setup,
        "figures": {name: float(f"{value:.4g}") for name, value in figures.items()},
    }
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")
    return entry


def page(entries: list[dict[str, Any]]) -> str:
    """history.md: a table of all entries, the newest first."""
    lines = [
        "# History of speed",
        "",
        "Written by `python bench/record.py --draw`; `bench/record.py` says what the figures are.",
        "",
    ]
    if not entries:
        return "\n".join([*lines, "There is no entry yet."]) + "\n"
    head = ["date", "commit", *(label for label, _ in FIGURES.values()), "machine", "versions", "remarks"]
    lines += ["![Each figure over time](history.svg)", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for entry in reversed(entries):
        known = entry["figures"]
        figures = [f"{known[name]:,.{digits}f}" if name in known else "" for name, (_, digits) in FIGURES.items()]
        versions = ", ".join(f"{name} {version}" for name, version in entry["versions"].items())
        cells = [entry["date"][:10], f"`{entry['commit']}`", *figures, entry["machine"], versions, "; ".join(entry["remarks"])]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(entries: list[dict[str, Any]]) -> Any:
    """Draws each figure over time, one line per machine. Entries with remarks are hollow."""
    from mjx_dher.tools import figures

    figure, axes = figures.subplots(2, 3, 15, 6)
    machines = list(dict.fromkeys(entry["machine"] for entry in entries))
    for axis, (name, (label, _)) in zip(axes, FIGURES.items()):
        for machine, (color, line, marker) in zip(machines, figures.styles(len(machines))):
            own = [entry for entry in entries if entry["machine"] == machine and name in entry["figures"]]
            dates = [datetime.datetime.fromisoformat(entry["date"]) for entry in own]
            axis.plot(dates, [entry["figures"][name] for entry in own], color=color, linestyle=line, label=machine)
            for date, entry in zip(dates, own):
                fill = "none" if entry["remarks"] else color
                axis.plot(date, entry["figures"][name], color=color, marker=marker, markerfacecolor=fill)
        axis.set_title(label, fontsize=10)
        axis.set_ylim(bottom=0)
        axis.tick_params(axis="x", labelrotation=20, labelsize=8)
        axis.grid(alpha=0.2)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", frameon=False, fontsize=8)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=HISTORY, help="file to append to, or to draw")
    parser.add_argument("--repeats", type=int, default=5, help="measurements per figure; the median counts")
    parser.add_argument("--anyway", action="store_true", help="record despite a busy machine or changes, with a remark")
    parser.add_argument("--draw", action="store_true", help="write history.md and history.svg next to the file")
    args = parser.parse_args()
    if not 1 <= args.repeats <= 100:
        parser.error(f"--repeats must lie in [1, 100]; got {args.repeats}")
    if not args.out.parent.is_dir():
        parser.error(f"--out: there is no folder {args.out.parent}")
    if not args.draw:
        print(json.dumps(record(args.out, args.repeats, args.anyway), indent=2))
        return
    from mjx_dher.tools import figures

    figures.check(("svg",), "--draw")
    entries = read(args.out)
    args.out.with_suffix(".md").write_text(page(entries))
    if entries:
        figures.write(draw(entries), args.out.with_suffix(".svg"))
    print(f"wrote {args.out.with_suffix('.md')} ({len(entries)} entries)")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    main()
