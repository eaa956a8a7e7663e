import importlib
import subprocess
import sys
import warnings
from collections import Counter

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT, refuses
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import mjx_dher.gym
import mjx_dher.tools.render
from mjx_dher import envs
from mjx_dher.components import COMPONENTS, Component
from mjx_dher.envs.base import GoalEnv
from mjx_dher.envs.engines import resolve_engine
from probes import Explodes

REACH = "mjx_dher/FetchReach-v0"

traced = Counter()


class Probe(Explodes, GoalEnv):
    """No physics: a point, of which the episodes that start at x > 0.2 fail at their third step. Counts what is traced."""

    name = "probe"

    def __init__(self, engine):
        super().__init__(None)

    def reset(self, key):
        traced["reset"] += 1
        return super().reset(key)

    def step(self, state, action):
        traced["step"] += 1
        return super().step(state, action)


@pytest.fixture(scope="module", autouse=True)
def registered():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(COMPONENTS["env"], "probe", Component("test_gym:Probe", ""))
        yield


def assert_same(a, b, atol=0.0):
    """What environments return, nested as it is: the same keys, dtypes and values."""
    assert type(a) is type(b)
    if isinstance(a, tuple):
        assert_same(dict(enumerate(a)), dict(enumerate(b)), atol)
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key], atol)
    else:
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


@pytest.mark.parametrize(("id", "name"), mjx_dher.gym.IDS.items())
def test_every_task_is_registered_with_its_spaces(id, name):
    env, pure = gymnasium.make(f"mjx_dher.gym:{id}"), envs.make(name)
    assert env.spec.max_episode_steps == pure.episode_length == 50
    sizes = {"observation": 10 if name == "reach" else 25, "achieved_goal": 3, "desired_goal": 3}
    assert {key: (space.shape, space.dtype) for key, space in env.observation_space.items()} == {
        key: ((size,), np.float32) for key, size in sizes.items()
    }
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
    assert env.metadata["render_fps"] == 25


def test_an_episode_is_that_of_the_pure_environment():
    env, pure = gymnasium.make(REACH, engine="native"), envs.make("reach", engine="native")
    step = jax.jit(pure.step)
    state = jax.jit(pure.reset)(jax.random.key(int(seeding.np_random(7)[0].integers(2**31))))
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (50, 4)).astype(np.float32)
    obs, info = env.reset(seed=7)
    assert_same(obs, jax.tree.map(np.asarray, dict(state.obs)))
    assert info == {"is_success": float(state.success), "failed": False}
    start = obs["achieved_goal"]
    for number, action in enumerate(actions, start=1):
        state = step(state, action)
        obs, reward, terminated, truncated, info = env.step(action)
        assert_same(obs, jax.tree.map(np.asarray, dict(state.obs)))
        assert (reward, terminated, truncated) == (float(state.reward), False, number == 50)
        assert info == {"is_success": float(state.success), "failed": False}
        assert reward == env.unwrapped.compute_reward(obs["achieved_goal"], obs["desired_goal"], info)
    assert np.abs(obs["achieved_goal"] - start).max() > 0.01


def test_a_seed_decides_all_episodes_that_follow():
    env = mjx_dher.gym.GymEnv("probe")
    first, second = env.reset(seed=3)[0], env.reset()[0]
    assert_same(env.reset(seed=3)[0], first)
    assert_same(env.reset()[0], second)
    starts = [tuple(obs["achieved_goal"]) for obs in (first, second, env.reset(seed=4)[0])]
    assert len(set(starts)) == 3


