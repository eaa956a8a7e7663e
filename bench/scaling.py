"""Scaling over devices: parallel runs, and one run split over devices.

    python bench/scaling.py lanes --devices 1 2 4 8 --env push pick_and_place slide   # 40 runs on one device, 320 on eight
    python bench/scaling.py run --devices 1 2 4 8 --env push --times 1 8              # one run; multiples of the preset's sizes
    python bench/scaling.py run --devices 8 --times 8 --updates-per-cycle 100 --profile

`run` measures one device, and for each larger number of devices a row with as many times the environments and batch (weak
scaling) and one with the same (strong scaling). A row is the median epoch of `--epochs`, without the first one. All programs
are compiled first. The rows of a size are measured in turn, `--rounds` times, and the best round of each counts. `--profile`
adds an epoch of each row under jax.profiler: the shares of the first device's time in which it works, and exchanges.
"""

import argparse
import concurrent.futures
import dataclasses
import gzip
import itertools
import json
import statistics
import sys
import tempfile
from pathlib import Path

import jax
from timing import print_table

from mjx_dher import config as config_lib
from mjx_dher import envs, presets
from mjx_dher.parallel import mesh
from mjx_dher.runs import loop
from mjx_dher.runs import program as program_lib
from mjx_dher.system.machine import prepare


class Case:
    """`runs` compiled runs of a spec on `devices` devices."""

    def __init__(self, env, spec, runs, devices):
        self.env, self.spec, self.runs, self.devices = env, spec, runs, devices
        specs = [dataclasses.replace(spec, seed=seed) for seed in range(runs)]
        choices, layout = program_lib.choices_of(specs), mesh.arrange(mesh.find(devices), runs)
        self.arguments = program_lib.stack(specs, choices, runs)
        updates = config_lib.num_updates(spec.config, env.episode_length)
        self.compiled = loop.compile_program(
            program_lib.make_loop(env, spec, choices, layout), *self.arguments, updates, layout
        )
        self.seconds = float("inf")  # of an epoch
        self.working = self.exchanging = float("nan")  # shares of a profiled epoch
        print(f"{spec.env}: {runs} runs on {devices} devices compiled", file=sys.stderr, flush=True)

    def train(self, epochs):
        """The progress of `epochs` epochs of new runs."""
        config = dataclasses.replace(
            self.spec.config, total_steps=epochs * config_lib.steps_per_epoch(self.spec.config, self.env.episode_length)
        )
        return loop.run(self.env, config, self.compiled, loop.Start(self.compiled.init(*self.arguments)))

    def measure(self, epochs):
        seconds = [progress.epoch_seconds for progress in self.train(1 + epochs)]
        self.seconds = min(self.seconds, statistics.median(seconds[1:]))

    def profile(self):
        epochs = self.train(3)
        next(epochs), next(epochs)
        with tempfile.TemporaryDirectory() as folder:
            with jax.profiler.trace(folder, create_perfetto_trace=False):
                seconds = next(epochs).epoch_seconds
            events: dict[bool, list] = {True: [], False: []}
            for event in device_events(Path(folder)):
                events["nccl" in event[0].lower()].append(event)
        self.exchanging, self.working = (busy(own) / 1e6 / seconds for own in events.values())

    @property
    def steps(self):
        """Environment steps per second, of all runs."""
        return self.runs * config_lib.steps_per_epoch(self.spec.config, self.env.episode_length) / self.seconds

    @property
    def transitions(self):
        """Transitions per second that updates learn from, of all runs."""
        config = self.spec.config
        return self.runs * config.cycles_per_epoch * config.updates_per_cycle * config.batch_size / self.seconds


def device_events(folder: Path):
    """(name, start, duration), both in µs, of the first GPU's activities."""
    (path,) = folder.rglob("*.trace.json.gz")
    trace = json.loads(gzip.decompress(path.read_bytes()))["traceEvents"]
    names = {e["pid"]: e["args"]["name"] for e in trace if e.get("name") == "process_name"}
    lines = {(e["pid"], e["tid"]): e["args"]["name"] for e in trace if e.get("name") == "thread_name"}
    for event in trace:
        if event.get("ph") != "X" or not names.get(event["pid"], "").endswith("GPU:0"):
            continue
        if lines.get((event["pid"], event["tid"]), "").startswith("Stream"):
            yield event["name"], event["ts"], event["dur"]


