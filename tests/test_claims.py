"""A folder belongs to one program, whatever two programs do."""

import contextlib
import errno
import os
import shutil
import threading
from pathlib import Path

import pytest
from conftest import refuses
from sweep_helpers import LONGER, compile_once, make_grid, run, spec_of, table  # noqa: F401

import mjx_dher
from mjx_dher import RunSpec, cli
from mjx_dher.runs import driver
from mjx_dher.runs.folder import run_folder
from mjx_dher.sweeps import grid, tables
from mjx_dher.system import files
from mjx_dher.system.files import BusyError, FolderError
from probes import PointMass, held

TINY = """
    --env docs.examples.point_mass:PointMass --num-envs 2 --cycles-per-epoch 1 --updates-per-cycle 2 --target-period 1
    --batch-size 16 --replay-size 1000 --hidden-sizes 8 8 --eval-episodes 2 --final-episodes 4 --checkpoint-every 1
""".split()  # noqa: SIM905


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_new_folder_is_made_and_goes_again_if_it_stays_empty(tmp_path):
    folder = tmp_path / "runs" / "a"
    with files.new_folder(folder):
        assert names_in(folder) == [files.LOCK]
        with refuses("a", error=BusyError):
            locked_by_another_thread(folder)
    assert names_in(tmp_path) == []
    with contextlib.suppress(RuntimeError), files.new_folder(folder):
        (folder / "config.json").write_text("{}")
        raise RuntimeError
    assert names_in(folder) == [files.LOCK, "config.json"]
    with refuses(folder, error=FolderError), files.new_folder(folder):
        pass


def locked_by_another_thread(folder):
    """Locks a folder in another thread, and raises what that raises."""
    errors = []

    def lock():
        try:
            with files.lock(folder):
                pass
        except FolderError as error:
            errors.append(error)

    thread = threading.Thread(target=lock)
    thread.start()
    thread.join()
    for error in errors:
        raise error


def test_a_lock_can_be_taken_again_by_who_has_it_and_its_file_stays(tmp_path):
    with files.lock(tmp_path), files.lock(tmp_path):
        pass
    assert names_in(tmp_path) == [files.LOCK]
    with held(tmp_path), pytest.raises(BusyError):
        locked_by_another_thread(tmp_path)
    locked_by_another_thread(tmp_path)
    (tmp_path / files.LOCK).unlink()
    (tmp_path / files.LOCK).symlink_to(tmp_path / "elsewhere")  # would lock a file that is not in the folder
    with pytest.raises(OSError), files.lock(tmp_path):  # noqa: PT011
        pass
    assert not (tmp_path / "elsewhere").exists()


def test_a_fresh_folder_is_never_one_that_is_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with run_folder.claim_new(None, RunSpec()) as first, run_folder.claim_new(None, RunSpec()) as second:
        assert first != second
        (first / "config.json").write_text("{}")
    assert (first.exists(), second.exists()) == (True, False)
    with run_folder.claim_new(tmp_path / "empty", RunSpec()) as chosen:
        assert chosen == tmp_path / "empty"
    with refuses(first, error=FolderError), run_folder.claim_new(first, RunSpec()):
        pass


def test_a_second_train_on_a_folder_is_refused_before_it_writes(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    with held(tmp_path / "run"):
        assert cli.main([*TINY, "--out", str(tmp_path / "run")]) == 2
    assert f"{tmp_path / 'run'} is being trained by another process" in capsys.readouterr().err
    assert names_in(tmp_path / "run") == [files.LOCK]


@pytest.mark.parametrize("place", ["checkpoints", "checkpoints/mine", "link/mine"])
def test_a_folder_in_another_run_s_checkpoints_is_refused(place, tmp_path, capsys):
    """That run would delete it at its end."""
    run_folder.write_config(tmp_path, RunSpec(), "native", {})
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "link").symlink_to("checkpoints")
    problem = f"out: {tmp_path / place} lies in the checkpoints of the run {tmp_path}, which"
    with refuses(problem, error=FolderError):
        driver.train_runs(PointMass(), [spec_of()], [tmp_path / place])
    for command in ([], ["sweep"]):
        assert cli.main([*command, "--env", "reach", "--dry-run", "--out", str(tmp_path / place)]) == 2
        assert f"error: {problem}" in capsys.readouterr().err
    assert not any((tmp_path / "checkpoints").iterdir())


def test_a_folder_named_checkpoints_is_a_place_for_runs(tmp_path):
    with run_folder.claim_new(tmp_path / "checkpoints" / "mine", RunSpec()) as chosen:
        assert chosen.is_dir()


def test_the_same_folder_twice_is_refused(tmp_path):
    specs = [spec_of(seed=0), spec_of(seed=1)]
    with refuses("folder"):
        mjx_dher.train_runs(PointMass(), specs, [tmp_path / "a", tmp_path / "a"])
    assert not list(tmp_path.iterdir())


