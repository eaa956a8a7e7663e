"""Two programs on one folder: `train` with two seeds, or two sweeps, and one sweep may be killed.

They start at random offsets, or one is stopped at a random moment of its start until the other has progressed.
"""

import csv
import json
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
SHAPES = """
    --env docs.examples.point_mass:PointMass --preset cpu --num-envs 2 --cycles-per-epoch 1 --updates-per-cycle 2
    --target-period 1 --batch-size 16 --hidden-sizes 8 8 --replay-size 20000 --eval-episodes 2 --final-episodes 4
""".split()  # noqa: SIM905
TRAIN = [*SHAPES, "--total-steps", "4000", "--checkpoint-every", "5"]  # 200 epochs
SWEEP = ["sweep", *SHAPES, "--total-steps", "1000", "--sampler", "future", "weighted", "--seeds", "3", "--lanes", "1"]
TIMES = ("wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes")


def start(*arguments, limit=None):
    """The command. `limit`: largest size of a file in kB."""
    command = [sys.executable, "-u", "train.py", *map(str, arguments)]
    if limit is not None:
        command = ["bash", "-c", f'ulimit -f {limit}; exec "$@"', "bash", *command]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def rows(path):
    with path.open() as file:
        return [{name: value for name, value in row.items() if name not in TIMES} for row in csv.DictReader(file)]


def of_run(folder):
    """A run's results, without times."""
    content = json.loads((folder / "result.json").read_text())
    config = json.loads((folder / "config.json").read_text())
    with np.load(folder / "policy.npz") as file:
        policy = {name: file[name].tobytes() for name in file.files}
    result = {name: value for name, value in content.items() if name not in TIMES}
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.name != ".lock")
    return {"config": config, "result": result, "metrics": rows(folder / "metrics.csv"), "policy": policy, "files": files}


def of_sweep(folder):
    """The tables of a sweep, without times."""
    return [rows(folder / name) for name in ("results.csv", "finals.csv", "comparison.csv")]


def same(read, folder, right):
    """Whether a folder has the right results. False if it cannot be read."""
    try:
        return read(folder) == right
    except Exception:
        return False


def ended(process, allowed):
    """Faults of how a process ended, and its output. `allowed` are statuses that need no message."""
    stdout, stderr = process.communicate(timeout=600)
    named = any(line.startswith("error: ") and ("another process" in line or "exists" in line) for line in stderr.splitlines())
    if "Traceback" in stderr:
        return [f"traceback: {stderr[-300:]}"], stdout
    if process.returncode in allowed or (process.returncode == 2 and named):
        return [], stdout
    return [f"status {process.returncode}: {stderr[-300:]}"], stdout


def faults_of(process, allowed):
    return ended(process, allowed)[0]


def wait_until(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)


def train_pair(folder, right, rng):
    """Two `train` with one `--out`."""
    one, other = rng.sample(sorted(right), 2)
    first = start(*TRAIN, "--seed", one, "--out", folder)
    time.sleep(rng.choice((0.0, rng.uniform(0, 1), rng.uniform(0, 12))))
    second = start(*TRAIN, "--seed", other, "--out", folder)
    return one_of(folder, right, {one: first, other: second})


def train_held(folder, right, rng):
    """Two `train` with one `--out`, started together. One is stopped until the other trains, or has ended."""
    processes = {seed: start(*TRAIN, "--seed", seed, "--out", folder) for seed in right}
    held, other = rng.sample(sorted(right), 2)
    if rng.random() < 0.5:
        wait_until(lambda: processes[held].poll() is not None or has_jax(processes[held]))
    time.sleep(rng.uniform(0, 2))
    processes[held].send_signal(signal.SIGSTOP)
    is_enough = rng.choice((lambda: False, (folder / "metrics.csv").exists))
    wait_until(lambda: processes[other].poll() is not None or is_enough(), seconds=120)
    processes[held].send_signal(signal.SIGCONT)
    return one_of(folder, right, processes)


def has_jax(process):
    """Whether a process has loaded JAX, and so has checked its arguments."""
    try:
        return "jaxlib" in Path(f"/proc/{process.pid}/maps").read_text(encoding="utf-8")
    except OSError:
        return True


