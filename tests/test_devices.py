"""Several devices: a CPU stands for four of them, in a process of its own."""

import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

from mjx_dher.parallel.reshard import regroup


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


def test_on_four_devices():
    run_on_four_devices("not slow", 600)


@pytest.mark.slow
def test_on_four_devices_at_length():
    run_on_four_devices("slow", 1800)


def ring_of(parts, rows, written, lanes=None):
    """Arrays of a ring, as a checkpoint has them, to which episodes 1, 2, ... have gone in turn, `written` of each part."""
    block = rows // parts
    priority = np.zeros(rows, np.float32)
    for part, count in enumerate(written):
        for number in range(count):
            priority[part * block + number % block] = 1 + number * parts + part
    cursor, size = np.array([n % block for n in written]), np.array([min(n, block) for n in written])
    arrays = {
        ".env_steps": np.int32(7),
        ".replay.priority": priority,
        ".replay.episodes.action": np.stack([priority, -priority], 1),
        ".replay.cursor": cursor if parts > 1 else cursor[0],
        ".replay.size": size if parts > 1 else size[0],
        ".learner.w": np.arange(3.0),
    }
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    return arrays if lanes is None else {name: np.stack([array] * lanes) for name, array in arrays.items()}


def assert_equal(found, expected):
    assert found.keys() == expected.keys()
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


@pytest.mark.parametrize("lanes", [None, 2])
def test_one_ring_is_dealt_out(lanes):
    """Eight rows, ten episodes: 3 to 10 are left, and 9 and 10 lie in the first rows."""
    whole, halves = ring_of(1, 8, [10], lanes), ring_of(2, 8, [4, 4], lanes)
    np.testing.assert_array_equal(np.ravel(whole[".replay.priority"])[:8], [9, 10, 3, 4, 5, 6, 7, 8])
    found = regroup(whole, halves, lanes or 1)
    newest_last = np.array([4, 6, 8, 10, 3, 5, 7, 9], np.float32)
    np.testing.assert_array_equal(np.atleast_2d(found[".replay.priority"])[0], newest_last)
    np.testing.assert_array_equal(found[".replay.episodes.action"][..., 1], -found[".replay.priority"])
    np.testing.assert_array_equal(np.atleast_2d(found[".replay.size"])[0], [4, 4])
    np.testing.assert_array_equal(np.atleast_2d(found[".replay.cursor"])[0], [0, 0])
    np.testing.assert_array_equal(found[".learner.w"], whole[".learner.w"])


def test_rings_are_put_together_oldest_first():
    """Of rings that hold 4 and 2 episodes of 4, the newest come last, and what is free is empty."""
    found = regroup(ring_of(2, 8, [5, 2]), ring_of(1, 8, [1]), 1)
    np.testing.assert_array_equal(found[".replay.priority"], [3, 5, 2, 7, 4, 9, 0, 0])
    np.testing.assert_array_equal(found[".replay.episodes.action"][:, 1], -found[".replay.priority"])
    assert found[".replay.size"] == found[".replay.cursor"] == 6


@pytest.mark.parametrize("parts", [1, 2, 4])
def test_a_ring_that_fits_stays_as_it_is(parts):
    arrays = ring_of(parts, 8, [3] * parts)
    assert_equal(regroup(arrays, arrays, 1), arrays)


def test_there_and_back_nothing_is_lost():
    start = ring_of(4, 16, [6, 6, 6, 6])
    back = regroup(regroup(start, ring_of(1, 16, [0]), 1), ring_of(4, 16, [0] * 4), 1)
    held = [sorted(arrays[".replay.priority"]) for arrays in (start, back)]
    assert held[0] == held[1] == sorted(float(n) for n in range(9, 25))


def test_lanes_are_filled_up_or_left_out():
    one = ring_of(1, 8, [3])
    three = {name: np.stack([array + i for i in range(3)]) for name, array in one.items()}
    four = {name: np.concatenate([array, array[-1:]]) for name, array in three.items()}
    assert_equal(regroup(three, four, 3), four)
    assert_equal(regroup(four, three, 3), three)
    alone = {name: array[None] for name, array in one.items()}
    assert_equal(regroup(one, alone, 1), alone)
    assert_equal(regroup(four, one, 1), one)
    assert_equal(regroup(four, three, 4), four)  # of another run it says nothing: who restores it refuses it
    assert_equal(regroup(three, one, 3), three)
    assert_equal(regroup({"a": np.ones(2)}, {"a": np.ones(3)}, 1), {"a": np.ones(2)})