def busy(events) -> float:
    """µs in which at least one of the events was running."""
    total, end = 0.0, -1.0
    for _, start, duration in sorted(events, key=lambda event: event[1]):
        total += max(0.0, start + duration - max(end, start))
        end = max(end, start + duration)
    return total


def compile_all(*arguments):
    """Cases of (env, spec, runs, devices), compiled side by side."""
    with concurrent.futures.ThreadPoolExecutor() as pool:
        return list(pool.map(lambda own: Case(*own), arguments))


def measure(cases, args):
    for _ in range(args.rounds):
        for case in cases:
            case.measure(args.epochs)
    for case in cases if args.profile else ():
        case.profile()


def resized(name, args, times=1):
    """The preset's run of a task with the command line's changes, and `times` the environments and the batch."""
    spec = presets.preset(args.preset, name, engine=args.engine)
    changes = {name: getattr(args, name) for name in ("num_envs", "batch_size", "updates_per_cycle", "cycles_per_epoch")}
    changes = {name: value for name, value in changes.items() if value is not None}
    if args.hidden_sizes:
        changes["hidden_sizes"] = tuple(args.hidden_sizes)
    spec = spec.replace(**changes)
    return spec.replace(**{name: times * getattr(spec.config, name) for name in ("num_envs", "batch_size", "replay_size")})


def lanes(args):
    tasks = [(envs.make(name, engine=args.engine), resized(name, args)) for name in args.env]
    cases = compile_all(*[(env, spec, n * args.lanes, n) for env, spec in tasks for n in args.devices])
    head, rows = "env | devices | lanes | s an epoch | env steps/s | of the first row's", []
    for own in groups(cases, len(args.devices)):
        measure(own, args)
        for case in own:
            rows.append(
                (case.spec.env, case.devices, case.runs, *speeds(case), f"{case.steps / own[0].steps:.2f}", *shares(case))
            )
    show(head, rows, args)


def one_run(args):
    tasks = [(name, envs.make(name, engine=args.engine)) for name in args.env]
    sizes = [(n, n) for n in args.devices] + [(1, n) for n in args.devices if n > 1]  # multiples of the work, devices
    each = itertools.product(tasks, args.times, sizes)
    cases = compile_all(*[(env, resized(name, args, times * work), 1, n) for (name, env), times, (work, n) in each])
    head = "env | devices | environments | batch | units | s an epoch | env steps/s | of the first row's | transitions"
    rows = []
    for own in groups(cases, len(sizes)):
        measure(own, args)
        for case in own:
            config = case.spec.config
            ratios = (f"{case.steps / own[0].steps:.2f}", f"{case.transitions / own[0].transitions:.2f}")
            told = (case.spec.env, case.devices, config.num_envs, config.batch_size, max(config.hidden_sizes))
            rows.append((*told, *speeds(case), *ratios, *shares(case)))
    show(head, rows, args)


def groups(cases, size):
    """Cases whose rows are compared. The first one is the baseline."""
    return [cases[first : first + size] for first in range(0, len(cases), size)]


def speeds(case):
    return f"{case.seconds:.3f}", f"{case.steps:,.0f}"


def shares(case):
    return f"{case.working:.2f}", f"{case.exchanging:.2f}"


def show(head, rows, args):
    """Prints a table, with the last two columns, the shares, only if there are profiles."""
    columns = [*head.split(" | "), "works", "exchanges"]
    number = len(columns) if args.profile else -2
    print_table(columns[:number], [row[:number] for row in rows])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("lanes", "run"))
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--env", nargs="+", default=["push"])
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", default="gpu")
    parser.add_argument("--lanes", type=int, default=40, help="lanes per device")
    parser.add_argument("--times", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--epochs", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--profile", action="store_true")
    for name in ("--num-envs", "--batch-size", "--updates-per-cycle", "--cycles-per-epoch"):
        parser.add_argument(name, type=int, help="in place of the preset's")
    parser.add_argument("--hidden-sizes", type=int, nargs="+", help="in place of the preset's")
    args = parser.parse_args()
    prepare()
    print(f"{len(jax.devices())} devices; times are of {args.rounds} rounds, the best")
    (lanes if args.what == "lanes" else one_run)(args)


if __name__ == "__main__":
    main()
