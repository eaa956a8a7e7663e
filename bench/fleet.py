"""Faults and overhead of a sweep over many nodes.

    python bench/fleet.py kills [--rounds 20] [--seeds 12] [--seed 0]
    python bench/fleet.py overhead [--seconds 60]

`kills` starts a cluster of four nodes on this machine (`ray.cluster_utils.Cluster`) and sweeps the point mass of docs/examples
with the real command. It kills (SIGKILL) a worker, a node and the driver in turn, at random times, then replaces the node, or
starts the driver again with the same command. When a sweep ends before all kills are made, another one begins. Each sweep must
have every trial exactly once, and the tables of the same sweep without Ray.

`overhead` times the same sweep by the plain command and by `--ray local` with one task at a time, after compilation. The extra
`ray` is needed.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled", "JAX_PLATFORMS": "cpu"}

import ray
from ray.cluster_utils import Cluster
from reliability_pairs import of_sweep
from timing import print_table

from mjx_dher.system.machine import usable_cores

ROOT = Path(__file__).resolve().parent.parent
STORE = 80 << 20  # bytes of a node's object store
SIZES = """
    --preset cpu --env docs.examples.point_mass:PointMass --sampler future weighted --final-episodes 20 --num-envs 16
    --batch-size 64 --replay-size 4000 --hidden-sizes 32 --eval-episodes 20 --threshold 0.5 --checkpoint-every 2
""".split()  # noqa: SIM905
LONG = [*SIZES, "--cycles-per-epoch", "20", "--updates-per-cycle", "40", "--total-steps"]
STEPS_PER_EPOCH = 3200


class Nodes:
    """A cluster on this machine: a head without CPUs, and nodes with one CPU each."""

    def __init__(self, count, **options):
        self.options = {"num_cpus": 1, "object_store_memory": STORE, **options}
        head = {"num_cpus": 0, "object_store_memory": STORE, "include_dashboard": False}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.nodes = [self.cluster.add_node(**self.options) for _ in range(count)]

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.cluster.shutdown()

    @property
    def address(self):
        return self.cluster.address

    def kill_node(self, number):
        """Kills all processes of a node, and starts another one."""
        self.cluster.remove_node(self.nodes.pop(number), allow_graceful=False)
        self.nodes.append(self.cluster.add_node(**self.options))

    def workers(self):
        """Process ids of training processes among the children of this cluster's nodes, by the title that Ray gives them."""
        raylets = {int(line.split()[0]): int(line.split()[1]) for line in _ps("pid=,ppid=")}
        own = {pid for pid, parent in raylets.items() if parent == os.getpid()}
        lines = [line.split(None, 2) for line in _ps("pid=,ppid=,args=")]
        return [int(pid) for pid, parent, title in lines if title.startswith("ray::chunk") and int(parent) in own]


def _ps(columns):
    return subprocess.run(["ps", "-eo", columns], capture_output=True, text=True, check=True).stdout.splitlines()


def sweep(out, *flags, **options):
    """Starts the real command."""
    command = [sys.executable, str(ROOT / "train.py"), "sweep", "--out", str(out), *map(str, flags)]
    log = out.with_suffix(".log").open("ab")
    return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, **options)


def finished(process, seconds=1800):
    """Waits for a command that must succeed."""
    if process.wait(seconds) != 0:
        raise SystemExit(f"the command ended with status {process.returncode}: {process.args}")


def kill(kind, nodes, driver, dice):
    """Kills a worker, a node or the driver. False if there was none to kill."""
    if kind == "worker":
        if workers := nodes.workers():
            os.kill(dice.choice(workers), signal.SIGKILL)
        return bool(workers)
    if kind == "node":
        nodes.kill_node(dice.randrange(len(nodes.nodes)))
    else:
        driver.kill()
        driver.wait()
    return True


