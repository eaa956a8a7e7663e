"""Checkpoints of a run. They are written atomically, and restored only if undamaged (`restoring`).

A checkpoint is a folder, RUN/checkpoints/epoch-000010. It has `state`, with a NumPy file per leaf of the TrainState, and
manifest.json, with the SHA-256 of every file and of itself, and each leaf's name, shape and dtype.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_dher.runs.folder.fingerprint import sha256_of
from mjx_dher.runs.folder.run_folder import CHECKPOINTS, MANIFEST, SCHEMA, checkpoints, epoch_of
from mjx_dher.system import files
from mjx_dher.system.files import FolderError
from mjx_dher.types import without_key

STATE_FOLDER = "state"
_PARTIAL = ".partial-"
_PIECE = 1 << 20  # bytes per test for zeros
_SPARE = 1 << 16  # bytes to leave free for metrics and result


class CheckpointError(FolderError):
    """A checkpoint cannot be written or used."""


def save(
    folder: Path,
    state: Any,
    epoch: int,
    wall_seconds: float,
    keep: int,
    runs: Sequence[Mapping[str, Any]] = (),
    refused: Sequence[Path] = (),
    failed: Mapping[int, tuple[int, str]] | None = None,
) -> Path:
    """Writes a checkpoint of a run. Keeps this one and the newest `keep` - 1 before it, and deletes the others.

    Checkpoints of later epochs are deleted too. If the disk is too full, only the newest one is kept while this one is written.

    Args:
      state: a TrainState, or any pytree of JAX arrays.
      keep: number of checkpoints to keep, at least 1.
      runs: `fingerprint.identity` of each run.
      refused: unusable checkpoints to delete.
      failed: epoch and reason of each failed run, by lane.

    Raises:
      CheckpointError: it cannot be written. Earlier checkpoints stay unchanged.
    """
    parent = folder / CHECKPOINTS
    target, partial = parent / f"epoch-{epoch:06d}", parent / f"{_PARTIAL}{epoch:06d}"
    try:
        files.make_folder(parent)
        for left in parent.glob(f"{_PARTIAL}*"):  # left by a run that was killed while saving
            files.remove(left)
        whole = [path for path in checkpoints(folder) if epoch_of(path) < epoch and path not in refused]
        for old in reversed(whole[1:]):
            if lack_of_space(parent, state):
                files.remove(old)
        if lack := lack_of_space(parent, state):
            raise OSError(lack)
        told = {"runs": list(runs), "failed": {str(lane): list(how) for lane, how in (failed or {}).items()}}
        _write(partial, state, {"schema": SCHEMA, "epoch": epoch, "wall_seconds": wall_seconds, **told})
        files.flush_all(partial)
        if target.exists() or target.is_symlink():
            files.remove(target)
        partial.rename(target)
        files.flush(parent)
        for old in set(checkpoints(folder)) - {target, *whole[: keep - 1]}:
            files.remove(old)
    except OSError as error:
        kept = checkpoints(folder)
        last = f"the last one is {kept[0]}" if kept else "there is none before it"
        raise CheckpointError(f"cannot write the checkpoint {target} ({error}); {last}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def lack_of_space(folder: Path, state: Any) -> str | None:
    """Reason why a checkpoint of `state`, arrays or their shapes, does not fit on the disk of `folder`, or None if it does."""
    sizes = [x.size * x.dtype.itemsize + np.lib.format.ARRAY_ALIGN * 2 for x in to_shapes(state).values()]
    lack = files.lack_of_space(folder, [*sizes, 300 * len(sizes), _SPARE])
    return lack and f"a checkpoint takes {lack}"


def _write(partial: Path, state: Any, content: dict[str, Any]) -> None:
    """Writes a checkpoint's files into the folder `partial`. The manifest has `content` and the digests of all files."""
    leaves = {name: np.asarray(array) for name, array in _named(without_keys(state)).items()}
    _write_arrays(partial / STATE_FOLDER, list(leaves.values()))
    content = {
        **content,
        "leaves": [[name, list(array.shape), str(array.dtype)] for name, array in leaves.items()],
        "files": {path.relative_to(partial).as_posix(): digest_of(path) for path in files_of(partial)},
    }
    with (partial / MANIFEST).open("w", encoding="utf-8") as file:
        json.dump({**content, "sha256": sha256_of(content)}, file, indent=1)


def files_of(folder: Path) -> list[Path]:
    """All files in a folder, sorted."""
    return sorted(path for path in folder.rglob("*") if path.is_file())


def digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _named(tree: Any) -> dict[str, Any]:
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def to_shapes(template: Any) -> dict[str, jax.ShapeDtypeStruct]:
    """Name and shape of each array in a checkpoint, for a state or its shapes."""
    return _named(jax.eval_shape(without_keys, template))


def without_keys(state: Any) -> Any:
    """State with its keys replaced by their data. `save` writes the same for it."""
    return jax.tree.map(without_key, state)


def _write_arrays(path: Path, arrays: list[np.ndarray]) -> None:
    """Writes NumPy files. Zeros, such as in a ring that is not full, take no space on most file systems."""
    path.mkdir(parents=True)
    for index, array in enumerate(np.asarray(array, order="C") for array in arrays):
        file = path / f"{index:04d}.npy"
        content = array.reshape(-1).view(np.uint8)
        with files.naming(file), file.open("wb") as stream:
            np.lib.format.write_array_header_1_0(stream, np.lib.format.header_data_from_array_1_0(array))
            for start in range(0, len(content), _PIECE):
                piece = content[start : start + _PIECE]
                if piece.any():
                    stream.write(piece.data)
                else:
                    stream.seek(len(piece), os.SEEK_CUR)
            stream.truncate()
