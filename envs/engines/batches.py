"""Batches of MuJoCo C as arrays: rows of float32 go in and come out."""

import ctypes
import math
import sys
from collections.abc import Callable, Container, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from mjx_dher.envs.engines.fields import LATE

EXACT = ("time", "history")  # float64 between steps too, because a float32 time would stop advancing
FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]
BAD_CTRL = int(mujoco.mjtWarning.mjWARN_BADCTRL)
_NONE = np.empty(0, np.intp)
_KEPT = 8  # batches to keep, of the last sizes
_Place = tuple[slice, slice]  # in rows
_FEW = 64  # most simulations that one thread may step faster than several, which must wake up


class Rows:
    """Simulations in a batch, and rows [nsim, n] of numbers that enter and leave the batch's memory.

    Args:
      batch: it must be persistent if some of `derived` are `LATE`.
      inputs: fields of the state that `write` sets.
      outputs: fields of the state that `read` returns.
      derived: other fields that it returns, after the outputs and factors.
      digits: numbers at the start of a row: the digits of `EXACT` that float32 omits, or 0 if rows do not have them.
      variation: numbers of the model that vary (`engines.variation_of`). Their factors follow the inputs in a row.
    """

    def __init__(
        self, batch: Batch, inputs: Sequence[str], outputs: Sequence[str], derived: Sequence[str], digits: int, variation: Any
    ):
        self.batch, self.seconds = batch, 0.0  # that a call takes
        self._inputs = _placed(batch, inputs, digits, EXACT if digits else ())
        self._outputs = _placed(batch, outputs, digits)
        # Factors follow the inputs, and derived fields follow the factors.
        begin = digits + sum(_size(batch.bind(name)) for name in inputs)
        self._factor_place, begin = np.s_[:, begin : begin + variation.size], begin + variation.size
        self._late: dict[str, _Place] = {}
        for name in derived:
            view = batch.bind(name).reshape(batch.nsim, -1)
            place, begin = np.s_[:, begin : begin + view.shape[1]], begin + view.shape[1]
            if view.shape[1] and name in LATE:
                self._late[name] = place
            elif view.shape[1]:
                self._outputs.append((view, place))
        # Exact numbers in memory, the places of what float32 has of them and of two parts of the rest, and a buffer.
        self._exact: list[tuple[np.ndarray, _Place, _Place, _Place, np.ndarray]] = []
        begin = 0
        for name in EXACT if digits else ():
            for view, place in _placed(batch, inputs, digits, set(inputs) - {name}):
                end, half = begin + view.shape[1], digits // 2
                high, low = np.s_[:, begin:end], np.s_[:, half + begin : half + end]
                self._exact.append((view, place, high, low, np.empty(view.shape)))
                begin = end
        # All of them in a row: the digits, and the time that follows.
        self._exact_places = [np.s_[:, : digits + 1], *(place for _, place, *_ in self._exact[1:])]
        self._known: list[bytes] | None = None  # the exact numbers in memory, as rows have them
        self._variation, self._factors = variation, np.full((batch.nsim, variation.size), np.nan)
        self._varied = {name: batch.expand(name) for name in variation.fields}
        batch.warning[..., 1] = 1  # MuJoCo writes MUJOCO_LOG.TXT when a number of warnings leaves 0
        self._warned = batch.warning.tobytes()

    def write(self, rows: np.ndarray) -> None:
        """Sets the state to `rows` [nsim, n]."""
        for view, place in self._inputs:
            view[...] = rows[place]
        if self._exact and self._known != self._exact_bytes(rows):
            for view, place, high, low, whole in self._exact:
                view[...] = rows[place]
                np.add(view, rows[high], out=whole)
                np.add(whole, rows[low], out=whole)
                np.copyto(view, whole, where=whole.astype(np.float32) == view)
        self._known = None
        if self._varied and not np.array_equal(factors := rows[self._factor_place], self._factors):
            self._factors[...] = factors
            for name, value in self._variation.values(self._factors).items():
                self._varied[name][...] = value

    def read(self, results: np.ndarray) -> None:
        """Puts the state and derived fields into `results` [nsim, n]."""
        for view, place in self._outputs:
            results[place] = view
        if self._late:
            self._compute_late(results)
        if self._exact and self._varied:
            results[self._factor_place] = self._factors
        for view, place, high, low, rest in self._exact:
            np.subtract(view, results[place], out=rest)
            results[high] = rest
            np.subtract(rest, results[high], out=rest)
            results[low] = rest
        if self._exact:
            self._known = self._exact_bytes(results)

    def read_warnings(self) -> tuple[int, np.ndarray]:
        """Timesteps that left out contacts since the last call, and the simulations that had a control that is no number."""
        warning = self.batch.warning
        if warning.tobytes() == self._warned:
            return 0, _NONE
        lost, bad = int((warning[:, FULL, 1] - 1).sum()), np.flatnonzero(warning[:, BAD_CTRL, 1] > 1)
        warning[..., 1] = 1
        self._warned = warning.tobytes()
        return lost, bad

    def _exact_bytes(self, rows: np.ndarray) -> list[bytes]:
        return [rows[place].tobytes() for place in self._exact_places]

    def _compute_late(self, results: np.ndarray) -> None:
        data = mujoco.MjData(self.batch.model)
        for index in range(self.batch.nsim):
            self.batch.get_data(index, data)
            model = self.batch.get_model(index) if self._varied else self.batch.model
            for compute in dict.fromkeys(LATE[name] for name in self._late):
                compute(model, data)
            for name, place in self._late.items():
                results[index, place[1]] = np.ravel(getattr(data, name))


