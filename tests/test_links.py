"""Links and names in the files of a folder lead nowhere outside of it."""

import base64
import json
from pathlib import Path

import pytest
from configs import TINY
from conftest import refuses
from test_trust import OWN, write

from mjx_dher import RunSpec, cli
from mjx_dher.fleet import chunks, worker
from mjx_dher.runs.folder import lane_checkpoints
from mjx_dher.system.files import FolderError


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The current folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def secret(here):
    (here / "secret").write_bytes(b"the token")
    return here / "secret"


@pytest.mark.parametrize("name", ["x.gif", "v.webm", "metrics.csv"])
def test_a_page_includes_no_file_from_elsewhere(here, secret, capsys, name):
    write(here / "run", RunSpec(env="reach", config=TINY), "native")
    (here / "run" / name).symlink_to(secret)
    assert cli.main(["report", "run"]) == 2
    assert not (here / "run" / "report.html").exists()
    (here / "run" / name).unlink()
    (here / "run" / "in.gif").write_bytes(b"GIF89a")
    (here / "run" / "also.gif").symlink_to("in.gif")
    (here / "named").symlink_to("run")
    assert cli.main(["report", "named"]) == 0
    assert base64.b64encode(b"the token") not in (here / "run" / "report.html").read_bytes()


def test_a_parcel_includes_no_file_from_elsewhere(here, secret):
    write(here / "run", RunSpec(env="reach", config=TINY), "native")
    (here / "run" / "sub").mkdir()
    (here / "run" / "sub" / "link").symlink_to(secret)
    with refuses(here / "run" / "sub" / "link", error=FolderError):
        worker.pack(here / "run")


@pytest.mark.parametrize("name", ["checkpoints", "metrics.csv", "tensorboard"])
def test_nothing_is_written_or_deleted_through_a_link(here, capsys, name):
    (here / "mine" / "epoch-000001").mkdir(parents=True)
    run = write(here / "run", OWN)
    (run / name).symlink_to(here / "mine")
    (run / "checkpoints" / "epoch-000002").mkdir(parents=True, exist_ok=True)
    before = sorted((here / "mine").rglob("*"))
    assert cli.main(["resume", "run"]) == 2
    assert str(Path("run") / name) in capsys.readouterr().err
    assert sorted((here / "mine").rglob("*")) == before


@pytest.mark.parametrize("link", ["cells", "cells/x", "unfinished"])
def test_a_sweep_writes_through_no_link(here, capsys, link):
    (here / "mine").mkdir()
    (here / "sweep" / "cells").mkdir(parents=True)
    if link == "cells":
        (here / "sweep" / "cells").rmdir()
    (here / "sweep" / link).symlink_to(here / "mine")
    assert cli.main(["sweep", "--out", "sweep", "--env", "reach", "--preset", "cpu", "--dry-run"]) == 2
    assert str(Path("sweep") / link) in capsys.readouterr().err


@pytest.mark.parametrize("names", [["/etc"], ["../.."], [5], [["x"]], "x", {"x": 1}, None])
def test_names_in_a_file_are_names_in_the_folder(here, names):
    (here / "cells.json").write_text(json.dumps({"cells": names}))
    found = lane_checkpoints._names(here / "cells.json")
    assert all(name == Path(name).name for name in found)
    (here / "storage" / "x").mkdir(parents=True)
    (here / "storage" / "x" / chunks.NAMES_FILE).write_text(json.dumps(names))
    assert chunks.unfinished(here / "storage", [OWN], [OWN]) == []
