import importlib.util
import json
import os
import platform
import re
import subprocess
import sys
from importlib import metadata

import jax
import pytest
from conftest import ROOT, names

import mjx_dher
from mjx_dher import cli, presets
from mjx_dher.envs import engines
from mjx_dher.system.machine import usable_cores
from mjx_dher.tools import doctor, render

ON_CPU = jax.default_backend() == "cpu"
pytestmark = pytest.mark.slow  # most of its time is a program of its own


@pytest.fixture(scope="module")
def examined(tmp_path_factory):
    """(report, exit status, folder that it was started in), whose cache folder has 1,500 bytes in two files."""
    folder = tmp_path_factory.mktemp("doctor")
    (folder / "mjx-dher" / "xla").mkdir(parents=True)
    (folder / "mjx-dher" / "one").write_bytes(bytes(1000))
    (folder / "mjx-dher" / "xla" / "two").write_bytes(bytes(500))
    (folder / "mujoco.py").write_text("raise ImportError('not the library')")
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"} | {"XDG_CACHE_HOME": str(folder)}
    command = [sys.executable, str(ROOT / "train.py"), "doctor", "--json"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    return json.loads(done.stdout), done.returncode, folder


def test_it_names_versions_and_the_machine(examined):
    report, _, _ = examined
    versions = report["versions"]
    assert versions["mjx_dher"] == mjx_dher.__version__
    assert versions["python"] == platform.python_version()
    for name in ("jax", "jaxlib", "mujoco", "mujoco-mjx", "optax", "onnx"):
        assert versions[name] == metadata.version(name)
    assert versions["furo"] in ("not installed (extra docs)", metadata_version("furo"))
    machine = report["machine"]
    assert machine["cores"] == str(usable_cores())
    assert jax.devices()[0].device_kind in machine["devices"]
    assert (machine["engine"], machine["preset"]) == (engines.resolve_engine("auto"), presets.machine_preset())


def metadata_version(package):
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def test_engines_are_tried(examined):
    report, status, _ = examined
    native, mjx, warp = (report["engines"][name] for name in ("native", "jax", "warp"))
    assert status == 0
    assert list(native) == list(mjx) == ["import", "build", "step"]
    if ON_CPU:
        missing = "[cuda]" if importlib.util.find_spec("warp") is None else "NVIDIA GPU"
        assert missing in warp["error"]
        assert "step" not in warp


def test_ways_to_draw_are_tried(examined):
    drawing = examined[0]["drawing"]
    assert drawing["MUJOCO_GL"] == "not set"
    assert os.path.isfile(os.path.expanduser(drawing["ffmpeg"]))
    ways = drawing.keys() - {"MUJOCO_GL", "ffmpeg"}
    assert ways == (set(render.GL) if sys.platform == "linux" else {"system"})
    assert all(drawing[name] == "works" or drawing[name].startswith("error: ") for name in ways)
    assert "not the library" not in str(drawing)


def test_it_leaves_nothing_behind(examined):
    report, _, folder = examined
    cache = folder / "mjx-dher"
    assert report["folders"] == {"cache": f"{cache}, 1.5 kB", "originals": f"{cache / 'fetch-originals'}, not ready"}
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*")} == {
        *("mujoco.py", "mjx-dher", "mjx-dher/one", "mjx-dher/xla", "mjx-dher/xla/two")
    }


def test_what_fails_leaves_the_rest(monkeypatch):
    """JAX without a backend."""
    monkeypatch.setenv("JAX_PLATFORMS", "nonsense")
    machine, native = (doctor.ask(topic, 60) for topic in ("machine", "native"))
    assert machine["cores"] == str(usable_cores())
    for name in ("devices", "engine"):
        assert re.match(r"error: RuntimeError: .*nonsense.* \(xla_bridge\.py, line \d+\)$", machine[name]), name
    assert {"import", "error"} <= native.keys() <= {"import", "build", "error"}
    assert "nonsense" in native["error"]


def test_what_takes_too_long_is_ended_without_loading_jax_or_mujoco_here():
    code = """
import sys
from mjx_dher.cli import main
assert main(["doctor", "--json", "--seconds", "0.01"]) == 1
assert not {"jax", "mujoco"} & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    late = {"error": "did not end within 0.01 s"}
    assert [report["machine"], *report["engines"].values()] == [late] * 4
    assert report["versions"]["jax"] == jax.__version__


def test_it_can_be_read():
    report = {
        "versions": {"flax": "0.12.1", "matplotlib": "not installed (extra plot)"},
        "engines": {"native": {"import": "1.0 s", "step": "1.2 s"}, "warp": {"import": "1.0 s", "error": "no GPU"}},
        "drawing": {"egl": "works"},
    }
    assert doctor.lines(report) == [
        "versions",
        "  flax        0.12.1",
        "  matplotlib  not installed (extra plot)",
        "engines",
        "  native      works, import: 1.0 s, step: 1.2 s",
        "  warp        fails, import: 1.0 s, error: no GPU",
        "drawing",
        "  egl         works",
    ]


def test_a_long_error_is_cut_short():
    assert doctor.one_line(ValueError("x\n" * 1000)) == ("x " * 200) + " ..."


def test_a_time_that_cannot_be_is_refused(capsys):
    for seconds in ("0", "-1", "nan", "4000"):
        assert cli.main(["doctor", "--seconds", seconds]) == 2
        names(capsys.readouterr().err, "seconds", "(0, 3600]", float(seconds))


def test_a_bug_report_is_asked_for_it():
    template = (ROOT / ".github" / "ISSUE_TEMPLATE" / "bug_report.md").read_text()
    assert template.startswith("---\nname: ")
    assert "`python train.py doctor`" in template
