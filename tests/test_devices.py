"""Several devices: a CPU stands for four of them, in a process of its own."""

import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

from mjx_dher.runs.folder import restoring


def run_on_four_devices(marker, seconds):
    flags = "--xla_force_host_platform_device_count=4 --xla_cpu_enable_concurrency_optimized_scheduler=false"
    process = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-m", marker, "-p", "no:cacheprovider", "tests/on_four_devices.py"],
        env={**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    assert " passed" in process.stdout


@pytest.mark.slow
def test_on_four_devices():
    run_on_four_devices("not slow", 600)


@pytest.mark.slow
def test_on_four_devices_at_length():
    run_on_four_devices("slow", 1800)


def test_lanes_of_a_checkpoint_are_filled_up_or_left_out():
    """Four lanes of three runs have the last one twice; one run alone has no axis."""
    one = {".env_steps": np.int32(7), ".learner.w": np.arange(3.0)}
    three = {name: np.stack([array + i for i in range(3)]) for name, array in one.items()}
    four = {name: np.concatenate([array, array[-1:]]) for name, array in three.items()}
    alone = {name: np.asarray(array)[None] for name, array in one.items()}
    one = {name: np.asarray(array) for name, array in one.items()}
    for before, after, runs, expected in (
        (three, four, 3, four),
        (four, three, 3, three),
        (one, alone, 1, alone),
        (four, one, 1, one),
        (four, three, 4, four),  # of other runs: who restores them refuses them
        (three, one, 3, three),
    ):
        found = restoring._fit_lanes(before, after, runs)
        assert found.keys() == expected.keys()
        for name in expected:
            np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
