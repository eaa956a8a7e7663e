"""Restores a run's newest undamaged checkpoint. `checkpoint` writes it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.runs.folder.checkpoint import STATE_FOLDER, CheckpointError, digest_of, files_of, to_shapes
from mjx_dher.runs.folder.reading import checked, read_manifest
from mjx_dher.runs.folder.results import checkpoints_to_resume
from mjx_dher.runs.folder.run_folder import epoch_of
from mjx_dher.system.files import FolderError
from mjx_dher.types import with_key

_HPARAMS = ".hparams."
_RING, _STEPS = ".replay.", ".env_steps"
_CURSOR, _SIZE, _PRIORITY = f"{_RING}cursor", f"{_RING}size", f"{_RING}priority"
_EARLIER = (".replay.episodes.length", ".replay.episodes.terminal")  # missing in checkpoints of 0.2.0


class Restored(NamedTuple):
    """A restored checkpoint."""

    path: Path
    epoch: int  # epochs that had ended
    wall_seconds: float
    state: Any
    runs: list[dict[str, Any]]  # `fingerprint.identity` of each
    refused: dict[Path, str]  # newer unusable checkpoints, and why
    failed: dict[int, tuple[int, str]]  # epoch and reason of each failed lane


def restore(folder: Path, template: Any, lines: Sequence[int] = (), places: Sequence[int] = ()) -> Restored:
    """Restores the newest undamaged checkpoint of a run, or of parallel runs.

    Args:
      template: structure of the state (`jax.ShapeDtypeStruct`s), with shardings if there are several devices.
      lines: epochs in metrics.csv of each run. Checkpoints of later epochs are not used.
      places: which runs of the checkpoint to restore, in this order. Default: all.

    Raises:
      FolderError: there is no checkpoint.
      CheckpointError: no checkpoint is usable. The message has the reason for each.
    """
    refused: dict[Path, str] = {}
    for path in checkpoints_to_resume(folder):
        try:
            with checked(path):
                manifest = read_manifest(path)
                runs = manifest["runs"]
                own = places or range(len(runs)) or (0,)
                if places and max(places) >= len(runs):
                    raise CheckpointError(f"{path} has {len(runs)} runs, and not number {1 + max(places)}")
                failed = _check_lines(path, manifest, lines, own)
                arrays = _load(path, manifest, template, own)
            state, runs = _place(arrays, template), [runs[place] for place in own if runs]
            return Restored(path, manifest["epoch"], manifest["wall_seconds"], state, runs, refused, failed)
        except FolderError as error:
            refused[path] = str(error)
    raise CheckpointError(f"{folder} has no checkpoint to resume from: " + "\n".join(refused.values()))


def _check_lines(
    path: Path, manifest: Mapping[str, Any], lines: Sequence[int], places: Sequence[int]
) -> dict[int, tuple[int, str]]:
    """Failed runs of those at `places`. Raises CheckpointError if a run's metrics.csv lacks epochs that had ended."""
    ended = {int(place): (epoch, reason) for place, (epoch, reason) in manifest["failed"].items()}
    failed = {lane: ended[place] for lane, place in enumerate(places) if place in ended}
    for lane, whole in enumerate(lines):
        if whole < (failed[lane][0] - 1 if lane in failed else manifest["epoch"]):  # the epoch that failed has no line
            raise CheckpointError(f"{path} has a later epoch than the last complete line of metrics.csv, {whole}")
    return failed


def _load(path: Path, manifest: Mapping[str, Any], template: Any, places: Sequence[int]) -> list[np.ndarray]:
    present = {file.relative_to(path).as_posix() for file in files_of(path)}
    for name, digest in manifest["files"].items():
        if name not in present:  # this also excludes files of other folders
            raise CheckpointError(f"{path} is damaged: {name} is missing")
        if digest_of(path / name) != digest:
            raise CheckpointError(f"{path} is damaged: {name} has changed (SHA-256 differs)")
    if manifest["epoch"] != epoch_of(path):
        raise CheckpointError(f"{path} was renamed: it is the checkpoint of epoch {manifest['epoch']}")
    read = _read_arrays(path / STATE_FOLDER, [dtype for _, _, dtype in manifest["leaves"]])
    arrays = {name: array for (name, _, _), array in zip(manifest["leaves"], read)}
    for name, shape, dtype in manifest["leaves"]:
        if (held := _say(name, arrays[name])) != (saved := f"{name} {dtype}{shape}"):
            raise CheckpointError(f"{path} was written as {saved} but read as {held}")
    shapes = to_shapes(template)
    arrays = _fit_lanes(arrays, shapes, places)
    return _fit(path, _deal(arrays, shapes), shapes)


def _fit_lanes(arrays: dict[str, np.ndarray], shapes: Mapping[str, Any], places: Sequence[int]) -> dict[str, np.ndarray]:
    """Arrays of the runs at `places`, with the last one repeated up to the number of lanes in `shapes`.

    A program may have more lanes than runs. A single run has no lane axis. Arrays of too few lanes stay as they are.
    """
    if _STEPS not in arrays or _STEPS not in shapes:
        return arrays  # not a TrainState
    saved, needed = arrays[_STEPS].shape, tuple(shapes[_STEPS].shape)
    every = [*range(*(saved or (1,)))]
    lanes: Any = [places[min(lane, len(places) - 1)] for lane in range(*(needed or (1,)))]
    if (saved == needed and lanes == every) or len(places) > len(lanes) or max(lanes) >= len(every):
        return arrays
    return {name: (array if saved else array[None])[lanes if needed else lanes[0]] for name, array in arrays.items()}


