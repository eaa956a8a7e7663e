"""Own code that changed: its file and its models are part of a trial, and who goes on with it is told."""

import dataclasses
import hashlib
import os
import sys

import pytest
from configs import SHORT, flags
from sweep_helpers import compile_once  # noqa: F401
from test_identity import SPEC, resume, train

from mjx_dher import cli
from mjx_dher.runs.folder import fingerprint
from mjx_dher.runs.folder.model_files import model_files
from mjx_dher.spec import RunSpec
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
    assert "own_task.py or a file of its model (env own_task:Mine) has changed since 2 of the runs in" in text
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
    assert "own_task.py or a file of its model has changed (env)" in capsys.readouterr().out
    status, text = resume(tmp_path / "run", capsys)
    assert (status, "own_task.py or a file of its model has changed (env)" in text) == (0, True), text
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "2"]) == 0
    assert "has changed" not in capsys.readouterr().out


BROKEN = """
class Mine(PointMass):
    def step(self, state, action):
        raise KeyError("boo")
"""


def test_eval_and_resume_name_the_line_of_a_task_that_no_longer_steps(own, tmp_path, capsys):
    train(tmp_path / "run", dataclasses.replace(SPEC, env="own_task:Mine"), until=2)
    own(BROKEN)
    del sys.modules["own_task"]
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "2"]) == 2
    told = capsys.readouterr().err
    place = f"own_task.py, line {(TASK + BROKEN[: BROKEN.index('raise')]).count(chr(10)) + 1})"
    assert "an episode raises KeyError: 'boo'" in told
    assert place in told
    status, text = resume(tmp_path / "run", capsys)
    assert status == 2
    assert place in text


def test_only_an_environment_has_files_of_a_model():
    for field in ("sampler", "metric", "networks", "env"):
        told = fingerprint.file_of(field, "own_task.py 3fa9c1d2e4")
        assert told == "own_task.py" + " or a file of its model" * (field == "env")


def write(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)


ROBOT = {
    "assets_of_test.py": 'model = "robots/arm.xml"',
    "robots/arm.xml": """
      <mujoco><compiler meshdir="meshes" texturedir='pictures'/><include file="parts/more.xml"/>
        <asset><mesh name="a > b" file="link.stl"/><mesh file="..\\shared\\hand.obj"/><mesh file="a&amp;b.obj"/>
          <hfield file='ground.png'/><texture type="cube" fileright="right.png" fileleft="left.png"/>
          <model file="tool/tool.xml"/><mesh file="missing.stl"/><mesh file="no\0ne"/><mesh file="."/></asset>
        <worldbody/></mujoco>""",
    "robots/parts/more.xml": '<mujoco><include file="../arm.xml"/><asset><skin file="skin.skn"/></asset></mujoco>',
    "robots/tool/tool.xml": '<mujoco><asset><mesh file="x/tip.stl"/><model file="../tool/tool.xml"/></asset></mujoco>',
}
ASSETS = (
    *("meshes/link.stl", "shared/hand.obj", "meshes/a&b.obj", "ground.png", "pictures/right.png", "pictures/left.png"),
    *("skin.skn", "tool/x/tip.stl"),
)


def test_assets_of_a_model_belong_to_the_identity(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    write(tmp_path, {**ROBOT, **{f"robots/{name}": name for name in ASSETS}, "robots/other.stl": "", "robots/tip.stl": ""})
    os.mkfifo(tmp_path / "robots" / "missing.stl")  # no regular file, which is not waited for
    digests = []
    for name in (*ASSETS, "parts/more.xml", "tool/tool.xml", "other.stl", "tip.stl"):
        with (tmp_path / "robots" / name).open("a") as file:
            file.write(" ")
        fingerprint._source.cache_clear()
        digests.append(fingerprint.sources(RunSpec(env="assets_of_test:Reach"))["env"])
    assert len(set(digests)) == len(ASSETS) + 2
    assert len(set(digests[-3:])) == 1  # the last two are not named: a tool's mesh is in the tool's folder
    found = [os.path.relpath(path, tmp_path / "robots") for path in model_files(tmp_path / "assets_of_test.py")]
    assert sorted(found) == sorted(["arm.xml", "parts/more.xml", "tool/tool.xml", *ASSETS])


def test_meshes_beside_model_text_and_without_their_folders_are_found(tmp_path):
    text = 'model = """<mujoco><compiler strippath="true" assetdir="m"/><mesh file="C:/cad/a.stl"/></mujoco>"""'
    write(tmp_path, {"own.py": text, "m/a.stl": "", "a.xml": ""})
    assert model_files(tmp_path / "own.py") == [tmp_path / "m" / "a.stl"]


def test_digests_of_models_without_assets_are_as_before(tmp_path, monkeypatch):
    """Names of older runs contain these digests."""
    monkeypatch.syspath_prepend(tmp_path)
    files = {"plain_of_test.py": 'model = "b.xml"', "a.xml": "<mujoco/>", "b.xml": '<mujoco><include file="a.xml"/></mujoco>'}
    write(tmp_path, files)
    whole = "".join(files.values()).encode()
    expected = f"plain_of_test.py {hashlib.sha256(whole).hexdigest()[:10]}"
    assert fingerprint.sources(RunSpec(env="plain_of_test:Reach")) == {"env": expected}