def kills(rounds, seeds, seed, epochs=12):
    """Kills in turn until `rounds` kills were made. Returns one row per sweep."""
    dice, rows, done = random.Random(seed), list[list[str]](), 0
    flags = [*LONG, epochs * STEPS_PER_EPOCH, "--seeds", seeds]
    with tempfile.TemporaryDirectory() as folder, Nodes(4) as nodes:
        reference = Path(folder) / "reference"
        finished(sweep(reference, *flags))
        while done < rounds:
            out = Path(folder) / f"sweep{len(rows)}"
            ray_flags = ["--ray", nodes.address, "--ray-cpus", 1, "--ray-chunk", 2, "--storage", Path(folder) / "storage"]
            started, before, starts = time.perf_counter(), done, 1
            driver = sweep(out, *flags, *ray_flags)
            while driver.poll() is None:
                wait = time.perf_counter() + dice.uniform(4, 12)
                while time.perf_counter() < wait and driver.poll() is None:
                    time.sleep(0.1)
                if (
                    driver.poll() is None
                    and done < rounds
                    and kill(("worker", "node", "driver")[done % 3], nodes, driver, dice)
                ):
                    done += 1
                if driver.poll() not in (None, 0):  # killed, by us or with the node that it had joined
                    driver, starts = sweep(out, *flags, *ray_flags), starts + 1
                    if starts > rounds + 5:
                        raise SystemExit(f"the driver ends again and again; see {out.with_suffix('.log').read_text()[-2000:]}")
            trials = [path.parent.name for path in out.glob("cells/*/result.json")]
            left = [path.name for path in (Path(folder) / "storage").glob("*")]
            rows.append(
                [
                    f"{done - before}",
                    f"{starts}",
                    f"{len(trials)} of {2 * seeds}",
                    "the same" if of_sweep(reference) == of_sweep(out) else "DIFFERENT",
                    ", ".join(left) or "nothing",
                    f"{time.perf_counter() - started:.0f} s",
                ]
            )
            print(*rows[-1], sep="; ", flush=True)
    return rows


def overhead(seconds):
    """Times the same sweep, plain and by Ray, with one task at a time of at least `seconds`."""
    cores = usable_cores()
    with tempfile.TemporaryDirectory() as folder:

        def timed(name, epochs, *flags):
            started = time.perf_counter()
            finished(sweep(Path(folder) / name, *LONG, epochs * STEPS_PER_EPOCH, "--seeds", 8, *flags))
            return time.perf_counter() - started

        timed("cached", 1)
        short = timed("short", 4)
        epochs = max(4, round(4 * seconds / max(short - 8, 1.0) * 2))  # two tasks of eight runs each
        on_ray = ["--ray", "local", "--ray-cpus", cores, "--ray-chunk", 8]
        rows = []
        for number in range(2):
            plain = timed(f"plain{number}", epochs)
            started = timed(f"empty{number}", 1, *on_ray)
            by_ray = timed(f"ray{number}", epochs, *on_ray)
            same = of_sweep(Path(folder) / f"plain{number}") == of_sweep(Path(folder) / f"ray{number}")
            part = f"{by_ray / plain - 1:+.1%}"
            rows.append([f"{plain:.1f} s", f"{by_ray:.1f} s", part, f"{started:.1f} s", "the same" if same else "DIFFERENT"])
            print(*rows[-1], sep="; ", flush=True)
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("kills", "overhead"))
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    args = parser.parse_args()
    load = os.getloadavg()[0]
    if args.part == "kills":
        head = ["kills", "starts of the driver", "trials", "tables", "left in the storage", "time"]
        rows = kills(args.rounds, args.seeds, args.seed)
    else:
        head = ["plain", "ray", "more", "of which the start, and an epoch each", "tables"]
        rows = overhead(args.seconds)
    print_table(head, rows)
    print(
        f"load of the machine: {load:.1f} before, {os.getloadavg()[0]:.1f} after; {os.cpu_count()} cores; ray {ray.__version__}"
    )


if __name__ == "__main__":
    main()
