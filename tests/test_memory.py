"""What the C library keeps of freed memory, in programs of their own."""

import subprocess
import sys
from types import SimpleNamespace

import jax
import pytest
from conftest import ROOT

from mjx_dher.system import machine

pytestmark = pytest.mark.skipif(machine._glibc() is None, reason="not glibc")

# Blocks that are freed while a smaller one on top of each stays: a hole each, which the heap cannot give back by itself.
HOLES = """
import ctypes, os
from mjx_dher.system import machine
c = ctypes.CDLL("libc.so.6")
c.malloc.restype, c.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
def used():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
{before}
def make_holes(number, size):
    blocks = []
    for _ in range(number):
        blocks.append(c.malloc(size))
        ctypes.memset(blocks[-1], 1, size)
        c.malloc(60_000)
    for block in blocks:
        c.free(block)
start = used()
make_holes(2, {size})
make_holes(100_000_000 // {size}, {size})
{after}
print((used() - start) / 1e6)
"""


def kept(size, before="", after=""):
    """Of 100 MB that were freed, how many the program still holds."""
    code = HOLES.format(size=size, before=before, after=after)
    return float(subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT).stdout)


def test_blocks_of_some_megabytes_go_back_to_the_system_when_they_are_freed():
    assert kept(5_000_000) > 80
    assert kept(5_000_000, before="machine.keep_heap_small()") < 10


THREADS = """
import ctypes, threading
from mjx_dher.system import machine
c = ctypes.CDLL("libc.so.6")
{before}
together = threading.Barrier({threads})
def allocate():
    together.wait()
    for _ in range(1000):
        c.malloc(1000)
threads = [threading.Thread(target=allocate) for _ in range({threads})]
for thread in threads: thread.start()
for thread in threads: thread.join()
stdout = ctypes.c_void_p.in_dll(c, "stdout")
c.malloc_info(0, stdout)
c.fflush(stdout)
"""


def heaps(before=""):
    """How many heaps threads have that allocate at the same time."""
    code = THREADS.format(before=before, threads=4 * machine.usable_cores())
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT).stdout
    return found.count("<heap nr=")


def test_there_are_two_heaps_a_core():
    """Not one for all: threads of the compiler would wait for one another."""
    cores = max(2, machine.usable_cores())
    assert heaps() > 2 * cores
    assert heaps(before="machine.keep_heap_small()") == 2 * cores


def test_release_gives_back_what_was_freed():
    assert kept(100_000) > 80
    assert kept(100_000, after="machine.release()") < 20


def test_each_process_asks_a_device_of_its_own(monkeypatch):
    """Under several processes the first of all devices is the first process's, and tells nobody else its memory."""
    monkeypatch.setattr(jax, "local_devices", lambda: [SimpleNamespace(platform="cpu")])
    assert 1e7 < machine.used_bytes() < 1e11  # of this process
    monkeypatch.setattr(jax, "local_devices", lambda: [Gpu()])
    monkeypatch.setattr(jax, "devices", lambda: [Gpu(stats=None), Gpu()])
    assert machine.available_bytes() == 70
    assert machine.used_bytes() == 30


class Gpu:
    """A device as JAX shows it: `memory_stats` raises for that of another process."""

    platform = "gpu"

    def __init__(self, stats=(("bytes_limit", 100), ("bytes_in_use", 30))):
        self.stats = stats

    def memory_stats(self):
        if self.stats is None:
            raise RuntimeError("MemoryStats is only supported for addressable PjRt devices.")
        return dict(self.stats)
