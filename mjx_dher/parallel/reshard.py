"""Arrays of a checkpoint, laid out for another number of devices than it was made on.

A run on one device has one ring. Of a run in parts, each has a ring of its own, an equal block of the rows, with a cursor and a
size. Runs side by side may be filled up to what the devices divide, by the last one again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

_EPISODES, _PRIORITY, _CURSOR, _SIZE = (f".replay.{name}" for name in ("episodes", "priority", "cursor", "size"))
_STEPS = ".env_steps"


def regroup(arrays: Mapping[str, np.ndarray], shapes: Mapping[str, Any], runs: int) -> dict[str, np.ndarray]:
    """Returns the arrays of a TrainState, by name, as `shapes` ask for them; what does not fit at all stays as it is.

    Args:
      arrays: as they were saved.
      shapes: what is needed, by name; anything with a shape.
      runs: that were saved; those behind them fill up.
    """
    if any(name not in names for name in (_CURSOR, _SIZE, _PRIORITY, _STEPS) for names in (arrays, shapes)):
        return dict(arrays)  # of no TrainState
    arrays = _fill_up(arrays, shapes, runs)
    batched = len(shapes[_STEPS].shape) > 0
    if arrays[_STEPS].shape != tuple(shapes[_STEPS].shape) or arrays[_CURSOR].shape == tuple(shapes[_CURSOR].shape):
        return arrays
    before, now = (_parts(x, batched) for x in (arrays[_CURSOR], shapes[_CURSOR]))
    rows = arrays[_PRIORITY].shape[-1]
    if rows % before or rows % now:
        return arrays
    ring = [name for name in arrays if name == _PRIORITY or name.startswith(_EPISODES)]
    counters = [arrays[name].reshape(-1, before) for name in (_CURSOR, _SIZE)]
    plans = [_plan(cursor, size, rows, now) for cursor, size in zip(*counters)]
    moved = {name: _move(arrays[name], [plan[0] for plan in plans], batched) for name in ring}
    sizes = np.stack([plan[1] for plan in plans]).astype(arrays[_SIZE].dtype)  # [L, now]
    shape = tuple(shapes[_CURSOR].shape)
    moved |= {_SIZE: sizes.reshape(shape), _CURSOR: (sizes % (rows // now)).astype(arrays[_CURSOR].dtype).reshape(shape)}
    return {name: moved.get(name, array) for name, array in arrays.items()}


def _parts(counter: Any, batched: bool) -> int:
    """Returns the parts of each run, by the shape of its cursor."""
    return int(counter.shape[-1]) if len(counter.shape) > batched else 1


def _fill_up(arrays: Mapping[str, np.ndarray], shapes: Mapping[str, Any], runs: int) -> dict[str, np.ndarray]:
    """Returns the arrays of the `runs` and so many repetitions of the last as are needed; one run alone needs no axis."""
    saved, needed = arrays[_STEPS].shape, tuple(shapes[_STEPS].shape)
    if saved == needed or not 1 <= runs <= min(*(saved or (1,)), *(needed or (1,))):
        return dict(arrays)
    batched = {name: array if saved else array[None] for name, array in arrays.items()}
    lanes: Any = np.minimum(np.arange(needed[0]), runs - 1) if needed else 0
    return {name: array[lanes] for name, array in batched.items()}


def _plan(cursor: np.ndarray, size: np.ndarray, rows: int, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Deals the episodes of one run's rings out to `parts` rings, oldest first.

    Args:
      cursor: of each ring [before].
      size: episodes that each holds [before].
      rows: of all rings together.
      parts: rings that are wanted.

    Returns:
      For each row from which row it comes, -1 for an empty one [rows], and the sizes of the new rings [parts].
    """
    block = rows // len(cursor)
    aged = [
        (age, part, part * block + (int(next_row) - 1 - age) % block)  # age 0: the newest episode of its ring
        for part, (next_row, held) in enumerate(zip(cursor, size))
        for age in range(int(held))
    ]
    newest_first = [row for _, _, row in sorted(aged)]
    source = np.full(rows, -1, np.int64)
    block = rows // parts
    dealt = [newest_first[part::parts][::-1] for part in range(parts)]
    for part, own in enumerate(dealt):
        source[part * block : part * block + len(own)] = own
    return source, np.array([len(own) for own in dealt])


def _move(array: np.ndarray, sources: list[np.ndarray], batched: bool) -> np.ndarray:
    """Returns an array of rings [rows, ...], or [L, rows, ...], with each row taken from where `sources` say; 0 where empty."""
    rings = array if batched else array[None]
    moved = np.zeros_like(rings)
    for ring, source, result in zip(rings, sources, moved):
        result[source >= 0] = ring[source[source >= 0]]
    return moved if batched else moved[0]
