"""What is written can be believed: settings and own code that changed, damage, and what a power cut leaves."""

import contextlib
import dataclasses
import itertools
import json
import math
import os
import shutil

import numpy as np
import pytest
from configs import SHORT as CONFIG
from conftest import names
from sweep_helpers import LONGER, compile_once, cut_short, make_grid, run, spec_of, table  # noqa: F401
from test_driver import rows_of

import mjx_dher
from mjx_dher import HParams, RunSpec, cli, envs
from mjx_dher.runs import driver
from mjx_dher.runs.folder import fingerprint, reading, results, run_folder
from mjx_dher.sweeps import grid, tables
from mjx_dher.system import files
from mjx_dher.system.files import FolderError

SPEC = RunSpec(env="point_mass:PointMass", config=dataclasses.replace(CONFIG, total_steps=240))  # 6 epochs


def train(folder, spec=SPEC, until=None, keep=2):
    """Trains `spec` into `folder`, to its end or until an epoch; returns what is reported."""
    seen, told = [], []
    mjx_dher.train_runs(
        envs.make(spec.env),
        [spec],
        [folder],
        options=mjx_dher.Options(final_episodes=4, checkpoint_every=2, keep=keep),
        report=told.append,
        on_epoch=lambda specs, progress: seen.append(progress.epoch),
        should_stop=lambda: seen[-1] == until,
    )
    return told


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """`run`, stopped after four of six epochs, with checkpoints of epochs 2 and 4, and `whole`, which was not stopped."""
    folder = tmp_path_factory.mktemp("identity")
    train(folder / "run", until=4)
    train(folder / "whole")
    return folder


@pytest.fixture
def stopped(made, tmp_path):
    return shutil.copytree(made / "run", tmp_path / "run")


@pytest.fixture
def whole(made, tmp_path):
    return shutil.copytree(made / "whole", tmp_path / "whole")


def edit(folder, path, value, name="config.json"):
    """Changes what `path`, names, leads to in config.json; removes it where `value` is None."""
    content = json.loads((folder / name).read_text())
    inner = content
    for part in path[:-1]:
        inner = inner[part]
    if value is None:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    (folder / name).write_text(json.dumps(content))


def resume(folder, capsys, *flags):
    status = cli.main(["resume", str(folder), "--no-curve", *flags])
    output = capsys.readouterr()
    return status, output.out + output.err


def test_all_files_of_a_run_carry_one_digest(made):
    digests = set()
    for folder in (made / "run", made / "whole"):
        content, spec = reading.read_run(folder)
        assert spec == SPEC
        digests |= {content["digest"], fingerprint.digest(reading.identity_of(content, spec))}
        digests |= {row["digest"] for row in results.read_rows(folder / "metrics.csv")}
        with np.load(folder / "policy.npz") as arrays:
            digests.add(fingerprint.digest(json.loads(arrays["settings"].tobytes())))
    digests.add(json.loads((made / "whole" / "result.json").read_text())["digest"])
    for path in run_folder.checkpoints(made / "run"):
        (run,) = json.loads((path / "manifest.json").read_text())["runs"]
        digests.add(fingerprint.digest(run))
    assert len(digests) == 1
    other = dataclasses.replace(SPEC, hparams=HParams(gamma=0.97))
    assert fingerprint.digest(fingerprint.identity(other, "none", fingerprint.sources(other))) not in digests


# Of each field, another value that is allowed. `wrong` below makes one of another type.
EDITS = {
    ("env",): "probes:Clock",
    ("env_kwargs",): ["limit=3"],
    ("engine",): "native",
    ("sampler",): "final",
    ("weight_kernel",): "softmax",
    ("weight_normalization",): "sum",
    ("metric",): "mjx_dher.samplers:position",
    ("priority",): "mjx_dher.priorities:eventful",
    ("generator",): "mjx_dher.contrib.generators:reset",
    ("learner",): "mjx_dher.learners.ddpg:make",
    ("networks",): "mjx_dher.networks:mlp",
    ("demonstrations",): "episodes.npz",
    ("seed",): 7,
    **{("config", field.name): 2 for field in dataclasses.fields(mjx_dher.Config) if isinstance(field.default, int)},
    ("config", "num_envs"): 3,
    ("config", "batch_size"): 17,
    ("config", "replay_size"): 120,
    ("config", "hidden_sizes"): [9],
    ("config", "learner_dtype"): "bfloat16",
    **{("hparams", name): 0.123 for name in HParams._fields},
}
ONE_OF_EACH_TYPE = ("env", "env_kwargs", "demonstrations", "seed", "num_envs", "hidden_sizes", "learner_dtype", "gamma")
EDITS = {path: value for path, value in EDITS.items() if path != ("config", "cycles_per_epoch")} | {
    ("config", "cycles_per_epoch"): 3,
    ("config", "target_period"): 2,
}