def test_many_at_once_are_as_many_single_ones():
    """Against gymnasium's own vectorisation: two restarts, in the middle of which comes another seed."""
    settings = {"num_envs": 3, "engine": "native"}
    ours = gymnasium.make_vec(REACH, vectorization_mode="vector_entry_point", max_episode_steps=4, **settings)
    theirs = gymnasium.make_vec(REACH, vectorization_mode="sync", max_episode_steps=4, **settings)
    assert isinstance(ours, mjx_dher.gym.GymVectorEnv)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    rng, truncations = np.random.default_rng(1), []
    for seed, steps in ((5, 12), ([1, None, 2], 6)):
        assert_same(ours.reset(seed=seed), theirs.reset(seed=seed), atol=1e-5)
        for _ in range(steps):
            actions = rng.uniform(-1, 1, (3, 4)).astype(np.float32)
            here, there = ours.step(actions), theirs.step(actions)
            assert_same(here, there, atol=1e-5)
            assert here[0] in ours.observation_space
            truncations.append(here[3].all())
    # Four steps, and one that resets.
    assert truncations == [number % 5 == 4 for number in range(1, 13)] + [number % 5 == 4 for number in range(1, 7)]
    assert [random.bit_generator.state for random in ours.np_random] == [
        random.bit_generator.state for random in theirs.np_random
    ]
    assert ours.np_random_seed == theirs.np_random_seed


@pytest.mark.parametrize("make", [mjx_dher.gym.GymEnv, mjx_dher.gym.GymVectorEnv])
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_rewards_are_those_of_the_environment_on_any_leading_axes(make, reward_type):
    env, pure = make("reach", reward_type=reward_type), envs.make("reach", reward_type=reward_type)
    achieved = np.random.default_rng(0).uniform(-0.05, 0.05, (5, 2, 3))
    rewards = env.compute_reward(achieved, np.zeros(3), [{}] * 10)
    assert (rewards.shape, rewards.dtype) == ((5, 2), np.float32)
    exact = {"rtol": 0, "atol": 0 if reward_type == "sparse" else 1e-8}
    np.testing.assert_allclose(rewards, pure.compute_reward(jnp.asarray(achieved), jnp.zeros(3)), **exact)
    for index in np.ndindex(5, 2):
        alone = env.compute_reward(achieved[index], np.zeros(3), {})
        assert np.ndim(alone) == 0
        np.testing.assert_allclose(alone, rewards[index], **exact)
    distances = np.linalg.norm(achieved, axis=-1)
    assert 0 < (distances > 0.05).mean() < 1
    np.testing.assert_allclose(rewards, -1.0 * (distances > 0.05) if reward_type == "sparse" else -distances, atol=1e-7)
    assert env.compute_reward(np.zeros((0, 3)), np.zeros((0, 3)), []).shape == (0,)
    for ends in (env.compute_terminated, env.compute_truncated):
        assert not ends(achieved[0, 0], np.zeros(3), {})
        np.testing.assert_array_equal(ends(achieved, np.zeros(3), [{}] * 10), np.zeros((5, 2), bool))


def test_what_was_compiled_serves_all_instances():
    def play():
        for env, actions in (
            (mjx_dher.gym.GymEnv("probe"), np.zeros(2)),
            (mjx_dher.gym.GymVectorEnv("probe", num_envs=3), np.zeros((3, 2))),
            (mjx_dher.gym.GymEnv("probe", engine=resolve_engine("auto")), np.zeros(2)),
        ):
            env.reset()
            for _ in range(3):
                env.step(actions)

    play()
    before = traced.copy()
    play()
    assert traced == before
    assert traced["step"] <= 2  # single, and many


def test_physics_that_blew_up_is_reported_until_the_episode_ends():
    env = mjx_dher.gym.GymVectorEnv("probe", num_envs=16)
    obs, infos = env.reset(seed=0)
    breaks = obs["observation"][:, 0] > Explodes.EDGE
    assert 0 < breaks.sum() < 16
    failed = [infos["failed"]] + [env.step(np.zeros((16, 2)))[-1]["failed"] for _ in range(11)]
    expected = [breaks & (number >= 3) for number in range(11)] + [np.zeros(16, bool)]
    np.testing.assert_array_equal(failed, expected)
    single = mjx_dher.gym.GymEnv("probe")
    single.reset(seed=int(np.flatnonzero(breaks)[0]))
    assert [single.step(np.zeros(2))[-1]["failed"] for _ in range(4)] == [False, False, True, True]


