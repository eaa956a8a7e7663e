import csv
import dataclasses
import gc
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses
from filelock import Timeout
from sweep_helpers import CONFIG, DEFAULT, LONGER, TIMES, compile_once, cut_short, make_grid, run, spec_of, table  # noqa: F401

import mjx_dher
from mjx_dher import HParams
from mjx_dher.runs import driver, loop, program
from mjx_dher.runs.folder import checkpoint
from mjx_dher.runs.folder.fingerprint import trial_name
from mjx_dher.sweeps import grid, tables
from mjx_dher.system import machine
from mjx_dher.system.files import FolderError
from probes import PointMass, held


def test_trials_are_all_combinations_seed_by_seed():
    trials = make_grid(points=(HParams(her_k=2.0), HParams(her_k=4.0)))
    assert [(t.seed, t.sampler, t.hparams.her_k) for t in trials] == [
        (seed, sampler, k) for seed in (0, 1) for sampler in ("future", "weighted") for k in (2.0, 4.0)
    ]
    names = [trial_name(t) for t in trials]
    assert len(set(names)) == 8
    assert names[0].startswith("point_mass-future-s0-")
    other = dataclasses.replace(trials[0], config=dataclasses.replace(trials[0].config, batch_size=33))
    assert trial_name(other) != names[0]
    assert trial_name(dataclasses.replace(trials[0], priority="my:priority")) != names[0]


def test_what_a_sampler_does_not_read_makes_no_trials_of_its_own():
    """future once, closest once, epsilon_closest for each epsilon, weighted for each kernel and temperature."""
    specs = [
        spec_of(sampler=sampler, weight_kernel=kernel, hparams=HParams(temperature=t, epsilon=e))
        for sampler in ("future", "closest", "epsilon_closest", "weighted")
        for kernel in ("linear", "softmax")
        for t in (0.5, 1.0)
        for e in (0.1, 0.2, 0.3)
    ]
    trials = grid.trials(specs, [0])
    count = lambda sampler: sum(trial.sampler == sampler for trial in trials)  # noqa: E731
    assert {name: count(name) for name in ("future", "closest", "epsilon_closest", "weighted")} == {
        "future": 1,
        "closest": 1,
        "epsilon_closest": 3,
        "weighted": 4,
    }


def test_what_can_share_a_program_is_together():
    runs = [spec_of(sampler=sampler, learner=learner) for sampler in ("future", "weighted") for learner in ("ddpg", "td3")]
    assert [[run.learner for run in group] for group in grid.by_program(runs)] == [["ddpg", "ddpg"], ["td3", "td3"]]
    assert [run.sampler for run in grid.by_program(runs)[1]] == ["future", "weighted"]


def test_readings_are_lanes_of_one_program_and_a_scale_counts_where_it_is_read():
    specs = [
        spec_of(sampler=sampler, weight_normalization=normalization, hparams=HParams(weight_scale=scale))
        for sampler in ("future", "weighted")
        for normalization in ("mean", "sum", "none")
        for scale in (0.02, 0.05)
    ]
    trials = grid.trials(specs, [0])
    assert len({trial.program for trial in trials}) == 1
    own = [(t.sampler, t.weight_normalization, t.hparams.weight_scale) for t in trials]
    assert own == [
        ("future", "mean", 0.02),
        ("weighted", "mean", 0.02),
        ("weighted", "sum", 0.02),
        ("weighted", "none", 0.02),
        ("weighted", "none", 0.05),
    ]
    assert len({trial_name(trial) for trial in trials}) == len(trials)


def test_environments_stay_together():
    trials = grid.trials([dataclasses.replace(spec_of(), env=env) for env in ("reach", "push")], [0, 1, 2])
    assert [trial.env for trial in trials] == ["reach"] * 3 + ["push"] * 3


@pytest.mark.slow
def test_a_run_that_another_program_trains_is_left_to_it(tmp_path, monkeypatch):
    trials = make_grid(seeds=(0, 1))
    path = grid.folder_of(tmp_path, trials[0])
    path.mkdir(parents=True)
    locked, finish = [], driver._finish

    def look(session, compiled, progress, runs, watch):
        for folder in watch.folders:
            with pytest.raises(Timeout), held(folder):
                pass
            locked.append(folder)
        return finish(session, compiled, progress, runs, watch)

    monkeypatch.setattr(driver, "_finish", look)
    with held(path):
        run(tmp_path, trials, lanes=2)
    assert [grid.is_done(tmp_path, trial) for trial in trials] == [False, True, True, True]
    assert locked == [grid.folder_of(tmp_path, trial) for trial in trials[1:]]  # until their results are written
    run(tmp_path, trials, lanes=2)
    assert locked[3:] == [path]


