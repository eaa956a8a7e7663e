"""Files of other runs in a run's folder, contents of a wrong type or range, and settings that only one of two writers wrote."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest
import sweep_helpers
from configs import SHORT, flags
from conftest import EXAMPLES, ROOT, names, refuses
from sweep_helpers import compile_once, cut_short, make_grid  # noqa: F401
from sweep_helpers import run as run_sweep
from test_identity import SPEC, edit, resume, train

import mjx_dher
from mjx_dher import Options, cli
from mjx_dher.cli import resume as resume_module
from mjx_dher.cli import sweep
from mjx_dher.cli import train as train_module
from mjx_dher.runs.folder import fingerprint, reading, results, run_folder
from mjx_dher.sweeps import grid
from mjx_dher.system.files import FolderError
from mjx_dher.tools import curves
from point_mass import PointMass

OTHER = dataclasses.replace(SPEC, seed=1)
LONGER = SPEC.replace(total_steps=320)  # 8 epochs


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Runs of two seeds, stopped after four of six epochs, and whole."""
    folder = tmp_path_factory.mktemp("splices")
    for name, spec in (("mine", SPEC), ("other", OTHER)):
        train(folder / name / "stopped", spec, until=4)
        shutil.copytree(folder / name / "stopped", folder / name / "whole")
        train(folder / name / "whole", spec)
    return folder


@pytest.fixture(params=["stopped", "whole"])
def run(request, made, tmp_path):
    return shutil.copytree(made / "mine" / request.param, tmp_path / request.param)


@pytest.fixture
def stopped(made, tmp_path):
    return shutil.copytree(made / "mine" / "stopped", tmp_path / "run")


def digest_of(spec):
    return fingerprint.digest(fingerprint.identity(spec, "none", fingerprint.sources(spec)))


def is_rejected(capsys, *arguments, naming):
    assert cli.main(list(map(str, arguments))) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    names(error, *naming)


@pytest.mark.parametrize("lines", [slice(1, None), slice(2, 3)], ids=["all", "one"])
def test_lines_of_another_run_are_rejected_by_all_readers(run, made, lines, capsys):
    path = run / "metrics.csv"
    own, other = (x.read_text().splitlines(keepends=True) for x in (path, made / "other" / run.name / "metrics.csv"))
    own[lines] = other[lines]
    path.write_text("".join(own))
    naming = ["metrics.csv", digest_of(OTHER)]
    with refuses(*naming, error=FolderError):
        results.read_metrics(run)
    with refuses(*naming, error=FolderError):
        curves.read_curve(run)
    for command in (["plot", run], ["report", run]):
        is_rejected(capsys, *command, naming=naming)
    if run.name == "stopped":
        is_rejected(capsys, "resume", run, naming=naming)
    else:
        names(results.result_problem(run), *naming)
    assert path.read_text() == "".join(own)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("success_rate", "1.5"),
        ("success_rate", "nan"),
        ("epoch", "4"),
        ("env_steps", "1"),
        ("updates", "x"),
        ("wall_seconds", "-1"),
    ],
)
def test_values_that_no_run_writes_are_named(stopped, column, value, capsys):
    path = stopped / "metrics.csv"
    head, *lines = path.read_text().splitlines()
    cells = lines[2].split(",")
    cells[head.split(",").index(column)] = value
    lines[2] = ",".join(cells)
    path.write_text("\n".join([head, *lines, ""]))
    is_rejected(capsys, "plot", stopped, naming=["metrics.csv", column, value])


def test_a_missing_line_is_named(stopped, capsys):
    lines = (stopped / "metrics.csv").read_text().splitlines(keepends=True)
    (stopped / "metrics.csv").write_text("".join(lines[:2] + lines[3:]))
    is_rejected(capsys, "plot", stopped, naming=["metrics.csv", "epoch", 3])


def test_metrics_that_would_block_or_fill_memory_do_neither(stopped):
    path = stopped / "metrics.csv"
    os.truncate(path, 50 << 30)  # zeros after the last line, as after a power cut
    assert len(results.read_metrics(stopped)) == 4
    path.unlink()
    os.mkfifo(path)
    with refuses("metrics.csv", error=FolderError):
        results.read_metrics(stopped)


@pytest.mark.parametrize(
    ("file", "path", "value"),
    [
        ("result.json", "success_rate", 7),
        ("result.json", "status", "good"),
        ("result.json", "epochs", True),
        ("result.json", "reason", 3),
        ("config.json", "versions", {"jax": 3}),
        ("config.json", "jax_flags", {"gamma": 0.5}),
        ("config.json", "lanes", []),
        ("config.json", "earlier", ["x"]),
        ("config.json", "digest", None),
    ],
)
def test_contents_of_a_wrong_type_or_range_are_named(made, tmp_path, file, path, value, capsys):
    folder = shutil.copytree(made / "mine" / "whole", tmp_path / "run")
    edit(folder, (path,), value, file)
    is_rejected(capsys, "plot", folder, naming=[file, path])


