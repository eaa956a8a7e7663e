"""Trains the trials of a sweep in as few compiled programs as possible.

A trial is a run folder, named after its settings and their digest, with a result once it has ended. A sweep that was stopped or
made larger trains the missing trials. Runs that were side by side when it was stopped resume from their checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from mjx_dher.parallel import processes
from mjx_dher.runs.driver import Result, train_runs
from mjx_dher.runs.options import Options
from mjx_dher.runs.program.loop import Progress
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid
from mjx_dher.types import Env

UNFINISHED = "unfinished"


def run(
    folder: Path,
    specs: Sequence[RunSpec],
    make_env: Callable[[RunSpec], Env],
    *,
    options: Options,
    lanes: int | None = None,
    devices: int | str = 1,
    should_stop: Callable[[], bool] = lambda: False,
    report: Callable[[str], None] = lambda text: None,
    on_epoch: Callable[[Sequence[RunSpec], Progress], None] = lambda specs, progress: None,
) -> list[Result]:
    """Trains trials into the folder of a sweep. Trials that can share a program do, in any order.

    Args:
      folder: of the sweep; made if it does not exist.
      specs: trials, in order.
      make_env: makes the environment of a trial.
      options: evaluation, checkpoints, logs.
      lanes: runs side by side, at most.
      devices: to train on, or "all", as for `train_runs`.
      should_stop: asked after every epoch; True ends the sweep, with a checkpoint.
      report: called with a line about each program and checkpoint.
      on_epoch: called after every epoch of those side by side.

    Returns:
      A Result for each trained trial. Trials that had ended before, that another program trains, or that were still waiting
      when the sweep was stopped have none.

    Raises:
      ValueError: as `train_runs`.
    """
    results: list[Result] = []
    for trials in grid.by_program(specs):
        if results and processes.any_process(should_stop()):
            break
        results += train_runs(
            make_env(trials[0]),
            trials,
            [grid.folder_of(folder, spec) for spec in trials],
            options=options,
            lanes=lanes,
            devices=devices,
            shared=folder / UNFINISHED,
            sweep=True,
            should_stop=should_stop,
            report=report,
            on_epoch=on_epoch,
        )
    return results
