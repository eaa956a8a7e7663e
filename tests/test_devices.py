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
        found = restoring._fit_lanes(before, after, range(runs))
        assert found.keys() == expected.keys()
        for name in expected:
            np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


def dealt(cursors, sizes, rows, devices):
    """Actions, which name their episodes, cursors and sizes after `_deal`. The rings are as `replay.add` fills them."""
    number, own = len(cursors), rows // len(cursors)
    before = {
        ".env_steps": np.int32(600),
        ".replay.priority": np.zeros(rows, np.float32),
        ".replay.cursor": np.array(cursors, np.int32).reshape(() if number == 1 else number),
        ".replay.size": np.array(sizes, np.int32).reshape(() if number == 1 else number),
        ".replay.episodes.action": np.zeros((rows, 2), np.float32),
    }
    for ring, (cursor, size) in enumerate(zip(cursors, sizes)):
        for age in range(size):
            before[".replay.episodes.action"][ring * own + (cursor - 1 - age) % own] = 100 * (ring + 1) + age
    counter = np.zeros(() if devices == 1 else devices, np.int32)
    after = before | {".replay.cursor": counter, ".replay.size": counter}
    found = restoring._deal({name: np.asarray(x) for name, x in before.items()}, after)
    assert found.keys() == before.keys()
    assert all(found[name].shape == after[name].shape and found[name].dtype == after[name].dtype for name in after)
    rings = found[".replay.episodes.action"][:, 0].reshape(devices, -1).tolist()
    return rings, found[".replay.cursor"].tolist(), found[".replay.size"].tolist(), int(found[".env_steps"])


def test_rings_are_dealt_to_other_devices():
    """100 is the newest episode of the first ring, 201 the second newest of the second."""
    # The first ring was full and has wrapped, the second is not full. One device has made as many steps as both.
    assert dealt([1, 2], [4, 2], 8, 1) == ([[103, 102, 201, 101, 200, 100, 0, 0]], 6, 6, 1200)
    # One ring to two: every other episode, oldest first, so that the next write replaces the oldest.
    assert dealt([1], [6], 6, 2) == ([[104, 102, 100], [105, 103, 101]], [0, 0], [3, 3], 300)
    # Four rings to two; an empty one has no part.
    assert dealt([1, 0, 1, 1], [1, 0, 2, 1], 8, 2) == ([[400, 100, 0, 0], [301, 300, 0, 0]], [2, 2], [2, 2], 1200)
