"""Cores and memory that this process may use: the machine's, or its control groups' (containers, Slurm, systemd) if less."""

import math
import os
from collections.abc import Iterator
from pathlib import Path

ROOT = Path("/")
# Files of a memory group in versions 2 and 1: limits, use, and the reclaimable parts of the use.
_MEMORY = (
    (("memory.max", "memory.high"), "memory.current", ("inactive_file", "active_file", "slab_reclaimable")),
    (("memory.limit_in_bytes",), "memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
)


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
