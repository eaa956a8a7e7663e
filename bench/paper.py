"""Runs the experiment of docs/results.md. Each figure is one command; run it again to resume.

    python bench/paper.py --plan              # what would run
    python bench/paper.py samplers            # one figure: its sweeps, and its curves into docs/paper
    python bench/paper.py k_push k_slide      # some sweeps of a figure
    python bench/paper.py all                 # all figures
    python docs/make_results_figures.py       # tables and pictures of docs/results.md from the curves

A figure is one or more calls of `train.py sweep`, each with a separate folder under --out. It is meant for one GPU. Two GPUs
share the work as `bench/paper.py samplers k` and `bench/paper.py slide readings ...` on one folder. `--toy` takes Reach, two
seeds and sizes that a CPU trains in seconds, to test the mechanics. Do not use it for a figure.
"""

import argparse
import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from mjx_dher.cli.settings import check_writable  # noqa: E402
from mjx_dher.sweeps import comparison, tables  # noqa: E402
from mjx_dher.system import files, signals  # noqa: E402
from mjx_dher.system.files import FolderError  # noqa: E402

CURVES = ROOT / "docs" / "paper"
COLUMNS = ("sweep", "setting", "seed", "epoch", "env_steps", "success_rate")
XLA_FLAGS = "--xla_gpu_enable_cublaslt=true --xla_gpu_enable_triton_gemm=false"
SEEDS = 10
LANES = 40  # most parallel runs
# The paper's epoch is 50 cycles of two episodes per worker. Here it is one cycle of as many episodes and updates.
FAST = "--cycles-per-epoch 1 --updates-per-cycle 2000 --learner-dtype bfloat16"
EPISODES = {"push": 800, "pick_and_place": 1600, "slide": 800}  # per epoch
TOY = (
    "--preset paper --engine native --num-envs 2 --cycles-per-epoch 1 --updates-per-cycle 2 --target-period 1 --batch-size 8"
    " --hidden-sizes 8 --eval-episodes 2 --final-episodes 2 --replay-size 400 --checkpoint-every 0"
)


class Sweep(NamedTuple):
    """One call of `train.py sweep`: its name within the figure, task, epochs, number of settings, options, seeds."""

    name: str
    task: str
    epochs: int
    settings: int
    options: str
    seeds: int = SEEDS
    first_seed: int = 0
    own_cycles: bool = False  # the paper's 50 cycles per epoch and float32, instead of FAST


_LINEAR = "--sampler weighted --weight-kernel linear --weight-normalization"
_SOFTMAX = "--sampler weighted --weight-kernel softmax --weight-normalization"
_K = "--sampler future --sweep.her-k 1 2 8 16"
_EVENTFUL = "--sampler future --sweep.priority-fraction 0.5"
_BOTH = "--sampler future weighted"
_NEW: dict[str, Any] = {"first_seed": 20, "own_cycles": True}  # seeds that influenced no choice
FIGURES: dict[str, tuple[Sweep, ...]] = {
    "own_cycles": (
        Sweep("own_push", "push", 50, 2, _BOTH, 20, **_NEW),
        Sweep("own_pick_and_place", "pick_and_place", 50, 2, _BOTH, 20, **_NEW),
        Sweep("own_slide", "slide", 100, 2, _BOTH, 10, **_NEW),
        Sweep("own_methods", "push", 50, 2, "--sampler closest epsilon_closest", 10, **_NEW),
    ),
    "own_set": (
        Sweep("samplers_own_push", "push", 30, 2, "--sampler final random", **_NEW),
        Sweep("readings_own_push", "push", 30, 5, f"{_LINEAR} sum max minmax none far", **_NEW),
        Sweep("readings_own_push_softmax", "push", 30, 2, f"{_SOFTMAX} mean none", **_NEW),
        Sweep("k_own_push", "push", 30, 4, _K, **_NEW),
        Sweep("ring_own_push", "push", 30, 1, "--sampler future --replay-size 200000", **_NEW),
        Sweep("noise_own_push", "push", 30, 1, "--sampler future --sweep.random-noise 0", **_NEW),
    ),
    "samplers": (
        Sweep(
            "samplers",
            "push",
            50,
            8,
            "--sampler episode future closest epsilon_closest weighted --sweep.epsilon 0.1 0.2 0.3 0.5",
        ),
    ),
    "pick_and_place": (Sweep("pick_and_place", "pick_and_place", 50, 2, "--sampler future weighted"),),
    "slide": (Sweep("slide", "slide", 200, 2, "--sampler future weighted"),),
    "readings": (
        Sweep("readings_push", "push", 30, 5, f"{_LINEAR} sum max minmax none far"),
        Sweep("readings_push_softmax", "push", 30, 2, f"{_SOFTMAX} mean none"),
        Sweep("readings_pick_and_place", "pick_and_place", 20, 3, f"{_LINEAR} sum minmax far"),
        Sweep("readings_pick_and_place_softmax", "pick_and_place", 20, 1, f"{_SOFTMAX} none"),
        Sweep("readings_slide", "slide", 40, 3, f"{_LINEAR} sum minmax far"),
        Sweep("readings_slide_softmax", "slide", 40, 1, f"{_SOFTMAX} none"),
    ),
    "k": (
        Sweep("k_push", "push", 50, 4, _K),
        Sweep("k_pick_and_place", "pick_and_place", 50, 4, _K),
        Sweep("k_slide", "slide", 50, 4, _K),
    ),
    "settings": (
        Sweep("ring_slide", "slide", 100, 1, "--sampler future --replay-size 1000000"),
        Sweep("noise_slide", "slide", 50, 1, "--sampler future --sweep.random-noise 0"),
    ),
    "eventful": (
        Sweep("eventful_push", "push", 30, 1, _EVENTFUL),
        Sweep("eventful_pick_and_place", "pick_and_place", 30, 1, _EVENTFUL),
        Sweep("eventful_slide", "slide", 50, 1, _EVENTFUL),
    ),
}
SWEEPS = tuple(sweep for figure in FIGURES.values() for sweep in figure)
BY_NAME = {sweep.name: sweep for sweep in SWEEPS}


