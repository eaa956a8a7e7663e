"""The gymnasium views as other programs use them: made in numbers, copied, and of environments of one's own."""

import copy
import dataclasses
import pickle
import re
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from conftest import ROOT, refuses
from flax import struct
from test_gym import REACH, assert_same

import mjx_dher.gym
from mjx_dher.tools import gym_cache, render
from point_mass import PointMass, PointState

ENV = f"mjx_dher.gym:{mjx_dher.gym.ENV_ID}"
SB3_INSTALL = "pip install stable-baselines3"


@struct.dataclass
class Keyed(PointState):
    key: jax.Array


class Slowed(PointMass):
    """Its states have a key, and its steps another length than the tasks'."""

    def __init__(self, dt=0.02):
        super().__init__()
        self.dt = dt

    def reset(self, key):
        return self._keyed(super().reset(key), key)

    def step(self, state, action):
        return self._keyed(super().step(state, action), state.key)

    def _keyed(self, state, key):
        return Keyed(state.obs, state.reward, state.success, key)


def test_to_be_made_costs_no_choice_of_how_to_draw(monkeypatch):
    """As Stable-Baselines3's make_vec_env makes environments: each with a render mode, drawn or not."""
    monkeypatch.setattr(render, "try_gl", lambda name: "no screen")
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    made = [gymnasium.make(f"mjx_dher.gym:{REACH}", render_mode="rgb_array") for _ in range(2)]
    made[0].action_space.seed(0)
    made[0].reset(seed=0)
    assert made[0].render_mode == "rgb_array"
    made[0].step(made[0].action_space.sample())
    with refuses("MUJOCO_GL", "glfw"):
        made[0].render()


@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("name", ["reach", "test_gym_use:Slowed"])
def test_copies_play_on_alone(name, again):
    """In the middle of an episode, and after a picture: the renderer stays with the first."""

    for make in (mjx_dher.gym.GymEnv, mjx_dher.gym.GymVectorEnv):
        env = make(name)
        env.reset(seed=3)
        env.step(env.action_space.sample())
        if make is mjx_dher.gym.GymEnv:
            env._painter = (None for _ in ())  # what cannot be copied
        twin = again(env)
        actions = env.action_space.sample()
        following = env.step(actions)
        env.step(actions)
        assert_same(twin.step(actions), following)
        assert_same(twin.reset(), env.reset())


def test_an_environment_of_ones_own_needs_no_more_than_the_contract():
    """No `check`, `failed`, `engine` nor model; the episode ends after the environment's own number of steps."""
    pictures = gymnasium.make(ENV, name="point_mass:PointMass", render_mode="rgb_array_list")
    assert isinstance(pictures, gymnasium.wrappers.RenderCollection)
    env = gymnasium.make(ENV, name="point_mass:PointMass", render_mode="rgb_array")
    obs, info = env.reset(seed=0)
    ends = [env.step(np.ones(2))[2:4] for _ in range(10)]
    assert ends == [(False, False)] * 9 + [(False, True)]
    assert info == {"is_success": 0.0, "failed": False}
    with refuses("point_mass", "model"):
        env.render()
    many = gymnasium.make_vec(ENV, num_envs=2, vectorization_mode="vector_entry_point", name="point_mass:PointMass")
    assert_same({key: value[0] for key, value in many.reset(seed=0)[0].items()}, obs)
    truncated = [many.step(np.ones((2, 2)))[3].all() for _ in range(11)]
    assert truncated == [False] * 9 + [True, False]


def test_the_page_s_custom_environment_is_made():
    section = (ROOT / "docs" / "gymnasium.md").read_text().split("## A custom environment")[1].split("\n## ")[0]
    made = {}
    for block in re.findall(r"```python\n(.*?)```", section, re.S):
        exec(compile(block, "gymnasium.md", "exec"), made)
    env = made["env"]  # by the id of its own
    env.reset(seed=0)
    assert [env.step(np.ones(2))[3] for _ in range(10)] == [False] * 9 + [True]
    assert made["envs"].num_envs == 8


@pytest.mark.slow
def test_the_loop_of_the_page_on_policies_reaches_the_goal(capsys):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "policies.md").read_text(), re.S)
    (loop,) = [block for block in blocks if "gymnasium.make" in block]
    exec(compile(loop, "policies.md", "exec"), {"mjx_dher": mjx_dher})
    assert capsys.readouterr().out == "1.0\n"


