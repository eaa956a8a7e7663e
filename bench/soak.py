"""An hour of the real command: does anything compile again, does memory grow, does it slow down?

    python bench/soak.py [--env push] [--minutes 60] [--out soak.csv] [-- OPTIONS OF train.py]

Trains, with checkpoints and a log of JSON lines, until the time is up, and is then stopped as by SIGTERM. After each epoch it
notes the memory held (resident), the processor time used and how often XLA has compiled. The epochs after the first tenth of
the time, in which the replay ring fills, are cut into ten blocks; a line is fitted to the blocks' medians. Exits with 1 if
anything compiled after the first epoch, if the 95 % interval of memory's slope lies above zero, or if steps per second change
by 5 % or more along the line.
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import jax
import numpy as np
import scipy.stats
from timing import print_table

from mjx_dher import cli, memory
from mjx_dher.run_folder import METRICS_FILE

BLOCKS = 10
COMPILATION = "/jax/core/compile/backend_compile_duration"


class Watch(threading.Thread):
    """Notes what each epoch leaves, as soon as its line is in metrics.csv, and stops the run when its time is up."""

    def __init__(self, run, seconds):
        super().__init__(daemon=True)
        self.file, self.seconds, self.rows, self.compilations = run / METRICS_FILE, seconds, [], []
        self.ended = threading.Event()
        jax.monitoring.register_event_duration_secs_listener(self._on_event)

    def _on_event(self, name, seconds, **_):
        if name == COMPILATION:
            self.compilations.append(time.perf_counter())

    def run(self):
        asked = False
        while not self.ended.wait(0.05):
            lines = self.file.read_text().splitlines()[1:] if self.file.exists() else []
            if len(lines) > len(self.rows):
                columns = lines[-1].split(",")
                self.rows.append(
                    {
                        "epoch": int(columns[0]),
                        "env_steps": int(columns[1]),
                        "seconds": time.perf_counter(),
                        "cpu_seconds": time.process_time(),
                        "memory": memory.used_bytes(),
                        "compilations": len(self.compilations),
                    }
                )
            if self.rows and not asked and time.perf_counter() - self.rows[0]["seconds"] > self.seconds:
                asked = True
                os.kill(os.getpid(), signal.SIGTERM)


def line(minutes, values):
    """Slope a minute and its 95 % interval, of the medians of BLOCKS blocks."""
    blocks = np.array_split(np.arange(len(values)), BLOCKS)
    found = scipy.stats.linregress([np.mean(minutes[b]) for b in blocks], [np.median(values[b]) for b in blocks])
    half = scipy.stats.t.ppf(0.975, BLOCKS - 2) * found.stderr
    return found.slope, found.slope - half, found.slope + half


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="push")
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--out", type=Path)
    parser.add_argument("options", nargs="*", help="of train.py, after --")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as parent:
        run = Path(parent) / "run"
        watch = Watch(run, args.minutes * 60)
        watch.start()
        command = ["--env", args.env, "--total-steps", "1000000000", "--checkpoint-every", "20", "--log", "jsonl"]
        status = cli.main([*command, "--out", str(run), *args.options])
        watch.ended.set()
        watch.join()
    if status != 128 + signal.SIGTERM:
        print(f"the run ended by itself, with status {status}", file=sys.stderr)
        return 1
    if args.out:
        with args.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(watch.rows[0]))
            writer.writeheader()
            writer.writerows(watch.rows)
    return report(watch.rows)


def report(rows) -> int:
    column = {name: np.array([row[name] for row in rows], float) for name in rows[0]}
    minutes = (column["seconds"] - column["seconds"][0]) / 60
    steps = np.diff(column["env_steps"])
    used = minutes[1:] > minutes[-1] / 10
    speed = (steps / np.diff(column["seconds"]))[used]
    speed_of_cpu = (steps / np.diff(column["cpu_seconds"]))[used]
    held = column["memory"][1:][used] / 1e6
    along = minutes[1:][used]
    span = along[-1] - along[0]
    again = int(column["compilations"][-1] - column["compilations"][0])
    table, wrong = [], [] if again == 0 else [f"{again} programs were compiled after the first epoch"]
    for name, values in (("memory, MB", held), ("steps/s", speed), ("steps/s of processor time", speed_of_cpu)):
        median = np.median(values)
        slope, low, high = (span * x for x in line(along, values))
        shares = " to ".join(f"{x / median:+.2%}" for x in (low, high))
        table.append((name, f"{median:,.1f}", f"{values.min():,.1f}", f"{values.max():,.1f}", f"{slope:+,.1f}", shares))
        if name == "memory, MB" and low > 0:
            wrong.append(f"memory grows by {slope:.1f} MB in {span:.0f} minutes ({low:.1f} to {high:.1f})")
        if name == "steps/s" and abs(slope) >= 0.05 * median:
            wrong.append(f"speed changes by {slope / median:+.1%}")
    print_table(("of the epochs", "median", "least", "most", f"change in {span:.0f} min", "95 % interval"), table)
    print(f"\n{len(rows)} epochs, {column['env_steps'][-1]:,.0f} env steps in {minutes[-1]:.1f} min;", end=" ")
    print(f"compiled before the first epoch's end: {int(column['compilations'][0])}, after it: {again}")
    for problem in wrong:
        print(f"NOT RIGHT: {problem}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
