"""Processes of one JAX program: what they tell each other, and how users' commands end, resume and share a sweep."""

import csv
import json
import os
import re
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import ROOT, free_port

from mjx_dher.cli import main
from mjx_dher.parallel import processes
from mjx_dher.runs.folder import results

TALK = """
import os, jax, numpy as np, psutil
from jax.sharding import NamedSharding, PartitionSpec
from mjx_dher.parallel import processes

processes.connect()
first = processes.leads()
assert first == (jax.process_index() == 0)
address, _, port = os.environ["JAX_COORDINATOR_ADDRESS"].rpartition(":")
listening = [one.laddr for one in psutil.Process().net_connections() if one.status == psutil.CONN_LISTEN]
assert [one.ip.removeprefix("::ffff:") for one in listening if one.port == int(port)] == [address] * first
assert processes.broadcast(lambda: {"a": [1, "x" * 3000]}) == {"a": [1, "x" * 3000]}
assert [processes.any_process(flag) for flag in (first, not first, False)] == [True, True, False]

def told(call):
    try:
        call()
    except ValueError as error:
        return str(error)

def fails():
    raise ValueError("no")

assert told(lambda: processes.broadcast(fails)) == ("no" if first else "process 0: no")
assert told(lambda: processes.check_equal({"gamma": 1})) is None
assert "gamma is 1 in process 0 and " in told(lambda: processes.check_equal({"gamma": 1 if first else 2})) or first
whole = np.arange(18.0).reshape(6, 3)
sharding = NamedSharding(jax.make_mesh((2,), ("a",), (jax.sharding.AxisType.Auto,)), PartitionSpec("a"))
array = jax.make_array_from_callback((6, 3), sharding, lambda index: whole[index])
for processes._PIECE in (1, 50, 1 << 20):
    assert (processes.fetch({"w": array, "n": np.ones(2)})["w"] == whole).all()
    collected = processes.collect([array])
    assert (collected[0] == whole).all() if first else collected is None
"""


