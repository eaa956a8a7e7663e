"""Comparison with Stable-Baselines3 and gymnasium-robotics: success over time, for the same cores and wall-clock budget.

    python bench/peers.py --env push --minutes 10 [--peers tqc sac] [--seeds 1] [--learner tqc] [--out DIR]

Trains, one after the other, `python train.py --preset cpu` on the engine native, and sb3-contrib's TQC and Stable-Baselines3's
SAC with HerReplayBuffer on the original task. Writes success.csv, success.png and a table. The peers have the settings of
rl-baselines3-zoo (see bench/peers_worker.py); `--peer-set batch_size=256 'net_arch=[256,256,256]'` changes them. They and the
original tasks need a separate virtual environment. The first call makes it in the user's cache folder with pip, whose
configuration selects PyTorch for CPUs or the larger one. `--python` names an existing environment.

Seconds are of training, evaluations included, on both sides. Imports, compilation and the making of environments are excluded,
and listed as start-up. Ours evaluates after each epoch, a peer `--eval-every` seconds after its last evaluation. Evaluations
and epochs are completed beyond the budget. Ours may end earlier, at the preset's total_steps. The final success is measured
with the last policy in the original task, for both over the same --final-episodes starts and goals.

`--parts steps relabel` prints the peers' rates: environment steps with random actions, in one process and in one process per
core, and transitions drawn by HerReplayBuffer. bench/throughput.py and bench/relabel.py print ours.
"""

import argparse
import contextlib
import csv
import dataclasses
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from peers_worker import EPISODE_LENGTH, FIRST_SEED, PEERS, ZOO, usable_cores

from mjx_dher.components import COMPONENTS
from mjx_dher.lookup import check_name, require_extra
from mjx_dher.runs.folder import reading, results, run_folder
from mjx_dher.stats import wilson_interval
from mjx_dher.system import subprocesses
from mjx_dher.system.machine import user_cache
from mjx_dher.tools import transfer
from mjx_dher.validation import check_count, check_number

HERE = Path(__file__).resolve().parent
REQUIREMENTS = (*transfer.REQUIREMENTS, "stable-baselines3==2.9.2", "sb3-contrib==2.9.2", "torch==2.13.0")
TASKS = ("push", "pick_and_place", "slide")
COLUMNS = ("who", "env", "seed", "seconds", "env_steps", "success_rate", "return_mean")
SUCCESS = 0.9  # the table lists when it was first reached


@dataclasses.dataclass
class Run:
    """One training run, evaluation by evaluation."""

    who: str
    env: str
    seed: int
    rows: list[dict[str, float]] = dataclasses.field(default_factory=list)  # COLUMNS from seconds on, and updates
    startup: float = math.nan  # s
    final_success: Sequence[int] = ()  # [final_episodes], 0 or 1
    final_return: Sequence[float] = ()

    def add(self, **row: float) -> None:
        """Appends an evaluation and prints it."""
        self.rows.append(row)
        text = "{seconds:7.0f} s {env_steps:10,.0f} steps  success {success_rate:.2f}  return {return_mean:6.1f}"
        print(f"{self.who}, seed {self.seed}: {text.format(**row)}", flush=True)


# The environment of the peers.


def find_python(given: Path | None) -> Path:
    """The peers' Python, made with pip unless it exists or is `given`.

    Raises:
      ValueError: the given one lacks a package, or pip failed. The message says what to do.
    """
    if given:
        if not transfer.is_ready(given, REQUIREMENTS):
            raise ValueError(f"{given} must have {', '.join(REQUIREMENTS)}")
        return given
    environment = user_cache() / "peers"
    python = transfer.interpreter(environment)
    if not transfer.is_ready(python, REQUIREMENTS):
        print(f"making the peers' environment in {environment} ...", flush=True)
        try:
            transfer.set_up(environment, REQUIREMENTS)
        except (ValueError, OSError, subprocess.SubprocessError) as error:
            raise ValueError(
                f"{error}\nThe peers need {', '.join(REQUIREMENTS)}: let pip reach a package index, or name with --python"
                " the Python of an environment that has them"
            ) from error
    return python


