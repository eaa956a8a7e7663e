"""Words of other libraries, the live curve, and what messages call this program."""

import io
import os
import sys

import numpy as np
import pytest
from conftest import ROOT
from rich.console import Console

from mjx_dher import RunSpec, cli, lookup
from mjx_dher.cli import common
from mjx_dher.runs.program.loop import Progress


def test_a_polyak_that_is_likely_a_tau_is_explained():
    for polyak, told in ((0.05, True), (0.95, False)):
        console = Console(file=io.StringIO(), width=200)
        common.warn_of_tau(polyak, console)
        assert ("it is 1 - tau of other libraries" in console.file.getvalue()) == told


@pytest.mark.parametrize("flag", common.FOREIGN_FLAGS)
def test_every_foreign_flag_names_one_that_is_there(flag, capsys):
    assert cli.main([flag, "3"]) == 2
    named = capsys.readouterr().err.split(" is called ")[1]
    assert cli.main(["train", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(word.strip(",:") in text for word in named.split(" here")[0].split() if word.startswith("--"))


def test_a_number_in_a_sweep_is_named_as_it_is_there(capsys):
    assert cli.main(["sweep", "--out", "x", "--her-k", "2", "4"]) == 2
    assert "error: --her-k is called --sweep.her-k here, and takes one or more values to try" in capsys.readouterr().err


def test_a_curve_of_characters():
    assert common.sparkline([0.0, 0.5, 1.0], 3) == "▁▅█"
    assert common.sparkline([0.0, 0.5, 1.0], 3, ascii_only=True) == " =#"
    assert common.sparkline([0.0] * 50 + [1.0] * 50, 100, width=4) == "▁▁██"
    assert common.sparkline([1.0] * 50, 100, width=4) == "██··"
    assert common.sparkline([], 2) == "··"
    assert common.sparkline([float("nan"), 2.0, -1.0], 3) == "▁█▁"


@pytest.mark.parametrize("width", [40, 80, 200])
def test_nothing_of_the_progress_is_cut_on_a_narrow_terminal(width):
    screen = io.StringIO()
    shown = common.Screen(Console(file=screen, force_terminal=True, width=width, color_system=None), [RunSpec()], [0.25])
    metrics = {"success_rate": np.asarray(0.75), "return_mean": np.asarray(-20.0)}
    shown.show([RunSpec()], Progress(2, 4, 2000, 200, 4.0, 2.0, metrics, None, True))
    shown.close()
    assert "\u2026" not in screen.getvalue()
    last = screen.getvalue().rsplit("epoch 2/4", 1)
    assert "▃▇··" in last[0]
    assert "ETA" in last[1]
    assert "0.75" in last[1]


def test_messages_name_the_program_that_was_started(monkeypatch):
    assert lookup.program() == "train.py"
    monkeypatch.setattr(sys, "argv", [os.path.join("bin", "mjx-dher")])
    assert lookup.program() == "mjx-dher"


HUGE = str(10**20)
BAD = [
    (["eval", "docs", "--seed", HUGE], [f"seed must lie in [0, 4294967295]; got {HUGE}"]),
    (["transfer", "docs", "--seed", "-1"], ["seed must lie in [0, 4294967295]; got -1"]),
    (["render", "docs", "--out", "x.png", "--seed", HUGE], [f"seed must lie in [0, 4294967295]; got {HUGE}"]),
    (["--env-kwargs", "dense"], ["env_kwargs must be NAME=VALUE each, such as reward_type=dense; got 'dense'"]),
    (["--config", "docs"], ["config: there is no file docs/config.json"]),
    (["--stop-at", "nan"], ["stop_at must lie in (0, 1]; got nan"]),
    (["sweep", "--out", "x", "--keep-end"], ["keep_end is for one run alone"]),
    (["plot", "docs"], ["docs is neither a run folder nor that of a sweep: it has neither config.json nor cells/"]),
    (["report", "docs/not-there"], ["docs/not-there is neither a run folder nor that of a sweep: no such folder"]),
    (["list", "smplers"], ["kind must be one of tasks", "did you mean 'samplers' or 'metrics'?"]),
]


@pytest.mark.parametrize(("argv", "messages"), BAD)
def test_bad_arguments_are_refused_with_a_line(argv, messages, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    before = {path.name for path in ROOT.iterdir()}
    assert cli.main(argv) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith("error: ")
    assert all(message in error for message in messages)
    assert {path.name for path in ROOT.iterdir()} == before
