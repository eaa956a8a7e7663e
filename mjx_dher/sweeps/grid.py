"""The trials of a sweep: every environment, sampler, number and seed of a grid. Loads neither JAX nor MuJoCo."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

from mjx_dher.config import HParams
from mjx_dher.host.files import FolderError
from mjx_dher.runs import identity, results, run_folder
from mjx_dher.spec import RunSpec, reads

CELLS = "cells"
_PARTS = ("weight_kernel", "metric")  # settings that only some samplers read, beside numbers


def trials(specs: Sequence[RunSpec], seeds: Sequence[int]) -> list[RunSpec]:
    """Returns every setting with every seed, seed by seed within an environment, so that what is to be compared ends together.

    Settings that a sampler does not read are those of its environment's first setting; what is then the same is there once.
    """
    settings: dict[RunSpec, None] = {}
    first: dict[str, RunSpec] = {}
    for spec in specs:
        base = first.setdefault(spec.env, spec)
        parts = {name: getattr(base, name) for name in _PARTS if not reads(spec.sampler, name)}
        numbers = {name: getattr(base.hparams, name) for name in HParams._fields if not reads(spec.sampler, name)}
        settings[dataclasses.replace(spec, seed=0, hparams=spec.hparams._replace(**numbers), **parts)] = None
    grouped = itertools.groupby(settings, key=lambda spec: spec.env)
    return [
        dataclasses.replace(spec, seed=seed)
        for group in (list(group) for _, group in grouped)
        for seed in seeds
        for spec in group
    ]


def shard(specs: Sequence[RunSpec], index: int, count: int) -> list[RunSpec]:
    """Returns the `index`-th (from 1) of `count` near-equal shards, split within each environment.

    Neighbours stay together, so a shard has all settings of some seeds, which are compared, and trains them side by side.
    """
    grouped = (list(group) for _, group in itertools.groupby(specs, key=lambda spec: spec.env))
    return [spec for group in grouped for spec in group[len(group) * (index - 1) // count : len(group) * index // count]]


def folder_of(sweep: Path, spec: RunSpec) -> Path:
    """Returns the run folder of a trial."""
    folder = sweep / CELLS / identity.trial_name(spec)
    earlier = sweep / CELLS / identity.trial_name(spec, own_sources={})  # of a version that did not look at own code
    return earlier if earlier.exists() and not folder.exists() else folder


def is_done(sweep: Path, spec: RunSpec) -> bool:
    """Returns whether the trial has ended, and its result can be believed."""
    return results.is_whole(folder_of(sweep, spec))


def changed_files(sweep: Path, specs: Sequence[RunSpec]) -> list[str]:
    """Returns what a reader is told of own code that is not what trials in the folder were trained with."""
    now = {(field, getattr(spec, field)): source for spec in specs for field, source in identity.sources(spec).items()}
    told: dict[str, int] = {}
    for path in sorted((sweep / CELLS).glob(f"*/{run_folder.CONFIG_FILE}")):
        try:
            content = run_folder.read_content(path.parent)
        except FolderError:
            continue  # whoever reads its result will say so
        for (field, value), source in now.items():
            if content.get(field) == value:
                before = content.get("sources", {}).get(field)
                if before is None:
                    text = f"whether {source.split()[0]} ({field} {value}) has changed is not known of"
                elif before != source:
                    text = f"{source.split()[0]} ({field} {value}) has changed since"
                else:
                    continue
                told[text] = told.get(text, 0) + 1
    return [f"{text} {count} of the runs in {sweep}" for text, count in told.items()]
