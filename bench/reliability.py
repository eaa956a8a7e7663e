"""Fault injection for the real command: kills, signals, a full disk, damage, power cuts, other programs, edits, wrong calls.

    python bench/reliability.py [--parts kills signals ...] [--kills 200] [--signals 50] [--flips 200] [--pairs 100]

Every restored state is compared, by the SHA-256 of all its leaves, with the state of an undisturbed run. Every run or sweep
that ends is compared with an undisturbed one. The table has one row per part. The exit status is 1 in three cases: a result
differs in any bit, more than one interval between checkpoints was lost, or a refusal named no cause. docs/reliability.md has
the results. `--workers` of `pairs`, `power` and `signals` run at a time.
"""

import argparse
import dataclasses
import hashlib
import json
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import reliability_calls
import reliability_hostile
import reliability_machines
import reliability_pairs
import reliability_power
import reliability_signals
import reliability_splices
from timing import print_table

from mjx_dher import Config, HParams, envs, make_train
from mjx_dher.runs import loop
from mjx_dher.runs.folder import checkpoint, restoring, run_folder

# A ring that takes a tenth of a second to save, so that kills meet saves.
SHAPES: dict[str, Any] = {"num_envs": 2, "cycles_per_epoch": 1, "updates_per_cycle": 2, "target_period": 1, "batch_size": 16}
SHAPES |= {"hidden_sizes": (8, 8), "replay_size": 50_000, "eval_episodes": 2}
EPOCHS = 400
INTERVAL = 2  # epochs between checkpoints


class Failure(Exception):
    """A result differs from the expected one."""


def expect(condition, what):
    if not condition:
        raise Failure(what)


class Runs:
    """Runs of one setting, and their expected states."""

    def __init__(self, env_name, folder):
        env = envs.make(env_name)
        self.folder = Path(folder)
        total_steps = EPOCHS * SHAPES["num_envs"] * env.episode_length
        self.env_name, self.config = env_name, Config(total_steps=total_steps, **SHAPES)
        self.program = make_train(env, self.config)
        compiled = loop.compile_program(self.program, jax.random.key(0), HParams())
        state = compiled.init(jax.random.key(0), HParams())
        self.right = [digest(state)]  # after each epoch
        for progress in loop.run(env, self.config, compiled, loop.Start(state)):
            self.right.append(digest(progress.state))
        self.template = loop.state_template(self.program)

    def start(self, out, limit=None):
        """The command, training into `out` or resuming from it. `limit`: largest size of a file in kB."""
        if run_folder.checkpoints(out):
            command = ["resume", out]
        else:
            shutil.rmtree(out, ignore_errors=True)
            options = dataclasses.asdict(self.config)
            command = ["--env", self.env_name, "--preset", "cpu", "--out", out]
            command += ["--checkpoint-every", INTERVAL, "--final-episodes", "2"]
            for name in ("total_steps", *SHAPES):
                value = options[name] if isinstance(options[name], tuple) else (options[name],)
                command += ["--" + name.replace("_", "-"), *value]
            numbers = HParams()._asdict()
            command += [str(x) for name, value in numbers.items() for x in ("--" + name.replace("_", "-"), value)]
        return reliability_pairs.start(*command, limit=limit)

    def check(self, out, lost=INTERVAL):
        """The epoch restored from `out`, or 0 if there is no checkpoint. At most `lost` epochs were done after it."""
        lines = (out / "metrics.csv").read_text().splitlines() if (out / "metrics.csv").exists() else []
        done = max(0, len([line for line in lines if line]) - 1)
        if not run_folder.checkpoints(out):
            expect(done <= lost, f"{done} epochs without a checkpoint")
            return 0
        found = restoring.restore(out, self.template)
        expect(not found.refused, f"a checkpoint is not whole: {found.refused}")
        expect(digest(found.state) == self.right[found.epoch], f"the state of epoch {found.epoch} is another")
        # An epoch's line is written before its checkpoint, and may be truncated by the kill.
        expect(done - found.epoch <= lost, f"epochs {found.epoch} to {done} are lost")
        return found.epoch