@pytest.mark.slow
def test_another_program_s_checkpoints_stay(tmp_path):
    first, second = make_grid(("future",), (0, 1), static=LONGER), make_grid(("future",), (2, 3), static=LONGER)
    cut_short(tmp_path, first, 2, lanes=2)
    run(tmp_path, second, lanes=2)
    assert len(list((tmp_path / "unfinished").iterdir())) == 1
    run(tmp_path, first, lanes=2)
    assert not (tmp_path / "unfinished").exists()


@pytest.mark.slow
def test_a_lane_is_that_run_alone(tmp_path):
    """The same first parameters, to the bit, and the same draws; afterwards rounding, because XLA sums products of another
    shape in another order, which 24 updates let grow to less than 1e-4 here."""
    trials = make_grid(("random", "weighted"), (3, 4))
    curves, learned = {}, {}

    def note(specs, progress):
        for lane, spec in enumerate(specs):
            curves[spec] = {name: values[lane] for name, values in progress.metrics.items()}
            learned[spec] = jax.tree.map(lambda x, lane=lane: np.asarray(x[lane]), progress.state.learner.params)

    run(tmp_path, trials, lanes=4, on_epoch=note)
    assert len({jax.tree.leaves(params)[0].tobytes() for params in learned.values()}) == len(trials)
    for sampler in ("random", "weighted"):
        own = [trial for trial in trials if trial.sampler == sampler]
        train = program.make_loop(PointMass(), own[0], program.choices_of(own))
        compiled = loop.compile_program(train, jax.random.key(0), HParams())
        for trial in own:
            start = loop.Start(compiled.init(jax.random.key(trial.seed), trial.hparams))
            (alone,) = loop.run(PointMass(), trial.config, compiled, start)
            for name, value in alone.metrics.items():
                assert curves[trial][name] == pytest.approx(value, rel=1e-3, abs=1e-4), (trial, name)
            for a, b in zip(jax.tree.leaves(learned[trial]), jax.tree.leaves(alone.state.learner.params), strict=True):
                np.testing.assert_allclose(a, b, atol=1e-4)
    keys, hparams = jnp.stack([jax.random.key(3), jax.random.key(4)]), HParams(*(jnp.full(2, x) for x in HParams()))
    together = jax.jit(jax.vmap(train.init))(keys, hparams)
    for lane, key in enumerate(keys):
        alone = jax.jit(train.init)(key, HParams())
        for a, b in zip(jax.tree.leaves(together.learner), jax.tree.leaves(alone.learner), strict=True):
            np.testing.assert_array_equal(a[lane], b)


@pytest.mark.slow
def test_a_sweep_that_was_cut_short_trains_what_is_missing_and_ends_as_if_it_had_not_been(tmp_path):
    trials, cut, whole = make_grid(seeds=(0, 1, 2)), tmp_path / "cut", tmp_path / "whole"
    done = []
    run(cut, trials, lanes=2, on_epoch=lambda specs, _: done.extend(specs), should_stop=lambda: len(done) > 2)
    assert [grid.is_done(cut, trial) for trial in trials] == [True] * 4 + [False] * 2
    curves = [grid.folder_of(cut, trial) / "metrics.csv" for trial in trials]
    assert [path.exists() and len(path.read_text().splitlines()) for path in curves] == [2, 2, 2, 2, False, False]
    assert len(table(cut)) == 4
    run(cut, [trial for trial in trials if not grid.is_done(cut, trial)], lanes=2)
    run(whole, trials, lanes=2)
    assert table(cut) == table(whole)
    assert table(cut, tables.FINALS) == table(whole, tables.FINALS)


