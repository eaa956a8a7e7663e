"""The trials of a sweep: every environment, sampler, number and seed of a grid. Loads neither JAX nor MuJoCo."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

from mjx_dher.config import HParams
from mjx_dher.runs import run_folder
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
    return sweep / CELLS / run_folder.trial_name(spec)


def is_done(sweep: Path, spec: RunSpec) -> bool:
    """Returns whether the trial has ended."""
    return (folder_of(sweep, spec) / run_folder.RESULT_FILE).exists()
