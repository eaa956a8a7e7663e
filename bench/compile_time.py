"""What passes before training begins: cold, and with what an earlier run has left in the caches of JAX and Warp.

    python bench/compile_time.py [--env push] [--engine auto] [--preset cpu]

Each row is a program of its own, with caches in a folder of its own. "Compiling" is what train.py reports: tracing, XLA, and,
for warp, its kernels. "First epoch" is how much longer the first one takes than the second.
"""

from __future__ import annotations

import argparse
import tempfile
import time

import apart

from mjx_dher import presets


def measure(env: str, engine: str, preset: str) -> dict[str, float]:
    start = time.perf_counter()
    import dataclasses

    from mjx_dher import envs, learners, samplers, trainer
    from mjx_dher.host.caches import keep_compiled_programs
    from mjx_dher.runs.loop import train

    keep_compiled_programs()
    spec = presets.preset(preset, env)
    config = dataclasses.replace(spec.config, total_steps=10**9)
    compiled: list[float] = []
    environment = envs.make(env, engine=engine)
    ready = time.perf_counter()
    note = lambda seconds: compiled.append(seconds) if seconds else None  # noqa: E731
    learner = learners.make(spec.learner, config, trainer.env_sizes(environment), spec.networks)
    run = train(environment, config, spec.hparams, 0, note, sampler=samplers.make("weighted"), learner=learner)
    first, second = next(run), next(run)
    run.close()
    return {
        "imports": ready - start,
        "compiling": compiled[0],
        "first epoch": first.epoch_seconds - second.epoch_seconds,
        "second epoch": second.epoch_seconds,
    }


def main() -> None:
    from timing import print_table

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["push"])
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", default=presets.machine_preset())
    args = parser.parse_args()
    rows = []
    for env in args.env:
        with tempfile.TemporaryDirectory() as folder:
            caches = {"JAX_COMPILATION_CACHE_DIR": f"{folder}/xla", "WARP_CACHE_PATH": f"{folder}/warp"}
            for state in ("cold", "cached"):
                found = apart.measured(__file__, (env, args.engine, args.preset), caches)
                rows.append((env, state, *(f"{seconds:.1f}" for seconds in found.values())))
    head = ("imports, s", "compiling, s", "first epoch, s more", "an epoch, s")
    print_table(("task", "caches", *head), rows)


if __name__ == "__main__":
    apart.main(measure, main)
