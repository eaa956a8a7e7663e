"""Processes of JAX that train together, as users start them: how they end, go on, and share a sweep."""

import csv
import json
import os
import re
import subprocess
import sys
import time

import pytest
from conftest import ROOT, free_port

from mjx_dher.runs.folder import loggers
from mjx_dher.system import line

pytestmark = pytest.mark.slow


REACH = (
    *("--env", "reach", "--engine", "native", "--num-envs", "4", "--cycles-per-epoch", "2", "--updates-per-cycle", "8"),
    *("--target-period", "8", "--batch-size", "32", "--replay-size", "4000", "--hidden-sizes", "32", "--eval-episodes", "6"),
    *("--final-episodes", "20", "--checkpoint-every", "1"),
)


def start(folder, number, port, *arguments, processes=2):
    return call(number, port, *REACH, "--out", folder, *arguments, processes=processes)


def call(number, port, *arguments, processes=2):
    """Starts train.py as one of so many processes."""
    command = [sys.executable, "train.py", *arguments]
    place = ["--coordinator", f"127.0.0.1:{port}", "--num-processes", str(processes), "--process-id", str(number)]
    return subprocess.Popen(
        [*map(str, command), *(place if processes > 1 else ())],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def rows_of(folder):
    return loggers.read_rows(folder / "metrics.csv")


@pytest.mark.parametrize("victim", [0, 1])
def test_two_processes_train_reach_and_one_is_killed(tmp_path, victim):
    """The other ends within a minute; the same command goes on from the last checkpoint, and ends."""
    folder, port = tmp_path / "run", free_port()
    steps = ("--total-steps", "16000")  # 40 epochs
    pair = [start(folder, number, port, *steps) for number in (0, 1)]
    deadline = time.monotonic() + 500
    while not (folder / "checkpoints").exists() or len(rows_of(folder)) < 3:
        assert time.monotonic() < deadline
        assert [process.poll() for process in pair] == [None, None], [process.communicate() for process in pair]
        time.sleep(0.2)
    pair[victim].kill()
    killed = time.monotonic()
    output, _ = pair[1 - victim].communicate(timeout=60)
    assert time.monotonic() - killed < 60
    assert pair[1 - victim].returncode == line.GONE, output
    assert f"error: process {victim} is gone" in output
    assert "the same command goes on from the last checkpoint" in output
    pair[victim].communicate()
    before = len(rows_of(folder))
    assert 3 <= before < 40

    pair = [start(folder, number, port, *steps) for number in (0, 1)]
    first, second = (process.communicate(timeout=500)[0] for process in pair)
    assert [process.returncode for process in pair] == [0, 0], first + second
    epoch = int(re.search(r"going on from .* after epoch (\d+)", first)[1])
    assert before - 2 <= epoch <= before
    assert [row["epoch"] for row in rows_of(folder)] == list(range(1, 41))
    result = json.loads((folder / "result.json").read_text())
    assert result["status"] == "finished"
    assert "epoch" not in second  # the first process alone tells


def test_two_processes_train_as_two_devices_of_one_do(tmp_path):
    port, steps = free_port(), ("--total-steps", "800")
    pair = [start(tmp_path / "two", number, port, *steps) for number in (0, 1)]
    outputs = [process.communicate(timeout=500)[0] for process in pair]
    assert [process.returncode for process in pair] == [0, 0], outputs
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    os.environ["XLA_FLAGS"], flags = flags, os.environ.get("XLA_FLAGS", "")
    try:
        alone = start(tmp_path / "one", 0, port, "--devices", "2", *steps, processes=1)
    finally:
        os.environ["XLA_FLAGS"] = flags
    output, _ = alone.communicate(timeout=500)
    assert alone.returncode == 0, output
    rows = [rows_of(tmp_path / name) for name in ("one", "two")]
    assert len(rows[0]) == 2
    for one, two in zip(*rows):
        for name in ("success_rate", "return_mean", "train_return_mean", "critic_loss", "actor_norm", "relabel_distance"):
            assert one[name] == pytest.approx(two[name], rel=1e-3), name


def test_processes_with_other_settings_are_refused_before_anything_is_trained(tmp_path):
    port = free_port()
    pair = [start(tmp_path / "run", n, port, "--total-steps", "800", "--gamma", gamma) for n, gamma in ((0, 0.98), (1, 0.9))]
    for process in pair:
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 2, output
        assert "all processes must be started alike: gamma is 0.98 in process 0, and 0.9 in process 1" in output
    assert not (tmp_path / "run").exists()


def both(port, *arguments):
    """Returns what two processes with the same arguments print; they must end well."""
    pair = [call(number, port, *arguments) for number in (0, 1)]
    outputs = [process.communicate(timeout=500)[0] for process in pair]
    assert [process.returncode for process in pair] == [0, 0], outputs
    return outputs


def test_two_processes_share_the_runs_of_a_sweep(tmp_path):
    """Each trains runs of its own; the first writes all, and the curves are those of one program."""
    arguments = ("sweep", *REACH, "--total-steps", "800", "--sampler", "future", "closest", "--seeds", "2")
    _, second = both(free_port(), *arguments, "--out", tmp_path / "two", "--devices", "all")
    assert "epoch" not in second
    one = call(0, 0, *arguments, "--out", tmp_path / "one", processes=1)
    assert one.wait(500) == 0, one.communicate()
    tables = [read_table(tmp_path / name / "results.csv") for name in ("one", "two")]
    assert len(tables[0]) == 4 * 2  # epochs
    for alone, shared in zip(*tables):
        assert [alone[name] for name in ("sampler", "seed", "epoch")] == [shared[name] for name in ("sampler", "seed", "epoch")]
        assert float(alone["return_mean"]) == pytest.approx(float(shared["return_mean"]), rel=1e-3)
    again, _ = both(free_port(), *arguments, "--out", tmp_path / "two", "--devices", "all")
    assert "compiling" not in again


def test_two_processes_go_on_with_a_run_of_one(tmp_path):
    folder = tmp_path / "run"
    alone = start(folder, 0, 0, "--total-steps", "16000", processes=1)
    deadline = time.monotonic() + 300
    while len(rows_of(folder) if (folder / "metrics.csv").exists() else ()) < 2:
        assert time.monotonic() < deadline
        assert alone.poll() is None, alone.communicate()
        time.sleep(0.1)
    alone.terminate()
    assert alone.wait(120) == 143, alone.communicate()
    first, second = both(free_port(), "resume", folder, "--devices", "all")
    assert "going on from" in first
    assert "epoch" not in second
    assert [row["epoch"] for row in rows_of(folder)] == list(range(1, 41))
    assert json.loads((folder / "result.json").read_text())["status"] == "finished"


def read_table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
