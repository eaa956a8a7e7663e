"""No traceback for what a user can do: a sentence and an exit status."""

import copy
import os
import pickle
import shutil
import subprocess
import sys
import threading

import jax
import numpy as np
import pytest
import wrong_calls
from configs import SHORT as CONFIG
from conftest import ROOT, refuses
from sweep_helpers import compile_once  # noqa: F401

import mjx_dher
from mjx_dher import Options, cli, envs
from mjx_dher.evaluate import play_policy
from mjx_dher.system.files import FolderError
from mjx_dher.testing import check_env
from point_mass import PointMass


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A finished run of Reach, one that was stopped, and a sweep."""
    folder = tmp_path_factory.mktemp("wrong")
    env = envs.make("reach", engine="native")
    seen = []
    config = mjx_dher.Config(**{**vars(CONFIG), "replay_size": 200, "total_steps": 400})
    spec = mjx_dher.RunSpec(env="reach", engine="native", config=config)
    options = Options(final_episodes=4)
    mjx_dher.train_runs(env, [spec], [folder / "run"], options=options)
    mjx_dher.train_runs(
        env,
        [spec],
        [folder / "stopped"],
        options=options,
        on_epoch=lambda specs, progress: seen.append(progress.epoch),
        should_stop=lambda: bool(seen),
    )
    shutil.copytree(folder / "run", folder / "sweep" / "cells" / "a")
    return folder


def everything(folder):
    return {path: (path.lstat().st_mtime_ns, path.lstat().st_size) for path in folder.rglob("*")}


def test_wrong_calls_end_with_a_sentence_and_write_nothing(runs, tmp_path, capfd):
    """One in five here; `bench/reliability.py --parts calls` makes all of them."""
    calls = wrong_calls.calls(tmp_path, *made(runs))
    assert len(calls) > 400
    before = everything(tmp_path), everything(runs)
    wrong = []
    for call in calls[::5]:
        status = cli.main(call)
        text = capfd.readouterr().err
        if status != 2 or "Traceback" in text or not ("error: " in text or "--help" in text):
            wrong.append((status, call, text[-300:]))
    assert wrong == []
    assert (everything(tmp_path), everything(runs)) == before


def made(runs):
    return runs / "run", runs / "stopped", runs / "sweep"


# Standard output.


# The loop is not needed to see what becomes of the output.
TRAINS = """
import sys
from mjx_dher import cli
from mjx_dher.cli import train
def fake(argv, console):
    for i in range(2000): console.print("a line of some length to fill what is kept back", i)
    open(sys.argv[1] if len(sys.argv) > 1 else "/dev/null", "w").write("done")
    return 0