def test_a_run_that_has_ended_is_not_trained_over(tmp_path):
    trials = make_grid(("future",), (0,))
    run(tmp_path, trials)
    with refuses("ended", error=FolderError):
        mjx_dher.train_runs(PointMass(), trials, [grid.folder_of(tmp_path, trials[0])])
    assert len(tables.read(tmp_path)) == 1


@pytest.mark.slow
def test_a_trial_that_ended_since_it_was_listed_is_left_alone(tmp_path, monkeypatch):
    """Another program trains all four while this one compiles, and has one of them again."""
    trials = make_grid(static=LONGER)
    run(tmp_path / "whole", trials)
    compile_runs = mjx_dher.runs.program.compile_runs

    def meanwhile(*args):
        shutil.copytree(tmp_path / "whole", tmp_path / "sweep", dirs_exist_ok=True)
        return compile_runs(*args)

    monkeypatch.setattr(mjx_dher.runs.program, "compile_runs", meanwhile)
    assert run(tmp_path / "sweep", trials, lanes=2) == []
    before = {path: os.stat(path).st_mtime_ns for path in (tmp_path / "whole").rglob("*.*")}
    assert all(
        os.stat(tmp_path / "sweep" / path.relative_to(tmp_path / "whole")).st_mtime_ns == t for path, t in before.items()
    )
    assert table(tmp_path / "sweep") == table(tmp_path / "whole")


@pytest.mark.slow
def test_a_finished_trial_with_a_short_curve_is_named_and_trained_again(tmp_path):
    trials = make_grid(("future",), (0, 1), static=LONGER)
    run(tmp_path, trials)
    whole = table(tmp_path)
    cell = grid.folder_of(tmp_path, trials[1])
    for lines, rows in ((2, 1), (0, 0)):
        kept = (cell / "metrics.csv").read_text().splitlines(keepends=True)[:lines]
        (cell / "metrics.csv").write_text("".join(kept))
        with refuses(cell / "metrics.csv", rows, 5, error=FolderError):
            tables.read(tmp_path)
        assert [grid.is_done(tmp_path, trial) for trial in trials] == [True, False]
        told = []
        (result,) = run(tmp_path, trials, report=told.append)
        assert result.folder == cell
        assert f"metrics.csv has complete lines of {rows} of 5 epochs; training it again" in told[0]
        assert table(tmp_path) == whole


def test_a_damaged_result_is_named_and_the_trial_trained_again(tmp_path):
    trials, told = make_grid(("future",), (0,)), []
    run(tmp_path, trials)
    for text in ("", "{", "[]", "\x00", "[" * 100_000, '{"status": "finished"}'):
        (grid.folder_of(tmp_path, trials[0]) / "result.json").write_text(text)
        with refuses("result.json", error=FolderError):
            tables.read(tmp_path)
    assert len(run(tmp_path, trials, report=told.append)) == 1
    assert "result.json" in told[0]
    assert len(tables.read(tmp_path)) == 1


def test_a_trial_that_cannot_be_read_is_not_left_out(tmp_path, monkeypatch):
    cell = tmp_path / "cells" / "run"
    cell.mkdir(parents=True)

    def unless_cell(read):  # as for users without permission, of whom root is none
        def guarded(path):
            if Path(path) == cell:
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return read(path)

        return guarded

    for name in ("listdir", "scandir"):
        monkeypatch.setattr(os, name, unless_cell(getattr(os, name)))
    with pytest.raises(PermissionError, match="run"):
        tables.read(tmp_path)


def test_files_of_two_runs_are_told_apart(tmp_path):
    trials = make_grid(("future",), (0, 1))
    run(tmp_path, trials)
    one, other = (grid.folder_of(tmp_path, trial) for trial in trials)
    for name, parts in (
        ("result.json", ["result.json"]),
        ("metrics.csv", ["metrics.csv"]),
        ("policy.npz", ["policy.npz", "seed", 1, 0]),
    ):
        whole = (one / name).read_bytes()
        shutil.copy(other / name, one / name)
        with refuses(*parts, error=FolderError):
            tables.read(tmp_path)
        (one / name).write_bytes(whole)
    assert len(tables.read(tmp_path)) == 2


@pytest.mark.slow
def test_a_sweep_whose_runs_another_program_has_says_so(tmp_path, capsys):
    flags = ["sweep", *TINY, "--total-steps", "40", "--sampler", "future", "--seeds", "2", "--out", str(tmp_path)]
    assert cli.main(flags) == 0
    cells = sorted((tmp_path / "cells").glob("*-s*"))
    for cell in cells:
        (cell / "result.json").unlink()
    with held(cells[0]), held(cells[1]):
        assert cli.main(flags) == 2
    assert "another process is training all 2 runs" in capsys.readouterr().err
    with held(cells[0]):
        assert cli.main(flags) == 2
    assert "another process is training 1 of the 2 runs, which are not in the tables" in capsys.readouterr().err
    assert cli.main(flags) == 0
    assert len(tables.read(tmp_path)) == 2
