"""Transfer to the original tasks: what can be tested without them; with them, in a slow test."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mjx_dher import cli
from mjx_dher.tools import originals


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder of `reach`, hardly trained."""
    out = tmp_path_factory.mktemp("runs") / "reach"
    small = "--num-envs 2 --cycles-per-epoch 1 --updates-per-cycle 1 --target-period 1 --batch-size 8 --replay-size 200"
    small += " --total-steps 100 --eval-episodes 2 --final-episodes 2 --hidden-sizes 8"
    assert cli.main(["--env", "reach", *small.split(), "--out", str(out)]) == 0
    return out


def test_a_python_without_the_originals_is_refused(run, capsys):
    """The Python of the tests has a MuJoCo that is too new."""
    assert cli.main(["transfer", str(run), "--python", sys.executable]) == 2
    message = capsys.readouterr().err
    assert "gymnasium-robotics==1.4.2 and mujoco==3.11.0" in message
    assert "--set-up" in message
    assert cli.main(["transfer", str(run), "--python", "/no/such/python"]) == 2
    assert "/no/such/python does not have them" in capsys.readouterr().err


def test_a_task_without_an_original_is_refused():
    with pytest.raises(ValueError, match="point_mass has no original to transfer to; the tasks that have: push, "):
        originals.check("point_mass", Path(sys.executable))


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["/no/such/run"], "is not a run folder"),
        (["{run}", "--episodes", "0"], "episodes must be an integer of at least 1"),
    ],
)
def test_bad_arguments_are_refused(run, capsys, args, message):
    assert cli.main(["transfer", *(arg.format(run=run) for arg in args)]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_policy_is_played_in_the_original(run, tmp_path, monkeypatch, capsys):
    """Needs a network: sets up the originals' environment."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cli.main(["transfer", str(run), "--episodes", "5", "--set-up"]) == 0
    shown = capsys.readouterr().out
    assert "FetchReach-v4, 5 episodes" in shown
    assert "there minus here" in shown
    python = originals.interpreter(originals.default_environment())
    alone = originals.play_apart(run, python, 5, seed=3, workers=1)
    shared = originals.play_apart(run, python, 5, seed=3, workers=2)
    assert alone.keys() == {"success", "reset_success", "ret"}
    for name in alone:
        np.testing.assert_array_equal(alone[name], shared[name])