def test_digests_from_before_a_resume_are_kept(stopped):
    """Lines of each digest that a run has had are its own, in this order."""
    train(stopped, LONGER)
    assert reading.digests(reading.read_config(stopped)) == [digest_of(SPEC), digest_of(LONGER)]
    assert [row["digest"] for row in results.read_metrics(stopped)] == 4 * [digest_of(SPEC)] + 4 * [digest_of(LONGER)]
    assert results.result_problem(stopped) is None
    assert results.earlier_digests(stopped, digest_of(SPEC)) == [digest_of(SPEC), digest_of(LONGER)]
    edit(stopped, ("earlier",), [digest_of(OTHER)])
    with refuses("metrics.csv", digest_of(SPEC), error=FolderError):
        results.read_metrics(stopped)


def test_lines_in_a_folder_without_earlier_digests_are_read_and_named(stopped, made):
    shutil.copy(made / "other" / "stopped" / "metrics.csv", stopped / "metrics.csv")
    edit(stopped, ("earlier",), None)
    with pytest.warns(UserWarning, match=digest_of(OTHER)):
        assert len(results.read_metrics(stopped)) == 4


@pytest.mark.parametrize("change", ["other", "without settings"])
def test_a_policy_that_is_not_this_run_s_is_rejected(run, made, change, capsys):
    path = run / "policy.npz"
    if change == "other":
        shutil.copy(made / "other" / run.name / "policy.npz", path)
    else:
        with np.load(path) as file:
            np.savez(path.with_name("other.npz"), **{name: file[name] for name in file.files if name != "settings"})
        path.with_name("other.npz").replace(path)
    naming = ["policy.npz", "seed" if change == "other" else "settings"]
    with refuses(*naming, error=FolderError):
        mjx_dher.load_policy(run)
    is_rejected(capsys, "eval", run, naming=naming)
    if run.name == "whole":
        names(results.result_problem(run), *naming)


@pytest.mark.parametrize("spec", [OTHER, LONGER], ids=["seed", "total_steps"])
def test_a_checkpoint_of_another_run_is_rejected(stopped, made, tmp_path, spec, capsys):
    train(tmp_path / "theirs", spec, until=4)
    shutil.rmtree(stopped / "checkpoints")
    shutil.copytree(tmp_path / "theirs" / "checkpoints", stopped / "checkpoints")
    before = (stopped / "metrics.csv").read_bytes()
    is_rejected(capsys, "resume", stopped, naming=["seed" if spec is OTHER else "total_steps"])
    assert (stopped / "metrics.csv").read_bytes() == before


def test_a_manifest_cannot_name_files_elsewhere(stopped, capsys):
    """Nor is a reader of such a file, which may have no end, kept waiting."""
    for path in run_folder.checkpoints(stopped):
        manifest = json.loads((path / "manifest.json").read_text())
        del manifest["sha256"]
        manifest["files"]["/dev/zero"] = "0"
        (path / "manifest.json").write_text(json.dumps({**manifest, "sha256": fingerprint.sha256_of(manifest)}))
    is_rejected(capsys, "resume", stopped, naming=["/dev/zero"])


def test_the_folder_of_a_trial_with_another_run_in_it_is_not_that_trial(made, tmp_path):
    folder = shutil.copytree(made / "mine" / "whole", grid.folder_of(tmp_path, OTHER))
    assert not grid.is_done(tmp_path, OTHER)
    names(results.trial_problem(folder, OTHER), "seed", 0, 1)
    assert results.is_done(folder, SPEC)


@pytest.mark.slow
def test_a_sweep_starts_runs_over_whose_metrics_are_of_another(tmp_path):
    trials = make_grid(("future",), (0, 1), static=sweep_helpers.LONGER)
    cut_short(tmp_path, trials, 2, lanes=2)
    one, other = (grid.folder_of(tmp_path, trial) for trial in trials)
    shutil.copy(other / "metrics.csv", one / "metrics.csv")
    told = []
    run_sweep(tmp_path, trials, lanes=2, report=told.append)
    digest = reading.read_config(other)["digest"]
    assert any("metrics.csv" in line and digest in line for line in told)
    assert [grid.is_done(tmp_path, trial) for trial in trials] == [True, True]


def test_other_versions_than_the_run_began_with_are_reported(stopped, monkeypatch, capsys):
    content = reading.read_config(stopped)
    edit(stopped, ("versions", "jax"), "0.0.1")
    monkeypatch.setattr(resume_module, "train_into", lambda *arguments: 0)
    assert resume(stopped, capsys)[1].count(f"jax was 0.0.1 and is {content['versions']['jax']}") == 1


# JAX's flags


