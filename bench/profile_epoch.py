"""Profile of a training epoch on a GPU: kernels by their share of the time, and transfers to and from the host.

    python bench/profile_epoch.py [--env push] [--preset gpu] [--top 25] [--out DIR]

Trains two epochs, and profiles a third with jax.profiler. Here an epoch is one cycle with 200 updates, and an evaluation. It
prints the time in which the GPU is busy, the copies between device and host, and the kernels that take longest. A round trip
inside an epoch would show as a copy. The trace is written to DIR.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import gzip
import json
import tempfile
import time
from pathlib import Path

import jax
from timing import print_table

from mjx_dher import envs, learners, presets, samplers
from mjx_dher.contract import env_spec
from mjx_dher.trainer import make_train


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="push")
    parser.add_argument("--preset", default=presets.machine_preset())
    parser.add_argument("--top", type=int, default=25)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if jax.default_backend() == "cpu":
        parser.error("this reads a GPU's profile, and JAX runs on a CPU here")
    spec = presets.preset(args.preset, args.env)
    config = dataclasses.replace(spec.config, cycles_per_epoch=1, updates_per_cycle=200)
    env = envs.make(args.env)
    learner = learners.make(spec.learner, config, env_spec(env), spec.networks)
    program = make_train(env, config, sampler=samplers.make("weighted"), learner=learner)
    state = jax.jit(program.init)(jax.random.key(0), spec.hparams)
    epoch = jax.jit(program.epoch, donate_argnums=0)
    for _ in range(2):
        state, _ = jax.block_until_ready(epoch(state))
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.out or Path(temporary)
        with jax.profiler.trace(str(folder), create_perfetto_trace=False):
            start = time.perf_counter()
            jax.block_until_ready(epoch(state))
            seconds = time.perf_counter() - start
        events = list(device_events(folder))
    spent, count = collections.Counter[str](), collections.Counter[str]()
    for name, _, duration in events:
        spent[name] += duration
        count[name] += 1
    total = sum(spent.values())
    rows = [(f"{t / total:.1%}", f"{count[n]:,}", f"{t / count[n]:.1f}", n[:80]) for n, t in spent.most_common(args.top)]
    print_table(("share", "times", "µs", "kernel"), rows)
    copies = {name: number for name, number in count.items() if "memcpy" in name.lower()}
    print(f"\nepoch {seconds:.2f} s, GPU busy {busy(events) / 1e6:.2f} s with {len(events):,} kernels and copies")
    print("copies:", ", ".join(f"{name} {number:,}" for name, number in copies.items()) or "none")


if __name__ == "__main__":
    main()
