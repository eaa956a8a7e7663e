"""Trains the trials of a sweep in as few compiled programs as possible.

A trial is a run folder, named after its settings and their digest. To finish or extend a sweep, run it again: it trains the
missing trials, and unfinished runs resume from their checkpoint.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mjx_dher.parallel import processes
from mjx_dher.runs import program
from mjx_dher.runs.driver import Result, train_runs
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid
from mjx_dher.types import Env

UNFINISHED = "unfinished"


def run(
    folder: Path,
    specs: Sequence[RunSpec],
    make_env: Callable[[RunSpec], Env],
    should_stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> list[Result]:
    """Trains trials into the folder of a sweep, which is made if necessary. Trials share programs if possible, in any order.

    `make_env` makes the environment of a trial. The options, and errors, are those of `train_runs`. Returns one Result per
    trained trial, none for those that had ended, that another process trains, or that were waiting at a stop.
    """
    options |= {"should_stop": should_stop, "shared": folder / UNFINISHED, "sweep": True}
    results: list[Result] = []
    groups = [(make_env(trials[0]), trials) for trials in grid.by_program(specs)]
    for env, trials in groups[1:]:  # before the first ones train, which may take days
        program.check_runs(env, trials, options.get("lanes"), options.get("devices", 1))
    for env, trials in groups:
        if results and processes.any_process(should_stop()):
            break
        results += train_runs(env, trials, [grid.folder_of(folder, spec) for spec in trials], **options)
    return results