def _deal(arrays: dict[str, np.ndarray], shapes: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Arrays with each run's episodes dealt to the rings of as many devices as in `shapes`, if their number differs.

    Each device that shares a run has a ring with a cursor. The new rings start with their oldest episode.
    """
    if not all(name in known for name in (_CURSOR, _STEPS) for known in (arrays, shapes)):
        return arrays  # not a TrainState
    before, now = (known[_CURSOR].size // max(1, known[_STEPS].size) for known in (arrays, shapes))
    if before == now or arrays[_PRIORITY].shape != shapes[_PRIORITY].shape:
        return arrays  # `_fit` compares the shapes
    lanes, rows = arrays[_STEPS].size, arrays[_PRIORITY].shape[-1]
    cursors, sizes = (arrays[name].reshape(lanes, before) for name in (_CURSOR, _SIZE))
    source = np.full((lanes, now, rows // now), -1)  # old row of each new one
    for lane in range(lanes):
        newest = _newest_first(cursors[lane], sizes[lane], rows // before)
        for device in range(now):
            own = newest[device::now]
            source[lane, device, : len(own)] = own[::-1]
    held = (source >= 0).sum(-1, dtype=sizes.dtype)
    source = source.reshape(lanes, rows, 1)

    def moved(x: np.ndarray) -> np.ndarray:
        taken = np.take_along_axis(x.reshape(lanes, rows, -1), np.maximum(source, 0), 1)
        taken[source[..., 0] < 0] = 0
        return taken.reshape(x.shape)

    dealt = {name: moved(x) if name.startswith(_RING) and name not in (_CURSOR, _SIZE) else x for name, x in arrays.items()}
    counters = {_CURSOR: held % (rows // now), _SIZE: held, _STEPS: arrays[_STEPS] * before // now}  # steps of one device
    return dealt | {name: counter.reshape(shapes[name].shape) for name, counter in counters.items()}


def _newest_first(cursors: np.ndarray, sizes: np.ndarray, rows: int) -> np.ndarray:
    """Rows of all episodes of rings with `rows` each, by age."""
    ages = [np.arange(size) for size in sizes]
    each = [ring * rows + (cursor - 1 - age) % rows for ring, (cursor, age) in enumerate(zip(cursors, ages))]
    return np.concatenate(each)[np.argsort(np.concatenate(ages), kind="stable")]


def _fit(path: Path, arrays: dict[str, np.ndarray], shapes: dict[str, jax.ShapeDtypeStruct]) -> list[np.ndarray]:
    """Arrays in the order of `shapes`.

    Missing HParams become 0 and additional ones are dropped, because a run takes them from its settings. Raises CheckpointError
    for the first array that does not match `shapes`.
    """
    fitted = []
    for name, leaf in shapes.items():
        needed = _say(name, leaf)
        if name not in arrays and name.startswith(_HPARAMS):
            fitted.append(np.zeros(leaf.shape, leaf.dtype))
        elif name not in arrays and name in _EARLIER:  # written before episodes could end early: all have T steps
            steps = shapes[".replay.episodes.action"].shape[-2]
            fitted.append(np.full(leaf.shape, steps if name.endswith("length") else 0, leaf.dtype))
        elif name not in arrays:
            raise CheckpointError(f"{path} does not fit this run: it has no {needed}")
        elif (held := _say(name, arrays[name])) != needed:
            raise CheckpointError(f"{path} does not fit this run: it has {held} instead of {needed}")
        else:
            fitted.append(arrays[name])
    if extra := [name for name in arrays if name not in shapes and not name.startswith(_HPARAMS)]:
        raise CheckpointError(f"{path} does not fit this run: it has {extra[0]}, which is not needed")
    return fitted


def _say(name: str, array: Any) -> str:
    return f"{name} {array.dtype}{list(array.shape)}"


def _place(arrays: Sequence[np.ndarray], template: Any) -> Any:
    """Makes a state from its leaves, with the shardings of `template` or on the default device."""
    leaves, treedef = jax.tree.flatten(template)

    def put(array: np.ndarray, leaf: Any) -> Any:
        if getattr(leaf, "sharding", None) is None:
            value = jnp.array(array)  # a copy, because the next epoch reuses its memory
        else:
            value = jax.make_array_from_callback(array.shape, leaf.sharding, lambda index: array[index])
        return with_key(value, leaf)

    return jax.tree.unflatten(treedef, [put(array, leaf) for array, leaf in zip(arrays, leaves)])


def _read_arrays(path: Path, dtypes: Sequence[str]) -> list[np.ndarray]:
    names = [f"{index:04d}" for index in range(len(dtypes))]
    try:
        if not any(path.glob("*.npy")):  # from a version that used orbax
            from mjx_dher.system import private_api

            with private_api.array_checkpointer() as checkpointer:
                arrays = checkpointer.restore(path.absolute())
            return [np.asarray(arrays[name]) for name in names]
        read = [np.load(path / f"{name}.npy", allow_pickle=False) for name in names]
        # NumPy has no name for bfloat16.
        return [array.view(jnp.dtype(dtype)) if array.dtype.kind == "V" else array for array, dtype in zip(read, dtypes)]
    except Exception as error:  # orbax raises many kinds of errors
        raise CheckpointError(f"{path} cannot be read ({error})") from error
