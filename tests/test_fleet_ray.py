"""The real command on a real cluster of Ray: nodes are processes of this machine."""

import importlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest
from conftest import ROOT

pytestmark = pytest.mark.slow
SMALL = """
    --preset cpu --env docs.examples.point_mass:PointMass --num-envs 8 --cycles-per-epoch 3 --updates-per-cycle 4
    --batch-size 32 --total-steps 960 --replay-size 400 --hidden-sizes 16 --eval-episodes 20 --final-episodes 20 --threshold 0.2
""".split()  # noqa: SIM905


@pytest.fixture
def bench(monkeypatch):
    """bench/fleet.py, whose clusters and kills these are."""
    pytest.importorskip("ray")
    monkeypatch.syspath_prepend(ROOT / "bench")
    for name in ("RAY_USAGE_STATS_ENABLED", "RAY_AUTH_MODE", "JAX_PLATFORMS"):  # that it sets
        monkeypatch.setenv(name, "")
    return importlib.reload(importlib.import_module("fleet"))


def refused(bench, out, *flags, seconds=60, leaves=False):
    """Error of a command that must be rejected within so many seconds, with nothing trained."""
    started = time.monotonic()
    command = [sys.executable, "train.py", "sweep", *SMALL, "--seeds", "2", "--out", str(out), *map(str, flags)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2, ended.stdout + ended.stderr
    assert time.monotonic() - started < seconds
    assert "Traceback" not in ended.stderr
    assert not list(out.glob("cells/*")) if leaves else not out.exists()
    return ended.stderr


def test_twenty_four_trials_on_four_nodes_have_the_tables_of_one_program(bench, tmp_path):
    flags = [*SMALL, "--sampler", "future", "weighted", "--seeds", 12]
    bench.finished(bench.sweep(tmp_path / "plain", *flags))
    with bench.Nodes(4) as nodes:
        bench.finished(bench.sweep(tmp_path / "fleet", *flags, "--ray", nodes.address, "--ray-chunk", 3))
        assert nodes.workers() == []
    assert len(bench.of_sweep(tmp_path / "fleet")[1]) == 24  # finals.csv
    assert bench.of_sweep(tmp_path / "plain") == bench.of_sweep(tmp_path / "fleet")
    assert "ray: 4 nodes, 4 parallel tasks, each with 0 GPUs and 1 CPUs; 24 runs" in (tmp_path / "fleet.log").read_text()


def test_kills_of_a_worker_a_node_and_the_driver_cost_no_trial(bench):
    rows = bench.kills(rounds=3, seeds=3, seed=1)
    assert sum(int(row[0]) for row in rows) == 3
    for row in rows:
        assert row[2:5] == ["6 of 6", "the same", "nothing"]


def test_without_a_storage_the_task_is_trained_again(bench, tmp_path):
    flags = [*bench.LONG, 40 * bench.STEPS_PER_EPOCH, "--seeds", 2]
    bench.finished(bench.sweep(tmp_path / "plain", *flags))
    with bench.Nodes(2) as nodes:
        driver = bench.sweep(tmp_path / "fleet", *flags, "--ray", nodes.address, "--ray-chunk", 2)
        deadline = time.monotonic() + 120
        while not nodes.workers() and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(8)
        assert bench.kill("worker", nodes, driver, bench.random.Random(0))
        bench.finished(driver)
    assert bench.of_sweep(tmp_path / "plain") == bench.of_sweep(tmp_path / "fleet")


@pytest.mark.parametrize(
    ("send", "number"), [(os.kill, signal.SIGTERM), (os.killpg, signal.SIGTERM), (os.killpg, signal.SIGHUP)]
)
def test_a_signal_ends_a_fleet_in_order_and_the_same_command_goes_on(bench, tmp_path, send, number):
    """Also one to the group of processes: Ray's are in others."""
    flags = [*bench.LONG, 40 * bench.STEPS_PER_EPOCH, "--seeds", 1, "--ray", "local", "--ray-cpus", 1]
    driver = bench.sweep(tmp_path / "sweep", *flags, start_new_session=True)
    log = tmp_path / "sweep.log"
    deadline = time.monotonic() + 180
    while "train on 1 hosts" not in log.read_text() and time.monotonic() < deadline:
        time.sleep(0.2)
    send(driver.pid, number)
    assert driver.wait(120) == 128 + number
    assert "stopping after this epoch" in log.read_text()
    assert list((tmp_path / "sweep" / "unfinished").glob("fleet-*/*/chunk.json"))
    bench.finished(bench.sweep(tmp_path / "sweep", *flags))
    assert "resuming from" in log.read_text()
    assert not (tmp_path / "sweep" / "unfinished").exists()


def test_nodes_with_another_version_or_storage_of_their_own_are_refused(bench, tmp_path):
    for name in ("mjx_dher", "envs"):
        shutil.copytree(ROOT / name, tmp_path / "old" / name, ignore=shutil.ignore_patterns("__pycache__"))
    start = tmp_path / "old" / "mjx_dher" / "__init__.py"
    start.write_text(start.read_text().replace('__version__ = "', '__version__ = "0.0.'))
    with bench.Nodes(1) as nodes:
        told = refused(bench, tmp_path / "a", "--ray", nodes.address, "--storage", "/proc/nothing")
        assert "storage: /proc/nothing cannot be written to" in told
        told = refused(bench, tmp_path / "b", "--ray", nodes.address, "--ray-cpus", 99)
        assert "no node has 0 GPUs and 99 CPUs for a task; nodes have" in told
        nodes.options["env_vars"] = {"PYTHONPATH": str(tmp_path / "old")}
        nodes.kill_node(0)
        told = refused(bench, tmp_path / "c", "--ray", nodes.address, leaves=True)
        assert "must have the driver's code: version of mjx_dher is 0.0." in told


def test_local_listens_on_loopback_alone_and_keeps_strangers_out(tmp_path, monkeypatch):
    """Every listening socket of Ray's processes, and their folder; a caller without the token of this run."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # too long for a path of Ray's sockets
    pytest.importorskip("ray")
    pytest.importorskip("psutil")
    code = """
import os, pathlib, re, subprocess, sys
from mjx_dher.fleet import cluster
with cluster.joined("local", None) as here:
    here.look(False)  # a worker has started
    import ray, psutil
    assert ray.nodes()[0]["NodeManagerAddress"] == "127.0.0.1"
    family = [psutil.Process(), *psutil.Process().children(recursive=True)]
    listening = [c.laddr for p in family for c in p.net_connections() if c.status == "LISTEN"]
    assert len(listening) > 4
    assert {place.ip for place in listening} <= {"127.0.0.1", "::ffff:127.0.0.1"}, listening
    folder = pathlib.Path(ray._private.worker._global_node.get_temp_dir_path()).parent
    assert folder.stat().st_mode & 0o77 == 0
    call = f"import ray; ray.init(address='{ray.get_runtime_context().gcs_address}')"
    environment = {k: v for k, v in os.environ.items() if k != "RAY_AUTH_TOKEN"} | {"HOME": str(folder / "nobody")}
    stranger = subprocess.run([sys.executable, "-c", call], env=environment, capture_output=True, text=True)
    assert stranger.returncode and "uthentic" in stranger.stderr, stranger.stderr
assert not folder.exists()
"""
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 0, ended.stderr


def test_an_address_where_something_else_answers_is_refused_within_seconds(bench, tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        told = refused(bench, tmp_path / "a", "--ray", f"127.0.0.1:{server.getsockname()[1]}", seconds=40)
    assert "ray: no cluster answers at 127.0.0.1" in told
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # where auto looks first
    assert "ray: no cluster answers at auto" in refused(bench, tmp_path / "b", "--ray", "auto")
