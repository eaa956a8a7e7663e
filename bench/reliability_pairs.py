"""Two programs on one folder, at random offsets: `train` with two seeds, and sweeps, of which one may be killed."""

from __future__ import annotations

import csv
import itertools
import json
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


def start(*arguments):
    command = [sys.executable, "-u", "train.py", *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def rows(path):
    with path.open() as file:
        return [{name: value for name, value in row.items() if name not in TIMES} for row in csv.DictReader(file)]


def of_run(folder):
    """What a run leaves, times left out."""
    content = json.loads((folder / "result.json").read_text())
    config = json.loads((folder / "config.json").read_text())
    with np.load(folder / "policy.npz") as file:
        policy = {name: file[name].tobytes() for name in file.files}
    result = {name: value for name, value in content.items() if name not in TIMES}
    return {"config": config, "result": result, "metrics": rows(folder / "metrics.csv"), "policy": policy}


def of_sweep(folder):
    """The tables of a sweep, times left out."""
    return [rows(folder / name) for name in ("results.csv", "finals.csv", "comparison.csv")]


def faults_of(process, allowed):
    """What is wrong with how a process ended; `allowed` are statuses that need no sentence."""
    _, stderr = process.communicate(timeout=300)
    lines = [line for line in stderr.splitlines() if line]
    if "Traceback" in stderr:
        return ["traceback"]
    if process.returncode in allowed:
        return []
    named = any(line.startswith("error: ") and ("another program" in line or "is there already" in line) for line in lines)
    return [] if process.returncode == 2 and named else [f"status {process.returncode}: {stderr[-200:]}"]


def train_pair(folder, right, rng):
    """Two `train` with one `--out`."""
    one, other = rng.sample(sorted(right), 2)
    first = start(*TRAIN, "--seed", one, "--out", folder)
    time.sleep(rng.choice((0.0, rng.uniform(0, 1), rng.uniform(0, 12))))
    second = start(*TRAIN, "--seed", other, "--out", folder)
    faults = faults_of(first, (0,)) + faults_of(second, (0,))
    if sorted((first.returncode, second.returncode)) != [0, 2]:
        return [*faults, f"statuses {first.returncode} and {second.returncode}"]
    seed = one if first.returncode == 0 else other
    return faults if of_run(folder) == right[seed] else [*faults, "silent: not the files of one undisturbed run"]


def sweep_pair(folder, right, rng):
    """The same sweep twice, or overlapping shards; one of them may be killed. Then the whole sweep once more."""
    shards = rng.choice((("1/1", "1/1"), ("1/2", "1/3"), ("2/2", "2/3")))
    processes, seen, faults = [], {}, []
    for shard in shards:
        processes.append(start(*SWEEP, "--shard", shard, "--out", folder))
        time.sleep(rng.choice((0.0, rng.uniform(0, 2), rng.uniform(0, 10))))
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
    if last.returncode == 0 and of_sweep(folder) != right:
        faults.append("silent: the tables are not those of an undisturbed sweep")
    return faults


def note(folder, seen):
    """Results that were written twice."""
    for path in folder.glob("cells/*/result.json"):
        written = path.stat().st_mtime_ns
        if seen.setdefault(path, written) != written:
            return [f"{path.parent.name} was trained again"]
    return []


def pairs(folder, count, rng, workers):
    """Half of them `train`, half sweeps."""
    folder.mkdir()
    right = {}
    for seed in (1, 2):
        faults_of(start(*TRAIN, "--seed", seed, "--out", folder / f"seed{seed}"), (0,))
        right[seed] = of_run(folder / f"seed{seed}")
    faults_of(start(*SWEEP, "--out", folder / "sweep"), (0,))
    tables = of_sweep(folder / "sweep")
    seeds = itertools.count(rng.randrange(10**6))

    def run(number):
        import random

        own = random.Random(next(seeds))
        function, expected = (train_pair, right) if number % 2 else (sweep_pair, tables)
        return function(folder / f"pair{number}", expected, own)

    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(run, range(count)))
    return [f"pair {number}: {fault}" for number, faults in enumerate(found) for fault in faults]