@pytest.mark.parametrize("make", [mjx_dher.gym.GymEnv, mjx_dher.gym.GymVectorEnv])
def test_after_a_step_that_raised_only_a_reset_helps(make):
    def broken(state, action):
        raise RuntimeError("lost")

    env = make("point_mass:PointMass")
    env.reset(seed=0)
    action, working = env.action_space.sample(), env._compiled
    env._compiled = dataclasses.replace(working, step=broken, step_all=broken)
    with pytest.raises(RuntimeError, match="lost"):
        env.step(action)
    env._compiled = working
    for _ in range(2):
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(action)
    env.reset()
    env.step(action)


def test_the_environment_says_how_long_a_step_takes():
    assert gymnasium.make(ENV, name="test_gym_use:Slowed").metadata["render_fps"] == 50
    assert gymnasium.make(ENV, name="test_gym_use:Slowed", dt=np.float32(0.5)).metadata["render_fps"] == 2
    assert gymnasium.make(ENV, name="point_mass:PointMass").metadata["render_fps"] == 25
    assert mjx_dher.gym.GymEnv.metadata["render_fps"] == 25


def test_programs_of_many_settings_are_not_all_kept():
    most = gym_cache._compile.cache_info().maxsize
    for number in range(most + 3):
        mjx_dher.gym.GymEnv("test_gym_use:Slowed", dt=0.01 + number)
    assert gym_cache._compile.cache_info().currsize == most


@pytest.mark.slow
def test_stable_baselines3_makes_its_own_vector():
    util = pytest.importorskip("stable_baselines3.common.env_util", reason=SB3_INSTALL)
    vector = util.make_vec_env(f"mjx_dher.gym:{REACH}", n_envs=2, seed=0)
    assert vector.reset()["achieved_goal"].shape == (2, 3)
    vector = util.make_vec_env(ENV, n_envs=2, seed=0, env_kwargs={"name": "point_mass:PointMass"})
    vector.reset()
    dones = [vector.step(np.zeros((2, 2)))[2].all() for _ in range(10)]
    assert dones == [False] * 9 + [True]


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"name": "point_mass:PointMas"}, ["env", "PointMas", "PointMass"]),
        ({"name": "point_mass:PointMass:x"}, ["env", "point_mass:PointMass:x", "module:attribute"]),
        ({"name": "point_mass:PointMass", "engine": "native"}, ["engine", "native"]),
        *(({"name": "test_gym_use:Slowed", "dt": dt}, ["dt", dt]) for dt in (-1.0, float("nan"), float("inf"), "fast")),
    ],
)
def test_what_cannot_be_made_is_named(options, parts):
    with refuses(*parts):
        gymnasium.make(ENV, **options)


@pytest.mark.slow
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
@pytest.mark.parametrize("id", mjx_dher.gym.IDS)
def test_stable_baselines3s_checker_has_nothing_to_say(id, reward_type):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason=SB3_INSTALL)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(gymnasium.make(id, engine="native", reward_type=reward_type).unwrapped)


@pytest.mark.slow
def test_stable_baselines3_learns_to_reach(capsys):
    """The example of docs/gymnasium.md; it prints its success over 100 episodes."""
    pytest.importorskip("stable_baselines3", reason=SB3_INSTALL)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "gymnasium.md").read_text(), re.S)
    (example,) = [block for block in blocks if "stable_baselines3" in block]
    exec(compile(example, "gymnasium.md", "exec"), {})
    assert float(capsys.readouterr().out.split()[-1]) >= 0.9


@pytest.mark.parametrize("steps", [4, 12])
def test_a_custom_environment_plays_episodes_of_another_length(steps):
    env = gymnasium.make(ENV, name="point_mass:PointMass", episode_length=steps)
    env.reset(seed=0)
    truncated = [env.step(np.zeros(2, np.float32))[3] for _ in range(steps)]
    assert truncated == [False] * (steps - 1) + [True]


@pytest.mark.parametrize("steps", [0, -1, 2.5, float("nan"), ""])
def test_a_length_that_no_episode_can_have_is_refused_by_name(steps):
    with refuses("episode_length", str(steps)):
        gymnasium.make(ENV, name="point_mass:PointMass", episode_length=steps)
