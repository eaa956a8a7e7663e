"""A stopped sweep of parallel runs goes on: each resumes from a checkpoint that it shares with others."""

import dataclasses
import json
import math

import pytest
from sweep_helpers import LONGER, compile_once, cut_short, make_grid, run, table  # noqa: F401

from mjx_dher import HParams
from mjx_dher.runs.program import equal_lanes
from mjx_dher.sweeps import grid, tables
from mjx_dher.system import files

METRICS = ("success_rate", "return_mean", "critic_norm", "q_mean", "relabel_distance")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Numbers of the tables of seven runs that were not stopped."""
    folder = tmp_path_factory.mktemp("whole")
    run(folder, make_grid(("future",), range(7), static=LONGER), lanes=3)
    return numbers(folder)


def numbers(folder):
    """Metrics by seed and epoch. Other lanes round differently."""
    rows = table(folder)
    return {(int(row["seed"]), row["epoch"]): pytest.approx([float(row[name]) for name in METRICS], rel=1e-4) for row in rows}


def goes_on(folder, whole, expected, seeds=range(7), **options):
    """Runs the sweep of seven to its end, and compares its parallel runs, with the epochs of each, and its rows."""
    said = []
    note = lambda specs, progress: said.append((*(spec.seed for spec in specs), progress.epoch))  # noqa: E731
    run(folder, make_grid(("future",), seeds, static=LONGER), on_epoch=note, **options)
    assert said == expected
    found = {place: metrics.expected for place, metrics in numbers(folder).items()}
    assert found == {place: metrics for place, metrics in whole.items() if place[0] in seeds}
    assert not (folder / "unfinished").exists()
    assert not list(folder.glob("cells/*/checkpoints"))


def test_parallel_runs_of_a_stopped_sweep_stay_together(tmp_path, whole):
    """Three of seven have ended. Chunks of equal sizes would be of two, and would not have the checkpoint of the next three."""
    seen = []
    stop = lambda: len(seen) == 5 + 2  # noqa: E731
    trials = make_grid(("future",), range(7), static=LONGER)
    run(tmp_path, trials, lanes=3, on_epoch=lambda specs, progress: seen.append(progress.epoch), should_stop=stop)
    goes_on(tmp_path, whole, [(3, 4, 5, epoch) for epoch in (3, 4, 5)] + [(6, epoch) for epoch in range(1, 6)], lanes=3)


def test_a_stopped_sweep_goes_on_with_other_lanes_and_more_seeds(tmp_path, whole):
    """Seeds 1 to 3 stop after two epochs. One of them then ends alone, and the other two as a pair, beside new ones."""
    cut_short(tmp_path, make_grid(("future",), (1, 2, 3), static=LONGER), 2, lanes=3)
    (cells,) = tmp_path.glob("unfinished/*/cells.json")
    run(tmp_path, make_grid(("future",), (2,), static=LONGER), lanes=1)
    assert cells.exists()  # two runs need it
    pair = [(1, 3, epoch) for epoch in (3, 4, 5)]
    rest = [(*seeds, epoch) for seeds in ((0, 4), (5, 6)) for epoch in range(1, 6)]
    goes_on(tmp_path, whole, rest[:5] + pair + rest[5:], lanes=2)


def test_a_kill_between_two_results_costs_no_epoch_twice(tmp_path, whole, monkeypatch):
    """The first of three results is written. The other two resume from the checkpoint of all three, in as many lanes."""
    write_json, left = files.write_json, [1]

    def killed(path, content):
        if path.name == "result.json":
            if not left:
                raise KeyboardInterrupt
            left.pop()
        write_json(path, content)

    trials = make_grid(("future",), (0, 1, 2), static=LONGER)
    monkeypatch.setattr(files, "write_json", killed)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, trials, lanes=3, checkpoint_every=4)
    monkeypatch.undo()
    assert [grid.is_done(tmp_path, trial) for trial in trials] == [True, False, False]
    goes_on(tmp_path, whole, [(1, 2, 5)] + [(3, 4, 5, epoch) for epoch in range(1, 6)], range(6), lanes=3)


def test_without_the_latest_checkpoint_an_earlier_one_is_used(tmp_path, whole):
    """A pair's checkpoint, of the second epoch, is damaged, and that of three, of the first epoch, is not."""
    cut_short(tmp_path, make_grid(("future",), (0, 1, 2), static=LONGER), 1, lanes=3)
    cut_short(tmp_path, make_grid(("future",), (0, 1), static=LONGER), 2, lanes=2)
    (manifest,) = tmp_path.glob("unfinished/*/checkpoints/epoch-000002/manifest.json")
    manifest.write_text("{")
    reports = []
    expected = [(0, 1, epoch) for epoch in range(2, 6)] + [(2, epoch) for epoch in range(2, 6)]
    goes_on(tmp_path, whole, expected, range(3), lanes=2, report=reports.append)
    assert any("epoch-000002" in line and "cannot" in line for line in reports), reports


