"""Time to success: trains several seeds of a preset in turn, and prints when each first reached a threshold.

    python bench/time_to_success.py [--env push] [--sampler weighted] [--seeds 5] [--threshold 0.9] [--out FILE.csv]
        [--set num_envs=512 noise_std=0.2]

Seconds are of training, with evaluations and without compilation. "First" is the first evaluation (eval_episodes episodes) at
or above the threshold. The final success is over 500 fresh episodes.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import jax
from bakeoff_runs import save
from timing import print_table

from mjx_dher import envs, learners, presets, priorities, samplers, stats
from mjx_dher.cli.settings import check_writable
from mjx_dher.contract import env_spec
from mjx_dher.evaluate import play_policy
from mjx_dher.runs.folder import fingerprint
from mjx_dher.runs.loop import train
from mjx_dher.system.files import FolderError
from mjx_dher.system.machine import keep_compiled_programs


def parse() -> argparse.Namespace:
    """Checked arguments. Unusable ones end the program with status 2 and an error message."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="push")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", default=presets.machine_preset())
    parser.add_argument("--sampler", default="weighted")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--threshold", type=float, default=0.9)
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="changes to the preset")
    parser.add_argument("--out", type=Path, help="CSV of every evaluation of every seed")
    args = parser.parse_args()
    try:
        args.spec = presets.preset(args.preset, args.env)
        known = fingerprint.settings(args.spec)
        changes = (change.partition("=") for change in args.set)
        args.spec = args.spec.replace(**{name: type(known.get(name, ""))(value) for name, _, value in changes})
    except ValueError as error:
        parser.error(str(error))
    if args.seeds < 1:
        parser.error(f"--seeds is 1 or more; got {args.seeds}")
    if args.out:
        if not args.out.resolve().parent.is_dir():
            parser.error(f"--out: there is no folder {args.out.parent}")
        try:
            check_writable(args.out.parent)
        except FolderError as error:
            parser.error(str(error))
    return args


def main() -> None:
    args = parse()
    spec, config, hparams = args.spec, args.spec.config, args.spec.hparams
    env = envs.make(args.env, engine=args.engine)
    learner = learners.make(spec.learner, config, env_spec(env), spec.networks)
    parts: dict[str, Any] = {"sampler": samplers.make(args.sampler), "priority": priorities.make(spec.priority)}
    keep_compiled_programs()
    rows, curve, compiled = [], [], []
    for seed in range(args.seeds):
        first, started = None, time.perf_counter()
        for progress in train(env, config, hparams, seed, learner=learner, **parts):
            if progress.epoch == 1:
                compiled.append(time.perf_counter() - started - progress.wall_seconds)
            success = progress.metrics["success_rate"]
            curve.append((seed, progress.env_steps, progress.updates, round(progress.wall_seconds, 2), success))
            if first is None and success >= args.threshold:
                first = progress
            last = progress
        outcome = play_policy(env, learner.export(jax.device_get(last.state.learner), hparams), 500, seed=1000 + seed)
        low, high = stats.wilson_interval(int(outcome.success.sum()), len(outcome.success))
        reached = (f"{first.wall_seconds:.0f}", f"{first.env_steps:,}", f"{first.updates:,}") if first else ("never",) * 3
        total = (f"{last.wall_seconds:.0f}", f"{last.env_steps:,}")
        final = (
            f"{outcome.success.mean():.3f} ({low:.3f}-{high:.3f})",
            f"{outcome.reset_success.mean():.3f}",
            f"{outcome.ret.mean():.1f}",
        )
        rows.append((seed, *reached, *total, *final))
        print(rows[-1], flush=True)
        if args.out:
            save(args.out, curve, ("seed", "env_steps", "updates", "wall_seconds", "success_rate"))
    head = ("seed", f"s to {args.threshold}", "env steps", "updates", "s in all", "env steps in all")
    print_table((*head, "final success (95 %)", "at reset", "mean return"), rows)
    times = [float(row[1]) if row[1] != "never" else float("inf") for row in rows]
    print(f"\nmedian seconds to {args.threshold}: {statistics.median(times):.0f}; compiling: {statistics.median(compiled):.1f}")


if __name__ == "__main__":
    main()