train.train_command = fake
sys.exit(cli.main([]))
"""


@pytest.mark.parametrize(
    ("redirect", "message"),
    [("> /dev/full", "No space left on device"), ("| head -1 > /dev/null; exit ${PIPESTATUS[0]}", "Broken pipe"), (">&-", "")],
)
def test_a_run_goes_on_when_its_output_is_lost(redirect, message):
    status, error = shell(TRAINS, redirect)
    assert status == 0
    assert "Traceback" not in error
    assert (f"error: cannot print ({message}); later output is lost" in error) == bool(message), error


def shell(code, redirect):
    process = subprocess.run(
        ["bash", "-c", f'"$0" -c "$1" {redirect}', sys.executable, code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return process.returncode, process.stderr


DOCTOR = (
    TRAINS.replace("from mjx_dher.cli import train", "from mjx_dher.cli import show")
    .replace("train.train_command = fake", "show.doctor_command = fake")
    .replace("cli.main([])", "cli.main(['doctor'])")
)


@pytest.mark.parametrize(
    ("redirect", "expected"),
    [
        ("> /dev/full", 2),
        ("| head -1 > /dev/null; exit ${PIPESTATUS[0]}", 141),
        pytest.param(">&-", 2, marks=pytest.mark.slow),
    ],
)
def test_a_command_whose_output_is_its_purpose_ends_with_an_error(redirect, expected):
    status, error = shell(DOCTOR, redirect)
    assert (status, "Traceback" in error) == (expected, False), error
    assert ("cannot print" in error) == (expected == 2)


@pytest.mark.parametrize("flag", ["--help", pytest.param("--no-such-flag", marks=pytest.mark.slow)])
def test_help_that_cannot_be_printed(flag):
    status, error = shell(f"import sys; from mjx_dher import cli; sys.exit(cli.main(['{flag}']))", "> /dev/full")
    assert (status, "Traceback" in error) == (2, False), error


def test_a_fault_of_this_program_keeps_its_place(monkeypatch):
    monkeypatch.setitem(cli.COMMANDS, "train", "test_wrong_calls:faulty")
    with pytest.raises(KeyError):
        cli.main([])


def faulty(argv, console):
    raise KeyError("a fault")


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(28, "No space left on device", "a/b"), "error: a/b: No space left on device"),
        (MemoryError("Unable to allocate 3 TiB"), "error: out of memory (Unable to allocate 3 TiB); it depends on"),
        (
            RuntimeError("RESOURCE_EXHAUSTED: Out of memory"),
            "error: out of memory (RESOURCE_EXHAUSTED: Out of memory)",
        ),
        (
            RuntimeError("UNKNOWN: FFI callback error: MemoryError: engine warp has too little"),
            "error: engine warp has too little",
        ),
        (RecursionError("maximum recursion depth exceeded"), "error: the input is nested too deeply"),
        (ValueError("one\ntwo"), "error: one\nerror: two"),
    ],
)
def test_what_a_user_can_do_is_a_sentence(monkeypatch, capsys, error, message):
    def raising(argv, console):
        raise error

    monkeypatch.setattr(sys.modules[__name__], "faulty", raising)
    monkeypatch.setitem(cli.COMMANDS, "train", f"{__name__}:faulty")
    assert cli.main([]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_line_in_a_thread(runs, tmp_path, capsys):
    folder = shutil.copytree(runs / "stopped", tmp_path / "run")
    statuses = []
    thread = threading.Thread(target=lambda: statuses.append(cli.main(["resume", str(folder)])))
    thread.start()
    thread.join()
    assert statuses == [0], capsys.readouterr().err


# JAX's own switches.


@pytest.fixture
def switch():
    """Sets an option of JAX for a test."""
    before = {}

    def set_option(name, value):
        before[name] = getattr(jax.config, name)
        jax.config.update(name, value)

    yield set_option
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.parametrize("name", [pytest.param("push", marks=pytest.mark.slow), "reach"])
def test_the_tasks_under_64_bits(switch, name):
    switch("jax_enable_x64", True)
    check_env(envs.make(name, engine="native", episode_length=4))


@pytest.mark.slow
@pytest.mark.parametrize(("option", "value"), [("jax_enable_x64", True), ("jax_numpy_rank_promotion", "raise")])
def test_a_run_under_jax_s_switches(switch, tmp_path, option, value):
    switch(option, value)
    check_env(PointMass())
    spec = mjx_dher.RunSpec(env="point_mass", config=CONFIG, sampler="weighted")
    (result,) = mjx_dher.train_runs(PointMass(), [spec], [tmp_path / "run"], options=Options(final_episodes=4))
    assert result.status == "finished"
    play_policy(PointMass(), mjx_dher.load_policy(tmp_path / "run"), 3, 0)


@pytest.mark.parametrize("platform", [pytest.param("tpu", marks=pytest.mark.slow), "cuda", "nonsense"])
def test_a_platform_that_is_not_there_is_named(platform, tmp_path):
    flags = ["--env", "reach", "--preset", "cpu", "--engine", "native", "--out", str(tmp_path / "run")]
    process = subprocess.run(
        [sys.executable, "train.py", *flags],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "JAX_PLATFORMS": platform},
        timeout=300,
        check=False,
    )
    if process.returncode != 2:
        pytest.skip(f"{platform} is there")
    assert process.stderr.splitlines()[-1].startswith(f"error: JAX_PLATFORMS='{platform}': JAX cannot start this platform")
    assert "Traceback" not in process.stderr
    assert not (tmp_path / "run").exists()


# Environments, policies.


def test_environments_can_be_copied_and_pickled():
    env = envs.make("reach", engine="native")
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, np.zeros(4, np.float32))
    for other in (copy.deepcopy(env), copy.copy(env), pickle.loads(pickle.dumps(env))):
        again = jax.jit(other.step)(state, np.zeros(4, np.float32))
        np.testing.assert_array_equal(again.obs["observation"], after.obs["observation"])


def test_goals_that_are_not_finite_are_never_the_best():
    env = envs.make("push", engine="native")
    goals = np.array([[0, 0, 0], [np.nan, 0, 0], [0, 0.04, 0], [0, 0.051, 0]], np.float32)
    assert env.compute_reward(goals, np.zeros((4, 3), np.float32)).tolist() == [0, -1, 0, -1]


def test_physics_that_blow_up_leave_no_file_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = envs.make("reach", engine="native")
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, np.full(4, np.nan, np.float32))
    assert bool(after.failed)
    assert list(tmp_path.iterdir()) == []


def test_arguments_of_an_environment_are_named():
    with refuses("point_mass:PointMass", "episode_length", "wals"):
        envs.make("point_mass:PointMass", wals=1)
    with refuses("reward", "reward_type", "distance_threshold", "num_threads"):
        envs.make("push", reward="dense")
    with refuses("reward_tpye", "reward_type"):
        envs.make("push", reward_tpye="dense")


OTHER_ARRAYS = [  # a change of a policy's arrays, and what the error must name
    (lambda a: a.pop("goal_std"), ["goal_std"]),
    (lambda a: a.update(layer0_kernel=a["layer0_kernel"][:-1]), ["layer0_kernel", 13]),
    (lambda a: a.update(layer1_bias=a["layer1_bias"][:-1]), ["layer1_kernel", 8]),
    (lambda a: a.update(layer0_bias=a["layer0_bias"] * np.nan), ["layer0_bias", "finite"]),
    (lambda a: a.update(observation_std=0 * a["observation_std"]), ["observation_std", 0]),
    (lambda a: a.update(norm_clip=np.float32(0)), ["norm_clip", 0]),
    (lambda a: a.update(norm_clip=np.ones(2, np.float32)), ["norm_clip"]),
    (lambda a: a.update(observation_mean=np.float32(0)), ["observation_mean"]),
    (lambda a: a.update(goal_mean=np.array(["a", "b", "c"])), ["goal_mean"]),
    (lambda a: a.update(goal_mean=a["goal_mean"][:2]), [12]),
    (lambda a: [a.pop(name) for name in list(a) if name.startswith("layer")], ["layer0_kernel"]),
]


def test_a_policy_of_other_arrays_is_refused(runs, tmp_path):
    for change, parts in OTHER_ARRAYS:
        with np.load(runs / "run" / "policy.npz") as file:
            arrays = {name: file[name] for name in file.files}
        change(arrays)
        np.savez(tmp_path / "policy.npz", **arrays)
        with refuses(*parts, error=FolderError):
            mjx_dher.load_policy(tmp_path / "policy.npz")


def test_nothing_is_unpickled(runs, tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    np.save(tmp_path / "one.npy", np.array([Evil()], object), allow_pickle=True)
    np.savez(tmp_path / "in.npz", allow_pickle=True, layer0_kernel=np.array([Evil()], object))
    (tmp_path / "whole.npz").write_bytes(pickle.dumps(Evil()))
    np.save(tmp_path / "plain.npy", np.zeros(3))
    for name in ("one.npy", "in.npz", "whole.npz", "plain.npy"):
        with refuses(name, error=FolderError):
            mjx_dher.load_policy(tmp_path / name)
    assert not (tmp_path / "ran").exists()


def test_a_policy_is_read_from_its_file_alone(runs, tmp_path):
    shutil.copy(runs / "run" / "policy.npz", tmp_path / "mine.npz")
    policy, same = mjx_dher.load_policy(tmp_path / "mine.npz"), mjx_dher.load_policy(runs / "run")
    obs = {"observation": np.ones(10), "desired_goal": np.ones(3)}
    np.testing.assert_array_equal(policy(obs), same(obs))
    assert policy.sizes == (10, 3, 4)


def test_a_policy_of_other_sizes_is_refused_by_eval(runs, tmp_path, capsys):
    other = shutil.copytree(runs / "run", tmp_path / "run")
    with np.load(other / "policy.npz") as file:
        arrays = {name: file[name] for name in file.files}
    arrays["observation_mean"], arrays["observation_std"] = np.zeros(9, np.float32), np.ones(9, np.float32)
    arrays["layer0_kernel"] = arrays["layer0_kernel"][:-1]
    np.savez(other / "policy.npz", **arrays)
    assert cli.main(["eval", str(other)]) == 2
    assert "needs observations of 9 and goals of 3 numbers and returns actions of 4; the environment has 10, 3 and 4" in (
        capsys.readouterr().err
    )