def command(sweep: Sweep, out: Path, toy: bool = False) -> list[str]:
    """Arguments of `train.py` for a sweep."""
    if toy:
        sizes = f"{TOY} --env reach --seeds 2 --total-steps 300"  # three epochs
        options = sweep.options.replace("--replay-size 1000000", "--replay-size 200")
    else:
        episodes = EPISODES[sweep.task]
        cycles = "" if sweep.own_cycles else f"{FAST} --num-envs {episodes}"
        seeds = f"--seeds {sweep.seeds} --first-seed {sweep.first_seed}"
        sizes = f"--preset paper --checkpoint-every 0 --lanes {LANES} {cycles} --env {sweep.task} {seeds}"
        options = f"--total-steps {sweep.epochs * episodes * 50} {sweep.options}"
    threshold = "0.6" if sweep.task == "slide" else "0.9"
    baseline = "future" if "future" in sweep.options else sweep.options.split()[1]
    return [
        "sweep",
        *f"{sizes} {options} --threshold {threshold} --baseline {baseline}".split(),
        "--out",
        str(out / sweep.name),
    ]


def chosen(names: Iterable[str]) -> list[Sweep]:
    """Sweeps by the names of figures, `all`, or sweeps, without duplicates."""
    each = [sweep for name in names for sweep in (SWEEPS if name == "all" else FIGURES.get(name) or (BY_NAME[name],))]
    return list(dict.fromkeys(each))


def plan(sweeps: Sequence[Sweep], out: Path, toy: bool) -> str:
    """The commands of sweeps."""
    lines = []
    for name, figure in FIGURES.items():
        if ours := [sweep for sweep in figure if sweep in sweeps]:
            lines.append(f"# {name}: {sum(s.settings for s in ours)} settings")
            lines += ["python train.py " + " ".join(command(sweep, out, toy)) for sweep in ours]
    return "\n".join(lines)


def run(sweeps: Sequence[Sweep], out: Path, curves: Path, toy: bool, at_once: int) -> int:
    """Runs sweeps, `at_once` of them in parallel, and collects their curves. Returns the first nonzero status.

    The first signal is passed to the running sweeps, which save their progress. Waiting sweeps do not begin.
    """
    waiting, status, number = list(sweeps), 0, None
    running: dict[Sweep, subprocess.Popen[bytes]] = {}

    def send(number: int) -> None:
        for child in running.values():
            child.send_signal(number)

    # An error or a second signal also ends the running sweeps.
    with signals.taken(), signals.held(print, out), signals.cleaning(lambda: send(signal.SIGTERM)):
        while running or (waiting and not status):
            while waiting and not status and len(running) < at_once:
                sweep = waiting.pop(0)
                running[sweep] = start(sweep, out, toy, quiet=at_once > 1)
            for sweep in [sweep for sweep, child in running.items() if child.poll() is not None]:
                own = ended(sweep, running.pop(sweep).returncode, out, curves)
                status = status or own
            if number is None and (number := signals.asked()) is not None:
                status = status or 128 + number
                send(number)  # a terminal sends it to all of them: two in quick succession are one
            time.sleep(0.2)
    return status


