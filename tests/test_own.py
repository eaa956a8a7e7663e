"""Environments and samplers of one's own, named as module:attribute."""

import csv
import json

import jax.numpy as jnp
import numpy as np
import pytest

import mjx_dher
from mjx_dher import cli, config, envs, samplers
from mjx_dher.cli import sweep as cli_sweep
from point_mass import PointMass, soon

TINY = """
    --num-envs 2 --cycles-per-epoch 1 --updates-per-cycle 2 --target-period 1 --batch-size 16 --replay-size 100
    --hidden-sizes 8 --eval-episodes 2 --final-episodes 4
""".split()  # noqa: SIM905
OWN = ["--env", "my_tasks:MyTask", "--sampler", "my_tasks:soon", *TINY]
MY_TASKS = """
import os, signal
from point_mass import PointMass, soon

class MyTask(PointMass):
    def check(self):  # after each epoch: stops the first run after one
        if os.environ.get("STOP_AFTER_AN_EPOCH") and self.checks == 1:
            signal.raise_signal(signal.SIGINT)
        self.checks += 1

    checks = 0

TWO = 2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a module of the user's, and in it a run that was stopped."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_tasks.py").write_text(MY_TASKS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("STOP_AFTER_AN_EPOCH", "1")
        assert cli.main([*OWN, "--total-steps", "60", "--out", "run"]) == 130
    return folder


def test_a_run_in_the_current_folder_s_module_is_resumed_and_evaluated(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert cli.main(["resume", "run"]) == 0
    assert "my_tasks:MyTask, sampler my_tasks:soon, seed 0; physics none" in capsys.readouterr().out
    assert cli.main(["eval", "run", "--episodes", "4"]) == 0
    assert "my_tasks:MyTask: 4 episodes" in capsys.readouterr().out
    settings = json.loads((folder / "run" / "config.json").read_text())["config"]
    assert (settings["env"], settings["sampler"]) == ("my_tasks:MyTask", "my_tasks:soon")
    with (folder / "run" / "metrics.csv").open() as file:
        assert [row["env_steps"] for row in csv.DictReader(file)] == ["20", "40", "60"]


def test_its_policy_needs_no_module(folder):
    policy = mjx_dher.load_policy(folder / "run")
    assert policy({"observation": np.zeros((5, 2)), "desired_goal": np.zeros((5, 2))}).shape == (5, 2)


def test_a_policy_is_played_where_there_is_no_check(folder):
    outcome = cli.play(PointMass(), mjx_dher.load_policy(folder / "run"), num_episodes=4, seed=0)
    assert outcome.success.shape == (4,)


def test_a_sweep_takes_them(folder, monkeypatch):
    monkeypatch.chdir(folder)
    _, (cell,) = cli_sweep.parse_sweep_args([*OWN, "--seeds", "1", "--out", "sweep"])
    assert (cell.config.env, cell.config.sampler) == ("my_tasks:MyTask", "my_tasks:soon")
    assert cell.name.startswith("my_tasks-mytask-my_tasks-soon-s0-")


@pytest.mark.slow
def test_a_sweep_trains_them(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert cli.main(["sweep", *OWN, "--total-steps", "20", "--seeds", "1", "--lanes", "1", "--out", "sweep"]) == 0
    assert "my_tasks:soon" in capsys.readouterr().out
    assert len(list((folder / "sweep" / "cells").glob("*/result.json"))) == 1


def test_what_has_no_model_is_not_rendered():
    from mjx_dher.tools import render

    with pytest.raises(ValueError, match=r"point_mass cannot be rendered: it needs a MuJoCo model \(attribute `model`\)"):
        render.play(PointMass(), lambda obs, key: jnp.zeros((2, 2)), seed=0, num_episodes=2)


def test_a_fresh_run_folder_s_name_is_one_of_a_file(monkeypatch, tmp_path):
    from mjx_dher.runs import run_folder

    monkeypatch.chdir(tmp_path)
    path = run_folder.choose(None, config.Config(env="my.Tasks:Mine", sampler="my.tasks:soon"), seed=3)
    assert path.name.startswith("my-tasks-mine-my-tasks-soon-s3-")


def test_make_imports_it():
    env = envs.make("point_mass:PointMass", episode_length=7)
    assert isinstance(env, PointMass)
    assert env.episode_length == 7
    assert envs.make("mjx_dher.envs.reach:Reach", engine="native", episode_length=3).engine.name == "native"
    assert samplers.make("point_mass:soon").log_weights is soon
    assert "point_mass:PointMass" not in envs.list_envs()


@pytest.mark.parametrize(
    ("make", "name", "message"),
    [
        (envs.make, "pont_mass:PointMass", "there is no module 'pont_mass' in the current .* .did you mean 'point_mass'"),
        (envs.make, "mjx_dher.envs.rech:Reach", "no module 'mjx_dher.envs.rech' in mjx_dher.envs .did you mean .*envs.reach"),
        (envs.make, "point_mass.py:PointMass", "no module 'point_mass.py' in point_mass .did you mean 'point_mass'"),
        (envs.make, "point_mass:PontMass", "module point_mass has no 'PontMass' .did you mean 'PointMass'"),
        (envs.make, "point_mass:a:b", "env must be module:attribute, .*got 'point_mass:a:b'"),
        (envs.make, "my_tasks:TWO", "env 'my_tasks:TWO' must be a class or function that makes an environment; it is 2"),
        (envs.make, "point_mass:PointState", "missing 3 required"),
        (
            envs.make,
            "collections:Counter",
            "is no environment: it has no action_size, episode_length, reset, step, comp",
        ),
        (samplers.make, "my_tasks:TWO", "sampler 'my_tasks:TWO' must be a function .* or a samplers.Sampler; it is 2"),
        (samplers.make, "point_mass:PointMass", "sampler 'point_mass:PointMass' must be a function .*; it is <class"),
        (samplers.make, "point_mass:son", "module point_mass has no 'son' .did you mean 'soon'"),
    ],
)
def test_what_cannot_be_used_is_refused(folder, monkeypatch, make, name, message):
    monkeypatch.syspath_prepend(str(folder))
    with pytest.raises((ValueError, TypeError), match=message):
        make(name)


def test_an_environment_without_an_engine_has_none_to_choose():
    with pytest.raises(ValueError, match="env 'point_mass:PointMass' has no engine to choose; got 'native'"):
        envs.make("point_mass:PointMass", engine="native")


def test_what_a_module_raises_is_raised_as_it_is(monkeypatch, tmp_path):
    (tmp_path / "lacks_another.py").write_text("import not_there")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ModuleNotFoundError, match="No module named 'not_there'"):
        envs.make("lacks_another:Task")


def test_nothing_is_assumed_of_the_length_of_its_episodes():
    short = config.Config(env="point_mass:PointMass", num_envs=8, replay_size=80, batch_size=16)
    config.validate(short, config.HParams())
    with pytest.raises(ValueError, match="8 episodes x 50 steps = 400"):
        config.validate(config.dataclasses.replace(short, env="push"), config.HParams())
    with pytest.raises(ValueError, match="8 episodes x 20 steps = 160"):
        config.validate(short, config.HParams(), episode_length=20)


def test_soon_halves():
    log_weights = soon(jnp.zeros((5, 2)), jnp.zeros(2), jnp.array(1), config.HParams())
    np.testing.assert_allclose(samplers.probabilities(log_weights), [0, 0, 4 / 7, 2 / 7, 1 / 7], rtol=1e-6)