class Untimed:
    """A block in which MuJoCo does not read its clock, which it does some 25 times a timestep to fill `MjData.timer`.

    In a model of few bodies this takes half of the time. The clock is MuJoCo's global `mjcb_time`, which the last block to end
    restores. Where a library does not export it, nothing changes.
    """

    def __init__(self) -> None:
        self._blocks: list[None] = []  # one for each open block; a list needs no lock
        self._before: int | None = None
        try:
            bindings = sys.modules[mujoco.mj_step.__module__].__file__
            self._clock: Any = ctypes.c_void_p.in_dll(ctypes.CDLL(bindings), "mjcb_time")
        except (OSError, ValueError):
            self._clock = ctypes.c_void_p()  # stands for it

    def __enter__(self) -> None:
        self._blocks.append(None)
        if (clock := self._clock.value) is not None:
            self._before, self._clock.value = clock, None

    def __exit__(self, *_: object) -> None:
        self._blocks.pop()
        if not self._blocks and self._clock.value is None:  # else somebody set a clock
            self._clock.value = self._before


UNTIMED = Untimed()


class Choice:
    """Batches of the same simulations on one thread and on all. Results are equal, and the faster one is used."""

    def __init__(self, num_threads: int):
        self._num_threads = num_threads
        self.kept: dict[int, list[Rows]] = {}  # by the number of simulations

    def choose(self, nsim: int, made: Callable[..., Rows], *options: Any) -> Rows:
        """Rows for `nsim` simulations. `made(nsim, threads, *options)` makes them for the first call."""
        rows = self.kept.pop(nsim, None)
        if rows is None:
            most = min(nsim, self._num_threads)
            rows = [made(nsim, threads, *options) for threads in sorted({1 if nsim <= _FEW else most, most})]
        self.kept[nsim] = rows
        if len(self.kept) > _KEPT:
            del self.kept[next(iter(self.kept))]
        if len(rows) == 1:
            return rows[0]
        chosen = min(rows, key=lambda each: each.seconds)
        for other in rows:
            if other is not chosen:
                other.seconds *= 0.998  # so that it is tried again, the less often the slower it was
        return chosen


def residue(values: np.ndarray) -> np.ndarray:
    """Parts of `values` [..., n] that float32 omits, as two float32 numbers [..., 2, n]."""
    parts = np.empty((*values.shape[:-1], 2, values.shape[-1]))
    np.subtract(values, values.astype(np.float32), out=parts[..., 0, :])
    np.subtract(parts[..., 0, :], parts[..., 0, :].astype(np.float32), out=parts[..., 1, :])
    return parts


def _placed(batch: Batch, names: Sequence[str], begin: int, skipped: Container[str] = ()) -> list[tuple[np.ndarray, _Place]]:
    """Views [nsim, n] of fields of the state, and their places in a row that has `names` from `begin` on.

    Fields that are neighbours in memory are one.
    """
    spans: list[list[int]] = []  # begin and end in memory, and end in the row
    for name in names:
        view = batch.bind(name)
        column, size = (view.ctypes.data - batch.state.ctypes.data) // batch.state.itemsize, _size(view)
        if size and name not in skipped:
            if not spans or spans[-1][1:] != [column, begin]:
                spans.append([column, column, begin])
            spans[-1] = [spans[-1][0], column + size, begin + size]
        begin += size
    return [(batch.state[:, first:last], np.s_[:, end - (last - first) : end]) for first, last, end in spans]


def _size(view: np.ndarray) -> int:
    return math.prod(view.shape[1:])
