"""Commands that several processes run together (`--distributed`)."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console

from mjx_dher import __version__
from mjx_dher.runs.folder import fingerprint, results, run_folder
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError


def join(distributed: bool, described: Mapping[str, Any], console: Console) -> Console:
    """Joins this process to the others if the command is `distributed`. Returns a console that prints in the first process.
    Raises ValueError if there are no other processes, or their versions or settings in `described` differ.
    """
    if not distributed:
        return console
    from mjx_dher.parallel import processes

    processes.connect()
    versions = {"version of mjx_dher": __version__, "version of jax": metadata.version("jax"), **fingerprint.jax_flags()}
    processes.check_equal({**versions, **described})
    return console if processes.leads() else Console(quiet=True)


def check_out(distributed: bool, out: Path | None) -> None:
    """Raises ValueError if several processes are to train a run without a named folder."""
    if distributed and out is None:
        raise ValueError("out must name the run folder with --distributed, so that the same command can resume it; got none")


def claim(stack: contextlib.ExitStack, out: Path | None, spec: RunSpec, resumes: bool) -> Path:
    """Locks a run's folder in `stack`: a new one, or if the command `resumes`, one with the same run. Raises FolderError if it
    holds something else, or the run has ended.
    """
    if not resumes or out is None or not (out / run_folder.CONFIG_FILE).exists():
        return stack.enter_context(run_folder.claim_new(out, spec))
    stack.enter_context(files.lock(out))
    run_folder.check_same(out, spec)
    if results.has_result(out) and results.read_result(out)["status"] != run_folder.FAILED:
        raise FolderError(f"out: {out} holds this run, and it has ended")
    return out
