"""Runs and a sweep that commit 070bb8d wrote: they are read, resumed and evaluated as they were there."""

import csv
import json
import shutil
import sys
import tarfile

import numpy as np
import pytest
from conftest import ROOT, refuses

import mjx_dher
from mjx_dher import cli
from mjx_dher.runs.folder import reading, results
from mjx_dher.sweeps import grid, tables

sys.path.append(str(ROOT / "tests" / "data"))
import make_runs_schema_2 as made

TIMES = ("wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes")


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive")
    with tarfile.open(ROOT / "tests" / "data" / "runs_schema_2.tar.xz") as file:
        file.extractall(folder, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))  # Python 3.11.0 to .3
    return folder


def compare(folder, expected):
    """The metrics and the result are those that the old code ended with; other processors round differently."""
    with (folder / "metrics.csv").open() as ours, (expected / "metrics.csv").open() as theirs:
        rows, expected_rows = list(csv.DictReader(ours)), list(csv.DictReader(theirs))
    assert len(rows) == len(expected_rows)
    for row, expected_row in zip(rows, expected_rows):
        _compare_numbers(row, expected_row)
    result = json.loads((folder / "result.json").read_text())
    _compare_numbers(result, json.loads((expected / "result.json").read_text()))


def _compare_numbers(ours, theirs):
    for name in theirs.keys() - {*TIMES}:
        if name in ("status", "reason", "digest"):
            assert ours[name] == theirs[name]
        else:
            assert float(ours[name]) == pytest.approx(float(theirs[name]), rel=1e-3), name


@pytest.mark.parametrize("name", made.RUNS)
def test_a_policy_plays_the_same_actions(archive, name):
    actions = mjx_dher.load_policy(archive / f"{name}_ended")(made.OBS)
    np.testing.assert_allclose(actions, np.load(archive / "expected" / f"{name}_actions.npy"), rtol=1e-6, atol=1e-7)


def test_an_evaluation_gives_the_same_numbers(archive, capsys):
    assert cli.main(["eval", str(archive / "ddpg_ended"), "--episodes", "600", "--seed", "11", "--json"]) == 0
    ours = json.loads(capsys.readouterr().out)
    theirs = json.loads((archive / "expected" / "ddpg_eval.json").read_text())
    numbers = [name for name, value in theirs.items() if isinstance(value, float)]
    assert ours.pop("run") == str(archive / "ddpg_ended")
    assert [ours[name] for name in numbers] == pytest.approx([theirs[name] for name in numbers])
    assert {name: value for name, value in ours.items() if name not in numbers} == {
        name: value for name, value in theirs.items() if name not in (*numbers, "run")
    }


@pytest.mark.parametrize("name", ["tqc", pytest.param("ddpg", marks=pytest.mark.slow)])
def test_a_stopped_run_resumes(archive, name):
    folder = archive / f"{name}_stopped"
    assert reading.read_spec(folder) == made.RUNS[name]
    assert cli.main(["resume", str(folder), "--no-curve"]) == 0
    compare(folder, archive / "expected" / folder.name)


@pytest.mark.slow
def test_an_ended_run_goes_on_with_more_steps(archive, tmp_path):
    folder = tmp_path / "ddpg_ended"
    shutil.copytree(archive / "ddpg_ended", folder)
    assert results.result_problem(folder) is None
    assert cli.main(["resume", str(folder), "--total-steps", "200", "--no-curve"]) == 0
    compare(folder, archive / "expected" / folder.name)


@pytest.mark.slow
def test_a_sweep_resumes_and_its_tables_read(archive):
    """The folders of the trials still have the names of today's settings; two of four runs had ended."""
    folder = archive / "sweep"
    assert [grid.is_done(folder, spec) for spec in made.SWEEP] == [True, True, False, False]
    lines = []
    trained = grid.train(folder, made.SWEEP, made.make_env, options=made.OPTIONS, lanes=2, report=lines.append)
    assert len(trained) == 2
    assert any("after epoch 2" in line for line in lines)
    trials = tables.read(folder)
    assert [(t["settings"]["sampler"], t["seed"], t["status"]) for t in trials] == [
        (sampler, seed, "finished") for sampler in ("future", "weighted") for seed in (5, 6)
    ]
    for trial in trials:
        compare(trial["folder"], archive / "expected" / "sweep" / "cells" / trial["folder"].name)


def test_a_setting_of_earlier_versions_is_read_and_cannot_be_resumed_with_another_value(archive, tmp_path):
    """config.json has `learner_kernels`, which is gone."""
    folder = tmp_path / "run"
    shutil.copytree(archive / "ddpg_ended", folder)
    content = json.loads((folder / "config.json").read_text())
    assert content["config"]["learner_kernels"] == "auto"
    spec = reading.to_spec(folder, content)
    content["config"]["learner_kernels"] = "xla"
    (folder / "config.json").write_text(json.dumps(content))
    with refuses("learner_kernels", "xla", "auto"):
        reading.check_same(folder, spec)