def test_flags_of_jax_that_change_numbers_are_part_of_a_run(stopped, made, monkeypatch, capsys):
    assert fingerprint.jax_flags() == {}
    name = fingerprint.trial_name(SPEC)
    monkeypatch.setattr(fingerprint, "jax_flags", lambda: {"JAX_ENABLE_X64": 1})
    assert fingerprint.trial_name(SPEC) != name
    status, text = resume(stopped, capsys)
    assert (status, "JAX_ENABLE_X64 was 0 and is 1" in text, "compiling" in text) == (2, True, False)
    train(stopped.with_name("new"), until=2)
    assert reading.read_config(stopped.with_name("new"))["jax_flags"] == {"JAX_ENABLE_X64": 1}
    assert cli.main(["eval", str(made / "mine" / "whole"), "--episodes", "4"]) == 0
    assert "JAX_ENABLE_X64 was 0 and is 1" in capsys.readouterr().out
    monkeypatch.undo()
    reading.read_run(stopped.with_name("new"))
    with refuses("JAX_ENABLE_X64", 1, 0, error=FolderError):
        reading.check_same(stopped.with_name("new"), SPEC)


def test_flags_are_the_same_before_jax_is_imported_and_after():
    code = """
import sys
from mjx_dher.runs.folder import fingerprint
before = fingerprint.jax_flags()
assert "jax" not in sys.modules
import jax
assert fingerprint.jax_flags() == before, (fingerprint.jax_flags(), before)
print(sorted(before.items()))
"""
    changed = {"JAX_ENABLE_X64": "True", "JAX_THREEFRY_PARTITIONABLE": "off", "JAX_RANDOM_SEED_OFFSET": "3"}
    changed |= {"JAX_DEFAULT_MATMUL_PRECISION": "bfloat16", "JAX_DEFAULT_PRNG_IMPL": "threefry2x32"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env={**os.environ, **changed}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = {**changed, "JAX_ENABLE_X64": 1, "JAX_THREEFRY_PARTITIONABLE": 0, "JAX_RANDOM_SEED_OFFSET": "3"}
    del found["JAX_DEFAULT_PRNG_IMPL"]
    assert done.stdout.strip() == str(sorted(found.items()))


def test_the_defaults_are_those_of_this_jax():
    for name, default in fingerprint.JAX_FLAGS.items():
        value = getattr(jax.config, name.lower())
        assert value == default or (value is None and default == "default"), name


# Options of `resume`


def test_options_of_resume_are_those_of_the_next_one(stopped, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setattr(Options, "is_reached", lambda self, rates: False)
    given = [
        "--keep-end",
        "--checkpoint-every",
        "0",
        "--keep",
        "3",
        "--log",
        "jsonl",
        "--final-episodes",
        "3",
        "--stop-at",
        "0.9",
    ]
    given += ["--total-steps", "320"]
    taken = []
    monkeypatch.setattr(resume_module, "train_into", lambda *arguments: taken.append(arguments) or 0)
    assert cli.main(["resume", str(stopped), *given]) == 0
    options = Options(final_episodes=3, checkpoint_every=0, keep=3, keep_end=True, log=("jsonl",), stop_at=0.9)
    assert taken[0][3] == options
    mjx_dher.train_runs(PointMass(), [LONGER], [stopped], options=options, should_stop=lambda: True)  # as `_train` does
    assert cli.main(["resume", str(stopped)]) == 0
    assert (taken[1][3], taken[1][1]) == (options, LONGER)
    assert cli.main(["resume", str(stopped), "--no-keep-end", "--log"]) == 0
    assert taken[2][3] == dataclasses.replace(options, keep_end=False, log=())


def test_a_run_without_its_policy_is_made_longer(made, tmp_path):
    folder = shutil.copytree(made / "mine" / "whole", tmp_path / "run")
    shutil.copytree(made / "mine" / "stopped" / "checkpoints", folder / "checkpoints")
    (folder / "policy.npz").unlink()
    assert cli.main(["resume", str(folder), "--total-steps", "320", "--no-curve"]) == 0
    assert results.result_problem(folder) is None


def test_settings_that_no_component_reads_are_ignored_with_a_line(capsys):
    common = flags(SHORT)
    plain, told = train_module.parse_train_args(common).spec, []
    args = train_module.parse_train_args([*common, "--renewals", "5", "--policy-delay", "2"], told.append)
    assert args.spec == plain
    names(told[0], "renewals", "policy_delay")
    assert train_module.parse_train_args([*common, "--renewals", "5", "--priority", "td_error"]).spec.config.renewals == 5
    sweeps = [*common[2:], "--out", "no/such", "--sampler", "future", "--seeds", "1"]
    plain = sweep.parse_sweep_args(sweeps)[1]
    assert sweep.parse_sweep_args([*sweeps, "--renewals", "5", "--sweep.temperature", "2", "3"], told.append)[1] == plain
    names(told[1], "renewals", "temperature")


# Output


@pytest.mark.parametrize("arguments", [["list"], ["--version"], ["--help"], ["eval", "reach", "--episodes", "1", "--json"]])
def test_output_that_is_closed_is_an_error_of_what_prints(arguments, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    assert cli.main(arguments) == 2
    assert "cannot print" in capsys.readouterr().err