def test_what_is_returned_belongs_to_the_caller():
    env = mjx_dher.gym.GymVectorEnv("probe", num_envs=2)
    obs, _ = env.reset(seed=0)
    kept = {key: value.copy() for key, value in obs.items()}
    for value in obs.values():
        value += 1
    following = env.step(np.zeros((2, 2)))[0]
    np.testing.assert_array_equal(following["achieved_goal"], kept["achieved_goal"])


REFUSED = [  # an act, and what the error must name
    (lambda: gymnasium.make(REACH, engine="natve"), ["engine", "natve", "native"]),
    (lambda: gymnasium.make(REACH, colour=1), ["argument", "colour", "num_threads"]),
    (lambda: gymnasium.make(REACH, reward_type="sprase"), ["reward_type", "sprase", "sparse"]),
    (lambda: gymnasium.make(REACH, episode_length=20), ["episode_length", "max_episode_steps"]),
    (lambda: mjx_dher.gym.GymEnv("probe", render_mode="ansi"), ["render_mode", "ansi", "rgb_array"]),
    (lambda: single(render_mode="rgb_array").render(), ["probe", "model"]),
    (lambda: mjx_dher.gym.GymEnv("pusch"), ["env", "pusch", "push"]),
    (lambda: gymnasium.make_vec(REACH, num_envs=0), ["num_envs", 0]),
    (lambda: gymnasium.make_vec(REACH, max_episode_steps=0), ["max_episode_steps", 0]),
    (lambda: gymnasium.make_vec(REACH, render_mode="rgb_array"), ["render_mode", "rgb_array"]),
    (lambda: single().step(np.zeros(3)), ["action", "(2,)", "(3,)"]),
    (lambda: single().step(np.array([0, np.nan])), ["action", "finite", "nan"]),
    (lambda: single().reset(options={"goal": 1}), ["options", {"goal": 1}]),
    (lambda: single().render(), ["render_mode", "rgb_array"]),
    (lambda: single().compute_reward(np.zeros(2), np.zeros(3), {}), ["goals", 2, "(3,)"]),
    (lambda: many().step(np.zeros(2)), ["action", "(2, 2)", "(2,)"]),
    (lambda: many().step(np.full((2, 2), np.inf)), ["action", "finite"]),
    *((lambda seed=seed: many().reset(seed=seed), ["seed"]) for seed in (1.5, -1, "x", [0, 1.5])),
    (lambda: many().reset(seed=[1]), ["seed", 2, 1]),
    (lambda: many().reset(options={"reset_mask": 1}), ["options", {"reset_mask": 1}]),
]


def single(make=mjx_dher.gym.GymEnv, **arguments):
    env = make("probe", **arguments)
    env.reset(seed=0)
    return env


def many():
    return single(mjx_dher.gym.GymVectorEnv, num_envs=2)


def test_bad_arguments_are_reported():
    for act, parts in REFUSED:
        with refuses(*parts):
            act()


def test_a_step_needs_a_reset():
    for make, shape in ((mjx_dher.gym.GymEnv, (2,)), (mjx_dher.gym.GymVectorEnv, (1, 2))):
        with pytest.raises(gymnasium.error.ResetNeeded):
            make("probe").step(np.zeros(shape))


def test_the_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "mjx_dher.gym")
    with refuses("gymnasium", "[gym]", error=ImportError):
        importlib.import_module("mjx_dher.gym")


