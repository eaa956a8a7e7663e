"""Trials of a sweep: the grid of environments, samplers, numbers and seeds, their folders, and their training in few programs.

A trial is a run folder, named after its settings and their digest. To finish or extend a sweep, train it again: the missing
trials are trained, and unfinished runs resume from their checkpoint. JAX is loaded only to train.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_dher.runs.folder import fingerprint, reading, results, run_folder
from mjx_dher.spec import RunSpec
from mjx_dher.system.files import FolderError

if TYPE_CHECKING:
    from mjx_dher.runs.driver import Result
    from mjx_dher.types import Env

CELLS = "cells"


def trials(specs: Sequence[RunSpec], seeds: Sequence[int], plain: Sequence[RunSpec] | None = None) -> list[RunSpec]:
    """Every setting with every seed, sorted by environment, then seed, so that runs to compare end together.

    Settings that a run does not read are as in its run in `plain`, by default the environment's first. Duplicates are dropped.
    """
    settings: dict[RunSpec, None] = {}
    first: dict[str, RunSpec] = {}
    for number, spec in enumerate(specs):
        base = plain[number] if plain else first.setdefault(spec.env, spec)
        settings[dataclasses.replace(fingerprint.with_unread_of(base, spec), seed=0)] = None
    grouped = itertools.groupby(settings, key=lambda spec: spec.env)
    return [
        dataclasses.replace(spec, seed=seed)
        for group in (list(group) for _, group in grouped)
        for seed in seeds
        for spec in group
    ]


def by_program(specs: Sequence[RunSpec]) -> list[list[RunSpec]]:
    """Groups trials that can share a program, in order of first appearance."""
    groups: dict[RunSpec, list[RunSpec]] = {}
    for spec in specs:
        groups.setdefault(spec.program, []).append(spec)
    return list(groups.values())


def folder_of(sweep: Path, spec: RunSpec) -> Path:
    """Run folder of a trial."""
    return sweep / CELLS / fingerprint.trial_name(spec)


def is_done(sweep: Path, spec: RunSpec) -> bool:
    """Whether a trial has ended with a valid result."""
    return results.is_done(folder_of(sweep, spec), spec)


def changed_files(sweep: Path, specs: Sequence[RunSpec]) -> list[str]:
    """Sentences about custom source files that changed since trials in the folder were trained."""
    now = {(field, getattr(spec, field)): source for spec in specs for field, source in fingerprint.sources(spec).items()}
    told: dict[str, int] = {}
    for path in sorted((sweep / CELLS).glob(f"*/{run_folder.CONFIG_FILE}")):
        try:
            content = reading.read_config(path.parent)
        except FolderError:
            continue  # reported when its result is read
        for (field, value), source in now.items():
            if content.get(field) == value and content["sources"].get(field) != source:
                text = f"{fingerprint.file_of(field, source)} ({field} {value}) has changed since"
                told[text] = told.get(text, 0) + 1
    return [f"{text} {count} of the runs in {sweep}" for text, count in told.items()]


def is_sweep(folders: Sequence[Path]) -> bool:
    """Whether the paths are one sweep. False for one or more run folders. Raises FolderError if they are neither."""
    if not folders:
        raise FolderError("pass one or more run folders, or a sweep; got none")
    for folder in folders:
        if not folder.is_dir():
            told = "it is a file" if folder.exists() else "no such folder"
            raise FolderError(f"{folder} is neither a run folder nor a sweep: {told}")
        sweep, run = (folder / CELLS).is_dir(), (folder / run_folder.CONFIG_FILE).exists()
        if not sweep and not run:
            told = f"it has neither {run_folder.CONFIG_FILE} nor {CELLS}/"
            raise FolderError(f"{folder} is neither a run folder nor a sweep: {told}")
        if sweep and len(folders) > 1:
            raise FolderError(f"{folder} is a sweep: pass it alone, without other folders")
    return (folders[0] / CELLS).is_dir()


def train(
    folder: Path,
    specs: Sequence[RunSpec],
    make_env: Callable[[RunSpec], "Env"],
    should_stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> list["Result"]:
    """Trains trials into the folder of a sweep, which is made if necessary. Trials share programs if possible, in any order.

    `make_env` makes the environment of a trial. Options and errors are as in `train_runs`. Returns one Result per
    trained trial, none for those that had ended, that another process trains, or that were waiting at a stop.
    """
    from mjx_dher.parallel import processes
    from mjx_dher.runs import driver, program

    options |= {"should_stop": should_stop, "shared": folder / "unfinished", "sweep": True}
    trained: list[Result] = []
    groups = [(make_env(own[0]), own) for own in by_program(specs)]
    for env, own in groups[1:]:  # before the first ones train, which may take days
        program.check_runs(env, own, options.get("lanes"), options.get("devices", 1), sweep=True)
    for env, own in groups:
        if trained and processes.any_process(should_stop()):
            break
        trained += driver.train_runs(env, own, [folder_of(folder, spec) for spec in own], **options)
    return trained