@pytest.mark.parametrize("types", [ONE_OF_EACH_TYPE, pytest.param([path[-1] for path in EDITS], marks=pytest.mark.slow)])
def test_a_setting_that_was_edited_is_named_and_refused(stopped, whole, capsys, types):
    shutil.copy(whole / "config.json", whole / "kept")
    for path, value in [
        (path, x)
        for path, right in EDITS.items()
        for x in (right, 3 if isinstance(right, str) else "x", [], None)
        if x is right or path[-1] in types
    ]:
        name = path[-1]
        for folder in (whole, stopped):
            shutil.copy(whole / "kept", folder / "config.json")
        edit(stopped, path, value)
        edit(whole, path, value)
        with contextlib.suppress(FolderError):
            if reading.read_spec(whole) == SPEC:  # it was the default, and so it is
                continue
        status, text = resume(stopped, capsys)
        assert (status, name in text, "Traceback" in text) == (2, True, False), (value, text)
        assert cli.main(["eval", str(whole)]) == 2
        text = capsys.readouterr().err
        assert name in text, (value, text)
        with pytest.raises(FolderError, match=name):
            mjx_dher.load_policy(whole)


@pytest.mark.slow
def test_more_steps_than_the_run_was_begun_with_are_taken_and_told(stopped, tmp_path, capsys):
    longer = SPEC.replace(total_steps=320)
    edited = shutil.copytree(stopped, tmp_path / "edited")
    edit(edited, ("config", "total_steps"), 320)
    assert cli.main(["eval", str(edited)]) == 2  # as long as the run itself does not know
    assert "total_steps was 240 and is 320" in capsys.readouterr().err
    for folder, flags in ((stopped, ["--total-steps", "320"]), (edited, [])):
        status, text = resume(folder, capsys, *flags)
        assert (status, "total_steps was 240 and is 320" in text) == (0, True), text
        assert reading.read_spec(folder) == longer
        assert [row["epoch"] for row in rows_of(folder)] == [str(epoch) for epoch in range(1, 9)]
    train(tmp_path / "long", longer)
    without = lambda rows: [{name: x for name, x in row.items() if name != "digest"} for row in rows]  # noqa: E731
    assert without(rows_of(edited)) == without(rows_of(tmp_path / "long"))


OTHER_KINDS = [
    (("config",), [], "config must be a dict"),
    (("config", "hidden_sizes"), 10**20, "config.hidden_sizes must be a list"),
    (("config", "hidden_sizes"), None, "'hidden_sizes'"),
    (("hparams",), "x", "hparams must be a dict"),
    (("physics",), 1, "physics must be a str"),
    (("physics",), None, "'physics'"),
    (("config", "total_steps"), None, "total_steps"),
    (("sources",), [], "sources must be a dict"),
    (("sources",), {"env": 10**20}, "sources.env must be a str"),
]


def test_parts_of_another_kind_are_named(stopped, capsys):
    shutil.copy(stopped / "config.json", stopped / "kept")
    for path, value, message in OTHER_KINDS:
        shutil.copy(stopped / "kept", stopped / "config.json")
        edit(stopped, path, value)
        status, text = resume(stopped, capsys)
        assert (status, message in text, "Traceback" in text) == (2, True, False), text
        assert cli.main(["eval", str(stopped)]) == 2
        assert message in capsys.readouterr().err


