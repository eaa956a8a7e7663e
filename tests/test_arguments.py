"""Arguments of environments, and of gymnasium's; copies of both; JAX's switches; streams and platforms that are not there."""

import copy
import os
import pickle
import subprocess
import sys
import types

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import own_learner
import pytest
from conftest import ROOT, refuses
from test_export import random_policy, save_run

import mjx_dher.gym
from mjx_dher import cli, envs
from mjx_dher.envs.engines.warp import WarpEngine

REACH = "mjx_dher/FetchReach-v0"
NAN, INF = float("nan"), float("inf")
BAD_ARGUMENTS = {
    "native": [
        *[("episode_length", value) for value in (1.5, "x", True, 10**7)],
        *[("distance_threshold", value) for value in ("x", 0, NAN, INF)],
        *[("num_threads", value) for value in (0, -1, "x", 10**9)],
    ],
    "jax": [("iterations", 0), ("ls_iterations", 2.5)],
    "warp": [("constraints", 0), ("iterations", -1)],
}


@pytest.mark.parametrize("engine", BAD_ARGUMENTS)
def test_a_bad_number_of_an_environment_is_reported_with_its_value_when_it_is_made(engine):
    options = {"engine": engine, **({"allow_cpu": True} if engine == "warp" else {})}
    for name, value in BAD_ARGUMENTS[engine]:
        with refuses(name, value):
            envs.make("reach", **options, **{name: value})


def test_numpy_s_numbers_are_numbers():
    env = envs.make("reach", engine="native", episode_length=np.int64(3), distance_threshold=np.float32(0.25))
    assert (env.episode_length, env.distance_threshold) == (3, 0.25)


def breaks(size=3):
    raise RuntimeError(f"no {size}")


@pytest.mark.parametrize(
    ("constructor", "reason"), [(breaks, "RuntimeError: no 3"), (lambda: len(3), "has no len"), (int, "builtins")]
)
def test_a_constructor_that_breaks_is_named(constructor, reason, monkeypatch):
    monkeypatch.setitem(sys.modules, "own", types.SimpleNamespace(made=constructor))
    with refuses("env", "own:made", reason):
        envs.make("own:made")


# gymnasium


@pytest.fixture(scope="module")
def single():
    return gymnasium.make(REACH).unwrapped


@pytest.fixture(scope="module")
def many():
    return gymnasium.make_vec(REACH, num_envs=2)


def test_bad_seeds_are_reported(single, many):
    for seed in (1.5, "x", -1, True, np.float64(3), NAN):
        for env, given in [(single, seed), (many, seed), (many, [1, seed])]:
            with refuses("seed", seed):
                env.reset(seed=given)


def test_seeds_of_every_kind_start_alike(single, many):
    alone, _ = single.reset(seed=np.int64(5))
    for seeds in ([5, 6], (5, 6), np.array([5, 6]), range(5, 7), 5, np.int64(5)):
        together, _ = many.reset(seed=seeds)
        np.testing.assert_allclose(together["desired_goal"][0], alone["desired_goal"], atol=1e-6)
        assert not np.allclose(together["desired_goal"][0], together["desired_goal"][1])


def test_other_mistakes_with_gymnasium_are_reported(single):
    with refuses("goals"):
        single.compute_reward(object(), np.zeros(3), {})
    with refuses("reward_type", "sparse"):
        mjx_dher.gym.GymEnv("reach", reward_type=["sparse"])
    with refuses("options", 3):
        single.reset(options=3)


COPIES = [copy.deepcopy, copy.copy, lambda x: pickle.loads(pickle.dumps(x))]


@pytest.mark.parametrize("duplicate", COPIES)
def test_gymnasium_s_environments_can_be_copied_and_pickled(duplicate, single, many):
    single.reset(seed=1)
    other = duplicate(single)
    for _ in range(2):
        np.testing.assert_array_equal(other.step(np.ones(4))[0]["observation"], single.step(np.ones(4))[0]["observation"])
    np.testing.assert_array_equal(duplicate(many).reset(seed=3)[0]["observation"], many.reset(seed=3)[0]["observation"])


@pytest.mark.parametrize("duplicate", COPIES)
def test_environments_on_warp_can_be_copied_and_pickled(duplicate):
    env = duplicate(envs.make("reach", engine="warp", allow_cpu=True))
    assert isinstance(env.engine, WarpEngine)
    shapes = jax.eval_shape(env.step, jax.eval_shape(env.reset, jax.random.key(0)), jax.ShapeDtypeStruct((4,), jnp.float32))
    assert shapes.obs["observation"].shape == (10,)


# JAX's switches


@pytest.fixture
def in_64_bits():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("pick_and_place", "push", "slide")]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reach", *SLOW])
def test_starts_are_the_same_in_64_bits(name, in_64_bits, task):
    env, key = task(name).env, jax.random.key(4)
    doubled = env.reset(key)
    jax.config.update("jax_enable_x64", False)
    plain = env.reset(key)
    for leaf, expected in zip(jax.tree.leaves(doubled), jax.tree.leaves(plain)):
        assert leaf.dtype == expected.dtype
        np.testing.assert_allclose(leaf, expected, atol=1e-6)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_step_keeps_its_types_in_64_bits(engine, in_64_bits):
    env = envs.make("reach", engine=engine)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((4,), jnp.float64))
    assert [leaf.dtype for leaf in jax.tree.leaves(after)] == [leaf.dtype for leaf in jax.tree.leaves(state)]


@pytest.mark.slow
def test_a_loop_of_one_s_own_runs_in_64_bits(in_64_bits, capsys):
    own_learner.main(["--rounds", "1", "--updates", "1"])
    assert capsys.readouterr().out.startswith("round 1: success ")


# Streams and platforms

PROGRAM = """
import sys, types
from mjx_dher import cli
def command(argv, console):
    console.print("a dash \\u2013 and no letter \\udcff")
    return open("pyproject.toml").fileno()
sys.modules["toy"] = types.SimpleNamespace(command=command)
cli.COMMANDS["train"] = "toy:command"
sys.exit(cli.main([]))
"""


@pytest.mark.parametrize("redirection", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
def test_no_file_takes_the_number_of_a_closed_stream(redirection):
    """What a library in C prints would go into it."""
    shell = ["bash", "-c", f'"$0" -c "$1" {redirection}', sys.executable, PROGRAM]
    assert subprocess.run(shell, cwd=ROOT, check=False, capture_output=True).returncode > 2


@pytest.mark.parametrize("variables", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "TERM": "dumb", "COLUMNS": "20"}])
def test_characters_that_standard_output_has_not_are_escaped(variables):
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, env={**os.environ, **variables})
    assert done.returncode > 2
    assert b"\\xff" in b"".join(done.stdout.split())
    assert done.stderr == b""


@pytest.mark.parametrize("argv", [["eval"], ["render", "--out", "x.png"]])
def test_a_platform_that_is_not_there_is_named_where_a_policy_is_played(argv, tmp_path, monkeypatch, capsys):
    def devices():
        raise RuntimeError("Unable to initialize backend 'tpu'")

    run = save_run(tmp_path / "run", random_policy())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mjx_dher.tools.render.choose_gl", lambda: "egl")
    monkeypatch.setattr("mjx_dher.tools.render.ffmpeg", lambda: "ffmpeg")
    monkeypatch.setattr(jax, "devices", devices)
    monkeypatch.setattr(jax, "default_backend", devices)
    assert cli.main([*argv, str(run)]) == 2
    assert "JAX cannot start this platform (Unable to initialize backend 'tpu')" in capsys.readouterr().err
