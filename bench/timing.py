"""Shared by the benchmarks: timing of compiled functions, and a table that names the machine."""

import platform
import statistics
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

import jax

from mjx_dher.system.machine import usable_cores


def median_seconds(run: Callable[[], Any], repeats: int = 7) -> float:
    """Median of `repeats` timed calls, after one that is not counted. `run` returns the arrays to wait for."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def machine() -> str:
    """One line: device, cores, versions."""
    versions = " ".join(f"{name} {metadata.version(name)}" for name in ("jax", "mujoco"))
    return f"{jax.devices()[0].device_kind}, {cpu()}, {usable_cores()} cores; Python {platform.python_version()} {versions}"


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table, under a line that names the machine."""
    cells = [list(head), *[[str(cell) for cell in row] for row in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = ["| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths)) + " |" for row in cells]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join([machine(), "", *lines])


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Prints `table`."""
    print(f"\n{table(head, rows)}")


def cpu() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.split(":")[1].strip() for line in file if line.startswith("model name")]
        return names[0] if names else platform.processor()
    except OSError:
        return platform.processor()
