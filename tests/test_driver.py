"""The run driver: one run or many, alike on the command line and as a library call."""

import csv
import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweep_helpers
from configs import SHORT, flags
from conftest import EXAMPLES, refuses
from sweep_helpers import compile_once  # noqa: F401

import mjx_dher
from mjx_dher import HParams, Options, RunSpec, cli
from mjx_dher.cli.common import Screen
from mjx_dher.learners import ddpg
from mjx_dher.runs import driver, program
from mjx_dher.runs.folder import checkpoint, fingerprint, lane_checkpoints, reading
from mjx_dher.runs.folder.lane_checkpoints import Schedule
from mjx_dher.sweeps import comparison, tables
from mjx_dher.system.files import FolderError
from point_mass import PointMass
from probes import held

CONFIG = SHORT
SPEC = RunSpec(env="point_mass:PointMass", config=CONFIG)
FLAGS = [*flags(SHORT), "--sampler", "weighted", "--final-episodes", "600"]
TIMES = ("wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes")


def rows_of(folder):
    with (folder / "metrics.csv").open() as file:
        return [{name: value for name, value in row.items() if name not in TIMES} for row in csv.DictReader(file)]


def result_of(folder):
    content = json.loads((folder / "result.json").read_text())
    return {name: value for name, value in content.items() if name not in TIMES}


def test_train_and_a_sweep_of_the_same_run_give_the_same_to_the_bit(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    assert cli.main([*FLAGS, "--seed", "3", "--out", str(tmp_path / "run")]) == 0
    monkeypatch.setattr(sweep_helpers, "_compiled", {})  # compiled again
    sweep = ["--first-seed", "3", "--seeds", "1", "--lanes", "1", "--out", str(tmp_path / "sweep")]
    assert cli.main(["sweep", *FLAGS, *sweep]) == 0
    trial = next((tmp_path / "sweep" / "cells").glob("*/result.json")).parent
    assert rows_of(trial) == rows_of(tmp_path / "run")
    assert len(rows_of(trial)) == 3
    assert result_of(trial) == result_of(tmp_path / "run")
    assert result_of(trial)["episodes"] == 600
    with np.load(trial / "policy.npz") as ours, np.load(tmp_path / "run" / "policy.npz") as other:
        assert set(ours.files) == set(other.files)
        assert all(np.array_equal(ours[name], other[name]) for name in ours.files)
    assert reading.read_spec(trial) == reading.read_spec(tmp_path / "run")


@pytest.mark.parametrize("remove", [shutil.rmtree, lambda run: run.rename(run.with_name("moved"))], ids=["deleted", "moved"])
def test_a_run_folder_that_is_moved_while_it_trains_is_named(tmp_path, monkeypatch, capsys, remove):
    """After the next epoch of three."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    run, shown = tmp_path / "run", []
    monkeypatch.setattr(Screen, "show", lambda self, specs, progress: (remove(run), shown.append(progress.epoch)))
    assert cli.main([*FLAGS, "--checkpoint-every", "1", "--out", str(run)]) == 2
    told = capsys.readouterr()
    assert "cannot write a checkpoint" in told.out
    assert f"error: {run} was moved or deleted during training" in told.err
    assert (shown, run.exists()) == ([1], False)


def remade(run):
    run.rename(run.with_name("moved"))
    run.mkdir()


def edited(run):
    (run / "config.json").write_text((run / "config.json").read_text().replace("weighted", "future"))


@pytest.mark.parametrize(
    ("change", "at", "told"),
    [
        (remade, 1, "was moved or deleted"),
        (remade, 3, "was moved or deleted"),  # during the last evaluation
        (edited, 1, "lost a file or got another config.json"),
        (lambda run: (run / "metrics.csv").unlink(), 1, "lost a file or got another config.json"),
    ],
)
def test_a_run_folder_that_is_remade_while_it_trains_gets_no_result(tmp_path, monkeypatch, capsys, change, at, told):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    run, evaluate = tmp_path / "run", program.evaluate
    if at == 3:
        monkeypatch.setattr(program, "evaluate", lambda *args: (evaluate(*args), change(run))[0])
    else:
        monkeypatch.setattr(Screen, "show", lambda self, specs, progress: progress.epoch == at and change(run))
    assert cli.main([*FLAGS, "--checkpoint-every", "0", "--out", str(run)]) == 2
    assert f"error: {run} {told} during training" in capsys.readouterr().err
    assert not (run / "result.json").exists()


def breaking():
    """DDPG's update, but that a run with her_k 7 is not finite from its second epoch on."""
    update = ddpg.DDPG.update

    def break_one(self, state, batch, hparams):
        state, losses = update(self, state, batch, hparams)
        broken = (hparams.her_k == 7) & (state.num_updates > 8)
        return state.replace(params=jax.tree.map(lambda x: jnp.where(broken, jnp.nan, x), state.params)), losses

    return break_one


THREE = [dataclasses.replace(SPEC, seed=seed, hparams=HParams(her_k=k)) for seed, k in ((0, 4.0), (1, 7.0), (2, 4.0))]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Three runs side by side by a library call; the second one's learner is not finite from its second epoch on."""
    folder = tmp_path_factory.mktemp("runs")
    specs, seen, said = THREE, [], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ddpg.DDPG, "update", breaking())
        patch.setattr(sweep_helpers, "_compiled", {})
        results = mjx_dher.train_runs(
            PointMass(),
            specs,
            [folder / "cells" / fingerprint.trial_name(spec) for spec in specs],
            options=Options(final_episodes=20, log=("jsonl",)),
            lanes=3,
            report=said.append,
            on_epoch=lambda specs, progress: seen.append(progress.epoch),
        )
    return folder, specs, results, seen, said


