"""Own code that changed: its file is part of a trial, and who goes on with it is told."""

import dataclasses
import sys

import pytest
from configs import SHORT, flags
from sweep_helpers import compile_once  # noqa: F401
from test_identity import SPEC, resume, train

from mjx_dher import cli
from mjx_dher.runs.folder import fingerprint
from mjx_dher.sweeps import tables

TASK = """
from point_mass import *  # noqa: F403

class Mine(PointMass):
    pass

def near(achieved, desired):
    return jnp.linalg.norm(achieved - desired, axis=-1)
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module of the user's own; a function that edits it, as between two programs."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "own_task", raising=False)

    def write(text):
        (tmp_path / "own_task.py").write_text(TASK + text)
        fingerprint._source.cache_clear()

    write("")
    yield write
    fingerprint._source.cache_clear()


def flags_of(out):
    own = [*flags(SHORT, "own_task:Mine"), "--sampler", "closest", "--metric", "own_task:near"]
    return [*own, "--total-steps", "80", "--final-episodes", "4", "--out", str(out)]


@pytest.mark.slow
def test_a_sweep_of_own_code_that_changed_trains_it_anew_and_says_so(own, tmp_path, capsys):
    command = ["sweep", *flags_of(tmp_path / "sweep"), "--seeds", "2"]
    assert cli.main(command) == 0
    before = tables.read(tmp_path / "sweep")
    assert cli.main(command) == 0
    assert "2 of them are done already" in capsys.readouterr().out
    own("# another reading")
    assert cli.main(command) == 0
    text = capsys.readouterr().out
    assert "own_task.py (env own_task:Mine) has changed since 2 of the runs in" in text
    assert "own_task.py (metric own_task:near) has changed since 2 of the runs in" in text
    trials = tables.read(tmp_path / "sweep")
    assert len(trials) == 4
    assert {trial["settings"]["source"] for trial in before} < {trial["settings"]["source"] for trial in trials}
    assert len({trial["settings"]["source"] for trial in trials}) == 2


def test_eval_and_resume_say_which_file_changed_since(own, tmp_path, capsys):
    spec = dataclasses.replace(SPEC, env="own_task:Mine")
    train(tmp_path / "run", spec, until=2)
    own("# another task")
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "2"]) == 0
    assert "own_task.py has changed (env)" in capsys.readouterr().out
    status, text = resume(tmp_path / "run", capsys)
    assert (status, "own_task.py has changed (env)" in text) == (0, True), text
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "2"]) == 0
    assert "has changed" not in capsys.readouterr().out
