"""Power cuts at random moments of runs and sweeps. Then the run is resumed, or the sweep's command repeated.

After every other cut all unflushed data is lost. After the others some of it is kept at random.
"""

import random
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import power_recorder
from reliability_pairs import ROOT, SHAPES, ended, faults_of, of_run, of_sweep, same, start, wait_until

from mjx_dher.runs.folder import results, run_folder

INTERVAL = 5  # epochs between checkpoints
TRAIN = [*SHAPES, "--total-steps", "3000", "--checkpoint-every", str(INTERVAL)]  # 150 epochs
SWEEP = ["sweep", *SHAPES, "--total-steps", "1000", "--sampler", "future", "weighted", "--seeds", "2"]
SWEEP += ["--checkpoint-every", str(INTERVAL)]
RECORDED = """
import sys
from pathlib import Path
sys.path[:0] = [{root!r}, {bench!r}]
import power_recorder
power_recorder.install(Path({disk!r}), Path({store!r}))
from mjx_dher import cli
sys.exit(cli.main(sys.argv[1:]))
"""


def start_recorded(disk, store, *arguments):
    disk.mkdir(parents=True)
    store.mkdir()
    code = RECORDED.format(root=str(ROOT), bench=str(Path(__file__).parent), disk=str(disk), store=str(store))
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def cut(process, written, rng):
    """Lets a process work until a little after `written` exists, then ends it."""
    wait_until(lambda: process.poll() is not None or written(), seconds=120)
    time.sleep(rng.uniform(0, 6))
    process.send_signal(signal.SIGKILL)
    process.communicate()


def contents(folder):
    """Contents of a finished run's files. Other files in its folder are ignored."""
    return {name: value for name, value in of_run(folder).items() if name != "files"}


def run_cut(folder, right, rng, disk_rng):
    """A run. Returns the faults, and the number of lost epochs."""
    disk, store, after = folder / "disk", folder / "store", folder / "after"
    process = start_recorded(disk, store, *TRAIN, "--out", disk / "run")
    cut(process, (disk / "run" / "metrics.csv").exists, rng)
    done = len(results.read_rows(disk / "run" / run_folder.METRICS_FILE))
    power_recorder.rebuild(disk, store, after, disk_rng)
    run = after / "run"
    if (run / run_folder.RESULT_FILE).exists():
        # The picture is not flushed, and neither are the deletions of checkpoints.
        whole = same(contents, run, {name: value for name, value in right.items() if name != "files"})
        return ([] if whole else ["silent: a finished run that is not whole"]), 0
    if not run_folder.checkpoints(run):
        return ([] if done <= INTERVAL else [f"lost: {done} epochs and no checkpoint"]), done
    faults, text = ended(start("resume", run), (0,))
    went_on = re.search(r"resuming from .*, after epoch (\d+)", text)
    lost = done - int(went_on[1]) if went_on else 0
    if lost > INTERVAL:
        faults.append(f"lost: {lost} epochs")
    if "damaged" in text:
        faults.append(f"damage that no one did: {text[-300:]}")
    if not faults and not same(of_run, run, right):
        faults.append("silent: the resumed run is another")
    return faults, lost


def sweep_cut(folder, right, rng, disk_rng, lanes):
    disk, store, after = folder / "disk", folder / "store", folder / "after"
    process = start_recorded(disk, store, *SWEEP, "--lanes", lanes, "--out", disk / "sweep")
    cut(process, lambda: any(disk.glob("sweep/cells/*/metrics.csv")), rng)
    power_recorder.rebuild(disk, store, after, disk_rng)
    faults = faults_of(start(*SWEEP, "--lanes", lanes, "--out", after / "sweep"), (0,))
    if not faults and not same(of_sweep, after / "sweep", right[lanes]):
        faults.append("silent: the tables are not those of an undisturbed sweep")
    return faults, 0


def power(folder, count, rng, workers):
    """Two of three are runs, the others sweeps of one lane and of two."""
    folder.mkdir()
    faults_of(start(*TRAIN, "--out", folder / "right"), (0,))
    right = of_run(folder / "right")
    tables = {}
    for lanes in (1, 2):
        faults_of(start(*SWEEP, "--lanes", lanes, "--out", folder / f"sweep{lanes}"), (0,))
        tables[lanes] = of_sweep(folder / f"sweep{lanes}")
    seeds = [rng.randrange(10**9) for _ in range(count)]

    def run(number):
        own, place = random.Random(seeds[number]), folder / f"cut{number}"
        disk_rng = own if number % 2 else None
        if number % 3:
            return run_cut(place, right, own, disk_rng)
        return sweep_cut(place, tables, own, disk_rng, 1 + number // 6 % 2)

    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(run, range(count)))
    return (
        f"{count} power cuts: what was not flushed is gone, or half there",
        f"at most {max(lost for _, lost in found)} epochs lost, of {INTERVAL} between checkpoints",
        [f"cut {number}: {fault}" for number, (faults, _) in enumerate(found) for fault in faults],
    )