@pytest.mark.slow
def test_a_library_call_trains_runs_side_by_side(trained):
    folder, specs, results, seen, said = trained
    assert [result.status for result in results] == ["finished", "failed", "finished"]
    assert seen == [1, 2, 3]
    assert "compiling for 3 parallel runs of 3" in said[0]
    assert reading.read_spec(results[2].folder) == specs[2]
    assert len((results[0].folder / "metrics.jsonl").read_text().splitlines()) == 3
    assert mjx_dher.load_policy(results[0].folder)({"observation": np.zeros(2), "desired_goal": np.zeros(2)}).shape == (2,)
    assert not (folder / "cells" / "unfinished").exists()


def test_a_lane_that_diverges_ends_alone_and_says_so_everywhere(trained, capsys):
    """In its result, its curve, `resume`, the tables and the comparison; the others are what they were without it."""
    folder, _, results, _, _ = trained
    diverged = results[1].folder
    content = json.loads((diverged / "result.json").read_text())
    assert (content["status"], content["epochs"], content["env_steps"]) == ("failed", 2, 80)
    assert "success_rate" not in content
    assert [row["epoch"] for row in rows_of(diverged)] == ["1"]
    assert not (diverged / "policy.npz").exists()
    assert cli.main(["resume", str(diverged)]) == 2
    assert "no checkpoint to resume from: it failed in epoch 2" in capsys.readouterr().err
    trials = tables.read(folder)
    tables.write(folder, trials)
    with (folder / "finals.csv").open() as file:
        finals = {row["seed"]: row for row in csv.DictReader(file)}
    assert {seed: row["status"] for seed, row in finals.items()} == {"0": "finished", "1": "failed", "2": "finished"}
    assert finals["1"]["success_rate"] == ""
    for group in comparison.groups(trials)["point_mass:PointMass"]:
        assert group.failed == (1 if group.others["her_k"] == 7 else 0)
        if group.failed:
            assert group.final.tolist() == [0.0]
            assert group.success.shape == (1, 3)
            assert not group.success[0, 1:].any()
    assert any("(1 failed)" in cell for line in comparison.table(_rows(trials))[1] for cell in line)


@pytest.mark.slow
def test_a_lane_that_had_failed_when_the_others_were_stopped_costs_them_nothing(trained, tmp_path, monkeypatch):
    """They go on from their checkpoint, and all end as those that were not stopped."""
    monkeypatch.setattr(ddpg.DDPG, "update", breaking())
    monkeypatch.setattr(sweep_helpers, "_compiled", {})
    folders, seen = [tmp_path / "cells" / fingerprint.trial_name(spec) for spec in THREE], []
    arguments = {"options": Options(final_episodes=20, log=("jsonl",)), "lanes": 3, "sweep": True}
    arguments |= {"on_epoch": lambda specs, progress: seen.append(progress.epoch), "should_stop": lambda: seen == [1, 2]}
    results = mjx_dher.train_runs(PointMass(), THREE, folders, **arguments)
    assert [result.status for result in results] == ["stopped"] * 3
    results = mjx_dher.train_runs(PointMass(), THREE, folders, **arguments)
    assert seen == [1, 2, 3]
    assert [(result.status, result.epoch) for result in results] == [("finished", 3), ("failed", 2), ("finished", 3)]
    for folder, whole in zip(folders, trained[2]):
        assert rows_of(folder) == rows_of(whole.folder)
        assert result_of(folder) == result_of(whole.folder)


