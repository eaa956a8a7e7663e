"""bench/peers.py: its arguments, budget and files, without the peers; with them, in a slow test, where they are there."""

import csv
import json
import sys
import types

import numpy as np
import pytest
from conftest import ROOT, refuses

from mjx_dher.system.machine import user_cache
from mjx_dher.tools import transfer

WORKER = """
import json, sys
print(json.dumps({"started": True}))
for i in (1, 2):
    means = {"success_rate": i / 10, "return_mean": -40.0}
    print(json.dumps({"seconds": 10.0 * i, "evaluation": 1.0, "env_steps": 100 * i, "updates": 50 * i, **means}))
print(json.dumps({"result": {"final_success": [1, 0], "final_return": [-10.0, -50.0]}}))
"""
# Writes an epoch every 0.3 s until it is told to stop, as train.py does.
TRAIN = """
import pathlib, signal, sys, time
from mjx_dher import RunSpec
from mjx_dher.runs.folder import loggers, run_folder
stopped = []
signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
folder = pathlib.Path(next(arg for arg in sys.argv if arg.startswith("--out="))[6:])
run_folder.write_config(folder, RunSpec(env="push"), "native", {})
sink = loggers.CsvSink(folder / "metrics.csv")
for epoch in range(1, 40):
    time.sleep(0.3)
    means = {"success_rate": 0.5, "return_mean": -30.0}
    sink.write({"epoch": epoch, "env_steps": 100 * epoch, "updates": epoch, "wall_seconds": 0.3 * epoch, **means})
    if stopped:
        sys.exit(128 + signal.SIGTERM)
"""


@pytest.fixture
def peers(monkeypatch):
    """The script as a module, which leaves the cores of this process alone."""
    monkeypatch.syspath_prepend(ROOT / "bench")
    import peers

    monkeypatch.setattr(peers, "pin", lambda cores: None)
    return peers


@pytest.fixture
def args(peers, tmp_path):
    args = peers.parse(["--minutes", "0.02", "--final-episodes", "2", "--out", str(tmp_path / "out")])
    args.out.mkdir()
    return args


@pytest.mark.parametrize(
    ("argv", "parts"),
    [
        (["--env", "reach"], ["--env", "reach", "push", "pick_and_place", "slide"]),
        (["--peers", "ddpg"], ["--peers", "ddpg", "tqc", "sac"]),
        (["--minutes", "0"], ["minutes", "(0, 10000]", "0.0"]),
        (["--minutes", "nan"], ["minutes", "nan"]),
        (["--seeds", "0"], ["seeds", "[1, 1000000]", "0"]),
        (["--final-episodes", "0"], ["final-episodes", "[1, 1000000]", "0"]),
        (["--eval-every", "-1"], ["eval-every", "-1"]),
        (["--out", str(ROOT / "docs")], ["out", "docs", "exists already"]),
        (["--peer-set", "tua=0.1"], ["peer-set", "tua", "did you mean 'tau'"]),
        (["--peer-set", "tau=2"], ["peer-set tau", "(0, 1]", "2"]),
        (["--peer-set", "batch_size=1.5"], ["peer-set batch_size", "1.5"]),
        (["--peer-set", "batch_size"], ["peer-set batch_size", "JSON", "2048"]),
        (["--peer-set", "net_arch=256"], ["peer-set net_arch", "[512, 512, 512]", "256"]),
        (["--peer-set", "n_envs=32"], ["peer-set learning_starts", "n_envs"]),
    ],
)
def test_bad_arguments_are_refused(peers, capsys, argv, parts):
    with pytest.raises(SystemExit) as error:
        peers.parse(argv)
    assert error.value.code == 2
    message = capsys.readouterr().err
    assert all(part in message for part in parts), message