def one_of(folder, right, processes):
    """The faults of two `train` on one folder, by seed: one trains as if it were alone, the other fails with an error."""
    faults = [fault for process in processes.values() for fault in faults_of(process, (0,))]
    seeds = [seed for seed, process in processes.items() if process.returncode == 0]
    if len(seeds) != 1:
        return [*faults, f"statuses {[process.returncode for process in processes.values()]}"]
    return faults if same(of_run, folder, right[seeds[0]]) else [*faults, "silent: not the files of one undisturbed run"]


def sweep_pair(folder, right, rng):
    """The same sweep twice, or two with some seeds in common; one may be killed. Then the whole sweep once more."""
    processes = []
    for first, seeds in rng.choice((((0, 3), (0, 3)), ((0, 2), (0, 1)), ((1, 2), (2, 1)))):
        processes.append(start(*SWEEP, "--first-seed", first, "--seeds", seeds, "--out", folder))
        time.sleep(rng.choice((0.0, rng.uniform(0, 2), rng.uniform(0, 10))))
    return and_once_more(folder, right, processes, rng)


def sweep_held(folder, right, rng):
    """The same sweep twice. One is stopped after listing its runs, until the other has finished some runs."""
    processes = [start(*SWEEP, "--out", folder) for _ in range(2)]
    held = rng.choice(processes)
    while (line := held.stdout.readline()) and "; writing to" not in line:
        pass
    time.sleep(rng.choice((0, rng.uniform(0, 4))))
    held.send_signal(signal.SIGSTOP)
    number = rng.choice((1, 1, 2, 6))
    others_done = lambda: len(list(folder.glob("cells/*/result.json"))) >= number  # noqa: E731
    wait_until(lambda: others_done() or all(process.poll() is not None for process in processes if process is not held))
    held.send_signal(signal.SIGCONT)
    return and_once_more(folder, right, processes, rng)


def and_once_more(folder, right, processes, rng):
    """The faults of sweeps on one folder, one possibly killed, and of the whole sweep afterwards."""
    seen: dict = {}
    faults = []
    killed = rng.choice((None, *processes))
    kill_at = time.monotonic() + rng.uniform(0, 15)
    while any(process.poll() is None for process in processes):
        if killed is not None and time.monotonic() > kill_at:
            killed.send_signal(signal.SIGKILL)
        faults += note(folder, seen)
        time.sleep(0.05)
    for process in processes:
        faults += faults_of(process, (0, -signal.SIGKILL if process is killed else 0))
    faults += faults_of(last := start(*SWEEP, "--out", folder), (0,)) + note(folder, seen)
    if last.returncode != 0:
        return [*faults, "the repeated command does not write the tables"]
    return faults if same(of_sweep, folder, right) else [*faults, "silent: the tables are not those of an undisturbed sweep"]


def note(folder, seen):
    """Results that were written twice. `seen` has the time of each result's last writing."""
    faults = []
    for path in folder.glob("cells/*/result.json"):
        written = path.stat().st_mtime_ns
        if seen.get(path, written) != written:
            faults.append(f"{path.parent.name} was trained again")
        seen[path] = written
    return faults


def pairs(folder, count, rng, workers):
    """One half are `train`, the other half sweeps. In every second pair of each half, one program is stopped for a while."""
    folder.mkdir()
    right = {}
    for seed in (1, 2):
        faults_of(start(*TRAIN, "--seed", seed, "--out", folder / f"seed{seed}"), (0,))
        right[seed] = of_run(folder / f"seed{seed}")
    faults_of(start(*SWEEP, "--out", folder / "sweep"), (0,))
    tables = of_sweep(folder / "sweep")
    first = rng.randrange(10**6)

    kinds = ((sweep_pair, tables), (train_pair, right), (sweep_held, tables), (train_held, right))

    def run(number):
        function, expected = kinds[number % 4]
        return function(folder / f"pair{number}", expected, random.Random(first + number))

    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(run, range(count)))
    named = [(f"pair {number}, {kinds[number % 4][0].__name__}", faults) for number, faults in enumerate(found)]
    faults = [f"{name}: {fault}" for name, faults in named for fault in faults]
    return (
        f"{count} pairs of programs on one folder",
        "one goes on, the other is refused or takes other work; right tables",
        faults,
    )
