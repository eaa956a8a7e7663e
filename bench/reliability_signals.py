"""Ctrl-C, SIGTERM and SIGHUP at random moments of `train`, `sweep`, `view` and `sweep --ray local`.

A signal goes to the process or to its group, once or twice within half a second, at any moment after the process handles
signals. The command must end within ten seconds with status 128 + signal, without a traceback, and leave no process and no
epoch without a checkpoint. The next trial resumes. Each run and sweep that ends is compared with an undisturbed one.
"""

import contextlib
import importlib.util
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import reliability_pairs

from mjx_dher.runs.folder import run_folder

SECONDS = 10.0  # time limit for a command to end
LONG = ["--total-steps", "20000", "--checkpoint-every", "0"]
GRID = ["sweep", *reliability_pairs.SHAPES, "--sampler", "future", "--seeds", "2", "--lanes", "1", *LONG]
COMMANDS = {
    "train": [*reliability_pairs.SHAPES, *LONG],
    "sweep": GRID,
    "view": ["view", "reach", "--port", "0", "--no-open"],
    "ray": [*GRID, "--ray", "local", "--ray-cpus", "1"],
}


class Trials:
    """Trials of one command, one after another, in one folder.

    Args:
      name: of the command.
      folder: for its output.
      rng: decides signals and moments.
    """

    def __init__(self, name: str, folder: Path, rng: random.Random):
        self.name, self.out, self.rng = name, folder / name, rng
        self.faults: list[str] = []
        self.seconds: list[float] = []
        self.ended = self.stopped = 0
        whole, started = folder / f"{name}-whole", time.monotonic()
        process = self._start(whole)
        if name == "view":
            assert process.stdout is not None
            process.stdout.readline()
            os.killpg(process.pid, signal.SIGKILL)
        _, err = process.communicate()
        if name != "view" and process.returncode != 0:
            raise RuntimeError(err)
        self.span = time.monotonic() - started
        self.right = self._left(whole)

    def _start(self, out: Path, mark: str = "") -> subprocess.Popen[str]:
        argv = COMMANDS[self.name]
        if self.name == "train" and run_folder.checkpoints(out):
            argv = ["resume", str(out), "--no-curve"]
        elif self.name == "train":
            shutil.rmtree(out, ignore_errors=True)
            argv = [*argv, "--out", str(out), "--no-curve"]
        elif self.name != "view":
            argv = [*argv, "--out", str(out)]
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
        return subprocess.Popen(
            [sys.executable, "-u", "train.py", *argv], cwd=reliability_pairs.ROOT, env={**os.environ, "MARK": mark}, **pipes
        )

    def _left(self, out: Path) -> object:
        """Faults that an ended command has left."""
        if self.name == "view":
            return None
        return reliability_pairs.of_run(out) if self.name == "train" else reliability_pairs.of_sweep(out)

    def run(self) -> None:
        """Sends a signal, and records the response."""
        mark, number = uuid.uuid4().hex, self.rng.choice((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
        send, twice = self.rng.choice((os.kill, os.killpg)), self.rng.random() < 0.5
        process = self._start(self.out, mark)
        while process.poll() is None and not _handles(process.pid):
            time.sleep(0.001)
        moment = self.rng.uniform(0, self.span)
        time.sleep(moment)
        began = time.monotonic()
        _send(send, process.pid, number)
        if twice:
            time.sleep(self.rng.uniform(0, 0.4))
            _send(send, process.pid, number)
        try:
            out, err = process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, err = process.communicate()
        seconds = time.monotonic() - began
        told = f"{self.name}: {number.name}{' twice' if twice else ''} by {send.__name__} after {moment:.2f} s"
        self.faults += [f"{told}: {fault}" for fault in self._faults(process.returncode, number, out, err, seconds, mark)]
        if process.returncode != 0:
            self.stopped += 1
            self.seconds.append(seconds)

    def _faults(self, status: int, number: int, out: str, err: str, seconds: float, mark: str) -> list[str]:
        lines = err.strip().splitlines()
        found = []
        if status not in (0, 128 + number):
            found.append(f"status {status}: {lines[-3:]}")
        if seconds > SECONDS and status != 0:
            found.append(f"hang of {seconds:.1f} s: {out.splitlines()[-2:]} {lines[-2:]}")
        if "Traceback" in err or len(lines) > 1:
            found.append(f"traceback or more than a line: {lines[-4:]}")
        if status and not (lines or "stopped" in out):
            found.append("silent")
        if left := _marked(mark):
            found.append(f"left {left}")
        return found + ([] if self.name == "view" else self._lost(status))

    def _lost(self, status: int) -> list[str]:
        """Epochs without a checkpoint, and differences from an undisturbed run."""
        if status == 0 or (self.name == "train" and (self.out / run_folder.RESULT_FILE).exists()):
            self.ended += 1
            right = self._left(self.out) == self.right
            shutil.rmtree(self.out)
            return [] if right else ["lost: the end is another"]
        lost = []
        for table in self.out.rglob(run_folder.METRICS_FILE):
            epochs = len(table.read_text().splitlines()) - 1
            saved = run_folder.checkpoints(table.parent)
            if epochs > 0 and not (table.parent / run_folder.RESULT_FILE).exists():
                at = run_folder.epoch_of(saved[0]) if saved else 0
                lost += [f"lost: epochs {at} to {epochs} of {table.parent.name}"] * (at != epochs)
        return lost


def _send(send, pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):  # it has ended
        send(pid, number)


def _handles(pid: int) -> bool:
    """Whether a process has a handler for SIGTERM."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    caught = next((line.split()[1] for line in text.splitlines() if line.startswith("SigCgt")), "0")
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def _marked(mark: str) -> list[str]:
    """Programs with the mark in their environment, two seconds after the command has ended."""
    for _ in range(20):
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            try:
                if f"MARK={mark}".encode() in (path / "environ").read_bytes():
                    found.append((path / "cmdline").read_text().replace("\0", " ")[:60])
            except OSError:
                continue
        if not found:
            return []
        time.sleep(0.1)
    return found


def signals(folder: Path, count: int, seed: int, workers: int) -> tuple[str, str, list[str]]:
    """Sends `count` signals to each command."""
    folder.mkdir(parents=True)
    names = [name for name in COMMANDS if name != "ray" or importlib.util.find_spec("ray")]

    def every(name: str) -> Trials:
        trials = Trials(name, folder, random.Random(f"{seed} {name}"))
        for _ in range(count):
            trials.run()
        return trials

    with ThreadPoolExecutor(workers) as pool:
        done = list(pool.map(every, names))
    told = "; ".join(f"{x.name} {x.stopped} stopped, {x.ended} ended, {max(x.seconds, default=0):.1f} s at most" for x in done)
    sent = f"{count} SIGINTs, SIGTERMs and SIGHUPs at random moments of each command"
    return sent, told, [fault for trials in done for fault in trials.faults]
