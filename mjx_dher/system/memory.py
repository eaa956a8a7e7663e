"""Memory that is available and in use, and settings that make the C library give freed memory back."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

from mjx_dher.system import limits

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # of glibc's malloc.h
_HEAPS_A_CORE = 2


def available_bytes() -> int | None:
    """Returns the bytes that this process's first device can still allocate, or None where they are unknown.

    On a CPU: the free memory of the machine, or of a container if that is less (Linux only).
    """
    import jax

    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats()
        return stats["bytes_limit"] - stats["bytes_in_use"] if stats and "bytes_limit" in stats else None
    return limits.free_bytes()


def used_bytes() -> int | None:
    """Returns the bytes that JAX uses on this process's first device; on a CPU, its own (Linux only). None where unknown."""
    import jax

    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats()
        return stats["bytes_in_use"] if stats else None
    try:
        return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return None


def keep_heap_small() -> None:
    """Makes the C library return freed blocks of a megabyte and more to the system, and keep smaller ones in few heaps.

    By default, glibc keeps freed blocks of up to 32 MB for reuse, in as many as eight heaps a core. The buffers of a checkpoint
    leave holes that those of the next one, of other threads, do not fit into: each makes a long run grow by some MB. As few
    heaps as cores are too few: the compiler's threads wait for one another, and Push is ready after 15 s instead of 10.
    Call this before threads are started. It does nothing except on Linux with glibc.
    """
    if (library := _glibc()) is not None:
        library.mallopt(_M_MMAP_THRESHOLD, 1 << 20)
        library.mallopt(_M_ARENA_MAX, _HEAPS_A_CORE * max(2, limits.usable_cores()))


def release() -> None:
    """Returns freed memory that the C library has kept to the system (glibc only): hundreds of MB after compiling."""
    if (library := _glibc()) is not None:
        library.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    try:
        library = ctypes.CDLL("libc.so.6")
        return library if hasattr(library, "mallopt") and hasattr(library, "malloc_trim") else None
    except OSError:
        return None


def format_bytes(amount: float) -> str:
    """Formats a number of bytes for people, such as "130.5 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"