def test_a_checkpoint_that_cannot_be_written_is_told_each_time_and_costs_nothing_else(tmp_path, monkeypatch):
    def fill(path, arrays):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "_write_arrays", fill)
    for name in ("SECONDS_TO_FIRST", "SECONDS_BETWEEN", "SHARE"):  # by the clock after every epoch
        monkeypatch.setattr(lane_checkpoints, name, 1e9 if name == "SHARE" else 0.0)
    lines, options = [], Options(final_episodes=2, checkpoint_every=0)
    (result,) = mjx_dher.train_runs(PointMass(), [SPEC], [tmp_path / "run"], options=options, report=lines.append)
    assert [line.split(" (")[0].rsplit("/", 1)[-1] for line in lines if "No space left" in line] == [
        "epoch-000001",
        "epoch-000002",
    ]
    assert (result.status, result.epoch, len(rows_of(tmp_path / "run"))) == ("finished", 3, 3)


def test_checkpoints_are_due_by_epochs_and_by_the_clock(monkeypatch):
    """After two minutes, then every ten, or so seldom that they take a twentieth of the time."""
    now = [0.0]
    monkeypatch.setattr(lane_checkpoints.time, "monotonic", lambda: now[0])
    schedule, by_epochs = Schedule(0), Schedule(3)
    saved = []
    for epoch in range(1, 60):
        now[0] += 60
        assert by_epochs.is_due(epoch) == (epoch >= 2)  # it is not saved
        if schedule.is_due(epoch):
            saved.append(epoch)
            with schedule.saving():
                now[0] += 60 if len(saved) == 3 else 1
    assert saved == [2, 12, 22, 42, 52]
    assert [Schedule(3).is_due(epoch) for epoch in range(1, 7)] == [False, False, True] * 2
    assert not Schedule(0).is_due(1)


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 2])
def test_a_run_that_is_killed_goes_on_from_a_checkpoint_by_the_clock(tmp_path, monkeypatch, lanes):
    """Without checkpoints by epochs; it ends as one without any, to the bit."""
    specs = [dataclasses.replace(SPEC, seed=seed) for seed in range(10, 10 + lanes)]
    options, lines = Options(final_episodes=2, checkpoint_every=0), []

    def train(name, **more):
        folders = [tmp_path / name / fingerprint.trial_name(spec) for spec in specs]
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
        mjx_dher.train_runs(PointMass(), specs, folders, options=options, report=lines.append, **more)
        return [(rows_of(folder), result_of(folder)) for folder in folders]

    def kill(specs, progress):
        if progress.epoch == 2:
            raise ZeroDivisionError

    whole = train("whole")
    monkeypatch.setattr(lane_checkpoints, "SECONDS_TO_FIRST", 0.0)
    with pytest.raises(ZeroDivisionError):
        train("killed", on_epoch=kill)
    assert train("killed") == whole
    assert sum("after epoch 1" in line for line in lines) == 1


def test_an_aim_is_the_mean_of_three_evaluations():
    options = Options(stop_at=0.9)
    assert not options.is_reached([1.0, 1.0])
    assert options.is_reached([0.0, 0.9, 0.8, 1.0])
    assert not options.is_reached([1.0, 0.9, 0.8, 0.99])
    assert not Options().is_reached([1.0, 1.0, 1.0])


