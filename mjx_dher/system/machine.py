"""The machine as a process has it: cores and memory that it may use, JAX's devices, and the user's cache folder.

Cores and memory are the machine's, or those of its control groups (containers, Slurm, systemd) if less.
"""

import ctypes
import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path("/")
# Files of a memory group in versions 2 and 1: limits, use, and the reclaimable parts of the use.
_MEMORY = (
    (("memory.max", "memory.high"), "memory.current", ("inactive_file", "active_file", "slab_reclaimable")),
    (("memory.limit_in_bytes",), "memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
)
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # of glibc's malloc.h
_HEAPS_A_CORE = 2


def user_cache() -> Path:
    """Folder of this library in the user's cache. All of its files can be recreated. Raises OSError if the user has no home
    folder (for example in a container, without a line in /etc/passwd).
    """
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx-dher"
    except RuntimeError as error:
        raise OSError("the user has no home folder; set HOME or XDG_CACHE_HOME") from error


def keep_compiled_programs() -> None:
    """Makes JAX cache compiled programs in the user's cache folder, unless the user has chosen another one.

    JAX cannot cache programs that call back to Python, such as those on a GPU with native physics.
    """
    import jax

    check_platform()
    config: Any = jax.config  # not all versions of JAX have types for its fields
    if config.jax_compilation_cache_dir is None:
        try:
            config.update("jax_compilation_cache_dir", str(user_cache() / "xla"))
        except OSError as error:
            print(f"compiled programs are not cached: {error}", file=sys.stderr)


def check_platform() -> None:
    """Starts JAX's devices, on at most the usable cores. Raises ValueError if JAX_PLATFORMS names one that is missing."""
    import jax

    limit_threads()
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # AssertionError: the package of a platform is missing
        reason = (str(error).splitlines() or ["it is not installed"])[0]
        asked = os.environ.get("JAX_PLATFORMS", "")
        raise ValueError(f"JAX_PLATFORMS={asked!r}: JAX cannot start this platform ({reason}); unset it, or use cpu") from error


def prepare() -> None:
    """Prepares a process for training: it caches compiled programs, and returns freed memory. Raises ValueError if the user has
    disabled compilation.
    """
    import jax

    if jax.config.jax_disable_jit:  # type: ignore[attr-defined]
        raise ValueError("JAX_DISABLE_JIT is set, but training needs compiled programs; unset it")
    keep_heap_small()  # before JAX starts threads
    keep_compiled_programs()


def usable_cores(root: Path = ROOT) -> int:
    """Number of cores that this process may use, considering `taskset` and containers. A quota is rounded up."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min([cores, *(max(1, math.ceil(quota)) for quota in _quotas(root))])


def limit_threads() -> None:
    """Limits XLA to `usable_cores`, because it ignores quotas. Call this before JAX starts its devices."""
    if any(_quotas(ROOT)):
        os.environ.setdefault("NPROC", str(usable_cores()))  # read by XLA


def free_bytes(root: Path = ROOT) -> int | None:
    """Allocatable memory, including reclaimable page cache, or None if unknown (Linux only)."""
    machine = _numbers(root / "proc/meminfo").get("MemAvailable:")
    known = [*_free_in_groups(root), *([] if machine is None else [machine * 1024])]
    return max(0, min(known)) if known else None


def _quotas(root: Path) -> Iterator[float]:
    """Quotas of processor time, in cores."""
    for group in _groups(root, "cpu"):
        texts = _words(group / "cpu.max") or [*_words(group / "cpu.cfs_quota_us"), *_words(group / "cpu.cfs_period_us")]
        if len(texts) == 2 and all(text.isdecimal() and int(text) for text in texts):  # else "max", or -1 in version 1
            yield int(texts[0]) / int(texts[1])


def _free_in_groups(root: Path) -> Iterator[int]:
    for group in _groups(root, "memory"):
        for limits, current, reclaimable in _MEMORY:
            bounds = [int(text) for name in limits for text in _words(group / name) if text.isdecimal()]
            used = [int(text) for text in _words(group / current) if text.isdecimal()]
            if bounds and used:
                stat = _numbers(group / "memory.stat")
                yield min(bounds) - used[0] + sum(stat.get(name, 0) for name in reclaimable)


def _groups(root: Path, controller: str) -> Iterator[Path]:
    """Folders of this process's control groups, of both versions, each followed by its ancestors."""
    mount = root / "sys/fs/cgroup"
    for line in _lines(root / "proc/self/cgroup"):
        _, controllers, path = (*line.split(":", 2), "", "")[:3]
        if controllers and controller not in controllers.split(","):
            continue
        names = [name for name in path.split("/") if name not in ("", "..")]
        for base in [mount / controller] if controllers else [mount, mount / "unified"]:
            # A container may see its group at the mount, but with the group's outside path.
            starts = (base.joinpath(*names[skipped:]) for skipped in range(len(names) + 1))
            start = next((folder for folder in starts if folder.is_dir()), base)
            yield from (folder for folder in (start, *start.parents) if folder.is_relative_to(base))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _words(path: Path) -> list[str]:
    return [word for line in _lines(path) for word in line.split()]


def _numbers(path: Path) -> dict[str, int]:
    """Numbers in a file with a name and a number per line."""
    return {words[0]: int(words[1]) for line in _lines(path) if len(words := line.split()) > 1 and words[1].isdecimal()}


def available_bytes() -> int | None:
    """Bytes that this process's first device can still allocate, or None if unknown.

    On a CPU: the free memory of the machine, or of a container if that is less (Linux only).
    """
    import jax

    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats()
        return stats["bytes_limit"] - stats["bytes_in_use"] if stats and "bytes_limit" in stats else None
    return free_bytes()


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
        library.mallopt(_M_ARENA_MAX, _HEAPS_A_CORE * max(2, usable_cores()))


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
