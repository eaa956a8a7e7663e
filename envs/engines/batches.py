"""Batches of MuJoCo C as arrays: rows of float32 go in and come out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from mjx_dher.envs.engines.fields import LATE

EXACT = ("time", "history")  # float64 between steps too, because a float32 time would stop advancing
FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]
_KEPT = 8  # batches to keep, of the last sizes
_FEW = 64  # most simulations that one thread may step faster than several, which must wake up


class Rows:
    """Simulations in a batch, and views [nsim, n] of the batch's memory.

    Args:
      batch: it must be persistent if some of `derived` are `LATE`.
      inputs: fields of the state that `write` sets.
      outputs: fields of the state that `read` returns.
      derived: other fields that it returns.
      exact: whether rows also have the digits of `EXACT` that float32 omits.
      variation: numbers of the model that vary (`base.variation_of`). Their factors end a row that goes in.
    """

    def __init__(
        self,
        batch: Batch,
        inputs: Sequence[str],
        outputs: Sequence[str],
        derived: Sequence[str],
        exact: bool,
        variation: Any,
    ):
        self.batch, self.seconds = batch, 0.0  # that a call takes
        self._inputs, self._outputs = _joined(batch, inputs), _joined(batch, outputs)
        views = {name: batch.bind(name).reshape(batch.nsim, -1) for name in derived if _size(batch.bind(name))}
        self._derived = list(views.items())
        self._late: dict[str, Callable[..., Any]] = {name: LATE[name] for name in views if name in LATE}
        self._exact = [view for name in EXACT for view in _joined(batch, [name])] if exact else []
        self._variation, self._factors = variation, np.full((batch.nsim, variation.size), np.nan)
        self._varied = {name: batch.expand(name) for name in variation.fields}
        self._warnings = batch.warning[..., 1]
        self._warnings[...] = 1  # MuJoCo writes MUJOCO_LOG.TXT when a number of warnings leaves 0

    def write(self, rows: np.ndarray) -> None:
        """Sets the state to `rows` [nsim, n]."""
        begin = 0
        for view in self._inputs:
            begin, end = begin + view.shape[1], begin
            view[...] = rows[:, end:begin]
        if self._exact:
            _add(self._exact, rows[:, begin:])
        if self._varied and not np.array_equal(factors := rows[:, -self._variation.size :], self._factors):
            self._factors[...] = factors
            for name, value in self._variation.values(self._factors).items():
                self._varied[name][...] = value

    def read(self, results: np.ndarray) -> None:
        """Puts the state and derived fields into `results` [nsim, n]."""
        parts = self._outputs
        if self._exact:
            late = self._compute_late() if self._late else {}
            exact = np.concatenate(self._exact, axis=1) if len(self._exact) > 1 else self._exact[0]
            derived = [late.get(name, view) for name, view in self._derived]
            parts = [*parts, *derived, residue(exact).reshape(len(exact), -1)]
        begin = 0
        for part in parts:
            begin, end = begin + part.shape[1], begin
            results[:, end:begin] = part

    def lost(self) -> int:
        """Timesteps that left out contacts since the last call."""
        if np.add.reduce(self._warnings, axis=None) == self._warnings.size:
            return 0
        lost = int((self._warnings[:, FULL] - 1).sum())
        self._warnings[...] = 1
        return lost

    def _compute_late(self) -> dict[str, np.ndarray]:
        data, filled = mujoco.MjData(self.batch.model), {name: np.empty_like(dict(self._derived)[name]) for name in self._late}
        for index in range(self.batch.nsim):
            self.batch.get_data(index, data)
            model = self.batch.get_model(index) if self._varied else self.batch.model
            for compute in dict.fromkeys(self._late.values()):
                compute(model, data)
            for name, rows in filled.items():
                rows[index] = np.ravel(getattr(data, name))
        return filled


class Choice:
    """Batches of the same simulations on one thread and on all. Results are equal, and the faster one is used."""

    def __init__(self, num_threads: int):
        self._num_threads = num_threads
        self.kept: dict[int, list[Rows]] = {}  # by the number of simulations

    def choose(self, nsim: int, made: Callable[..., Rows], *options: Any) -> Rows:
        """Rows for `nsim` simulations. `made(nsim, threads, *options)` makes them for the first call."""
        rows = self.kept.pop(nsim, None)
        if rows is None:
            few = 1 if nsim <= _FEW else self._num_threads
            rows = [made(nsim, threads, *options) for threads in sorted({few, self._num_threads})]
        self.kept[nsim] = rows
        if len(self.kept) > _KEPT:
            del self.kept[next(iter(self.kept))]
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


def _add(exact: list[np.ndarray], residue: np.ndarray) -> None:
    """Adds `residue` [nsim, 2 n] to the fields [nsim, n in total] whose values it belongs to."""
    size = sum(view.shape[1] for view in exact)
    parts = np.add(residue[:, :size], residue[:, size : 2 * size], dtype=np.float64)
    for view in exact:
        part, parts = parts[:, : view.shape[1]], parts[:, view.shape[1] :]
        whole = view + part
        np.copyto(view, whole, where=whole.astype(np.float32) == view)


def _joined(batch: Batch, names: Sequence[str]) -> list[np.ndarray]:
    """Views [nsim, n] of fields of the state. Those that are neighbours in memory are one."""
    spans: list[list[int]] = []
    for name in names:
        view = batch.bind(name)
        begin = (view.ctypes.data - batch.state.ctypes.data) // batch.state.itemsize
        if not spans or spans[-1][1] != begin:
            spans.append([begin, begin])
        spans[-1][1] += view.size // batch.nsim
    return [batch.state[:, begin:end] for begin, end in spans if begin < end]


def _size(view: np.ndarray) -> int:
    return math.prod(view.shape[1:])
