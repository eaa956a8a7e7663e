"""Runs that have ended and go on: to the bit as if they had been longer from the start."""

import json
import sys
from unittest.mock import Mock

import pytest
from configs import SHORT, flags
from conftest import EXAMPLES, names, refuses
from sweep_helpers import compile_once  # noqa: F401
from test_driver import result_of, rows_of

import mjx_dher
from mjx_dher import Options, RunSpec, cli
from mjx_dher.runs.folder import run_folder, services
from point_mass import PointMass

FLAGS = [*flags(SHORT), "--final-episodes", "4", "--no-curve"]


@pytest.fixture(autouse=True)
def examples(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A run of three epochs with a checkpoint of its end, made five epochs long; and what was printed."""
    sys.path.insert(0, str(EXAMPLES))
    out = tmp_path_factory.mktemp("longer") / "run"
    assert cli.main([*FLAGS, "--keep-end", "--checkpoint-every", "1", "--out", str(out)]) == 0
    assert [path.name for path in run_folder.checkpoints(out)] == ["epoch-000003"]
    assert result_of(out)["epochs"] == 3
    assert cli.main(["resume", str(out), "--total-steps", "200", "--no-curve"]) == 0
    return out


def test_a_run_that_goes_on_is_as_one_that_was_longer_from_the_start(kept, tmp_path):
    assert cli.main([*FLAGS, "--total-steps", "200", "--out", str(tmp_path / "whole")]) == 0
    assert rows_of(kept)[3:] == rows_of(tmp_path / "whole")[3:]
    assert len(rows_of(kept)) == 5
    assert result_of(kept) == result_of(tmp_path / "whole")
    assert json.loads((kept / "config.json").read_text())["config"]["total_steps"] == 200
    assert [path.name for path in run_folder.checkpoints(kept)] == ["epoch-000005"]  # it can go on once more
    assert not run_folder.checkpoints(tmp_path / "whole")


@pytest.mark.parametrize("more", [[], ["--total-steps", "200"], ["--total-steps", "1"]])
def test_no_more_steps_are_nothing_to_go_on_for(kept, more, capsys):
    before = {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()}
    assert cli.main(["resume", str(kept), *more]) == 2
    assert "has ended after 200 environment steps; total_steps must be larger to resume it" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()} == before


def test_a_log_that_cannot_start_leaves_a_run_as_it_was(kept, tmp_path, monkeypatch, capsys):
    before = {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()}
    monkeypatch.setattr(services, "TensorBoardSink", Mock(side_effect=ValueError("log tensorboard cannot start")))
    assert cli.main(["resume", str(kept), "--total-steps", "240", "--log", "tensorboard"]) == 2
    assert "log tensorboard cannot start" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()} == before
    assert cli.main([*FLAGS, "--log", "tensorboard", "--out", str(tmp_path / "new")]) == 2
    assert cli.main([*FLAGS, "--out", str(tmp_path / "new")]) == 0  # the folder is free


def test_a_run_that_kept_nothing_says_how_to_train_a_longer_one(tmp_path, capsys):
    out = tmp_path / "run"
    assert cli.main([*FLAGS, "--out", str(out)]) == 0
    assert cli.main(["resume", str(out), "--total-steps", "200"]) == 2
    error = capsys.readouterr().err
    assert "has ended; there is nothing to resume: --keep-end would have kept its last checkpoint" in error
    assert f"`python train.py --config {out} --total-steps N`" in error


@pytest.mark.slow
def test_what_falling_step_sizes_do_is_said(tmp_path, capsys):
    out = tmp_path / "run"
    assert cli.main([*FLAGS, "--keep-end", "--lr-end", "0.1", "--out", str(out)]) == 0
    assert cli.main(["resume", str(out), "--total-steps", "160", "--no-curve"]) == 0
    assert "learning rates fall to 0.1 of their start over the whole run. Its length has changed" in capsys.readouterr().out
    assert len(rows_of(out)) == 4


def test_a_run_that_stop_at_has_ended_goes_on_when_asked(tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    monkeypatch.setattr(Options, "is_reached", lambda self, rates: self.stop_at is not None and len(rates) == 2)
    assert cli.main([*FLAGS, "--keep-end", "--stop-at", "0.5", "--out", str(out)]) == 0
    assert result_of(out)["epochs"] == 2
    assert cli.main(["resume", str(out)]) == 2
    assert "at its stop_at 0.5: pass --total-steps, or another --stop-at, to resume" in capsys.readouterr().err
    assert cli.main(["resume", str(out), "--total-steps", "200", "--no-curve"]) == 0
    assert len(rows_of(out)) == 5


def test_runs_of_a_sweep_keep_no_end(tmp_path, capsys):
    for option, name in (("--keep-end", "keep_end"), ("--stop-at=0.9", "stop_at")):
        assert cli.main(["sweep", "--out", str(tmp_path / "sweep"), option]) == 2
        names(capsys.readouterr().err, name)
    specs = [RunSpec(env="point_mass:PointMass", seed=seed) for seed in (0, 1)]
    with refuses("keep_end"):
        mjx_dher.train_runs(PointMass(), specs, [tmp_path / "a", tmp_path / "b"], options=Options(keep_end=True))
    with refuses("keep_end", 3):
        Options(keep_end=3).check()
    assert not any(tmp_path.iterdir())
