"""Transfer to the original tasks: what can be tested without them; with them, in a slow test."""

import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import refuses, save_policy

from mjx_dher import RunSpec, cli, policy
from mjx_dher.runs.folder import run_folder
from mjx_dher.system import subprocesses
from mjx_dher.tools import transfer


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder of `reach` with a policy written by hand: moved by the gripper's place and the goal's, at random."""
    out = tmp_path_factory.mktemp("runs") / "reach"
    run_folder.write_config(out, RunSpec(env="reach", engine="native"), "native", {})
    kernel = np.random.default_rng(0).normal(size=(13, 4)).astype(np.float32)
    random = policy.Policy(
        layers=((kernel, np.zeros(4, np.float32)),),
        observation_mean=np.zeros(10),
        observation_std=np.ones(10),
        goal_mean=np.zeros(3),
        goal_std=np.ones(3),
        norm_clip=5.0,
        obs_clip=200.0,
    )
    save_policy(out, random)
    return out


def test_a_python_without_the_originals_is_refused(run, capsys):
    """The Python of the tests has a MuJoCo that is too new."""
    assert cli.main(["transfer", str(run), "--python", sys.executable]) == 2
    message = capsys.readouterr().err
    assert "gymnasium-robotics==1.4.2 and mujoco==3.11.0" in message
    assert "--set-up" in message
    assert cli.main(["transfer", str(run), "--python", "/no/such/python"]) == 2
    assert "/no/such/python does not have them" in capsys.readouterr().err


def test_files_of_the_current_folder_are_not_modules_of_the_other_python(tmp_path, monkeypatch):
    for name in ("email", "importlib", "this"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    installed = f"numpy=={np.__version__}"
    assert transfer.is_ready(Path(sys.executable), (installed,))
    answer = subprocesses.ask(transfer._running(Path(sys.executable), "this"))
    assert answer.failure is None
    assert "The Zen of Python" in answer.out


def test_a_task_without_an_original_is_refused_before_the_download(tmp_path, monkeypatch, capsys):
    with refuses("point_mass", "push"):
        transfer.check_original("point_mass", Path(sys.executable))
    run_folder.write_config(tmp_path, RunSpec(env="arm_reach", engine="native"), "native", {})
    save_policy(tmp_path)
    monkeypatch.delattr(transfer, "set_up")
    assert cli.main(["transfer", str(tmp_path), "--set-up"]) == 2
    assert "arm_reach has no original" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (["/no/such/run"], ["/no/such/run", "is not a run folder"]),
        (["{run}", "--episodes", "0"], ["episodes", "[1, 1000000]", "got 0"]),
        (["{run}", "--engine", "wrap"], ["engine", "'wrap'", "auto, native, jax, warp"]),
    ],
)
def test_bad_arguments_are_refused(run, capsys, args, parts):
    assert cli.main(["transfer", *(arg.format(run=run) for arg in args)]) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in parts), error


@pytest.mark.slow
def test_a_policy_is_played_in_the_original(run, tmp_path, monkeypatch, capsys):
    """Needs a network: sets up the originals' environment."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cli.main(["transfer", str(run), "--episodes", "5", "--set-up"]) == 0
    shown = capsys.readouterr().out
    assert "FetchReach-v4, 5 episodes" in shown
    assert "there minus here" in shown
    python = transfer.interpreter(transfer.default_environment())
    alone = transfer.play_apart(run, python, 5, seed=3, workers=1)
    shared = transfer.play_apart(run, python, 5, seed=3, workers=2)
    assert alone.keys() == {"success", "reset_success", "ret"}
    for name in alone:
        np.testing.assert_array_equal(alone[name], shared[name])