def test_more_cores_than_there_are_are_refused(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import peers

    with refuses("cores", 10_000):
        peers.pin(10_000)


def test_settings_change_by_name(peers):
    settings = peers.read_settings(["batch_size=256", "net_arch=[64,32]", "learning_rate=3e-4"])
    assert {name for name in settings if settings[name] != peers.ZOO[name]} == {"batch_size", "net_arch", "learning_rate"}
    assert settings["net_arch"] == [64, 32]


def test_a_python_without_the_peers_is_refused_and_a_failed_set_up_told(peers, monkeypatch, tmp_path):
    with refuses("no_python", "gymnasium-robotics", "stable-baselines3"):
        peers.find_python(tmp_path / "no_python")

    def fail(environment, requirements):
        raise ValueError("no network")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(transfer, "set_up", fail)
    with refuses("no network", "pip", "--python"):
        peers.find_python(None)


def test_a_peer_s_lines_become_a_run(peers, args, monkeypatch):
    args.settings["tau"] = 0.1
    requests = []

    def worker(python, **request):
        requests.append(request)
        return (sys.executable, "-c", WORKER)

    monkeypatch.setattr(peers, "worker", worker)
    run = peers.train_theirs(args, "tqc", 3, sys.executable)
    assert (run.who, run.env, run.seed) == ("sb3-contrib TQC tau=0.1", "push", 3)
    assert [row["env_steps"] for row in run.rows] == [100, 200]
    assert (run.final_success, run.final_return) == ([1, 0], [-10.0, -50.0])
    (request,) = requests
    assert (request["task"], request["seconds"], request["final"]) == ("FetchPush-v4", 1.2, 2)
    assert request["settings"]["tau"] == 0.1


def test_a_peer_that_fails_is_told_with_the_end_of_its_log(peers, args, monkeypatch):
    monkeypatch.setattr(peers, "worker", lambda python, **request: (sys.executable, "-c", "raise SystemExit('no torch')"))
    with refuses("sac_seed0", 1, "no torch"):
        peers.train_theirs(args, "sac", 0, sys.executable)


def test_ours_is_stopped_when_the_budget_ends(peers, args, monkeypatch, tmp_path):
    (tmp_path / "train.py").write_text(TRAIN)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(peers, "HERE", tmp_path / "bench")
    outcome = {"success": np.array([True, False]), "ret": np.array([-5.0, -50.0])}
    monkeypatch.setattr(transfer, "play_apart", lambda *given: outcome)
    run = peers.train_ours(args, 0, sys.executable)
    assert run.who == "mjx-dher ddpg future"
    assert 1.2 <= run.rows[-1]["seconds"] < 4
    assert run.rows[-1]["env_steps"] == 100 * len(run.rows)
    assert run.final_success == [1, 0]
    assert 0 < run.startup < 60


def test_the_files_hold_every_evaluation(peers, tmp_path, capsys):
    runs = []
    for seed, who in enumerate(("ours", "theirs")):
        run = peers.Run(who, "push", seed, startup=1.0, final_success=[1, 1, 0], final_return=[-3.0, -4.0, -50.0])
        for i in (1, 2):
            run.add(seconds=60.0 * i, env_steps=1_234_500 * i, updates=i, success_rate=0.45 * i, return_mean=-20.0)
        runs.append(run)
    peers.write_csv(runs, tmp_path / "success.csv")
    peers.draw(runs, tmp_path / "success.png", episodes=100)
    with (tmp_path / "success.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == ("who", "env", "seed", "seconds", "env_steps", "success_rate", "return_mean")
    assert list(rows[3].values()) == ["theirs", "push", "1", "120", "2469000", "0.9", "-20"]
    assert (tmp_path / "success.png").read_bytes().startswith(b"\x89PNG")
    peers.print_runs(runs)
    table = capsys.readouterr().out
    assert "120" in table
    assert "0.667 (" in table


@pytest.mark.slow
def test_the_peers_train(peers, tmp_path):
    """Where their environment is there; making it takes a download."""
    python = transfer.interpreter(user_cache() / "peers")
    if not transfer.is_ready(python, peers.REQUIREMENTS):
        pytest.skip("bench/peers.py has not made the peers' environment")
    settings = {**peers.ZOO, "batch_size": 64, "net_arch": [32]}
    options = {"minutes": 0.1, "eval_every": 3.0, "episodes": 10, "final_episodes": 10}
    args = types.SimpleNamespace(env="push", out=tmp_path, settings=settings, **options)
    run = peers.train_theirs(args, "sac", 0, python)
    assert run.rows[-1]["seconds"] >= 6
    assert run.rows[-1]["updates"] > 0
    assert len(run.final_success) == 10
    assert json.dumps(run.final_return)
