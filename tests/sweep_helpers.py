"""A sweep of the point mass, for its tests; what one test has compiled the next one need not."""

import csv
import dataclasses

import pytest
from configs import SMALL

from mjx_dher import HParams, Options, RunSpec
from mjx_dher.runs import driver, program
from mjx_dher.sweeps import grid, tables
from mjx_dher.system import machine
from probes import PointMass

# An epoch of 240 steps.
CONFIG = dataclasses.replace(SMALL, num_envs=8, updates_per_cycle=8, hidden_sizes=(16,), total_steps=240)
LONGER = dataclasses.replace(CONFIG, total_steps=5 * CONFIG.total_steps)
DEFAULT = HParams()
_compiled = {}


@pytest.fixture(scope="module", autouse=True)
def compile_once():
    """Tests and fixtures of a module that imports it share compiled programs, which have no state."""
    compile_runs = program.compile_runs

    def cached(env, specs, max_lanes, final_episodes, report, devices=(), sweep=False, together=1):
        choices = str(program.choices_of(specs))
        lanes = program.equal_lanes(len(specs), min(len(specs), max_lanes or len(specs)), 1, together)
        key = (type(env), specs[0].program, choices, lanes, final_episodes, machine.available_bytes, devices, sweep)
        if key not in _compiled:
            lines = []
            _compiled[key] = (
                compile_runs(env, specs, max_lanes, final_episodes, lines.append, devices, sweep, together),
                lines,
            )
        compiled, lines = _compiled[key]
        for line in lines:
            report(line)
        return compiled

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program, "compile_runs", cached)
        yield


def spec_of(static=CONFIG, **changes):
    return RunSpec(env="point_mass", config=static, **changes)


def make_grid(samplers=("future", "weighted"), seeds=(0, 1), points=(DEFAULT,), static=CONFIG, env="point_mass"):
    settings = [spec_of(static, sampler=sampler, hparams=point) for sampler in samplers for point in points]
    return grid.trials([dataclasses.replace(spec, env=env) for spec in settings], seeds)


def run(folder, trials, checkpoint_every=0, **options):
    options.setdefault("lanes", 1)
    settings = Options(final_episodes=15, checkpoint_every=checkpoint_every)
    return grid.train(folder, trials, lambda spec: PointMass(), options=settings, **options)


TIMES = ("wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes")


def table(folder, name=tables.RESULTS, without=TIMES):
    tables.write(folder, tables.read(folder))
    with (folder / name).open() as file:
        return [{k: v for k, v in row.items() if k not in without} for row in csv.DictReader(file)]


def cut_short(folder, trials, epoch, **options):
    """Trains until a stop is asked for after `epoch`."""
    seen = []
    on_epoch = lambda specs, progress: seen.append(progress.epoch)  # noqa: E731
    results = run(folder, trials, on_epoch=on_epoch, should_stop=lambda: seen[-1] == epoch, **options)
    assert {result.status for result in results} == {driver.STOPPED}
