import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata

import jax
import pytest
from conftest import ROOT, names

import mjx_dher
from mjx_dher import cli, presets
from mjx_dher.envs import engines
from mjx_dher.envs.engines.native import usable_cores
from mjx_dher.tools import doctor, render

ON_CPU = jax.default_backend() == "cpu"


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
    assert versions["python"] == ".".join(map(str, sys.version_info[:3]))
    for name in ("jax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "onnx"):
        assert versions[name] == metadata.version(name)
    machine = report["machine"]
    assert machine["cores"] == usable_cores()
    assert machine["devices"][0]["kind"] == jax.devices()[0].device_kind
    assert (machine["auto"], machine["preset"]) == (engines.resolve_engine("auto"), presets.machine_preset())
    assert machine["memory"] is None or machine["memory"] > 10**8


def test_engines_are_tried(examined):
    report, status, _ = examined
    native, mjx, warp = (report["engines"][name] for name in ("native", "jax", "warp"))
    assert status == 0
    assert native["works"]
    assert all(native[stage] > 0 for stage in ("import", "build", "step"))
    assert mjx["works"]
    assert mjx["step"] is None
    if ON_CPU:
        missing = "[cuda]" if importlib.util.find_spec("warp") is None else "NVIDIA GPU"
        assert not warp["works"]
        assert missing in warp["error"]
        assert "step" not in warp


def test_ways_to_draw_are_tried(examined):
    drawing = examined[0]["drawing"]
    assert drawing["MUJOCO_GL"] is None
    assert os.path.isfile(os.path.expanduser(drawing["ffmpeg"]))
    ways = drawing.keys() - {"MUJOCO_GL", "ffmpeg"}
    assert ways == (set(render.GL) if sys.platform == "linux" else {"system"})
    assert all(drawing[name]["works"] != ("error" in drawing[name]) for name in ways)
    assert "not the library" not in str(drawing)


def test_it_leaves_nothing_behind(examined):
    report, _, folder = examined
    cache = folder / "mjx-dher"
    assert report["folders"]["cache"] == {"path": str(cache), "bytes": 1500}
    assert report["folders"]["originals"] == {"path": str(cache / "fetch-originals"), "ready": False}
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*")} == {
        *("mujoco.py", "mjx-dher", "mjx-dher/one", "mjx-dher/xla", "mjx-dher/xla/two")
    }


def test_what_fails_leaves_the_rest(monkeypatch):
    """JAX without a backend."""
    monkeypatch.setenv("JAX_PLATFORMS", "nonsense")
    machine, native = (
        doctor.ask([sys.executable, "-m", "mjx_dher.tools.doctor", topic], 60) for topic in ("machine", "native")
    )
    assert machine["cores"] == usable_cores()
    for name in ("devices", "memory", "auto"):
        assert re.match(r"RuntimeError: .*nonsense.* \(xla_bridge\.py, line \d+\)$", machine[name]["error"]), name
    assert native["import"] > 0
    assert native["error"].startswith("RuntimeError: ")
    assert "nonsense" in native["error"]
    assert "step" not in native


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
    assert list(report["machine"].values()) == [late] * 5
    assert list(report["engines"].values()) == [{"works": False, **late}] * 3
    assert report["drawing"]["egl" if sys.platform == "linux" else "system"] == {"works": False, **late}
    assert report["versions"]["jax"] == jax.__version__


@pytest.mark.parametrize(
    ("end", "expected"),
    [
        ("", {}),
        ("sys.stdout.write('{\"c\": '); sys.stdout.flush(); time.sleep(60)", {"error": "did not end within 2 s"}),
        ("print('no\\nluck', file=sys.stderr); sys.exit(3)", {"error": "exit status 3: luck"}),
        ("os.kill(os.getpid(), 9)", {"error": "exit status -9: "}),
    ],
)
def test_what_a_process_found_before_its_end_counts(end, expected):
    code = f"import json, os, sys, time\nfor x in 'ab': print(json.dumps({{x: 1}}), flush=True)\n{end}"
    assert doctor.ask([sys.executable, "-S", "-c", code], seconds=2) == {"a": 1, "b": 1, **expected}


