"""Random actions of full strength, by the benchmark that users can run for longer."""

import subprocess
import sys
from pathlib import Path

import jax
import pytest

SCRIPT = Path(__file__).parent.parent / "bench" / "bang_bang.py"


def survives(*args: str) -> None:
    done = subprocess.run([sys.executable, SCRIPT, *args], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_physics_survives_10_000_slams_a_task():
    survives("--actions", "10000")


@pytest.mark.slow
@pytest.mark.parametrize("task", ["reach", "push", "pick_and_place", "slide"])
@pytest.mark.parametrize("engine", ["native", "jax", "warp"])
def test_physics_survives_a_million_slams(task, engine, request):
    if (task, engine) == ("slide", "native"):
        request.applymarker(pytest.mark.xfail(strict=True, reason="the puck sinks 63 mm once; see bench/README.md"))
    if engine == "warp" and jax.default_backend() == "cpu":
        pytest.skip("warp needs an NVIDIA GPU")
    survives("--tasks", task, "--engine", engine, "--actions", "1000000")