def worker(python: Path, **request: Any) -> tuple[str, ...]:
    """The command of a part in the peers' Python."""
    return (str(python), str(HERE / "peers_worker.py"), json.dumps(request))


def pin(cores: int) -> None:
    """Keeps this process and its children to its first `cores`, on Linux. Raises ValueError if it has fewer."""
    check_number("cores", cores, f"[1, {usable_cores()}]")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])


# Training.


@contextlib.contextmanager
def started(command: Sequence[str], log: Path, stdout: int | None = None) -> Iterator[subprocess.Popen[str]]:
    """Starts a program with a log file for its messages, and kills it at the end of the block unless it has ended."""
    with log.open("wb") as file, subprocess.Popen(command, stdout=stdout or file, stderr=file, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def check_ended(process: subprocess.Popen[str], log: Path, allowed: Sequence[int] = (0,)) -> None:
    """Waits for a program. If its exit status is not `allowed`, raises ValueError with the end of its log."""
    if process.wait() not in allowed:
        end = "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-15:])
        raise ValueError(f"{log.stem} failed with exit status {process.returncode}; the end of {log}:\n{end}")


def train_ours(args: argparse.Namespace, seed: int, python: Path) -> Run:
    """Runs train.py until it ends or the budget does, then its policy in the original task."""
    folder, log = args.out / f"ours_seed{seed}", args.out / f"ours_seed{seed}.log"
    options = {"env": args.env, "learner": args.learner, "sampler": args.sampler, "seed": seed, "out": folder}
    options |= {"eval-episodes": args.episodes, "final-episodes": args.final_episodes}
    given = [f"--{name}={value}" for name, value in options.items() if value is not None]
    command = (sys.executable, str(HERE.parent / "train.py"), "--preset=cpu", "--engine=native", *given)
    run, began, first, stopped = Run("mjx-dher", args.env, seed), time.perf_counter(), math.inf, False
    with started(command, log) as process:
        running = True
        while running:
            running = process.poll() is None  # polled before reading rows, so that none is missed
            for row in results.read_rows(folder / run_folder.METRICS_FILE)[len(run.rows) :]:
                if not run.rows:
                    first = time.perf_counter() - row["wall_seconds"]  # when training began
                    spec = reading.read_spec(folder)
                    run.who, run.startup = f"mjx-dher {spec.learner} {spec.sampler}", first - began
                run.add(**{name: row["wall_seconds" if name == "seconds" else name] for name in (*COLUMNS[3:], "updates")})
            if running and not stopped and time.perf_counter() - first >= 60 * args.minutes:
                process.send_signal(signal.SIGTERM)  # it ends with the epoch; the next signal would end it at once
                stopped = True
            time.sleep(0.2)
        check_ended(process, log, (0, 128 + signal.SIGTERM) if stopped else (0,))
    outcome = transfer.play_apart(folder, python, args.final_episodes, FIRST_SEED, usable_cores())
    run.final_success, run.final_return = outcome["success"].astype(int).tolist(), outcome["ret"].tolist()
    return run


def train_theirs(args: argparse.Namespace, learner: str, seed: int, python: Path) -> Run:
    """Runs a peer's learner for the budget, then its policy for the final episodes."""
    changes = [f"{name}={value}".replace(" ", "") for name, value in args.settings.items() if value != ZOO[name]]
    run, log = Run(" ".join((PEERS[learner], *changes)), args.env, seed), args.out / f"{learner}_seed{seed}.log"
    request = {"task": transfer.ORIGINALS[args.env], "learner": learner, "settings": args.settings, "seed": seed}
    request |= {"seconds": 60 * args.minutes, "every": args.eval_every}
    request |= {"episodes": args.episodes, "final": args.final_episodes}
    began = time.perf_counter()
    with started(worker(python, part="train", **request), log, subprocess.PIPE) as process:
        for content in map(json.loads, process.stdout or ()):
            if "started" in content:
                run.startup = time.perf_counter() - began
            elif "result" in content:
                run.final_success, run.final_return = content["result"]["final_success"], content["result"]["final_return"]
            else:
                run.add(**content)
        check_ended(process, log)
    return run


def train(args: argparse.Namespace, python: Path) -> None:
    """Trains ours and the peers in turn, and writes the results after each run."""
    print(f"{args.seeds * (1 + len(args.peers))} runs of {args.minutes:g} minutes at most, to {args.out}", flush=True)
    args.out.mkdir(parents=True)
    runs: list[Run] = []
    for seed, who in itertools.product(range(args.seeds), (None, *args.peers)):
        runs.append(train_theirs(args, who, seed, python) if who else train_ours(args, seed, python))
        write_csv(runs, args.out / "success.csv")
        draw(runs, args.out / "success.png", args.episodes)
    print_runs(runs)


# Results.


def write_csv(runs: Sequence[Run], path: Path) -> None:
    """Writes a line for each evaluation of each run."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for run, row in ((each, row) for each in runs for row in each.rows):
            numbers = [f"{round(row[name], 4):.12g}" for name in COLUMNS[3:]]
            writer.writerow((run.who, run.env, run.seed, *numbers))


def draw(runs: Sequence[Run], path: Path, episodes: int) -> None:
    """Draws success over seconds and over environment steps, one line per run and one colour per learner."""
    import matplotlib.pyplot as plt
    from plot_time_to_success import LOOKS

    looks = dict(zip(dict.fromkeys(run.who for run in runs), itertools.cycle(LOOKS)))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6 + 0.2 * len(looks)), sharey=True, layout="constrained")
    for axis, column in zip(axes, ("seconds", "env_steps")):
        for run in runs:
            color, dashes = looks[run.who]
            look = {"color": color, "linestyle": dashes, "marker": "o", "markersize": 3, "linewidth": 1.3, "alpha": 0.8}
            line = ([row[column] for row in run.rows], [row["success_rate"] for row in run.rows])
            axis.plot(*line, **look, label=f"{'_' * (run.seed > 0)}{run.who}")  # one entry in the legend
        axis.grid(alpha=0.25)
    axes[0].set(xlim=(0, None), ylim=(-0.02, 1.02), xlabel="seconds of training, evaluations included")
    axes[0].set(ylabel=f"success rate ({episodes} episodes)", title=f"{runs[0].env}, {usable_cores()} cores")
    decades = [math.log10(row["env_steps"]) for run in runs for row in run.rows]
    limits = (10 ** math.floor(min(decades)), 10 ** math.ceil(max(decades)))
    axes[1].set(xscale="log", xlim=limits, xlabel="environment steps")
    axes[1].xaxis.set_minor_formatter("")
    figure.legend(*axes[1].get_legend_handles_labels(), fontsize=8, loc="outside lower center")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def print_runs(runs: Sequence[Run]) -> None:
    """Prints a row for each run, its final success with a 95 % interval."""
    from timing import print_table

    rows = []
    for run in runs:
        last, episodes = run.rows[-1], len(run.final_success)
        low, high = wilson_interval(sum(run.final_success), episodes)
        reached = next((f"{row['seconds']:.0f}" for row in run.rows if row["success_rate"] >= SUCCESS), "never")
        evaluating = f"{sum(row['evaluation'] for row in run.rows):.0f}" if "evaluation" in last else "in each epoch"
        times = (f"{run.startup:.0f}", f"{last['seconds']:.0f}", evaluating)
        counts = (f"{last['env_steps']:,.0f}", f"{last['updates']:,.0f}")
        success = f"{sum(run.final_success) / episodes:.3f} ({low:.3f}-{high:.3f})"
        ends = (f"{last['success_rate']:.2f}", success, f"{sum(run.final_return) / episodes:.1f}")
        rows.append((run.who, run.seed, *times, *counts, reached, *ends))
    head = ("who", "seed", "start-up, s", "s", "evaluations, s", "env steps", "updates", f"s to {SUCCESS:g}", "last success")
    print_table((*head, f"final success (95 %), {len(runs[0].final_success)} episodes", "mean return"), rows)


def print_rates(parts: Sequence[str], env_name: str, python: Path) -> None:
    """Measures `parts` (`steps`, `relabel`) and prints a table. Raises ValueError if the worker failed."""
    from timing import print_table

    rows = []
    for part in parts:
        answer = subprocesses.ask(worker(python, part=part, task=transfer.ORIGINALS[env_name]))
        if answer.failure:
            raise ValueError(f"the part {part} failed: {answer.err.strip() or answer.failure}")
        rows += [(name, f"{rate:,.0f}") for name, rate in answer.last_json()["result"].items()]
    print_table((f"the peers on {transfer.ORIGINALS[env_name]}", "a second"), rows)


# The command.


def read_settings(changes: Sequence[str]) -> dict[str, Any]:
    """`ZOO` with changes NAME=VALUE, whose values are JSON.

    Raises:
      ValueError: unknown name, or a value of the wrong kind. The message lists the allowed ones.
    """
    settings = dict(ZOO)
    for name, _, text in (change.partition("=") for change in changes):
        check_name("peer-set", name, ZOO)
        kind, value = type(ZOO[name]), None
        with contextlib.suppress(ValueError):
            value = json.loads(text)
        if not value or (kind is list) != isinstance(value, list):
            raise ValueError(f"peer-set {name} must be in JSON, such as {json.dumps(ZOO[name])}; got {text!r}")
        interval = "(0, 1]" if kind is float else "[1, 100000000]"
        for number in value if kind is list else [value]:
            check_number(f"peer-set {name}", number, interval, float if kind is float else int)
        settings[name] = value
    if settings["learning_starts"] < EPISODE_LENGTH * settings["n_envs"]:
        raise ValueError(f"peer-set learning_starts must be {EPISODE_LENGTH} times n_envs or more: each ends an episode first")
    return settings


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Checked arguments. Exits with a message if one is unusable."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=TASKS, default="push")
    parser.add_argument("--parts", nargs="+", choices=("train", "steps", "relabel"), default=["train"])
    parser.add_argument("--minutes", type=float, default=10, help="budget of each run (10)")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each learner, with the seeds 0, 1, ... (1)")
    parser.add_argument("--peers", nargs="+", choices=tuple(PEERS), default=list(PEERS))
    parser.add_argument("--peer-set", nargs="+", default=[], metavar="NAME=VALUE", help=", ".join(ZOO))
    parser.add_argument("--learner", choices=tuple(COMPONENTS["learner"]), help="our learner (default: the preset's)")
    parser.add_argument("--sampler", choices=COMPONENTS["sampler"], help="our sampler (default: train.py's)")
    parser.add_argument("--episodes", type=int, default=100, help="episodes per evaluation (100)")
    parser.add_argument(
        "--final-episodes", type=int, default=100, help="episodes of the final evaluation, in the original task (100)"
    )
    parser.add_argument("--eval-every", type=float, help="seconds between a peer's evaluations (60 or a quarter of the budget)")
    parser.add_argument("--cores", type=int, default=min(2, usable_cores()), help="cores per run (2)")
    parser.add_argument("--out", type=Path, help="new folder (runs/peers_ENV)")
    parser.add_argument("--python", type=Path, help="Python of an environment with the peers")
    args = parser.parse_args(argv)
    try:
        check_number("minutes", args.minutes, "(0, 10000]", float)
        args.eval_every = min(60.0, 15 * args.minutes) if args.eval_every is None else args.eval_every
        check_number("eval-every", args.eval_every, "(0, 100000]", float)
        for name in ("seeds", "episodes", "final_episodes"):
            check_count(name.replace("_", "-"), getattr(args, name))
        args.settings = read_settings(args.peer_set)
        args.out = args.out or Path("runs") / f"peers_{args.env}"
        if "train" in args.parts:
            require_extra("success.png", "matplotlib", "plot")
            if args.out.exists():
                raise ValueError(f"out: {args.out} exists already; pass a new folder")
        pin(args.cores)
    except ValueError as error:
        parser.error(str(error))
    return args


def main() -> int:
    """Runs the parts given on the command line. Returns the exit status."""
    args = parse()
    os.environ["JAX_PLATFORMS"] = "cpu"
    try:
        python = find_python(args.python)
        if "train" in args.parts:
            train(args, python)
        if parts := [part for part in args.parts if part != "train"]:
            print_rates(parts, args.env, python)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