@pytest.mark.slow
def test_what_ran_side_by_side_goes_on_from_its_checkpoint_to_the_same_tables(tmp_path):
    trials, cut, whole, seen, said = make_grid(static=LONGER), tmp_path / "cut", tmp_path / "whole", [], []
    cut_short(cut, trials, 3, lanes=4)
    assert len(list((cut / "unfinished").glob("*/checkpoints/epoch-000003"))) == 1

    def look(specs, progress):
        gc.collect()
        seen.append((progress.epoch, sum(array.nbytes for array in jax.live_arrays())))

    run(cut, trials, lanes=4, on_epoch=look, report=said.append)
    run(whole, trials, lanes=4, on_epoch=look)
    assert [epoch for epoch, _ in seen] == [4, 5, 1, 2, 3, 4, 5]
    assert seen[1][1] <= seen[-1][1]  # one state in memory, as from the start
    assert any("resuming from" in line and "after epoch 3" in line for line in said)
    assert not (cut / "unfinished").exists()
    assert table(cut) == table(whole)
    assert table(cut, tables.FINALS) == table(whole, tables.FINALS)
    seconds = [float(row["wall_seconds"]) for row in csv.DictReader((cut / "results.csv").open())][:5]
    assert seconds == sorted(set(seconds))


def test_a_checkpoint_is_made_every_so_many_epochs_and_one_is_kept(tmp_path):
    seen = []

    def look(specs, progress):
        seen.append([path.name for path in tmp_path.glob("unfinished/*/checkpoints/*")])

    trials = make_grid(("future",), (0, 1), static=LONGER)
    run(tmp_path, trials, lanes=2, checkpoint_every=2, on_epoch=look)
    assert seen == [[], [], ["epoch-000002"], ["epoch-000002"], []]  # none when the results are written


@pytest.mark.slow
def test_one_run_at_a_time_has_its_checkpoints_in_its_own_folder(tmp_path):
    trials = make_grid(("future",), (0, 1), static=LONGER)
    cut_short(tmp_path, trials, 2)
    assert [path.name for path in grid.folder_of(tmp_path, trials[0]).glob("checkpoints/*")] == ["epoch-000002"]
    seen = []
    run(tmp_path, trials, on_epoch=lambda specs, progress: seen.append(progress.epoch))
    assert seen == [3, 4, 5, 1, 2, 3, 4, 5]
    assert not list(tmp_path.glob("**/checkpoints"))


@pytest.mark.slow
def test_another_lane_s_sampler_is_its_own_when_fewer_are_left(tmp_path):
    """`closest` is the first of two samplers, and was the second of three when it was cut short."""
    trials = make_grid(("future", "closest", "weighted"), (0,), static=LONGER)
    ended = []
    note = lambda specs, progress: ended.append(progress.epoch)  # noqa: E731
    run(tmp_path / "cut", trials, on_epoch=note, should_stop=lambda: len(ended) == 5 + 3)
    assert [grid.is_done(tmp_path / "cut", trial) for trial in trials] == [True, False, False]
    run(tmp_path / "cut", trials[1:], on_epoch=note)
    assert ended[8:] == [4, 5, 1, 2, 3, 4, 5]
    run(tmp_path / "whole", trials[1:2])
    ours, alone = table(tmp_path / "cut"), table(tmp_path / "whole")
    ours = [row for row in ours if row["sampler"] == "closest"]
    for a, b in zip(ours, alone, strict=True):
        assert {name: float(a[name]) for name in NUMBERS} == pytest.approx({name: float(b[name]) for name in NUMBERS}, rel=1e-2)


NUMBERS = ("actor_norm", "critic_norm", "q_mean", "relabel_distance")


@pytest.mark.slow
def test_without_a_whole_checkpoint_runs_begin_anew(tmp_path):
    trials, seen, said = make_grid(static=LONGER), [], []
    cut_short(tmp_path, trials, 2, lanes=4)
    (manifest,) = tmp_path.glob("unfinished/*/checkpoints/*/manifest.json")
    manifest.write_text(manifest.read_text().replace('"epoch": 2', '"epoch": 1'))
    on_epoch = lambda specs, progress: seen.append(progress.epoch)  # noqa: E731
    run(tmp_path, trials, lanes=4, on_epoch=on_epoch, report=said.append)
    assert seen == [1, 2, 3, 4, 5]
    assert any("manifest.json has changed" in line for line in said)
    assert [len(cell["curve"]["epoch"]) for cell in tables.read(tmp_path)] == [5] * 4
    assert not (tmp_path / "unfinished").exists()