def test_each_run_resumes_from_its_latest_checkpoint(tmp_path, whole):
    """Of three after one epoch, of a pair of them after two, and of one alone."""
    cut_short(tmp_path, make_grid(("future",), (0, 1, 2), static=LONGER), 1, lanes=3)
    cut_short(tmp_path, make_grid(("future",), (0, 2), static=LONGER), 2, lanes=2)
    cut_short(tmp_path, make_grid(("future",), (3,), static=LONGER), 4, lanes=1)
    pair = [(0, 2, epoch) for epoch in (3, 4, 5)]
    goes_on(tmp_path, whole, [*pair, *((1, epoch) for epoch in range(2, 6)), (3, 5)], range(4), lanes=3)


def test_runs_that_share_a_checkpoint_need_no_list_of_names(tmp_path, whole):
    """The list is damaged, and the runs are claimed in the same order."""
    cut_short(tmp_path, make_grid(("future",), (0, 1, 2), static=LONGER), 3, lanes=3)
    (cells,) = tmp_path.glob("unfinished/*/cells.json")
    cells.write_text("{")
    goes_on(tmp_path, whole, [(0, 1, 2, epoch) for epoch in (4, 5)], range(3), lanes=3)


def test_a_failed_lane_is_no_other_one_s_failure(tmp_path):
    """The second of three fails in the first epoch. After the stop they go on one by one."""
    bad = HParams(action_l2=3e38)
    trials = [
        trial if trial.seed == 1 else dataclasses.replace(trial, hparams=HParams())
        for trial in make_grid(("future",), (0, 1, 2), (bad,), LONGER)
    ]
    cut_short(tmp_path, trials, 2, lanes=3)
    seen = []
    run(tmp_path, trials, lanes=1, on_epoch=lambda specs, progress: seen.append((specs[0].seed, progress.epoch)))
    assert [seed_epoch for seed_epoch in seen if seed_epoch[0] != 1] == [
        (seed, epoch) for seed in (0, 2) for epoch in (3, 4, 5)
    ]
    assert [trial["status"] for trial in tables.read(tmp_path)] == ["finished", "finished", "failed"]  # by name


def test_lanes_for_chunks_of_equal_sizes():
    assert [equal_lanes(runs, 16, 1, 1) for runs in (5, 16, 17, 40)] == [5, 16, 9, 14]
    assert equal_lanes(26, 16, 1, 14) == 14  # of 40, after the first 14
    assert equal_lanes(26, 16, 1, 20) == 16
    assert equal_lanes(7, 4, 2, 1) == 4
    assert [equal_lanes(10, 4, 2, together) for together in (1, 6, 8, 9)] == [3, 3, 4, 4]


def edited(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_a_trial_with_edited_files_is_trained_again(tmp_path):
    trials = make_grid(("future",), (0, 1))
    run(tmp_path, trials)
    config, result = (grid.folder_of(tmp_path, trials[0]) / name for name in ("config.json", "result.json"))
    first, metrics = config.read_bytes(), config.with_name("metrics.csv")
    for episodes in ([500], "5", 0, math.nan):
        edited(config, final_episodes=episodes)
        assert not grid.is_done(tmp_path, trials[0]), episodes
    config.write_bytes(first)
    assert grid.is_done(tmp_path, trials[0])
    content = json.loads(result.read_text())
    del content["return_mean"]  # as for NaN
    result.write_text(json.dumps(content))
    assert grid.is_done(tmp_path, trials[0])
    assert math.isnan(tables.read(tmp_path)[0]["final"]["return_mean"])
    edited(result, epochs=0)
    metrics.write_text(metrics.read_text().splitlines()[0] + "\n")
    assert not grid.is_done(tmp_path, trials[0])
    run(tmp_path, trials)
    assert all(grid.is_done(tmp_path, trial) for trial in trials)
