"""Presets of the hand and the arm tasks, and what the pages say of them and of JaxGCRL's own code."""

import csv

import numpy as np
from conftest import ROOT
from test_pages import cells

from mjx_dher import envs, presets, spec
from mjx_dher.components import robot


def test_presets_know_the_robot_by_its_built_in_name():
    known = {"push": "fetch", "pen": "hand", "arm_grasp": "arms", "arm_of_mine": "", "mine:ArmGrasp": "", 3: ""}
    assert {env: robot(env) for env in known} == known
    for env in (name for name in envs.list_envs() if robot(name) == "arms"):
        for name in ("cpu", "gpu"):
            run = presets.preset(name, env)
            spec.validate(run)
            assert (run.learner, run.sampler, run.config.replay_size) == ("sac", "final", run.config.total_steps)
        assert presets.preset("gpu", env, learner="tqc").hparams == presets.preset("gpu", "push", learner="tqc").hparams
        assert presets.preset("gpu", env, sampler="future").sampler == "future"


def test_tables_of_hands_and_arms_are_those_of_the_file():
    """Success on `native` and its median, on the presets' pages and beside others' on docs/field.md."""
    found: dict[str, list[dict[str, str]]] = {}
    with (ROOT / "docs" / "preset_success.csv").open() as file:
        for row in (row for row in csv.DictReader(file) if robot(row["task"]) != "fetch"):
            found.setdefault(row["task"], []).append(row)
    assert len(found) == 8
    pages = ROOT / "docs" / "experiments"
    text = (pages / "preset_hands.md").read_text().split("## Results")[1]
    text += (pages / "preset_gpu.md").read_text().split("## The arm tasks")[1]
    tables = [[cell.strip() for cell in cells(line)] for line in text.splitlines()]
    field = [
        line for line in (ROOT / "docs" / "field.md").read_text().splitlines() if line.startswith("| mjx-dher, preset `gpu` |")
    ]
    assert len(field) == 2
    for task, rows in found.items():
        (row,) = (row for row in tables if row[0] == f"`{task}`" and f"{int(rows[0]['env_steps']):,}" in row)
        median = f"{np.median([float(row['success']) for row in rows]):.3f}"
        assert ", ".join(row["success"] for row in rows) in row, task
        assert median in row, task
        assert median in " ".join(field), task


def test_curves_of_jaxgcrls_own_code_are_those_of_the_file(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import crl_curves

    assert crl_curves.report([ROOT / "docs" / "crl_curves.csv"]) in (ROOT / "docs" / "experiments" / "crl.md").read_text()
