"""The policies that are part of the package: their files, their cards, their names, and how new ones take their place."""

import json
import runpy
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT, names, refuses

import mjx_dher
from mjx_dher import cli
from mjx_dher.cli import common, policies
from mjx_dher.cli.train import parse_train_args
from mjx_dher.policy import bundled
from mjx_dher.runs.folder import reading, results
from mjx_dher.spec import RunSpec
from mjx_dher.system.files import FolderError
from mjx_dher.tools.transfer import ORIGINALS

PUBLISH = runpy.run_path(str(ROOT / "docs" / "publish_policy.py"))
SIZES = {"push": (25, 3, 4), "pick_and_place": (25, 3, 4), "slide": (25, 3, 4), "reach": (10, 3, 4)}
SIZES |= dict.fromkeys(("block_rotate_z", "egg_rotate"), (61, 7, 20))


def facts_of(name):
    return bundled.facts(bundled.FOLDER / name)


def test_the_tasks_have_policies():
    assert {"push", "reach"} <= set(bundled.names()) <= set(ORIGINALS)
    files = [path for path in bundled.FOLDER.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")]
    assert sum(path.stat().st_size for path in files) < 9_000_000


@pytest.mark.parametrize("name", bundled.names())
def test_a_policy_is_a_whole_run_with_a_card(name):
    folder = bundled.FOLDER / name
    assert results.result_problem(folder) is None
    assert reading.read_spec(folder).env == name
    assert (folder / "README.md").read_text() == PUBLISH["card"](folder)
    here = facts_of(name)["here"]
    assert here["success_low"] <= here["success_rate"] <= here["success_high"]
    assert here["episodes"] >= 500


@pytest.mark.parametrize("name", bundled.names())
def test_the_command_on_a_card_describes_the_run(name):
    run = reading.read_spec(bundled.FOLDER / name)
    arguments = PUBLISH["command"](run)
    assert f"python train.py {' '.join(arguments)}\n" in (bundled.FOLDER / name / "README.md").read_text()
    assert parse_train_args(arguments).spec == run


def test_the_documents_have_every_policy():
    """The table has the figures of the cards, and the site the cards."""
    page, index = ((ROOT / "docs" / name).read_text() for name in ("policies.md", "index.md"))
    for name in bundled.names():
        facts, result = facts_of(name), results.read_result(bundled.FOLDER / name)
        rates = " | ".join(
            f"{x['success_rate']:.3f} ({x['success_low']:.3f} to {x['success_high']:.3f})" if x else "not measured"
            for x in (facts["here"], facts["original"])
        )
        card = f"../mjx_dher/policy/bundled/{name}/README.md"
        assert f"| `{name}` | {rates} | {result['env_steps']:,} | [card]({card}) |\n" in page
        assert f"[{name}]({card})" in index


@pytest.mark.parametrize(("engine", "made"), [("warp", "auto"), ("jax", None), ("auto", None)])
def test_a_run_of_warp_plays_on_a_machine_without_a_gpu(monkeypatch, engine, made):
    monkeypatch.setattr(common, "make_env", lambda run, engine: engine)
    run = RunSpec(env="push", engine=engine)
    assert policies.played_env(run, None) == made
    assert policies.played_env(run, "warp") == "warp"  # typed: an error says that there is no GPU


def test_every_setting_can_be_told_by_a_command():
    run = mjx_dher.preset("gpu", "slide", sampler="closest", metric="position", seed=7)
    config = run.config.__class__(**{**run.config.__dict__, "hidden_sizes": (64, 32), "n_step": 2})
    run = run.__class__(**{**run.__dict__, "config": config, "hparams": run.hparams._replace(gamma=0.9, actor_lr=3e-4)})
    assert parse_train_args(PUBLISH["command"](run)).spec == run


def test_they_load_anywhere_and_need_numpy_alone(tmp_path):
    code = f"""
import sys
import numpy as np
import mjx_dher
from mjx_dher.policy import bundled
sizes = {SIZES!r}
for name in bundled.names():
    policy = mjx_dher.load_policy(name)
    observation, goal, action = sizes[name]
    assert policy.sizes == sizes[name]
    assert policy({{"observation": np.zeros((7, observation)), "desired_goal": np.zeros((7, goal))}}).shape == (7, action)
assert not {{"jax", "mujoco", "viser"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


def test_one_is_played_by_its_name(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["eval", "reach", "--episodes", "20"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("reach: the bundled policy; its card is ")
    assert float(out.split("success ")[1].split()[0]) >= 0.9
    assert cli.main(["export", "reach", "--format", "safetensors"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["reach.safetensors"]  # nothing is written into the package


def test_a_run_folder_by_the_name_comes_first(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(bundled.FOLDER / "reach", tmp_path / "push")
    assert bundled.find("push") == (tmp_path / "push").relative_to(tmp_path)
    assert mjx_dher.load_policy("push").sizes == SIZES["reach"]
    assert cli.main(["export", "push", "--format", "safetensors"]) == 0
    assert "push: the run in the current folder, not the bundled policy of this name" in capsys.readouterr().out
    assert (tmp_path / "push" / "policy.safetensors").exists()


def test_a_folder_that_is_no_run_does_not(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "push").mkdir()
    assert bundled.find("push") == bundled.FOLDER / "push"
    assert mjx_dher.load_policy("push").sizes == SIZES["push"]


def test_a_file_by_the_name_comes_first(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "push").write_text("something else")
    with refuses("push", error=FolderError):
        mjx_dher.load_policy("push")


def test_another_name_is_refused(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("pusch", "Push", "", "nowhere/push", "../policies/push"):
        with refuses(name, error=FolderError):
            mjx_dher.load_policy(name)


def test_a_wrong_name_is_told_the_nearest(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for command in (["eval", "pusch"], ["view", "pusch"], ["export", "pusch", "--format", "onnx"], ["transfer", "pusch"]):
        assert cli.main(command) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        names(error, "pusch", "push")


def new_facts(rate):
    return {"machine": "a machine", "commit": "abc", "date": "2026-01-01", "original": None, "here": summary(rate)}


def summary(rate):
    low, high = rate - 0.1, min(1.0, rate + 0.1)
    return {"episodes": 500, "success_rate": rate, "success_low": low, "success_high": high, "seed": 1, "physics": "native"} | {
        "reset_success_rate": 0.0
    }


def test_a_better_policy_takes_the_place_of_the_one_before(tmp_path):
    run, target = bundled.FOLDER / "reach", tmp_path / "policies" / "reach"
    PUBLISH["publish"](run, target, new_facts(0.5), anyway=False)
    PUBLISH["publish"](run, target, new_facts(0.75), anyway=False)
    assert "**0.750** (95 % interval 0.650 to 0.850, 500 episodes from seed 1)" in (target / "README.md").read_text()
    assert {path.name for path in target.iterdir()} == {path.name for path in run.iterdir()}
    with refuses("0.750", "0.500", "--anyway"):
        PUBLISH["publish"](run, target, new_facts(0.5), anyway=False)
    PUBLISH["publish"](run, target, new_facts(0.5), anyway=True)
    assert "**0.500**" in (target / "README.md").read_text()


def test_too_large_a_policy_leaves_what_is_there(tmp_path):
    run, target = bundled.FOLDER / "reach", tmp_path / "policies" / "reach"
    PUBLISH["publish"](run, target, new_facts(0.5), anyway=False)
    (tmp_path / "policies" / "other").write_bytes(bytes(8_900_000))
    with refuses("9,000,000"):
        PUBLISH["publish"](run, target, new_facts(0.75), anyway=False)
    assert "**0.500**" in (target / "README.md").read_text()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "result.json").unlink(), "result.json"),
        (lambda folder: (folder / "metrics.csv").write_text(""), "metrics.csv"),
        (lambda folder: (folder / "policy.npz").unlink(), "policy.npz"),
        (lambda folder: edit(folder / "result.json", status="failed", epochs=3), "failed"),
    ],
)
def test_a_run_that_is_not_whole_is_not_published(damage, message, tmp_path):
    shutil.copytree(bundled.FOLDER / "reach", tmp_path / "run")
    damage(tmp_path / "run")
    with refuses(message):
        PUBLISH["check"](tmp_path / "run", reading.read_spec(bundled.FOLDER / "reach"))


def edit(path, **changes):
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_its_actions_are_those_of_the_run_that_it_is_of():
    """The array of settings in the policy is that of its config.json: files of two runs were not mixed up."""
    for name in bundled.names():
        assert reading.edited(bundled.FOLDER / name, *reading.read_run(bundled.FOLDER / name)) == {}
        with np.load(bundled.FOLDER / name / "policy.npz", allow_pickle=False) as arrays:
            assert json.loads(arrays["settings"].tobytes())["env"] == name