def start(sweep: Sweep, out: Path, toy: bool, quiet: bool) -> subprocess.Popen:
    """Starts a sweep. If `quiet`, its output goes to a file next to its folder."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {'' if toy else XLA_FLAGS}".strip()
    argv = [sys.executable, str(ROOT / "train.py"), *command(sweep, out, toy)]
    environment = {**os.environ, "XLA_FLAGS": flags}
    log = out / f"{sweep.name}.log"
    print(f"== {time.strftime('%H:%M:%S')} {sweep.name}{f', output in {log}' if quiet else ''}", flush=True)
    if not quiet:
        return subprocess.Popen(argv, env=environment)
    out.mkdir(parents=True, exist_ok=True)
    with log.open("w") as file:
        return subprocess.Popen(argv, env=environment, stdout=file, stderr=subprocess.STDOUT)


def ended(sweep: Sweep, status: int, out: Path, curves: Path) -> int:
    """Collects the curves of a successful sweep, or prints an error. Returns its status, as a shell gives it."""
    print(f"== {time.strftime('%H:%M:%S')} {sweep.name} ended", flush=True)
    if status:
        print(f"{sweep.name} ended with status {status}; run the same command again to resume it", file=sys.stderr)
        return status if status > 0 else 128 - status
    print(f"wrote {collect(sweep, out, curves)}", flush=True)
    return 0


def read_curves(folder: Path, sweep: Sweep) -> list[dict[str, str]]:
    """Rows of a sweep's curves, with settings named as in comparison.csv."""
    rows = []
    for groups in comparison.groups(tables.read(folder)).values():
        for group in groups:
            setting = named(sweep, group.label)
            for seed, success in zip(group.seeds, group.success):
                for epoch, steps, rate in zip(group.epoch, group.env_steps, success):
                    values = (sweep.name, setting, seed, epoch, steps, f"{rate:g}")
                    rows.append(dict(zip(COLUMNS, map(str, values))))
    return rows


def named(sweep: Sweep, label: str) -> str:
    """A setting's name, completed with the values that all settings of its sweep share. A label names only the differences."""
    shared = {
        "readings": lambda: _reading(sweep, label),
        "ring": lambda: f"future, ring of {'200,000' if 'own' in sweep.name else 'a million'}",
        "noise": lambda: "future, random_noise 0",
        "eventful": lambda: "future, priority_fraction 0.5",
    }
    return shared.get(sweep.name.partition("_")[0], lambda: label)()


def _reading(sweep: Sweep, label: str) -> str:
    options = sweep.options.split()
    kernel, normalizations = options[3], options[options.index("--weight-normalization") + 1 :]
    normalization = normalizations[0] if len(normalizations) == 1 else label.rpartition(", ")[2]
    return f"weighted, {normalization}, {kernel}"


def collect(sweep: Sweep, out: Path, folder: Path) -> Path:
    """Writes the curves of a sweep under `out` into its task's file in `folder`, and returns the file.

    Curves of other sweeps in it are kept: the set can be made in parts, on several machines.
    """
    path, own = folder / f"{sweep.task}_curves.csv", read_curves(out / sweep.name, sweep)
    folder.mkdir(parents=True, exist_ok=True)
    with files.lock(folder, wait=True):  # against another program whose sweep ends now
        rows = {sweep.name: own}
        if path.is_file():
            with path.open(newline="") as file:
                for row in csv.DictReader(file):
                    if row["sweep"] != sweep.name:
                        rows.setdefault(row["sweep"], []).append(row)
        with files.atomic_write(path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            for name in dict.fromkeys((*BY_NAME, *rows)):
                writer.writerows(rows.get(name, []))
    return path


def main() -> int:
    """Runs or plans figures. Returns 0, or the status of the first sweep that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = f"{', '.join(FIGURES)}, one of their sweeps, or all, the default"
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help=names)
    parser.add_argument("--out", type=Path, default=Path("sweeps/paper"), help="folder of the sweeps")
    parser.add_argument("--curves", type=Path, help="folder of the curves: docs/paper, and under --out with --toy")
    parser.add_argument("--at-once", type=int, default=1, help="parallel sweeps: one computes while another compiles")
    parser.add_argument("--plan", action="store_true", help="print the commands, and run nothing")
    parser.add_argument("--toy", action="store_true", help="Reach, two seeds, tiny sizes: tries the mechanics on a CPU")
    args = parser.parse_args()
    wanted = args.figures or ["all"]
    if unknown := [name for name in wanted if name not in (*FIGURES, *BY_NAME, "all")]:
        parser.error(f"figures are {', '.join(FIGURES)} and all, sweeps {', '.join(BY_NAME)}; got {', '.join(unknown)}")
    if args.at_once < 1:
        parser.error(f"--at-once is 1 or more; got {args.at_once}")
    sweeps = chosen(wanted)
    if args.plan:
        print(plan(sweeps, args.out, args.toy))
        return 0
    curves = args.curves or (args.out / "curves" if args.toy else CURVES)
    try:
        for folder in (args.out, curves):
            check_writable(folder)
    except FolderError as error:
        parser.error(str(error))
    return run(sweeps, args.out, curves, args.toy, args.at_once)


if __name__ == "__main__":
    sys.exit(main())
