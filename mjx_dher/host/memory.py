"""How much memory there is, how much is held, and having the C library give back what is free."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # of glibc's malloc.h


def available_bytes() -> int | None:
    """Bytes that the default device can still allocate, None where it does not tell.

    On a CPU: the free memory of the machine, or of the container if that is less (Linux only).
    """
    import jax

    device = jax.devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats()
        return stats["bytes_limit"] - stats["bytes_in_use"] if stats and "bytes_limit" in stats else None
    found = [amount for amount in (_meminfo_available(), _container_available()) if amount is not None]
    return min(found, default=None)


def used_bytes() -> int | None:
    """Bytes that the default device holds for JAX; on a CPU, that this program holds (Linux only). None where unknown."""
    import jax

    device = jax.devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats()
        return stats["bytes_in_use"] if stats else None
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return None


def keep_heap_small() -> None:
    """Has the C library give freed blocks of a megabyte and more back to the system, and keep the others in one heap.

    As it comes, glibc keeps freed blocks of up to 32 MB for later ones, in as many heaps as threads ask for. Buffers of
    checkpoints then leave holes that the next ones, of other threads, do not fit into, and a long run grows by some MB with
    each. To be called before threads are started. Elsewhere than on Linux with glibc: nothing.
    """
    if (library := _glibc()) is not None:
        library.mallopt(_M_MMAP_THRESHOLD, 1 << 20)
        library.mallopt(_M_ARENA_MAX, 1)


def release() -> None:
    """Gives the system back what the C library has kept of freed memory (glibc only): after compiling, hundreds of MB."""
    if (library := _glibc()) is not None:
        library.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    try:
        library = ctypes.CDLL("libc.so.6")
        return library if hasattr(library, "mallopt") and hasattr(library, "malloc_trim") else None
    except OSError:
        return None


def format_bytes(amount: float) -> str:
    """For a reader: "130.5 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"


def _meminfo_available() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


def _container_available() -> int | None:
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
    except (OSError, ValueError):
        return None
    return None if limit == "max" else int(limit) - used
