"""Options by which several processes, on one machine or several, train together."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console

from mjx_dher import __version__
from mjx_dher.config import check_number
from mjx_dher.runs.folder import fingerprint, results, run_folder
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError

SLURM = "slurm"
MAX_PROCESSES = 10_000
# Variables that stand for options that are not given.
VARIABLES = {
    "coordinator": "JAX_COORDINATOR_ADDRESS",
    "num_processes": "JAX_NUM_PROCESSES",
    "process_id": "JAX_PROCESS_ID",
}


@dataclasses.dataclass(frozen=True)
class Hosts:
    """Processes that train together."""

    coordinator: str | None = None
    """Address of the first of several processes that train together, HOST:PORT, or slurm: Slurm's variables tell. Each process
    has the same command; the first one writes. JAX_COORDINATOR_ADDRESS unless given."""
    num_processes: int | None = None
    """Processes that train together; JAX_NUM_PROCESSES unless given."""
    process_id: int | None = None
    """Number of this process, from 0; JAX_PROCESS_ID unless given."""

    def place(self, environ: Mapping[str, str]) -> tuple[str, int, int] | None:
        """Returns the first process's address, how many there are, and which this one is; None for one alone.

        Raises:
          ValueError: one of them is missing, or cannot be used.
        """
        values = {name: getattr(self, name) for name in VARIABLES}
        values |= {name: environ.get(VARIABLES[name]) for name, value in values.items() if value is None}
        if values["coordinator"] == SLURM:
            return _of_slurm(environ)
        if given := [name for name, value in values.items() if value is not None]:
            if missing := [f"{name} (or {VARIABLES[name]})" for name in VARIABLES if name not in given]:
                raise ValueError(f"several processes need {', '.join(missing)}, too: only {', '.join(given)} is given")
            return _checked(*(str(values[name]) for name in VARIABLES))
        return None


def _checked(address: str, size: str, number: str) -> tuple[str, int, int]:
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise ValueError(f"coordinator must be HOST:PORT, with a port in [1, 65535], or slurm; got {address!r}")
    numbers = [int(text) if text.isdecimal() else text for text in (size, number)]
    check_number("num_processes", numbers[0], f"[2, {MAX_PROCESSES}]")
    check_number("process_id", numbers[1], f"[0, {int(numbers[0]) - 1}]")
    return address, int(size), int(number)


def _of_slurm(environ: Mapping[str, str]) -> tuple[str, int, int] | None:
    """Returns the place among the tasks of a job step; None for its only one. A port follows from the job's number."""
    needed = ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_STEP_NUM_TASKS", "SLURM_PROCID")
    if missing := [name for name in needed if not environ.get(name)]:
        raise ValueError(f"coordinator slurm needs the variables that srun sets; there is no {', '.join(missing)}")
    job, nodes, size, number = (environ[name] for name in needed)
    port = 61440 + int(re.sub(r"\D", "", job) or 0) % 4096  # above the ports that systems hand out
    return None if size == "1" else _checked(f"{first_node(nodes)}:{port}", size, number)


def first_node(nodes: str) -> str:
    """Returns the first of Slurm's list of nodes: of "gpu[003-005,9],cpu1" it is gpu003."""
    match = re.match(r"([^,\[]+)(?:\[(\w+)[^\]]*\])?", nodes)
    if match is None:
        raise ValueError(f"SLURM_STEP_NODELIST must be a list of nodes; got {nodes!r}")
    return match[1] + (match[2] or "")


@contextlib.contextmanager
def joined(hosts: Hosts, described: Mapping[str, Any], console: Console) -> Iterator[tuple[Any, Console]]:
    """Joins this process to the others; yields the `Team`, and a console on which the first process alone prints.

    Raises:
      ValueError: nobody answers, somebody does not come, or others were started otherwise.
    """
    from mjx_dher.parallel import processes as team_lib

    place = hosts.place(os.environ)
    if place is None:
        yield team_lib.ALONE, console
        return
    versions = {"version of mjx_dher": __version__, "version of jax": metadata.version("jax")}
    console.print(f"process {place[2]} of {place[1]}: waiting for the others at {place[0]} ...", soft_wrap=True)
    team = team_lib.connect(*place, {**versions, **described})
    try:
        yield team, console if team.leads else Console(quiet=True)
    except BaseException as error:
        team.close(str(error) or type(error).__name__)
        raise
    team.close()


def check_out(hosts: Hosts, out: Path | None) -> None:
    """Raises ValueError where several processes train a run whose folder has no name."""
    if hosts.place(os.environ) is not None and out is None:
        raise ValueError("out: several processes need the name of the run folder, from which the same command can go on")


def refuse_with_ray(hosts: Hosts, devices: int | str) -> None:
    """Raises ValueError where a sweep on a Ray cluster is also to be one program over several devices."""
    if devices != 1 or hosts.place(os.environ) is not None:
        raise ValueError("devices and coordinator are for one program over several devices; with ray each task has a device")


def claim(stack: contextlib.ExitStack, out: Path | None, spec: RunSpec, goes_on: bool) -> Path:
    """Returns a run's folder, which `stack` keeps locked: a new one, or, where the run `goes_on`, also one that it has begun.

    Raises:
      FolderError: it holds something else, or the run has ended.
    """
    if not goes_on or out is None or not (out / run_folder.CONFIG_FILE).exists():
        return stack.enter_context(run_folder.claim_new(out, spec))
    stack.enter_context(files.lock(out))
    content, begun = run_folder.read_run(out)
    before = run_folder.identity_of(content, begun)
    now = fingerprint.identity(spec, content["physics"], fingerprint.sources(spec))
    changed = {name: text for name, text in fingerprint.differences(before, now).items() if name not in fingerprint.MAY_CHANGE}
    if changed:
        raise FolderError(f"out: {out} holds a run with other settings: {'; '.join(changed.values())}")
    if results.has_result(out) and results.read_result(out)["status"] != run_folder.FAILED:
        raise FolderError(f"out: {out} holds this run, and it has ended")
    return out