def test_it_can_be_read():
    report = {
        "versions": {"flax": "0.12.1", "matplotlib": None, "gymnasium": None},
        "machine": {
            "cores": 2,
            "devices": [
                {"platform": "gpu", "kind": "NVIDIA H200", "memory": 113_000_000_000},
                {"platform": "cpu", "kind": "cpu", "memory": None},
            ],
            "memory": 24_000_000_000,
            "auto": {"error": "KeyError: 'x' (a.py, line 3)"},
        },
        "engines": {
            "native": {"works": True, "import": 1.04, "build": 0.04, "step": 1.2},
            "jax": {"works": True, "import": 1.0, "build": 1.5, "step": None},
            "warp": {"works": False, "import": 1.0, "error": "no GPU"},
        },
        "drawing": {"MUJOCO_GL": None, "egl": {"works": True}, "glfw": {"works": False, "error": "no screen"}, "ffmpeg": "/x"},
        "folders": {"cache": {"path": "~/c", "bytes": 1500}, "originals": {"path": "~/o", "ready": False}},
    }
    lines = doctor.lines(report)
    assert [line for line in lines if not line.startswith("  ")] == list(report)  # a heading for each section
    shown = {line.split()[0]: line.split(maxsplit=1)[1] for line in lines if line.startswith("  ")}
    assert shown.keys() == {name for parts in report.values() for name in parts}
    columns = {line.index(shown[line.split()[0]]) for line in lines if line.startswith("  ")}
    assert len(columns) == 1
    for name, values in {
        "jax": ["works: yes", "import: 1.0 s", "build: 1.5 s", "step: not tried"],
        "matplotlib": ["not installed", "extra plot"],
        "gymnasium": ["not installed", "extra gym"],
        "flax": ["0.12.1"],
        "cores": ["2"],
        "devices": ["gpu", "NVIDIA H200", "113.0 GB", "cpu", "unknown"],
        "memory": ["24.0 GB"],
        "auto": ["error: KeyError: 'x' (a.py, line 3)"],
        "native": ["works: yes", "import: 1.0 s", "build: 0.0 s", "step: 1.2 s"],
        "warp": ["works: no", "no GPU", "import: 1.0 s"],
        "MUJOCO_GL": ["not set"],
        "egl": ["works: yes"],
        "glfw": ["works: no", "no screen"],
        "ffmpeg": ["/x"],
        "cache": ["~/c", "1.5 kB"],
        "originals": ["~/o", "no"],
    }.items():
        assert all(value in shown[name] for value in values), shown[name]


def test_a_long_error_is_cut_short():
    assert doctor.one_line(ValueError("x\n" * 1000)) == ("x " * 200) + " ..."


def test_a_time_that_cannot_be_is_refused(capsys):
    for seconds in ("0", "-1", "nan", "4000"):
        assert cli.main(["doctor", "--seconds", seconds]) == 2
        names(capsys.readouterr().err, "seconds", "(0, 3600]", seconds)


def test_extras_are_those_that_install_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    name_of = lambda requirement: re.match(r"[\w.-]+", requirement)[0]  # noqa: E731
    needed = {name_of(requirement) for requirement in project["dependencies"]}
    extras = project["optional-dependencies"].items()
    optional = {name_of(r): extra for extra, requirements in extras if extra != "test" for r in requirements}
    optional = {name: extra for name, extra in optional.items() if name not in needed}
    optional["jax-cuda12-plugin"] = "cuda"  # of jax[cuda12]
    assert optional == doctor.EXTRA_OF
    assert not needed & doctor.EXTRA_OF.keys()


def test_a_bug_report_is_asked_for_it():
    template = (ROOT / ".github" / "ISSUE_TEMPLATE" / "bug_report.md").read_text()
    assert template.startswith("---\nname: ")
    assert "`python train.py doctor`" in template
