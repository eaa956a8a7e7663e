"""Checkpoints of parallel runs."""

import contextlib
import dataclasses
import functools
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from mjx_dher.parallel import processes
from mjx_dher.runs.folder import checkpoint, fingerprint, loggers, run_folder
from mjx_dher.runs.loop import Progress, Start
from mjx_dher.system import files
from mjx_dher.system.files import FolderError
from mjx_dher.trainer import TrainState

if TYPE_CHECKING:
    from mjx_dher.runs.folder.restoring import Restored

NAMES_FILE = "cells.json"  # names of the run folders that share a checkpoint
SECONDS_TO_FIRST, SECONDS_BETWEEN, SHARE = 120.0, 600.0, 0.05  # checkpoints by the clock, as `Schedule` says


@dataclasses.dataclass(frozen=True)
class LaneCheckpoints:
    """Checkpoints of parallel runs, in a folder in `shared`, or of a single run, in its own folder."""

    folders: Sequence[Path]  # of the runs
    lanes: int
    shared: Path
    keep: int
    restart: bool  # start over if no checkpoint is usable, instead of raising
    report: Callable[[str], None]
    runs: Sequence[dict[str, Any]]  # `fingerprint.identity` of each
    refused: list[Path] = dataclasses.field(default_factory=list)  # unusable checkpoints
    failed: dict[int, tuple[int, str]] = dataclasses.field(default_factory=dict)  # epoch and reason of each failed lane

    @property
    def names(self) -> list[str]:
        return [folder.name for folder in self.folders]

    @property
    def folder(self) -> Path:
        """Folder to whose `checkpoints/` these runs write."""
        return self.shared / fingerprint.sha256_of(self.names)[:10] if self.lanes > 1 else self.folders[0]

    def _sources(self) -> dict[Path, list[int]]:
        """Folders with checkpoints of at least these runs, the latest first, and the places of the runs in them."""
        own = [self.folder, *(self.folders if len(self.folders) == 1 else ())]
        held = reversed(_held(self.shared, dict.fromkeys(own, self.names)).items())
        return {folder: [*map(names.index, self.names)] for folder, names in held if {*names} >= {*self.names}}

    def restore(self, init: Callable[[], TrainState], will_save: bool) -> Start:
        """Restores the newest checkpoint. Without one, the runs start with the state from `init`. Raises FolderError if no
        checkpoint is usable and `restart` is False, or there is none and no space for one that the runs `will_save`.
        """
        state = init()
        if not processes.broadcast(functools.partial(self._find, state, will_save)):
            return Start(state)
        template = jax.tree.map(self._shape_of, state)
        hparams: Any = jax.tree.map(jnp.copy, state.hparams)
        del state  # memory may not suffice for two
        try:
            restored = self._read(template)
        except FolderError as error:
            if not self.restart:
                raise
            self.report(f"{error}; these runs start over")
            self.refused.extend(path for folder in self._sources() for path in run_folder.checkpoints(folder))
            return Start(init())
        for path, why in restored.refused.items():
            self.report(f"not used: {why}")
            self.refused.append(path)
        self.failed.update(restored.failed)
        self.report(f"resuming from {restored.path}, after epoch {restored.epoch}")
        # The index of a lane's sampler depends on the remaining runs.
        return Start(dataclasses.replace(restored.state, hparams=hparams), restored.epoch, restored.wall_seconds)

    def _find(self, state: TrainState, will_save: bool) -> bool:
        """Whether there is a checkpoint. Reports a disk too full for another one. Raises FolderError if it is too full for the
        first.
        """
        has_some = bool(self._sources())
        if will_save and (lack := checkpoint.lack_of_space(self.folder, state)):
            if not has_some:
                raise FolderError(f"{self.folder}: {lack}")
            self.report(lack)
        return has_some

    def _read(self, template: TrainState) -> "Restored":
        """Reads the newest undamaged checkpoint. Raises FolderError in all processes if one of them cannot read it."""
        from mjx_dher.runs.folder import restoring, results

        problem: FolderError | None = None
        for source, places in self._sources().items():
            if problem is not None:
                self.report(str(problem))
            try:
                restored = restoring.restore(source, template, [len(results.read_metrics(run)) for run in self.folders], places)
                self._compare(restored)
                problem = None
                break
            except FolderError as error:
                problem = error
        if processes.any_process(problem is not None):
            raise problem or FolderError(f"another process cannot read {self.folder}: all must share one file system")
        processes.check_equal({"checkpoint": restored.path})
        return restored

    def _shape_of(self, leaf: Any) -> jax.ShapeDtypeStruct:
        sharding = leaf.sharding if len(leaf.sharding.device_set) > 1 else None
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)

    def _compare(self, restored: "Restored") -> None:
        """Reports changes of settings since the checkpoint. Raises FolderError for settings that must not change."""
        from mjx_dher.runs.folder import reading

        changed: dict[str, str] = {}
        for folder, before, now in zip(self.folders, restored.runs, self.runs):
            content = reading.read_config(folder)
            if other := reading.foreign(content, reading.to_spec(folder, content), before):
                raise FolderError(f"{restored.path} is of a run with other settings: {other}")
            changed |= fingerprint.differences(before, now)
        if refused := [text for name, text in changed.items() if name not in fingerprint.MAY_CHANGE]:
            raise FolderError(f"{restored.path} is of a run with other settings: {'; '.join(refused)}")
        for text in changed.values():
            self.report(f"since {restored.path}: {text}")

    def save(self, progress: Progress) -> Path:
        """Writes a checkpoint. Returns its path. Raises CheckpointError if it cannot be written."""
        state = processes.collect(checkpoint.without_keys(progress.state))
        if state is None:
            return self.shared
        folder = self.folder
        if folder not in self.folders:
            files.make_folder(folder)
            files.write_json(folder / NAMES_FILE, {"cells": self.names})
        for run in self.folders:
            loggers.flush_logs(run)  # a checkpoint is useless without the lines before it
        told: dict[str, Any] = {"runs": self.runs, "refused": tuple(self.refused), "failed": self.failed}
        path = checkpoint.save(folder, state, progress.epoch, progress.wall_seconds, self.keep, **told)
        self.refused.clear()
        return path

    def try_save(self, progress: Progress) -> None:
        """Writes a checkpoint, or reports that it cannot be written."""
        try:
            self.save(progress)
        except (OSError, checkpoint.CheckpointError) as error:
            self.report(str(error) if isinstance(error, FolderError) else f"cannot write a checkpoint ({error})")

    def clear(self, keep_end: bool = False) -> None:
        """Removes the checkpoints of these runs, and those in `shared` whose runs have all ended. With `keep_end`, the newest
        checkpoint in a run's own folder stays.
        """
        if not processes.leads():
            return
        own = self.folders[0]
        old = run_folder.checkpoints(own)[1:] if keep_end else [own / run_folder.CHECKPOINTS]
        for path in {*old, self.folder} - {own}:
            shutil.rmtree(path, ignore_errors=True)
        remove_ended(self.shared, NAMES_FILE, own.parent)