def digest(state):
    found = hashlib.sha256()
    for array in jax.tree.leaves(checkpoint.without_keys(state)):
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def kills(runs, count, rng):
    """SIGKILL at random moments. The run is resumed each time."""
    out = runs.folder / "kills"
    inside, lost, ended = 0, [], 0
    for _ in range(count):
        process = runs.start(out)
        before = {path.name for path in run_folder.checkpoints(out)}
        deadline = time.monotonic() + 120
        while process.poll() is None and time.monotonic() < deadline:  # until it works
            if {path.name for path in run_folder.checkpoints(out)} - before:
                break
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.6))
        process.kill()
        process.communicate()
        if (out / run_folder.RESULT_FILE).exists():
            ended += 1
            shutil.rmtree(out)
            continue
        inside += any((out / run_folder.CHECKPOINTS).glob(".partial-*"))
        lines = (out / "metrics.csv").read_text().splitlines()
        lost.append(max(0, len(lines) - 1 - runs.check(out)))
    return f"{count} SIGKILLs, {inside} of them inside a save; {ended} runs had ended", f"at most {max(lost)} epochs lost"


def saved(runs, name):
    """A folder with two checkpoints of a run that was stopped."""
    out = runs.folder / name
    process = runs.start(out)
    while process.poll() is None and len(run_folder.checkpoints(out)) < 2:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    process.communicate()
    return out


def flips(runs, count, rng):
    """Flips one bit at a time, anywhere in the newest checkpoint, which is the only one."""
    out = saved(runs, "flips")
    newest, *older = run_folder.checkpoints(out)
    for path in older:
        shutil.rmtree(path)
    files = [path for path in sorted(newest.rglob("*")) if path.is_file() and path.stat().st_size]
    refused = harmless = 0
    for path in rng.choices(files, k=count):
        whole = path.read_bytes()
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            found = restoring.restore(out, runs.template)
            expect(digest(found.state) == runs.right[found.epoch], f"restored silently wrong: {path}")
            harmless += 1
        except checkpoint.CheckpointError:
            refused += 1
        path.write_bytes(whole)
    return f"{count} flipped bits in {len(files)} files", f"{refused} refused, {harmless} restored right, 0 wrong"


