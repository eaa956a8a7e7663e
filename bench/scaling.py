"""Scaling over devices: parallel runs, and one run split over devices.

    python bench/scaling.py lanes --devices 2 --env push --lanes 40       # 40 lanes on one device, 80 on two
    python bench/scaling.py lanes --devices 2 --env pick_and_place slide
    python bench/scaling.py run --devices 2 --env push --times 1 2 4 8    # multiples of the environments and the batch

`run` has three rows for each size: one device; all devices, with as many times the environments and batch; all devices, with
the same. The third row shows the cost of the exchange if work is too small to share. A row is the median epoch of `--epochs`,
without the first one. The rows of a size are measured in turn, `--rounds` times, and the best round of each counts.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics

import jax
from timing import print_table

from mjx_dher import config as config_lib
from mjx_dher import envs, presets
from mjx_dher.parallel import mesh
from mjx_dher.runs.program import loop
from mjx_dher.runs.program import program as program_lib
from mjx_dher.system.caches import prepare


class Case:
    """`runs` compiled runs of a spec on `devices` devices."""

    def __init__(self, env, spec, runs, devices):
        self.env, self.spec, self.devices = env, spec, devices
        specs = [dataclasses.replace(spec, seed=seed) for seed in range(runs)]
        self.program = program_lib.compile_runs(env, specs, runs, 1, lambda text: print(text, flush=True), mesh.find(devices))
        self.runs = self.program.lanes
        self.arguments = program_lib.stack(specs, self.program.choices, self.program.lanes)
        self.seconds = float("inf")  # of an epoch

    def measure(self, epochs):
        steps = (1 + epochs) * config_lib.steps_per_epoch(self.spec.config, self.env.episode_length)
        config = dataclasses.replace(self.spec.config, total_steps=steps)
        start = loop.Start(self.program.compiled.init(*self.arguments))
        seconds = [progress.epoch_seconds for progress in loop.run(self.env, config, self.program.compiled, start)]
        self.seconds = min(self.seconds, statistics.median(seconds[1:]))

    @property
    def steps(self):
        """Environment steps per second, of all runs."""
        return self.runs * config_lib.steps_per_epoch(self.spec.config, self.env.episode_length) / self.seconds

    @property
    def transitions(self):
        """Transitions per second that updates learn from, of all runs."""
        config = self.spec.config
        return self.runs * config.cycles_per_epoch * config.updates_per_cycle * config.batch_size / self.seconds


def measure(cases, args):
    for _ in range(args.rounds):
        for case in cases:
            case.measure(args.epochs)


def resized(spec, args, times=1):
    """The spec with the command line's changes, and `times` the environments and the batch."""
    changes = {name: getattr(args, name) for name in ("num_envs", "batch_size", "updates_per_cycle", "cycles_per_epoch")}
    changes = {name: value for name, value in changes.items() if value is not None}
    if args.hidden_sizes:
        changes["hidden_sizes"] = tuple(args.hidden_sizes)
    config = dataclasses.replace(spec.config, **changes)
    config = dataclasses.replace(config, num_envs=times * config.num_envs, batch_size=times * config.batch_size)
    return dataclasses.replace(spec, config=config)


def lanes(args):
    rows = []
    for name in args.env:
        spec = resized(presets.preset(args.preset, name, engine=args.engine), args)
        env = envs.make(name, engine=args.engine)
        cases = [Case(env, spec, n * args.lanes, n) for n in (1, args.devices)]
        measure(cases, args)
        for case in cases:
            ratio = case.seconds / cases[0].seconds
            rows.append((name, case.devices, case.runs, f"{case.seconds:.3f}", f"{case.steps:,.0f}", f"{ratio:.3f}"))
    print_table(("env", "devices", "lanes", "s an epoch", "env steps/s", "time, of one device's"), rows)


def one_run(args):
    rows = []
    for name in args.env:
        env = envs.make(name, engine=args.engine)
        for times in args.times:
            one = resized(presets.preset(args.preset, name, engine=args.engine), args, times)
            more = resized(presets.preset(args.preset, name, engine=args.engine), args, times * args.devices)
            cases = [Case(env, spec, 1, devices) for spec, devices in ((one, 1), (more, args.devices), (one, args.devices))]
            measure(cases, args)
            for case in cases:
                sizes = (case.spec.config.num_envs, case.spec.config.batch_size, max(case.spec.config.hidden_sizes))
                ratios = (f"{case.steps / cases[0].steps:.2f}", f"{case.transitions / cases[0].transitions:.2f}")
                rows.append((name, case.devices, *sizes, f"{case.seconds:.3f}", f"{case.steps:,.0f}", *ratios))
    head = ("env", "devices", "environments", "batch", "units", "s an epoch", "env steps/s", "steps, of one's", "transitions")
    print_table(head, rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("lanes", "run"))
    parser.add_argument("--devices", type=int, default=2)
    parser.add_argument("--env", nargs="+", default=["push"])
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", default="gpu")
    parser.add_argument("--lanes", type=int, default=40, help="lanes per device")
    parser.add_argument("--times", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--epochs", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=3)
    for name in ("--num-envs", "--batch-size", "--updates-per-cycle", "--cycles-per-epoch"):
        parser.add_argument(name, type=int, help="in place of the preset's")
    parser.add_argument("--hidden-sizes", type=int, nargs="+", help="in place of the preset's")
    args = parser.parse_args()
    prepare()
    print(f"{len(jax.devices())} devices; times are of {args.rounds} rounds, the best")
    (lanes if args.what == "lanes" else one_run)(args)


if __name__ == "__main__":
    main()
