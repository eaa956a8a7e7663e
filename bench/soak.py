"""An hour of the real command: does anything compile again, does memory grow, does it slow down?

    python bench/soak.py [--env push] [--minutes 60] [--out soak.csv] [-- OPTIONS OF train.py]

Trains, with checkpoints and a log of JSON lines, until the time is up, and is then stopped as by SIGTERM. After each epoch it
records the resident memory, the number of XLA compilations, and the machine's current speed. For the speed, another process,
idle otherwise, plays episodes and multiplies matrices on all cores for half a second.

The epochs after the first tenth of the time, in which the replay ring fills, are cut into ten blocks. A line is fitted to the
blocks' medians. The exit status is 1 if anything compiled after the first epoch, if the 95 % interval of memory's slope lies
above zero, or if the environment steps per second, relative to the machine's speed, change by 5 % or more along the line.
"""

import argparse
import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from timing import print_table

from mjx_dher import cli, envs, rollout
from mjx_dher.runs.folder import loggers
from mjx_dher.system import machine

BLOCKS = 10
REFERENCE_EPISODES = 24  # about 0.1 s on two cores
REFERENCE_PRODUCTS = 600  # about 0.3 s
COLUMNS = ("epoch", "env_steps", "seconds", "epoch_seconds", "reference_seconds", "memory", "compilations")
COMPILATION = "/jax/core/compile/backend_compile_duration"


class Watch:
    """A sink that records each epoch, and stops the run when its time is up.

    Rows are written to a file at once: in memory they would grow like the leak to be found.
    """

    def __init__(self, path, seconds):
        self.seconds, self.compilations = seconds, 0
        jax.monitoring.register_event_duration_secs_listener(self._on_event)
        self.since = None  # the first epoch's end
        self.file = path.open("w", newline="", buffering=1)
        self.writer = csv.DictWriter(self.file, COLUMNS)
        self.writer.writeheader()
        command = [sys.executable, __file__, "--reference"]
        # A new session: Ctrl-C is for the run.
        self.clock = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
        self._reference()

    def _on_event(self, event, duration_secs, **_):
        self.compilations += event == COMPILATION

    def write(self, row):
        now = time.perf_counter()
        if self.since is None:
            self.since = self.begin = now
        elif now - self.since > self.seconds:
            os.kill(os.getpid(), signal.SIGTERM)
        self.writer.writerow(
            {
                "epoch": row["epoch"],
                "env_steps": row["env_steps"],
                "seconds": now - self.since,
                "epoch_seconds": now - self.begin,
                "reference_seconds": self._reference(),
                "memory": machine.used_bytes(),
                "compilations": self.compilations,
            }
        )
        self.begin = time.perf_counter()

    def _reference(self):
        assert self.clock.stdin is not None
        assert self.clock.stdout is not None
        self.clock.stdin.write("\n")
        self.clock.stdin.flush()
        return float(self.clock.stdout.readline())

    def close(self):
        self.clock.communicate()
        self.file.close()


def tell_speed() -> None:
    """The other process. For each line of input it does the same work once and prints the seconds."""
    env = envs.make("push", engine="native")
    actions = jnp.zeros((env.episode_length, REFERENCE_EPISODES, env.action_size))

    @jax.jit
    def work(x):
        played = rollout.rollout(env, lambda action, obs: action, jax.random.key(0), REFERENCE_EPISODES, actions)[1]
        return played, jax.lax.scan(lambda x, _: (jnp.tanh(x @ x[:256]), None), x, length=REFERENCE_PRODUCTS)[0]

    x = jax.random.normal(jax.random.key(0), (1024, 256))
    jax.block_until_ready(work(x))
    for _ in sys.stdin:
        started = time.perf_counter()
        jax.block_until_ready(work(x))
        print(time.perf_counter() - started, flush=True)


def line(minutes, values):
    """Slope per minute and its 95 % interval, of the medians of BLOCKS blocks."""
    blocks = np.array_split(np.arange(len(values)), BLOCKS)
    found = scipy.stats.linregress([np.mean(minutes[b]) for b in blocks], [np.median(values[b]) for b in blocks])
    half = scipy.stats.t.ppf(0.975, BLOCKS - 2) * found.stderr
    return found.slope, found.slope - half, found.slope + half


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="push")
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--reference", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("options", nargs="*", help="options of train.py, after --")
    args = parser.parse_args()
    if args.reference:
        tell_speed()
        return 0
    open_sinks = loggers.open_sinks
    with tempfile.TemporaryDirectory() as parent:
        out = args.out or Path(parent) / "soak.csv"
        watch = Watch(out, args.minutes * 60)
        loggers.open_sinks = lambda *rest: [*open_sinks(*rest), watch]
        command = ["--env", args.env, "--total-steps", "1000000000", "--checkpoint-every", "20", "--log", "jsonl"]
        status = cli.main([*command, "--out", str(Path(parent) / "run"), *args.options])
        if status != 128 + signal.SIGTERM:
            print(f"the run ended by itself, with status {status}", file=sys.stderr)
            return 1
        with out.open(newline="") as file:
            return report(list(csv.DictReader(file)))


def report(rows) -> int:
    column = {name: np.array([row[name] for row in rows], float) for name in rows[0]}
    minutes = column["seconds"] / 60
    used = minutes > minutes[-1] / 10
    if used.sum() < 2 * BLOCKS:
        print(f"only {used.sum()} epochs after the first tenth of the time; {2 * BLOCKS} are needed", file=sys.stderr)
        return 1
    along, held = minutes[used], column["memory"][used] / 1e6
    speed = (np.diff(column["env_steps"], prepend=0) / column["epoch_seconds"].clip(1e-9))[used]
    machine_speed = 1 / column["reference_seconds"][used]
    span = along[-1] - along[0]
    again = int(column["compilations"][-1] - column["compilations"][0])
    measured = {
        "memory, MB": held,
        "env steps/s": speed,
        "the machine, units of work/s": machine_speed,
        "env steps a unit of the machine's work": speed / machine_speed,
    }
    table, wrong = [], [] if again == 0 else [f"{again} programs were compiled after the first epoch"]
    for name, values in measured.items():
        median = np.median(values)
        slope, low, high = (span * x for x in line(along, values))
        shares = " to ".join(f"{x / median:+.2%}" for x in (low, high))
        table.append((name, f"{median:,.1f}", f"{values.min():,.1f}", f"{values.max():,.1f}", f"{slope:+,.1f}", shares))
        if name == "memory, MB" and low > 0:
            wrong.append(f"memory grows by {slope:.1f} MB in {span:.0f} minutes ({low:.1f} to {high:.1f})")
        if name.startswith("env steps a unit") and abs(slope) >= 0.05 * median:
            wrong.append(f"speed changes by {slope / median:+.1%}, beside the machine's own")
    print_table(("of the epochs", "median", "least", "most", f"change in {span:.0f} min", "95 % interval"), table)
    print(f"\n{len(rows)} epochs, {column['env_steps'][-1]:,.0f} env steps in {minutes[-1]:.1f} min;", end=" ")
    print(f"compiled before the first epoch's end: {int(column['compilations'][0])}, after it: {again}")
    for problem in wrong:
        print(f"NOT RIGHT: {problem}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
