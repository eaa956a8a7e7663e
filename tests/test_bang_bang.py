"""Random actions of full strength, by the benchmark that users can run for longer."""

import os
import subprocess
import sys

import jax
import pytest
from conftest import ROOT

TASKS = ("reach", "push", "pick_and_place", "slide", "hand_reach", "block_rotate_xyz", "egg_rotate", "pen_rotate")
SCRIPT = ROOT / "bench" / "bang_bang.py"


def survives(*args: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}  # this checkout, whichever is installed
    done = subprocess.run([sys.executable, SCRIPT, *args], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_physics_survives_10_000_slams(task):
    survives("--tasks", task, "--actions", "10000")


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("engine", ["native", "jax", "warp"])
def test_physics_survives_a_million_slams(task, engine, request):
    if (task, engine) == ("slide", "native"):
        request.applymarker(pytest.mark.xfail(strict=True, reason="the puck sinks 63 mm once; see bench/slams.md"))
    if engine == "warp" and jax.default_backend() == "cpu":
        pytest.skip("warp needs an NVIDIA GPU")
    survives("--tasks", task, "--engine", engine, "--actions", "1000000")