# In a process of its own: MuJoCo chooses how to draw when it is imported, which other tests have done.
SCRIPT = """
import sys
import gymnasium, mjx_dher.gym
assert not {"jax", "mujoco"} & set(sys.modules)
import copy, pickle
import numpy as np
env = gymnasium.make("mjx_dher/FetchReach-v0", render_mode="rgb_array")
env.reset(seed=0)
try:
    env.render()
except ValueError as error:
    print(error)
    sys.exit(77)
pictures = []
for seed in (0, 1):
    env.reset(seed=seed)
    pictures += [env.render(), env.render()]
assert all(picture.shape == (480, 480, 3) and picture.dtype == np.uint8 for picture in pictures)
assert np.array_equal(pictures[0], pictures[1]) and np.array_equal(pictures[2], pictures[3])
assert not np.array_equal(pictures[0], pictures[2])  # another goal
for _ in range(3):
    env.step(np.array([0, 0, -1, 0]))
assert not np.array_equal(env.render(), pictures[3])  # the arm has moved
twin = pickle.loads(pickle.dumps(copy.deepcopy(env)))
for one in (env, twin):
    one.step(np.array([0, 1, 0, 0]))
assert np.array_equal(env.render(), twin.render())
env.close()
twin.close()
"""


@pytest.mark.slow
def test_pictures_follow_the_state():
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode == 77:
        pytest.skip(f"nothing on this machine can draw: {done.stdout.strip()}")
    assert (done.returncode, done.stderr) == (0, "")


TASKS = [pytest.param(id, marks=() if id == REACH else pytest.mark.slow) for id in mjx_dher.gym.IDS]


@pytest.mark.parametrize("id", TASKS)
def test_gymnasiums_checker_has_nothing_to_say(id):
    """But that observations have no bounds, which those of the original have not either."""
    env = gymnasium.make(id, engine="native")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    assert all("infinity. This is probably too" in str(warning.message) for warning in said), [str(w.message) for w in said]


@pytest.mark.parametrize("ends_at_goal", [False, True])
def test_terminated_and_truncated_are_those_of_the_task(ends_at_goal):
    """A walk of its own: it is truncated beyond x = 1, terminated below y = -1 and, if that ends it, at its goal."""
    name = f"probes:{'WalkToGoal' if ends_at_goal else 'Walk'}"
    single = mjx_dher.gym.GymEnv(name)
    many = mjx_dher.gym.GymVectorEnv(name, num_envs=3)
    obs, _ = single.reset(seed=3)
    all_obs, _ = many.reset(seed=[3, 4, 5])
    random = np.random.default_rng(0)
    seen, length = set(), 0
    for _ in range(300):
        actions = 0.5 * random.normal(size=(3, 2)).astype(np.float32)
        was_over = many._ended.copy()
        if was_over[0]:
            obs, _ = single.reset()
            terminated = truncated = False
            length = 0
        else:
            obs, _, terminated, truncated, _ = single.step(actions[0])
            length += 1
        all_obs, rewards, all_terminated, all_truncated, _ = many.step(actions)
        x, y = obs["achieved_goal"]
        reached = np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"]) <= 0.1
        assert terminated == (length > 0 and bool(y < -1 or (ends_at_goal and reached)))
        assert truncated == (length > 0 and bool(x > 1 and not terminated))
        assert single.compute_terminated(obs["achieved_goal"], obs["desired_goal"], {}) == (ends_at_goal and reached)
        np.testing.assert_allclose(all_obs["achieved_goal"][0], obs["achieved_goal"], atol=1e-6)
        assert all_terminated[0] == terminated
        assert all_truncated[0] == (truncated or length == 12)  # as a TimeLimit's, even if it is terminated, too
        assert (rewards[was_over] == 0).all()
        seen.add((bool(terminated), bool(truncated)))
    assert seen == {(False, False), (True, False), (False, True)}


def test_a_fault_is_told_when_any_copy_restarts(monkeypatch):
    """Copies of a task that ends early hardly ever restart together."""
    many = mjx_dher.gym.GymVectorEnv("probes:Walk", num_envs=2)
    many.reset(seed=0)
    checks = Counter()
    monkeypatch.setattr(many._compiled.env, "check", lambda: checks.update(made=1), raising=False)
    many.step(one_moves := np.array([[0.75, 0.0], [0.0, 0.0]]))
    assert many.step(one_moves)[3].tolist() == [True, False]
    assert not checks
    many.step(np.zeros((2, 2)))
    assert checks["made"] == 1