def damage(runs, count, rng):
    """Every file of a checkpoint cut short, emptied and removed; another schema; nothing left."""
    out = saved(runs, "damage")
    newest, older = run_folder.checkpoints(out)
    expected = int(older.name[-6:])
    tried = 0
    for path in [path for path in sorted(newest.rglob("*")) if path.is_file()]:
        whole = path.read_bytes()
        for harm in (lambda p, b: p.write_bytes(b[: len(b) // 2]), lambda p, b: p.write_bytes(b""), lambda p, b: p.unlink()):
            if len(whole) == 0 and path.exists():
                continue  # cutting an empty file changes nothing
            harm(path, whole)
            found = restoring.restore(out, runs.template)
            expect((found.epoch, len(found.refused)) == (expected, 1), f"{path}: epoch {found.epoch}, {found.refused}")
            expect(digest(found.state) == runs.right[found.epoch], "the older one is another")
            path.write_bytes(whole)
            tried += 1
    manifest = newest / run_folder.MANIFEST
    manifest.write_text(manifest.read_text().replace(f'"schema": {checkpoint.SCHEMA}', '"schema": 0'))
    expect("schema" in restoring.restore(out, runs.template).refused[newest], "an older schema is not named")
    shutil.rmtree(older)
    process = runs.start(out)
    _, stderr = process.communicate()
    expect(process.returncode == 2 and stderr.startswith(f"error: {out} has no checkpoint"), stderr)
    return f"{tried} files cut, emptied or removed; another schema", "each refused by name, and the checkpoint before it used"


def disk(runs, count, rng):
    """Limits the size of files to less than a checkpoint needs, as on a full disk."""
    out = saved(runs, "disk")
    before = runs.check(out)
    for limit in (16, 4, 1):
        process = runs.start(out, limit)
        stdout, stderr = process.communicate()
        named = "error: cannot write the checkpoint" in stderr or "cannot be written to" in stderr
        expect(process.returncode == 2 and named, f"{limit}: {process.returncode} {stderr}")
        # A run warns and continues if a checkpoint cannot be written. It ends when its metrics cannot be written.
        told = stdout.count("cannot write the checkpoint")
        expect(runs.check(out, lost=(told + 1) * INTERVAL) >= before, "a checkpoint is gone")
    return "files limited to 16, 4 and 1 kB", "each epoch not saved is told, then a named error; the checkpoints stay whole"


def twice(runs, count, rng):
    """A second program on the folder of the first."""
    out = runs.folder / "twice"
    first = runs.start(out)
    while first.poll() is None and not run_folder.checkpoints(out):
        time.sleep(0.01)
    second = runs.start(out)
    _, stderr = second.communicate()
    expect(second.returncode == 2 and "is being trained by another process" in stderr, stderr)
    first.kill()
    first.communicate()
    runs.check(out)
    return "a second program on the folder", "refused by name; the first goes on"


def expect_none(faults):
    for fault in faults:
        print(fault, file=sys.stderr)
    kinds = {kind: sum(f": {kind}" in fault for fault in faults) for kind in ("silent", "lost", "traceback")}
    counts = ", ".join(f"{kind} {count}" for kind, count in kinds.items())
    expect(not faults, f"{len(faults)} faults ({counts})")


def messages(folder, args):
    """Hostile messages to every port."""
    import reliability_messages  # which needs the extras view and ray

    ports, faults = reliability_messages.messages(folder, args.messages, args.seed)
    done = f"{args.messages} hostile messages to each of {ports} ports"
    return done, "nothing ended or blocked; a browser still served", faults


# Parts that do not share `Runs`: functions of a folder and the arguments. Each returns a count of its trials, their outcome,
# and the faults.
APART: dict[str, Any] = {
    "pairs": lambda folder, args: reliability_pairs.pairs(folder, args.pairs, random.Random(args.seed), args.workers),
    "power": lambda folder, args: reliability_power.power(folder, args.power, random.Random(args.seed), args.workers),
    "edits": lambda folder, args: reliability_calls.edits(folder),
    "calls": lambda folder, args: reliability_calls.calls(folder),
    "messages": messages,
    "signals": lambda folder, args: reliability_signals.signals(folder, args.signals, args.seed, args.workers),
    "splices": lambda folder, args: reliability_splices.splices(folder),
    "disks": lambda folder, args: reliability_machines.disks(folder),
    "containers": lambda folder, args: reliability_machines.containers(folder),
    "hostile": lambda folder, args: reliability_hostile.hostile(folder, seed=args.seed),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {"kills": kills, "flips": flips, "damage": damage, "disk": disk, "twice": twice}
    names = [*parts, *APART]
    parser.add_argument("--parts", nargs="+", choices=names, default=names)
    numbers = {"kills": 200, "flips": 200, "pairs": 100, "power": 50, "messages": 200, "signals": 50, "workers": 1, "seed": 0}
    for name, number in numbers.items():
        parser.add_argument(f"--{name}", type=int, default=number)
    parser.add_argument("--env", default="reach")
    args = parser.parse_args()
    rows, failed = [], False
    with tempfile.TemporaryDirectory() as folder:
        runs = Runs(args.env, folder) if set(args.parts) - set(APART) else None
        for name in args.parts:
            try:
                if name in APART:
                    *texts, faults = APART[name](Path(folder, name), args)
                    expect_none(faults)
                else:
                    texts = parts[name](runs, getattr(args, name, 0), random.Random(args.seed))
                rows.append((name, *texts, "yes"))
            except Failure as failure:
                failed = True
                print(failure, file=sys.stderr)
                rows.append((name, "", " ".join(str(failure).split())[:80], "NO"))
            print(json.dumps(rows[-1]), flush=True)
    print_table(("part", "what was done", "what came of it", "as it must be"), rows)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
