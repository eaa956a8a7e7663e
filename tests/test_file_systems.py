"""File systems that lack something: flushing folders, locks, space; what is left of a folder that could not be made."""

import ast
import contextlib
import errno
import fcntl
import os
import stat
import subprocess
import sys
import warnings
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT

from mjx_dher.cli import sentence
from mjx_dher.runs.folder import checkpoint, restoring
from mjx_dher.runs.folder.run_folder import Claims
from mjx_dher.spec import RunSpec
from mjx_dher.system import files

fsync = os.fsync


def failing(number, is_folder):
    """`os.fsync` of a file system that cannot flush folders, or files."""

    def flush(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode) is is_folder:
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    return flush


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP])
def test_folders_that_cannot_be_flushed_are_passed_over_and_files_are_not(number, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", failing(number, is_folder=True))
    with files.new_folder(tmp_path / "a" / "b"):
        files.write_json(tmp_path / "a" / "b" / "x.json", {})
    files.flush_all(tmp_path)
    monkeypatch.setattr(os, "fsync", failing(number, is_folder=False))
    with pytest.raises(OSError) as raised:  # noqa: PT011
        files.write_json(tmp_path / "y.json", {})
    assert (raised.value.errno, str(tmp_path / "y.json")) == (
        number,
        sentence(raised.value).split(": ")[0].removesuffix(f".{os.getpid()}.partial"),
    )
    assert not list(tmp_path.glob("y.json*"))


def test_a_folder_where_a_file_is_to_be_is_named_and_not_the_partial_file(tmp_path):
    (tmp_path / "finals.csv").mkdir()
    with pytest.raises(IsADirectoryError) as raised:
        files.write(tmp_path / "finals.csv", b"")
    assert sentence(raised.value) == f"{tmp_path / 'finals.csv'}: {os.strerror(errno.EISDIR)}"


@pytest.mark.parametrize("make", [files.make_folder, lambda path: files.new_folder(path).__enter__()])
def test_a_folder_that_cannot_be_flushed_is_named_and_does_not_stay(make, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", failing(errno.EIO, is_folder=True))
    with pytest.raises(OSError) as raised:  # noqa: PT011
        make(tmp_path / "a" / "b")
    assert sentence(raised.value) == f"{tmp_path / 'a'}: {os.strerror(errno.EIO)}"
    assert not list(tmp_path.iterdir())


@pytest.fixture(params=[errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def no_locks(request, monkeypatch):
    def flock(descriptor, operation):
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr(fcntl, "flock", flock)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        yield request.param
        assert len(told) == 1


OTHER = """
import sys
from pathlib import Path
from types import SimpleNamespace
from mjx_dher.system import files
with files.lock(Path(sys.argv[1])):
    print(flush=True)
    sys.stdin.read()
"""


def test_without_locks_a_file_marks_a_folder(no_locks, tmp_path):
    out = tmp_path / "a" / "b"
    with files.new_folder(out), files.lock(out):
        assert not files.is_used(out)
    assert not list(tmp_path.iterdir())
    with files.new_folder(out):
        (out / "x").touch()
    with files.lock(out):
        pass
    assert not [path for path in out.iterdir() if path.name not in ("x", files.LOCK)]


def test_without_locks_another_program_is_noticed_until_it_is_killed(tmp_path):
    shim = tmp_path / "flock.so"
    source = "#include <errno.h>\nint flock(int fd, int op) { errno = 37; return -1; }\n"
    built = subprocess.run(["gcc", "-shared", "-fPIC", "-o", shim, "-xc", "-"], input=source, text=True, check=False)
    if built.returncode:
        pytest.skip("no compiler")
    folder = tmp_path / "run"
    folder.mkdir()
    variables = {**os.environ, "LD_PRELOAD": str(shim)}
    start = lambda: subprocess.Popen(  # noqa: E731
        [sys.executable, "-c", OTHER, folder],
        cwd=ROOT,
        env=variables,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    first = start()
    assert first.stdout.readline() == "\n"
    second = start()
    stderr = second.communicate()[1]
    assert second.returncode
    assert f"BusyError: {folder} " in stderr
    first.kill()
    first.communicate()
    third = start()
    assert third.communicate()[0] == "\n"
    assert third.returncode == 0


def test_a_folder_whose_lock_fails_is_named_and_does_not_stay(tmp_path, monkeypatch):
    def flock(descriptor, operation):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(ValueError, match=r"x.*Input/output"), contextlib.ExitStack() as stack:
        Claims(False, print).claim(stack, [(RunSpec(), tmp_path / "x")], 1)
    with pytest.raises(OSError) as raised, files.new_folder(tmp_path / "y"):  # noqa: PT011
        pass
    assert sentence(raised.value) == f"{tmp_path / 'y' / files.LOCK}: {os.strerror(errno.EIO)}"


TEXT = ("open", "read_text", "write_text")  # functions that take an encoding


def is_in_the_locale_s_encoding(call):
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    texts = [argument.value for argument in call.args if isinstance(argument, ast.Constant)]
    given = {keyword.arg for keyword in call.keywords}
    other = getattr(getattr(call.func, "value", None), "id", "") in ("os", "webbrowser", "archive")  # they open no text
    return name in TEXT and "encoding" not in given and not other and not any("b" in str(text) for text in texts[-1:])


@pytest.mark.parametrize("folder", ["mjx_dher", "envs"])
def test_no_text_is_in_the_locale_s_encoding(folder):
    """A sampler called `grün` would be written otherwise on another machine, or not at all."""
    for path in (ROOT / folder).rglob("*.py"):
        calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
        assert not [f"{path}:{call.lineno}" for call in calls if is_in_the_locale_s_encoding(call)]


def test_arrays_of_every_kind_come_back_to_the_bit_and_zeros_take_no_space(tmp_path):
    """A piece of zeros is a hole of the file: at the start, in the middle, at the end, and whole."""
    ring = np.zeros((4, 1 << 20), np.uint8)
    ring[1, 7] = ring[3, 0] = 1
    folded = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    half = np.asarray(jnp.arange(5, dtype=jnp.bfloat16))
    others = [np.zeros((0, 3)), np.array(-0.0, np.float32), np.array(True), np.frombuffer(b"abc", np.int8)]
    arrays = [ring, ring[::2], folded, half, np.zeros(1 << 22, np.float32), *others]
    checkpoint._write_arrays(tmp_path / "x", arrays)
    read = restoring._read_arrays(tmp_path / "x", [str(array.dtype) for array in arrays])
    assert [(x.dtype, x.shape, x.tobytes()) for x in read] == [(x.dtype, x.shape, x.tobytes()) for x in arrays]
    assert sum(path.stat().st_blocks * 512 for path in tmp_path.rglob("*.npy")) < 4 << 20  # of 22 MB


@pytest.mark.parametrize("size", [0, 4096])
def test_a_file_system_that_tells_no_size_is_not_full(size, tmp_path, monkeypatch):
    """An unlimited tmpfs, some of FUSE."""
    nothing = SimpleNamespace(f_frsize=size, f_blocks=0, f_bavail=0, f_files=0, f_favail=0)
    monkeypatch.setattr(os, "statvfs", lambda path: nothing)
    assert files.lack_of_space(tmp_path / "a", [10**9]) is None


def test_two_programs_write_one_file(tmp_path):
    """Each write is whole, and neither program takes the other's unfinished file for a leftover."""
    code = "import sys; from pathlib import Path; from mjx_dher.system import files\n"
    code += "for _ in range(300): files.write(Path(sys.argv[1]), sys.argv[2].encode() * 999)"
    command = [sys.executable, "-c", code, str(tmp_path / "x")]
    both = [subprocess.Popen([*command, letter], cwd=ROOT) for letter in "ab"]
    assert [process.wait() for process in both] == [0, 0]
    assert (tmp_path / "x").read_bytes() in (b"a" * 999, b"b" * 999)
    assert os.listdir(tmp_path) == ["x"]


def test_what_a_killed_program_has_left_goes_with_the_next_write(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    kept = ("x.mine.partial", f"xy.{ended.pid}.partial", f"x.{os.getppid()}.partial")
    for name in (*kept, f"x.{ended.pid}.partial", f"x.{os.getpid()}.partial"):
        (tmp_path / name).write_text("")
    files.write(tmp_path / "x", b"new")
    assert sorted(os.listdir(tmp_path)) == sorted(("x", *kept))
    with pytest.raises(OSError, match="nowhere"):
        files.write(tmp_path / "nowhere" / "x", b"")
