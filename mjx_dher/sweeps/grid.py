"""Grid of a sweep: trials for each environment, sampler, number and seed. Loads neither JAX nor MuJoCo."""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

from mjx_dher.runs.folder import fingerprint, reading, results, run_folder
from mjx_dher.spec import RunSpec
from mjx_dher.system.files import FolderError

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
                text = f"{source.split()[0]} ({field} {value}) has changed since"
                told[text] = told.get(text, 0) + 1
    return [f"{text} {count} of the runs in {sweep}" for text, count in told.items()]


def is_sweep(folders: Sequence[Path]) -> bool:
    """Whether the paths are one sweep. False for one or more run folders. Raises FolderError if they are neither."""
    if not folders:
        raise FolderError("pass one or more run folders, or a sweep; got none")
    for folder in folders:
        if not folder.is_dir():
            raise FolderError(f"{folder} is neither a run folder nor a sweep: no such folder")
        sweep, run = (folder / CELLS).is_dir(), (folder / run_folder.CONFIG_FILE).exists()
        if not sweep and not run:
            told = f"it has neither {run_folder.CONFIG_FILE} nor {CELLS}/"
            raise FolderError(f"{folder} is neither a run folder nor a sweep: {told}")
        if sweep and len(folders) > 1:
            raise FolderError(f"{folder} is a sweep: pass it alone, without other folders")
    return (folders[0] / CELLS).is_dir()