def test_fewer_steps_than_any_checkpoint_s_are_refused_before_anything_is_compiled(stopped, capsys, monkeypatch):
    monkeypatch.setattr(driver.program_lib, "compile_runs", lambda *args: pytest.fail("compiled"))
    status, text = resume(stopped, capsys, "--total-steps", "80")
    assert (status, "nothing is left to train: 4 epochs have ended, and total_steps 80 takes 2" in text) == (2, True)


@pytest.mark.slow
def test_fewer_steps_than_were_made_are_refused_and_nothing_is_lost(stopped, capsys):
    before = (stopped / "config.json").read_bytes()
    status, text = resume(stopped, capsys, "--total-steps", "160")
    assert (status, "nothing is left to train: 4 epochs have ended, and total_steps 160 takes 4" in text) == (2, True)
    assert (stopped / "config.json").read_bytes() == before
    assert resume(stopped, capsys)[0] == 0


OPTIONS = {"--log": "jsonl", "--keep": "1", "--final-episodes": "7", "--checkpoint-every": "0"}


@pytest.mark.parametrize("flags", [OPTIONS, *(pytest.param({flag: OPTIONS[flag]}, marks=pytest.mark.slow) for flag in OPTIONS)])
def test_options_may_change(stopped, whole, capsys, flags):
    status, text = resume(stopped, capsys, *itertools.chain(*flags.items()))
    assert status == 0, text
    names(text, *(f"{flag[2:].replace('-', '_')} {value}" for flag, value in flags.items() if flag != "--log"))
    assert rows_of(stopped) == rows_of(whole)
    if "--log" not in flags:
        return
    lines = [json.loads(line) for line in (stopped / "metrics.jsonl").read_text().splitlines()]
    assert [line["epoch"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert [f"{line['critic_loss']:.6g}" for line in lines] == [row["critic_loss"] for row in rows_of(whole)]


@pytest.mark.parametrize(("name", "value"), [("checkpoint_every", "x"), ("log", None), ("log", "jsonl"), ("keep", [1])])
def test_an_option_of_another_type_is_refused(stopped, capsys, name, value):
    edit(stopped, (name,), value if value is not None else 3)
    status, text = resume(stopped, capsys)
    assert (status, name in text, "Traceback" in text) == (2, True, False), text


@pytest.mark.parametrize("lines", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_metrics_that_lag_behind_a_checkpoint_make_resume_take_the_one_before(stopped, whole, capsys, lines):
    """As a power cut leaves them, the last line cut."""
    content = (stopped / "metrics.csv").read_text().splitlines(keepends=True)
    (stopped / "metrics.csv").write_text("".join(content[:lines]) + content[lines][:-5])
    status, text = resume(stopped, capsys)
    assert f"epoch-000004 has a later epoch than the last complete line of metrics.csv, {lines - 1}" in text
    assert (status, "epoch-000002, after epoch 2" in text) == (0, True)
    assert rows_of(stopped) == rows_of(whole)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"epoch,x\n1,2\n", b"epoch,env_steps\n"])
def test_metrics_that_are_damaged_are_named(stopped, capsys, content):
    (stopped / "metrics.csv").write_bytes(content)
    status, text = resume(stopped, capsys)
    assert (status, "later epoch than the last complete line of metrics.csv, 0" in text) == (2, True)
    assert (stopped / "metrics.csv").read_bytes() == content
    assert len(run_folder.checkpoints(stopped)) == 2


def damage(path):
    (path / "manifest.json").write_text("{")


@pytest.mark.parametrize("keep", [1, 2])
def test_a_damaged_checkpoint_costs_no_whole_one(stopped, keep, capsys):
    """Neither the ones written after it, nor the one that the run goes on from before there is a newer one."""
    newest, older = run_folder.checkpoints(stopped)
    damage(newest)
    shutil.move(newest, newest.with_name("epoch-000061"))
    train(stopped, until=3, keep=keep)
    expected = ["epoch-000003"] if keep == 1 else ["epoch-000003", "epoch-000002"]
    assert [path.name for path in run_folder.checkpoints(stopped)] == expected
    assert reading.read_manifest(run_folder.checkpoints(stopped)[0])["epoch"] == 3
    assert older.exists() == (keep == 2)


def test_a_damaged_older_one_is_not_kept_for_a_whole_one(made, tmp_path):
    folder = shutil.copytree(made / "run", tmp_path / "run")
    newest, older = run_folder.checkpoints(folder)
    damage(newest)
    train(folder, until=5)
    assert [path.name for path in run_folder.checkpoints(folder)] == ["epoch-000005", "epoch-000004"]
    assert [reading.read_manifest(path)["epoch"] for path in run_folder.checkpoints(folder)] == [5, 4]
    assert not older.exists()


def test_checkpoints_sort_by_number_and_strays_are_none(tmp_path):
    for name in ("epoch-999999", "epoch-1000000", "epoch-000010", "epoch-x", "epoch-", ".partial-000001"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    assert [path.name for path in run_folder.checkpoints(tmp_path)] == ["epoch-1000000", "epoch-999999", "epoch-000010"]


def test_links_in_the_way_are_removed_and_not_followed(stopped, tmp_path):
    elsewhere = tmp_path / "mine"
    elsewhere.mkdir()
    (elsewhere / "file").write_text("mine")
    (stopped / "checkpoints" / "epoch-000001").symlink_to(elsewhere)
    (stopped / "checkpoints" / ".partial-000009").symlink_to(elsewhere)
    (stopped / f"policy.npz.{os.getpid()}.partial").symlink_to(elsewhere / "file")
    (stopped / f"metrics.csv.{os.getpid()}.partial").symlink_to(elsewhere / "file")
    train(stopped, until=5)
    assert [path.name for path in run_folder.checkpoints(stopped)] == ["epoch-000005", "epoch-000004"]
    assert (elsewhere / "file").read_text() == "mine"


def test_what_must_survive_a_power_cut_is_flushed_before_what_relies_on_it(tmp_path, monkeypatch):
    """Metrics before the checkpoint, all of a checkpoint before its name, the policy and metrics before the result."""
    flushed = []
    flush = files.flush
    monkeypatch.setattr(files, "flush", lambda path: (flushed.append(path.relative_to(tmp_path).as_posix()), flush(path))[1])
    folder = tmp_path / "run"
    train(folder)
    assert flushed[0] == "."  # that the run's folder is in it

    def last(name):
        return len(flushed) - 1 - flushed[::-1].index(name)

    names = [name for name in flushed if name.startswith("run/checkpoints")]
    partial = [name for name in names if ".partial-000004" in name]
    before = flushed.index("run/checkpoints", flushed.index("run/checkpoints/.partial-000002"))
    first, end = flushed.index(partial[0]), flushed.index("run/checkpoints", flushed.index(partial[-1]))
    assert "run/metrics.csv" in flushed[before:first]
    assert partial[-1] == "run/checkpoints/.partial-000004"  # the folder itself, after what is in it
    assert {name.rpartition("/")[2] for name in partial} >= {"manifest.json", "state"}
    assert end > first
    result = last(f"run/result.json.{os.getpid()}.partial")
    assert last("run/policy.npz") < result
    assert last("run/metrics.csv") < result
    assert flushed[-1] == "run"


def test_lanes_share_a_checkpoint_of_their_own_settings(tmp_path):
    trials = make_grid(("future",), (0, 1), static=LONGER)
    cut_short(tmp_path, trials, 2, lanes=2)
    (manifest,) = tmp_path.glob("unfinished/*/checkpoints/*/manifest.json")
    runs = json.loads(manifest.read_text())["runs"]
    assert [fingerprint.digest(run) for run in runs] == [
        fingerprint.digest(fingerprint.identity(trial, "none", {})) for trial in trials
    ]
    (tmp_path / grid.CELLS / "stray").mkdir()
    (tmp_path / "unfinished" / "stray").mkdir()
    (tmp_path / "unfinished" / "stray" / "cells.json").write_text("")  # as a kill leaves it
    run(tmp_path, trials, lanes=2)
    assert [path.name for path in (tmp_path / "unfinished").iterdir()] == ["stray"]
    assert len(tables.read(tmp_path)) == 2


def test_an_infinite_number_survives_config_json(tmp_path):
    spec = RunSpec(env="reach", hparams=HParams(her_k=math.inf))
    run_folder.write_config(tmp_path / "run", spec, "native", {})
    assert reading.read_run(tmp_path / "run")[1] == spec
