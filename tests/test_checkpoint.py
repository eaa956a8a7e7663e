import dataclasses
import errno
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import orbax.checkpoint
import pytest
from configs import SMALL
from conftest import ROOT, refuses

from mjx_dher import HParams, RunSpec, cli, trainer
from mjx_dher.learners import ddpg
from mjx_dher.runs import loop
from mjx_dher.runs.folder import checkpoint, fingerprint, reading, restoring, run_folder
from mjx_dher.runs.folder.checkpoint import CheckpointError
from mjx_dher.system import files
from mjx_dher.system.files import write_json
from probes import PointMass

CONFIG = dataclasses.replace(SMALL, total_steps=480)  # 4 epochs
ENV = PointMass()


@pytest.fixture(scope="module")
def program():
    program = trainer.make_train(ENV, CONFIG)
    return program, loop.compile_program(program, jax.random.key(0), HParams())


def bits(state):
    return [np.asarray(jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x).tobytes()
            for x in jax.tree.leaves(state)]  # fmt: skip


def train(program, folder=None, save_at=(), start=None):
    """Metrics of each epoch, and the last state's bits."""
    _, compiled = program
    start = start or loop.Start(compiled.init(jax.random.key(7), HParams()))
    rows = []
    for progress in loop.run(ENV, CONFIG, compiled, start):
        rows.append({name: float(value) for name, value in progress.metrics.items()} | {"steps": progress.env_steps})
        if progress.epoch in save_at:
            checkpoint.save(folder, progress.state, progress.epoch, progress.wall_seconds, keep=2)
    return rows, bits(progress.state)


@pytest.fixture(scope="module")
def saved(program, tmp_path_factory):
    """A run's folder with checkpoints of epochs 2 and 3, of four."""
    folder = tmp_path_factory.mktemp("run")
    return folder, *train(program, folder, save_at=(1, 2, 3))


@pytest.fixture
def copy(saved, tmp_path):
    shutil.copytree(saved[0], tmp_path / "run")
    return tmp_path / "run"


def restore(folder, program):
    return restoring.restore(folder, loop.state_template(program[0]))


def test_a_resumed_run_is_the_uninterrupted_one_to_the_bit(program, saved):
    folder, rows, last = saved
    found = restore(folder, program)
    assert (found.path.name, found.epoch, found.refused) == ("epoch-000003", 3, {})
    again, end = train(program, start=loop.Start(found.state, found.epoch, found.wall_seconds))
    assert again == rows[3:]
    assert end == last
    shutil.copytree(folder, elsewhere := folder.parent / "older")
    shutil.rmtree(elsewhere / "checkpoints" / "epoch-000003")
    found = restore(elsewhere, program)
    again, end = train(program, start=loop.Start(found.state, found.epoch, found.wall_seconds))
    assert again == rows[2:]
    assert end == last


def test_time_goes_on_where_it_stopped(program, saved):
    found = restore(saved[0], program)
    _, compiled = program
    (progress,) = loop.run(ENV, CONFIG, compiled, loop.Start(found.state, found.epoch, 1000.0))
    assert 1000 < progress.wall_seconds < 1100
    assert progress.epoch_seconds < 100


def test_only_the_newest_are_kept_and_what_a_kill_has_left_goes(program, copy):
    assert [path.name for path in run_folder.checkpoints(copy)] == ["epoch-000003", "epoch-000002"]
    left = copy / "checkpoints" / ".partial-000009"
    left.mkdir()
    (left / "state").write_text("half")
    checkpoint.save(copy, restore(copy, program).state, 4, 1.0, keep=1)
    assert [path.name for path in (copy / "checkpoints").iterdir()] == ["epoch-000004"]