def test_a_checkpoint_that_cannot_be_written_does_not_end_the_sweep(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        checkpoint, "lack_of_space", lambda folder, state: asked.append(folder) or (len(asked) > 1 and "a lack")
    )
    said = []
    run(tmp_path, make_grid(("future",), (0,), static=LONGER), checkpoint_every=2, report=said.append)
    assert sum("a lack" in line for line in said) == 2
    assert len(tables.read(tmp_path)) == 1


def test_the_tables_hold_every_epoch_and_every_setting(tmp_path):
    run(tmp_path, make_grid(("future",), (5,), (HParams(her_k=2.0), HParams(her_k=8.0)), LONGER), lanes=2)
    rows = table(tmp_path, without=())
    assert [(row["her_k"], row["seed"], row["epoch"], row["env_steps"], row["updates"]) for row in rows] == [
        (k, "5", str(epoch), str(240 * epoch), str(24 * epoch)) for k in ("2.0", "8.0") for epoch in range(1, 6)
    ]
    names = ("env", "sampler", "engine", "lanes", "wall_seconds", "success_rate", "return_mean")
    assert {*HParams._fields, *names} <= set(rows[0])
    assert 0 < float(rows[0]["wall_seconds"]) < float(rows[1]["wall_seconds"])
    arrays = np.load(tmp_path / "results.npz")
    np.testing.assert_array_equal(arrays["success_rate"], [float(row["success_rate"]) for row in rows])
    assert arrays["epoch"].dtype.kind == "i"
    finals = table(tmp_path, tables.FINALS)
    assert [row["episodes"] for row in finals] == ["15"] * 2
    assert all(len(row[name]) <= 8 for row in finals for name in ("success_rate", "reset_success_rate", "return_mean"))
    assert all(row["env_steps"] == "1200" for row in finals)
    for cell in (tmp_path / grid.CELLS).iterdir():
        learned = mjx_dher.load_policy(cell)
        assert learned({"observation": np.zeros(2), "achieved_goal": np.zeros(2), "desired_goal": np.zeros(2)}).shape == (2,)


def test_a_metric_with_a_setting_s_name_has_its_own_column(tmp_path):
    settings = dataclasses.asdict(CONFIG) | {"env_kwargs": (), "entropy_weight": 0.5}
    curve = {name: [1] for name in ("epoch", "env_steps", "updates", "wall_seconds")} | {"entropy_weight": [0.4]}
    trial = {"settings": settings, "seed": 0, "lanes": 1, "status": "finished", "reason": None, "curve": curve, "final": {}}
    tables.write(tmp_path, [trial])
    (row,) = csv.DictReader((tmp_path / tables.RESULTS).open())
    assert (row["entropy_weight"], row["metric_entropy_weight"]) == ("0.5", "0.4")


@pytest.mark.slow
def test_lanes_are_as_many_as_memory_holds_as_the_compiler_counts_it(tmp_path, monkeypatch):
    """All four rings would fit; four whole programs do not."""
    trials = make_grid(("future",), seeds=range(4))
    monkeypatch.setattr(machine, "available_bytes", lambda: 200_000)
    told, sizes = [], []
    run(tmp_path, trials, lanes=4, report=told.append, on_epoch=lambda specs, _: sizes.append(len(specs)))
    assert "compiling for 4 parallel runs of 4" in told[0]
    assert "compiling for 4 runs" not in told[2]
    assert sum(sizes) == 4
    assert 1 <= max(sizes) < 4
    assert len(tables.read(tmp_path)) == 4


def test_what_is_no_sweep_is_named(tmp_path):
    with refuses(tmp_path, error=FolderError):
        tables.read(tmp_path)
    trials = make_grid(("future",), (0,), static=LONGER)
    run(tmp_path, trials)
    cell = grid.folder_of(tmp_path, trials[0])
    for name, content, part in (
        ("metrics.csv", "epoch,success_rate\n", "5 epochs"),
        ("config.json", json.dumps({"schema": 0}), "schema"),
        ("result.json", "{", "line 1 column 2"),
    ):
        (cell / name).write_text(content)
        with refuses(name, part, error=FolderError):
            tables.read(tmp_path)
    (cell / "result.json").unlink()  # as if the write had been cut short
    assert not grid.is_done(tmp_path, trials[0])
