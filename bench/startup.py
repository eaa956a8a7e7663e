"""Waiting times of a user: from Enter to the first epoch, and from the last epoch to the prompt.

    python bench/startup.py [--env push] [--engine auto] [--preset cpu] [--sampler weighted] [--repeats 3]

Each row is the command `python train.py` itself, for two epochs. It is "cold" in an empty home folder, without compilations
cached by JAX, Warp or the GPU's driver, and "warm" in the same one after that (medians).
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from timing import print_table

from mjx_dher import config, presets

ROOT = Path(__file__).parent.parent
# Output of train.py at the end of a part, and the part.
PARTS = {
    "writing to": "imports, arguments",
    "compiling for": "checks, first networks",
    "compiled in": "compiling",
    "epoch 1/": "first epoch",
    "epoch 2/": "second epoch, last evaluation",
    "run folder": "result",
}
CACHES = ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH", "XDG_CACHE_HOME", "CUDA_CACHE_PATH")


def measure(command: list[str], home: str) -> dict[str, float]:
    """Runs a command with this home folder. Returns the seconds of each part, and of all."""
    environ = {name: value for name, value in os.environ.items() if name not in CACHES}
    with tempfile.TemporaryDirectory() as folder:
        start = last = time.perf_counter()
        program = subprocess.Popen(
            [sys.executable, "-u", str(ROOT / "train.py"), *command, "--out", f"{folder}/run"],
            env={**environ, "HOME": home},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert program.stdout is not None
        seconds, lines = {}, []
        for line in program.stdout:
            lines.append(line)
            for text, part in PARTS.items():
                if text in line and part not in seconds:
                    now = time.perf_counter()
                    seconds[part], last = now - last, now
        if program.wait() or len(seconds) < len(PARTS):
            raise SystemExit(f"{' '.join(command)} ended with status {program.returncode}:\n{''.join(lines)}")
    end = time.perf_counter()
    to_first = sum(seconds[part] for part in list(PARTS.values())[:3])
    return {**seconds, "exit": end - last, "to the first epoch": to_first, "whole command": end - start}


def machine_preset() -> str:
    """The machine's preset, from a separate process: this one must not hold the GPU's memory."""
    code = "from mjx_dher import presets; print(presets.machine_preset())"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()[-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["push"])
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", help="preset (default: the one for this machine)")
    parser.add_argument("--sampler", default="weighted")
    parser.add_argument("--repeats", type=int, default=3, help="warm runs")
    args = parser.parse_args()
    rows, head = [], []
    preset = args.preset or machine_preset()
    for env in args.env:
        steps = 2 * config.steps_per_epoch(presets.preset(preset, env).config, 50)
        command = ["--env", env, "--engine", args.engine, "--preset", preset, "--sampler", args.sampler]
        with tempfile.TemporaryDirectory() as home:
            found = [measure([*command, "--total-steps", str(steps)], home) for _ in range(1 + args.repeats)]
        head = list(found[0])
        warm = {name: statistics.median(run[name] for run in found[1:]) for name in head} if args.repeats else {}
        rows += [
            (env, state, *(f"{seconds:.1f}" for seconds in run.values()))
            for state, run in (("cold", found[0]), ("warm", warm))
            if run
        ]
    print_table(("task", "caches", *(f"{name}, s" for name in head)), rows)


if __name__ == "__main__":
    main()
