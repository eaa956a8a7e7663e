"""Words of other libraries, the live curve, and what messages call this program."""

import io
import os
import re
import sys

import numpy as np
import pytest
from conftest import ROOT, names
from rich.console import Console

from mjx_dher import RunSpec, cli, lookup
from mjx_dher.cli import FOREIGN_FLAGS, common
from mjx_dher.runs.loop import Progress


def test_a_polyak_that_is_likely_a_tau_is_explained():
    for polyak, told in ((0.05, True), (0.95, False)):
        console = Console(file=io.StringIO(), width=200)
        common.warn_of_tau(polyak, console)
        assert ("it is 1 - tau in other libraries" in console.file.getvalue()) == told


def test_every_foreign_flag_names_one_that_is_there(capsys):
    assert cli.main(["train", "--help"]) == 0
    text = capsys.readouterr().out
    for flag in FOREIGN_FLAGS:
        assert cli.main([flag, "3"]) == 2
        named = re.findall(r"--[\w-]+", capsys.readouterr().err.replace(flag, "", 1))
        assert all(word in text for word in named), flag


def test_a_number_in_a_sweep_is_named_as_it_is_there(capsys):
    assert cli.main(["sweep", "--out", "x", "--her-k", "2", "4"]) == 2
    names(capsys.readouterr().err, "--her-k", "--sweep.her-k")


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
    assert lookup.command_name() == "python train.py"
    for path, command in ((("bin", "mjx-dher"), "mjx-dher"), (("mjx_dher", "__main__.py"), "python -m mjx_dher")):
        monkeypatch.setattr(sys, "argv", [os.path.join(*path)])
        assert lookup.command_name() == command


HUGE = str(10**20)
BAD = [  # arguments, and what the error must name
    (["eval", "docs", "--seed", HUGE], ["seed", HUGE, 4294967295]),
    (["transfer", "docs", "--seed", "-1"], ["seed", -1]),
    (["render", "docs", "--out", "x.png", "--seed", HUGE], ["seed", HUGE]),
    (["--env-kwargs", "dense"], ["env_kwargs", "dense"]),
    (["--config", "docs"], ["config", "docs/config.json"]),
    (["--stop-at", "nan"], ["stop_at", "nan"]),
    (["sweep", "--out", "x", "--keep-end"], ["keep_end"]),
    (["plot", "docs"], ["docs", "config.json"]),
    (["report", "docs/not-there"], ["docs/not-there"]),
    (["list", "smplers"], ["kind", "smplers", "samplers"]),
]


def test_bad_arguments_are_refused_with_a_line(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    before = {path.name for path in ROOT.iterdir()}
    for argv, parts in BAD:
        assert cli.main(argv) == 2
        (error,) = capsys.readouterr().err.splitlines()
        assert error.startswith("error: ")
        names(error, *parts)
    assert {path.name for path in ROOT.iterdir()} == before