def run_pair(port, *command):
    """Starts a Python command as the two processes of a program."""
    place = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port}", "JAX_NUM_PROCESSES": "2", "JAX_PLATFORMS": "cpu"}
    return [
        subprocess.Popen(
            [sys.executable, *map(str, own)],
            cwd=ROOT,
            env={**os.environ, **place, "JAX_PROCESS_ID": str(number)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for number, own in enumerate(command if isinstance(command[0], tuple) else (command, command))
    ]


def test_what_two_processes_tell_each_other():
    pair = run_pair(free_port(), "-c", TALK)
    outputs = [process.communicate(timeout=120)[0] for process in pair]
    assert [process.returncode for process in pair] == [0, 0], outputs


def test_one_process_asks_nobody():
    assert processes.broadcast(lambda: 3) == 3
    assert processes.any_process(True)
    assert not processes.any_process(False)
    assert processes.fetch([np.ones(1)])[0] == processes.collect([np.ones(1)])[0] == 1.0


def test_processes_that_cannot_be_joined_are_rejected(tmp_path, capsys, monkeypatch):
    out = ["--out", str(tmp_path / "run")]
    for arguments, field in (
        (["train", "--distributed"], "out must name the run folder"),
        (["train", "--distributed", *out], "distributed: "),
        (["sweep", "--distributed", *out], "distributed: "),
        (["train", "--devices", "0", *out], "devices must be"),
    ):
        assert main(arguments) == 2
        assert field in capsys.readouterr().err
    for address in ("", "127.0.0.1", ":9876", "127.0.0.1:x", "127.0.0.1:99999"):  # JAX would take the last for 34463
        monkeypatch.setenv("JAX_COORDINATOR_ADDRESS", address)
        assert main(["train", "--distributed", *out]) == 2
        assert "JAX_COORDINATOR_ADDRESS" in capsys.readouterr().err
    monkeypatch.setenv("JAX_NUM_PROCESSES", "nan")
    assert main(["train", "--distributed", *out]) == 2
    assert "JAX_NUM_PROCESSES" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


REACH = (
    *("--env", "reach", "--engine", "native", "--num-envs", "4", "--cycles-per-epoch", "2", "--updates-per-cycle", "8"),
    *("--target-period", "8", "--batch-size", "32", "--replay-size", "4000", "--hidden-sizes", "32", "--eval-episodes", "6"),
    *("--final-episodes", "20", "--checkpoint-every", "1"),
)


def call(*arguments, **variables):
    """Starts train.py alone."""
    return subprocess.Popen(
        [sys.executable, "train.py", *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu", **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def start_pair(*arguments):
    return run_pair(free_port(), "train.py", *arguments, "--distributed", "--devices", "all")


def both(*arguments):
    """Returns what two processes with the same arguments print; they must end well."""
    pair = start_pair(*arguments)
    outputs = [process.communicate(timeout=500)[0] for process in pair]
    assert [process.returncode for process in pair] == [0, 0], outputs
    return outputs


def rows_of(folder):
    return results.read_rows(folder / "metrics.csv")


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_two_processes_train_reach_and_one_is_killed(tmp_path, victim):
    """JAX ends the other within a minute or so; the same command resumes from the last checkpoint."""
    folder = tmp_path / "run"
    command = (*REACH, "--out", folder, "--total-steps", "16000")  # 40 epochs
    pair = start_pair(*command)
    deadline = time.monotonic() + 500
    while not (folder / "checkpoints").exists() or len(rows_of(folder)) < 3:
        assert time.monotonic() < deadline
        assert [process.poll() for process in pair] == [None, None], [process.communicate() for process in pair]
        time.sleep(0.2)
    pair[victim].kill()
    output, _ = pair[1 - victim].communicate(timeout=120)
    assert pair[1 - victim].returncode != 0, output
    pair[victim].communicate()
    before = len(rows_of(folder))
    assert 3 <= before < 40
    first, second = both(*command)
    epoch = int(re.search(r"resuming from .* after epoch (\d+)", first)[1])
    assert before - 2 <= epoch <= before
    assert [row["epoch"] for row in rows_of(folder)] == list(range(1, 41))
    assert json.loads((folder / "result.json").read_text())["status"] == "finished"
    assert "epoch" not in second  # the first process alone prints


@pytest.mark.slow
def test_two_processes_train_as_two_devices_of_one_do(tmp_path):
    steps = ("--total-steps", "800")
    both(*REACH, "--out", tmp_path / "two", *steps)
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    alone = call(*REACH, "--out", tmp_path / "one", "--devices", "2", *steps, XLA_FLAGS=flags)
    output, _ = alone.communicate(timeout=500)
    assert alone.returncode == 0, output
    rows = [rows_of(tmp_path / name) for name in ("one", "two")]
    assert len(rows[0]) == 2
    for one, two in zip(*rows):
        for name in ("success_rate", "return_mean", "train_return_mean", "critic_loss", "actor_norm", "relabel_distance"):
            assert one[name] == pytest.approx(two[name], rel=1e-3), name


@pytest.mark.slow
def test_processes_with_other_settings_are_rejected_before_anything_is_trained(tmp_path):
    command = ("train.py", *REACH, "--out", tmp_path / "run", "--distributed", "--gamma")
    pair = run_pair(free_port(), (*command, "0.98"), (*command, "0.9"))
    outputs = [process.communicate(timeout=120)[0] for process in pair]
    assert [process.returncode for process in pair] == [2, 2], outputs
    assert "gamma is 0.98 in process 0 and 0.9 here" in outputs[1]
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_two_processes_share_the_runs_of_a_sweep(tmp_path):
    """Each trains runs of its own; the first writes all, and the curves are those of one program."""
    arguments = ("sweep", *REACH, "--total-steps", "800", "--sampler", "future", "closest", "--seeds", "2")
    _, second = both(*arguments, "--out", tmp_path / "two")
    assert "epoch" not in second
    one = call(*arguments, "--out", tmp_path / "one")
    assert one.wait(500) == 0, one.communicate()
    tables = [read_table(tmp_path / name / "results.csv") for name in ("one", "two")]
    assert len(tables[0]) == 4 * 2  # epochs
    for alone, shared in zip(*tables):
        assert [alone[name] for name in ("sampler", "seed", "epoch")] == [shared[name] for name in ("sampler", "seed", "epoch")]
        assert float(alone["return_mean"]) == pytest.approx(float(shared["return_mean"]), rel=1e-3)
    again, _ = both(*arguments, "--out", tmp_path / "two")
    assert "compiling" not in again


@pytest.mark.slow
def test_two_processes_resume_a_run(tmp_path):
    """SIGTERM to either stops both, with a checkpoint."""
    folder = tmp_path / "run"
    pair = start_pair(*REACH, "--out", folder, "--total-steps", "16000")
    deadline = time.monotonic() + 300
    while len(rows_of(folder) if (folder / "metrics.csv").exists() else ()) < 2:
        assert time.monotonic() < deadline
        assert [process.poll() for process in pair] == [None, None], [process.communicate() for process in pair]
        time.sleep(0.1)
    pair[1].terminate()
    outputs = [process.communicate(timeout=120)[0] for process in pair]
    assert [process.returncode for process in pair] == [143, 143], outputs
    pair = run_pair(free_port(), "train.py", "resume", folder, "--distributed")
    first, second = (process.communicate(timeout=500)[0] for process in pair)
    assert [process.returncode for process in pair] == [0, 0], first + second
    assert "resuming from" in first
    assert "epoch" not in second
    assert [row["epoch"] for row in rows_of(folder)] == list(range(1, 41))
    assert json.loads((folder / "result.json").read_text())["status"] == "finished"


def read_table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