def files_of(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_a_flipped_bit_is_never_restored_as_it_is(program, copy):
    """Of any file, the manifest too: it is refused, or what was restored is right to the bit (a blank of the manifest)."""
    newest, older = run_folder.checkpoints(copy)
    right = bits(restore(copy, program).state)
    shutil.rmtree(older)
    rng = random.Random(0)
    refused = 0
    for _ in range(30):
        path = rng.choice(files_of(newest))
        whole = path.read_bytes()
        if not whole:
            continue
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            assert bits(restore(copy, program).state) == right
        except CheckpointError:
            refused += 1
        path.write_bytes(whole)
    assert refused > 15
    assert bits(restore(copy, program).state) == right


def cut(path):
    biggest = max(files_of(path / "state"), key=lambda file: file.stat().st_size)
    biggest.write_bytes(biggest.read_bytes()[:-1])


def change_manifest(path, **changes):
    content = json.loads((path / "manifest.json").read_text()) | changes
    del content["sha256"]
    digest = fingerprint.sha256_of(content)
    (path / "manifest.json").write_text(json.dumps({**content, "sha256": digest}))


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (cut, []),
        (lambda path: (path / "manifest.json").unlink(), ["manifest.json"]),
        (lambda path: (path / "manifest.json").write_text('{"schema": 1'), ["manifest.json"]),
        (lambda path: (path / "manifest.json").write_text("[]"), ["schema", None]),
        (lambda path: shutil.rmtree(path / "state"), []),
        (lambda path: change_manifest(path, schema=0), ["schema", 0]),
        (lambda path: change_manifest(path, leaves=[]), []),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_name_and_the_one_before_it_is_used(program, copy, damage, parts):
    newest, older = run_folder.checkpoints(copy)
    damage(newest)
    found = restore(copy, program)
    assert (found.path, found.epoch) == (older, 2)
    shutil.rmtree(older)
    with refuses(newest, *parts, error=CheckpointError):
        restore(copy, program)


@pytest.mark.parametrize(
    ("config", "parts"),
    [
        (dataclasses.replace(CONFIG, hidden_sizes=(16, 17)), ["float32[16]", "float32[17]"]),
        (dataclasses.replace(CONFIG, hidden_sizes=(16,)), []),
        (dataclasses.replace(CONFIG, replay_size=210), []),
    ],
)
def test_the_state_of_another_run_is_refused(saved, config, parts):
    other = trainer.make_train(ENV, config)
    with refuses(*parts, error=CheckpointError):
        restoring.restore(saved[0], loop.state_template(other))


def test_another_dtype_is_refused(saved, program):
    template = loop.state_template(program[0])
    template = dataclasses.replace(template, env_steps=jax.ShapeDtypeStruct((), "float32"))
    with refuses("env_steps", "int32[]", "float32[]", error=CheckpointError):
        restoring.restore(saved[0], template)


@pytest.mark.parametrize("use_ocdbt", [False, True])
def test_a_checkpoint_that_was_written_with_orbax_is_read(copy, program, use_ocdbt):
    path = copy / "checkpoints" / "epoch-000003"
    arrays = {file.stem: np.load(file) for file in files_of(path / "state")}
    shutil.rmtree(path / "state")
    with orbax.checkpoint.Checkpointer(orbax.checkpoint.PyTreeCheckpointHandler(use_ocdbt=use_ocdbt)) as checkpointer:
        checkpointer.save(path / "state", arrays)
    assert bool(list(path.rglob("manifest.ocdbt"))) == use_ocdbt
    inside = [file for file in files_of(path) if file.name != "manifest.json"]
    change_manifest(path, files={file.relative_to(path).as_posix(): checkpoint.digest_of(file) for file in inside})
    found = restore(copy, program)
    assert (found.epoch, found.refused) == (3, {})
    assert bits(found.state) == [array.tobytes() for array in arrays.values()]


def test_arrays_that_come_back_as_others_are_refused(saved, program, monkeypatch):
    read = restoring._read_arrays
    monkeypatch.setattr(restoring, "_read_arrays", lambda *args: [x.astype(np.float64) for x in read(*args)])
    with refuses("float64", error=CheckpointError):
        restore(saved[0], program)


def test_a_full_disk_leaves_the_earlier_ones_as_they_were(program, copy, monkeypatch):
    state = restore(copy, program).state
    truncate, opened = io.BufferedWriter.truncate, []

    class Full(io.BufferedWriter):
        def truncate(self, *size):
            opened.append(self)
            if len(opened) == 4:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return truncate(self, *size)

    monkeypatch.setattr(Path, "open", lambda path, mode="r", **options: Full(io.FileIO(path, mode)))
    with refuses("epoch-000004", "No space left", "0003.npy", "epoch-000003", error=CheckpointError):
        checkpoint.save(copy, state, 4, 1.0, keep=1)
    monkeypatch.undo()
    assert sorted(path.name for path in (copy / "checkpoints").iterdir()) == ["epoch-000002", "epoch-000003"]
    assert restore(copy, program).epoch == 3


def disk_with(free, files=10**6, block=4096):
    """`os.statvfs` of a disk with so many bytes and files left."""
    return lambda path: SimpleNamespace(f_frsize=block, f_blocks=10**9, f_bavail=free // block, f_files=10**6, f_favail=files)


@pytest.mark.parametrize("disk", [disk_with(40_000), disk_with(10**9, files=3), disk_with(10**6, block=1 << 20)])
def test_a_disk_with_too_little_left_is_refused_before_anything_is_written(program, copy, monkeypatch, disk):
    """The state has 20 kB in some 40 arrays, each of which takes a block."""
    state = restore(copy, program).state
    monkeypatch.setattr(files.os, "statvfs", disk)
    with refuses("epoch-000004", error=CheckpointError):
        checkpoint.save(copy, state, 4, 1.0, keep=1)
    assert restore(copy, program).epoch == 3


def test_on_a_full_disk_older_checkpoints_make_room(program, copy, monkeypatch):
    """But not the newest one."""
    state = restore(copy, program).state
    for epoch in (4, 5):
        monkeypatch.setattr(
            files.os, "statvfs", lambda path: disk_with(0 if len(run_folder.checkpoints(copy)) > 1 else 10**6)(path)
        )
        checkpoint.save(copy, state, epoch, 1.0, keep=3)
        assert [run_folder.epoch_of(path) for path in run_folder.checkpoints(copy)] == [epoch, 3 if epoch == 4 else 4]


# The command line.

TINY = """
    --env docs.examples.point_mass:PointMass --num-envs 2 --cycles-per-epoch 1 --updates-per-cycle 2 --target-period 1
    --batch-size 16 --replay-size 1000 --hidden-sizes 8 8 --eval-episodes 2 --final-episodes 4 --checkpoint-every 20
""".split()  # noqa: SIM905
TIMES = ("wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes")


def table(folder):
    lines = [line.split(",") for line in (folder / "metrics.csv").read_text().splitlines()]
    keep = [i for i, name in enumerate(lines[0]) if name not in TIMES]
    return [[line[i] for i in keep] for line in lines]


def start(*args):
    return subprocess.Popen(
        [sys.executable, "-u", "train.py", *map(str, args)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def wait_for(condition, process):
    deadline = time.time() + 200
    while not condition() and process.poll() is None and time.time() < deadline:
        time.sleep(0.02)


@pytest.mark.slow
def test_killed_and_stopped_runs_end_like_the_one_that_was_not(tmp_path):
    """SIGKILL after a checkpoint, then SIGTERM, then to the end: metrics and policy are those of a run in one go."""
    steps = ["--total-steps", "8000"]
    whole, out = tmp_path / "whole", tmp_path / "run"
    first = start(*TINY, *steps, "--out", out)
    wait_for(lambda: run_folder.checkpoints(out), first)
    busy = subprocess.run([sys.executable, "train.py", "resume", out], cwd=ROOT, capture_output=True, text=True, check=False)
    first.kill()
    first.communicate()
    assert (busy.returncode, busy.stderr) == (2, f"error: {out} is being trained by another process\n")
    epochs = len(table(out)) - 1
    second = start("resume", out)
    wait_for(lambda: len(table(out)) - 1 > epochs + 3, second)
    second.send_signal(signal.SIGTERM)
    stdout, stderr = second.communicate(timeout=100)
    assert (second.returncode, stderr) == (128 + signal.SIGTERM, ""), stdout
    newest = run_folder.checkpoints(out)[0]
    assert f"saved {newest}" in stdout
    assert f"`python train.py resume {out}` resumes" in stdout
    assert len(table(out)) - 1 == int(newest.name[-6:])
    third = start("resume", out)
    stdout, stderr = third.communicate(timeout=200)
    assert (third.returncode, stderr) == (0, "")
    assert f"resuming from {newest}" in stdout
    assert cli.main([*TINY, *steps, "--out", str(whole)]) == 0
    assert len(table(whole)) == 401
    assert table(out) == table(whole)
    for name, array in np.load(whole / "policy.npz").items():
        np.testing.assert_array_equal(np.load(out / "policy.npz")[name], array)
    results = [json.loads((path / "result.json").read_text()) for path in (out, whole)]
    assert all(results[0][name] == results[1][name] for name in results[0] if name not in TIMES)
    assert not (out / "checkpoints").exists()


def refusal(capsys, *args):
    assert cli.main([str(arg) for arg in args]) == 2
    return capsys.readouterr().err


def test_what_cannot_be_resumed_is_refused_at_once(saved, tmp_path, capsys):
    assert "no such folder" in refusal(capsys, "resume", tmp_path / "none")
    run_folder.write_config(tmp_path / "run", RunSpec(config=CONFIG), "native", {})
    assert "no checkpoint to resume from" in refusal(capsys, "resume", tmp_path / "run")
    assert "engine must be" in refusal(capsys, "resume", tmp_path / "run", "--engine", "bullet")
    assert "keep must lie in" in refusal(capsys, "resume", tmp_path / "run", "--keep", "0")
    assert "checkpoint_every must lie in" in refusal(capsys, "resume", tmp_path / "run", "--checkpoint-every", "-1")
    assert "checkpoint_every must lie in" in refusal(capsys, "--env", "push", "--checkpoint-every", "-1")
    rates = dict.fromkeys(("success_rate", "success_low", "success_high", "reset_success_rate", "return_mean"), 0.5)
    ended = {"status": "finished", "epochs": 4, "env_steps": 40, "wall_seconds": 1.0, "lanes": 1, "episodes": 4, **rates}
    write_json(tmp_path / "run" / "result.json", {**ended, "digest": reading.read_config(tmp_path / "run")["digest"]})
    assert "has ended" in refusal(capsys, "resume", tmp_path / "run")


def test_networks_that_are_not_finite_stop_the_run_and_no_policy_is_written(tmp_path, capsys, monkeypatch):
    init = ddpg.DDPG.init
    monkeypatch.setattr(ddpg.DDPG, "init", lambda *args: jax.tree.map(lambda x: x / 0, init(*args)))
    error = refusal(capsys, *TINY, "--total-steps", "300", "--out", tmp_path / "run")
    assert "epoch 1: the networks or normalizers have numbers that are not finite" in error
    assert "there is no checkpoint" in error
    for command in ("resume", "eval", "view"):
        assert "it failed in epoch 1: the networks" in refusal(capsys, command, tmp_path / "run")
    assert not (tmp_path / "run" / "policy.npz").exists()