@pytest.mark.slow
def test_a_run_that_has_reached_its_aim_ends_there_also_after_a_stop(tmp_path):
    """The mean of three evaluations: those before the stop count."""
    spec = SPEC.replace(total_steps=200, eval_episodes=200)
    env, rates, lines = PointMass(), [], []
    options = Options(final_episodes=2)

    def train(folder, options, **more):
        return mjx_dher.train_runs(env, [spec], [folder], options=options, report=lines.append, **more)[0]

    train(tmp_path / "whole", options, on_epoch=lambda specs, progress: rates.append(float(progress.metrics["success_rate"])))
    means = [sum(rates[i - 3 : i]) / 3 for i in range(3, len(rates) + 1)]
    aim = max(means)
    assert (len(rates), aim > 0) == (5, True)
    due = 3 + next(i for i, mean in enumerate(means) if mean >= aim)
    ended = train(tmp_path / "ended", dataclasses.replace(options, stop_at=aim))
    assert (ended.status, ended.epoch, ended.content["epochs"]) == ("finished", due, due)
    assert len(rows_of(tmp_path / "ended")) == due
    assert any(f"stop_at {aim:g} is reached after epoch {due} of 5" in line for line in lines) or due == 5
    resumed, stopping = dataclasses.replace(options, stop_at=aim), iter([False] * (due - 2) + [True])
    stopped = train(tmp_path / "resumed", resumed, should_stop=lambda: next(stopping))
    assert (stopped.status, stopped.epoch) == ("stopped", due - 1)
    assert train(tmp_path / "resumed", resumed).epoch == due


def test_an_aim_is_for_one_run(tmp_path):
    for value in (0.0, 1.5, "x", True):
        with refuses("stop_at"):
            mjx_dher.train_runs(PointMass(), [SPEC], [tmp_path / "a"], options=Options(stop_at=value))
    two = [SPEC, dataclasses.replace(SPEC, seed=1)]
    for specs, sweep in ((two, False), ([SPEC], True)):
        folders = [tmp_path / str(spec.seed) for spec in specs]
        with refuses("stop_at"):
            mjx_dher.train_runs(PointMass(), specs, folders, options=Options(stop_at=0.9), sweep=sweep)
    assert not list(tmp_path.iterdir())


def _rows(trials):
    return [row for groups in comparison.groups(trials).values() for row in comparison.compare(groups, "future", 0.9)]


def test_a_run_that_diverged_counts_as_a_failure_from_then_on():
    curve = {"epoch": [1, 2, 3], "env_steps": [1, 2, 3], "wall_seconds": [1.0, 2.0, 3.0], "success_rate": [0.5, 0.6, 0.7]}
    settings = {"env": "e", "sampler": "future", "learner": "ddpg", "weight_normalization": "mean", "gamma": 0.9}
    whole = {"settings": settings, "seed": 0, "status": "finished", "curve": curve, "lanes": 1, "folder": "a"}
    whole["final"] = {"success_rate": 0.8, "reset_success_rate": 0.1}
    cut = {name: values[:1] for name, values in curve.items()}
    (group,) = comparison.groups([whole, {**whole, "seed": 1, "status": "failed", "curve": cut, "final": {}}])["e"]
    np.testing.assert_array_equal(group.success, [[0.5, 0.6, 0.7], [0.5, 0.0, 0.0]])
    np.testing.assert_array_equal(group.final, [0.8, 0.0])
    assert (group.failed, group.at_reset) == (1, 0.1)
    np.testing.assert_array_equal(group.seconds, [1.0, 2.0, 3.0])


def test_runs_that_cannot_share_a_program_are_refused(tmp_path):
    other = SPEC.replace(batch_size=17)
    for specs, folders in (([SPEC, other], ["a", "b"]), ([SPEC], ["a", "b"]), ([], [])):
        with refuses("RunSpec.program"):
            mjx_dher.train_runs(PointMass(), specs, [tmp_path / name for name in folders])
    with refuses("gamma"):
        mjx_dher.train_runs(PointMass(), [dataclasses.replace(SPEC, hparams=HParams(gamma=1.0))], [tmp_path / "a"])
    with refuses("final_episodes"):
        mjx_dher.train_runs(PointMass(), [SPEC], [tmp_path / "a"], options=Options(final_episodes=0))
    assert not list(tmp_path.iterdir())


def test_a_folder_that_another_program_trains_in_is_refused_before_anything_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setattr(driver.program_lib, "compile_runs", lambda *args: pytest.fail("compiled"))
    (tmp_path / "a").mkdir()
    with held(tmp_path / "a"), refuses(tmp_path / "a", error=FolderError):
        mjx_dher.train_runs(PointMass(), [SPEC], [tmp_path / "a"])
