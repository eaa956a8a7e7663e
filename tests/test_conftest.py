"""Which folders the tests keep what they compile in, and which module runs first; conftest in a process of its own."""

import json
import os
import subprocess
import sys
import time
import zlib

import pytest
from conftest import LONGEST, ROOT

FOLDERS = ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH")
SHOW = f"import json, os, conftest; print(json.dumps({{name: os.environ[name] for name in {FOLDERS}}}))"


def folders(**given):
    """The folders of a test run that is started with the environment variables `given`."""
    ours = ("PYTEST_XDIST_WORKER", "XDG_CACHE_HOME", *FOLDERS)
    environment = {name: value for name, value in os.environ.items() if name not in ours}
    done = subprocess.run(
        [sys.executable, "-c", SHOW],
        env={**environment, "PYTHONPATH": str(ROOT / "tests"), **{name: str(value) for name, value in given.items()}},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def test_folders_that_the_user_has_chosen_are_kept(tmp_path):
    mine = {name: str(tmp_path / name) for name in FOLDERS}
    assert folders(HOME=tmp_path, **mine) == mine


def test_otherwise_they_are_kept_from_run_to_run_apart_from_those_of_the_user_s_own_runs(tmp_path):
    first = folders(HOME=tmp_path)
    assert first == {name: str(tmp_path / ".cache" / "mjx-dher-tests" / kind) for name, kind in zip(FOLDERS, ("xla", "warp"))}
    elsewhere = folders(XDG_CACHE_HOME=tmp_path / "other")
    assert elsewhere["WARP_CACHE_PATH"] == str(tmp_path / "other" / "mjx-dher-tests" / "warp")


def test_what_is_a_month_old_or_cut_short_goes(tmp_path):
    kept = tmp_path / "mjx-dher-tests" / "xla"
    kept.mkdir(parents=True)
    whole, month = zlib.compress(bytes(1000)), 31 * 24 * 60 * 60
    for name, content, age in (("new", whole, 0), ("old", whole, month), ("cut", whole[:-1], 0), ("empty", b"", 0)):
        (kept / f"{name}-cache").write_bytes(content)
        os.utime(kept / f"{name}-cache", (time.time() - age,) * 2)
    folders(XDG_CACHE_HOME=tmp_path)
    assert [path.name for path in kept.iterdir()] == ["new-cache"]


def test_the_modules_that_start_first_are_there():
    for name in LONGEST:
        assert (ROOT / "tests" / f"test_{name}.py").exists(), name


CI = ROOT / ".ci" / "run"


COVERED = ["pytest --cov --cov-report=", "pytest -m slow --dist load --cov --cov-append --cov-report="]


@pytest.mark.parametrize(("args", "runs"), [([], ["pytest"]), (["--all"], COVERED)])
def test_ci_runs_the_tests_and_if_asked_the_slow_ones(args, runs, tmp_path):
    """With stand-ins for all that it calls."""
    called = tmp_path / "called"
    for name in ("python3", "python", "pip", "ruff", "lint-imports", "mypy", "pytest", "coverage"):
        (tmp_path / name).write_text(
            f'#!/bin/sh\n[ "$1" = -m ] && [ "$2" = venv ] && mkdir -p "$3/bin" && touch "$3/bin/activate"\n'
            f'echo "{name} $*" | sed "s/ $//" >> {called}\n'
        )
        (tmp_path / name).chmod(0o755)
    subprocess.run([CI, *args], env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}, check=True, capture_output=True)
    assert [line for line in called.read_text().splitlines() if line.startswith("pytest")] == runs


@pytest.mark.parametrize("args", [["--al"], ["--all", "--all"], [""]])
def test_ci_refuses_what_it_does_not_know(args):
    done = subprocess.run([CI, *args], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "usage: .ci/run [--all | --docs [FOLDER]]\n")