class Schedule:
    """Times of checkpoints: by epochs, and by the clock. Saving by the clock takes at most a fraction `SHARE` of the time."""

    def __init__(self, epochs: int):
        self._epochs, self._due = epochs, time.monotonic() + SECONDS_TO_FIRST

    def is_due(self, epoch: int) -> bool:
        return time.monotonic() >= self._due or (self._epochs > 0 and epoch % self._epochs == 0)

    @contextlib.contextmanager
    def saving(self) -> Iterator[None]:
        """Times the block, which saves, and schedules the next checkpoint by the clock."""
        began = time.monotonic()
        yield
        self._due = time.monotonic() + max(SECONDS_BETWEEN, (time.monotonic() - began) / SHARE)


def remove_ended(storage: Path, names_file: str, cells: Path) -> None:
    """Removes folders in `storage` whose runs, by their file of names, have all ended in `cells`, and `storage` if empty."""
    for path in storage.glob(f"*/{names_file}"):
        if (names := _names(path)) and all((cells / name / run_folder.RESULT_FILE).exists() for name in names):
            shutil.rmtree(path.parent, ignore_errors=True)
    with contextlib.suppress(OSError):  # not empty, or never made
        storage.rmdir()


def groups(shared: Path, folders: Sequence[Path]) -> dict[str, str]:
    """The folder of the latest checkpoint of each run in `folders` that has one. Runs with the same one resume together."""
    own = {folder.name for folder in folders}
    held = _held(shared, {folder: [folder.name] for folder in folders})
    return {name: str(folder) for folder, names in held.items() for name in names if name in own}


def _held(shared: Path, own: dict[Path, list[str]]) -> dict[Path, list[str]]:
    """Names of the runs of each folder with a checkpoint, in `shared` and among `own`, the latest checkpoint last."""
    held = {path.parent: _names(path) for path in sorted(shared.glob(f"*/{NAMES_FILE}"))} | own
    saved = {folder: paths[0] for folder in held if (paths := run_folder.checkpoints(folder))}
    return {folder: held[folder] for folder in sorted(saved, key=lambda folder: run_folder.epoch_of(saved[folder]))}


def _names(path: Path) -> list[str]:
    """Run names in a file, which is their list or has it as "cells". Empty if the file was just removed, or is damaged."""
    try:
        content = files.read_json(path)
        names = content["cells"] if isinstance(content, dict) else content
        return names if all(name == Path(name).name for name in names) else []
    except (OSError, ValueError, KeyError, TypeError):
        return []
