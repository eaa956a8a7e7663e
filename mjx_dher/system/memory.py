"""Available and used memory, and settings that make the C library return freed memory."""

import ctypes
import os
from pathlib import Path

from mjx_dher.system import limits

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # of glibc's malloc.h
_HEAPS_A_CORE = 2


def available_bytes() -> int | None:
    """Bytes that this process's first device can still allocate, or None if unknown.

    On a CPU: the free memory of the machine, or of a container if that is less (Linux only).
    """
    import jax

    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats()
        return stats["bytes_limit"] - stats["bytes_in_use"] if stats and "bytes_limit" in stats else None
    return limits.free_bytes()


def used_bytes() -> int | None:
    """Bytes that JAX uses on this process's first device, or on a CPU the process itself (Linux only). None if unknown."""
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
    """Makes the C library return freed blocks of at least a megabyte, and keep smaller ones in few heaps (Linux with glibc).

    By default, glibc keeps freed blocks of up to 32 MB, in up to eight heaps per core. Each checkpoint then leaves holes that
    the next one does not fit into, and a long run grows by some MB each time. With one heap per core, the compiler's threads
    wait for each other: Push is ready after 15 s instead of 10. Call this before any threads start.
    """
    if (library := _glibc()) is not None:
        library.mallopt(_M_MMAP_THRESHOLD, 1 << 20)
        library.mallopt(_M_ARENA_MAX, _HEAPS_A_CORE * max(2, limits.usable_cores()))


def release() -> None:
    """Returns freed memory to the system (glibc only): hundreds of MB after compiling."""
    if (library := _glibc()) is not None:
        library.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    try:
        library = ctypes.CDLL("libc.so.6")
        return library if hasattr(library, "mallopt") and hasattr(library, "malloc_trim") else None
    except OSError:
        return None


def format_bytes(amount: float) -> str:
    """Formats a number of bytes, such as "130.5 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"
