"""Wrappers: noise, delay, filter and frame stack, by hand on a point mass, and on tasks by name."""

import pickle
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import my_arm
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import contract, envs
from mjx_dher.envs.wrappers import ActionDelay, ActionFilter, FrameStack, ObservationNoise
from mjx_dher.rollout import rollout
from mjx_dher.testing import check_env

KEY = jax.random.key(3)


class PointState(NamedTuple):
    obs: dict
    reward: jax.Array
    success: jax.Array


class Point:
    """A point in the plane that an action moves by a tenth; the observation is the last action, and where the point is."""

    action_size, episode_length, observation_size, dt = 2, 6, 4, 0.1

    def __init__(self, speed: float = 0.1):
        self.speed = speed

    def _state(self, action, position, goal):
        obs = {"observation": jnp.concatenate([action, position]), "achieved_goal": position, "desired_goal": goal}
        reward = self.compute_reward(position, goal)
        return PointState(obs, reward, 1.0 + reward)

    def reset(self, key):
        start, goal = jax.random.uniform(key, (2, 2), minval=-1.0)
        return self._state(jnp.zeros(2), start, goal)

    def step(self, state, action):
        action = jnp.clip(action, -1.0, 1.0)
        return self._state(action, state.obs["achieved_goal"] + self.speed * action, state.obs["desired_goal"])

    def compute_reward(self, achieved_goal, desired_goal):
        return -(jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) > 0.5).astype(jnp.float32)

    def with_goal(self, state, goal):
        return self._state(state.obs["observation"][:2], state.obs["achieved_goal"], goal)


ACTIONS = np.linspace(-0.9, 0.9, 12, dtype=np.float32).reshape(6, 2)
ALL = {"action_filter": 0.5, "action_delay": "0-2", "obs_noise": 0.1, "frame_stack": 3}


def applied(env, key=KEY):
    """The actions that arrive at the point, [T, 2]."""
    state, arrived = env.reset(key), []
    for action in ACTIONS:
        state = env.step(state, action)
        arrived.append(np.asarray(state.inner.obs["observation"][:2]))
    return np.array(arrived)


def test_a_wrapped_environment_is_one():
    """Pure, one structure, the same alone and in a batch, `with_goal`; and it starts and plays where the plain one does."""
    env = pickle.loads(pickle.dumps(envs.make("test_wrappers:Point", **ALL)))
    check_env(env)
    first, plain = jax.jit(env.reset)(KEY), jax.jit(Point().reset)(KEY)
    np.testing.assert_array_equal(first.obs["achieved_goal"], plain.obs["achieved_goal"])
    assert (env.dt, contract.step_seconds(env), hasattr(env, "with_object"), hasattr(first, "failed")) == (
        0.1,
        0.1,
        False,
        False,
    )
    keys = jax.random.split(KEY, 16)
    actions = jnp.broadcast_to(ACTIONS[:, None], (6, 16, 2))
    episodes, outcome = jax.jit(lambda keys: rollout(env, lambda action, obs: action, keys, 16, actions))(keys)
    reward = env.compute_reward(episodes.achieved_goal[:, 1:], episodes.desired_goal[:, None])  # as hindsight computes it
    np.testing.assert_array_equal(reward.sum(-1), outcome.ret)


@pytest.mark.parametrize("delay", [0, 1, 2, 6])
def test_delay_applies_the_actions_so_many_steps_late(delay):
    expected = np.concatenate([np.zeros((delay, 2)), ACTIONS])[:6]
    env = ActionDelay(Point(), delay)
    np.testing.assert_array_equal(applied(env), expected)
    np.testing.assert_array_equal(applied(env), expected)  # a reset forgets


def test_delay_between_two_numbers_is_drawn_at_each_reset():
    env = ActionDelay(Point(), "1-3")
    shifts = {}
    for key in jax.random.split(KEY, 12):
        arrived = applied(env, key)
        shifts[int(np.argmax(np.any(arrived != 0, axis=1)))] = arrived
    assert sorted(shifts) == [1, 2, 3]
    for delay, arrived in shifts.items():
        np.testing.assert_array_equal(arrived[delay:], ACTIONS[: 6 - delay])


def test_filter_is_the_formula():
    filtered, expected = np.zeros(2), []
    for action in ACTIONS:
        filtered = 0.75 * filtered + 0.25 * action
        expected.append(filtered)
    np.testing.assert_allclose(applied(ActionFilter(Point(), 0.75)), expected, rtol=1e-6)
    state = ActionFilter(Point(), 0.75).reset(KEY)
    state = ActionFilter(Point(), 0.75).step(state, np.array([100.0, 0.0]))  # is clipped first, and does not wind up
    np.testing.assert_allclose(state.memory, [0.25, 0.0])


@pytest.mark.parametrize("std", [0.2, np.array([0.1, 0.0, 0.3, 1.0])])
def test_noise_has_the_deviation_and_is_drawn_anew_at_each_step(std):
    env = ObservationNoise(Point(), std)
    step, reset = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.reset))
    keys = jax.random.split(KEY, 4000)
    states = [reset(keys)]
    states += [step(states[-1], np.zeros((4000, 2), np.float32))]
    noise = np.array([state.obs["observation"] - state.inner.obs["observation"] for state in states])
    np.testing.assert_allclose(noise.std(axis=1), np.broadcast_to(std, (2, 4)), rtol=0.05, atol=1e-6)
    np.testing.assert_allclose(noise.mean(axis=1), 0.0, atol=0.06)
    assert abs(np.corrcoef(noise[0, :, 0], noise[1, :, 0])[0, 1]) < 0.06
    assert abs(np.corrcoef(noise[0, :, 0], noise[0, :, 2])[0, 1]) < 0.06
    again = step(reset(keys), np.zeros((4000, 2), np.float32))
    np.testing.assert_array_equal(again.obs["observation"], states[1].obs["observation"])
    np.testing.assert_array_equal(states[1].obs["achieved_goal"], states[1].inner.obs["achieved_goal"])


def test_noise_in_noise_is_independent():
    env = ObservationNoise(ObservationNoise(Point(), 0.3), 0.4)
    state = jax.vmap(env.reset)(jax.random.split(KEY, 4000))
    noise = state.obs["observation"] - state.inner.inner.obs["observation"]
    np.testing.assert_allclose(np.std(noise, axis=0), 0.5, rtol=0.05)


def test_frames_are_the_latest_first_and_the_first_one_repeats():
    env = FrameStack(Point(), 3)
    state = env.reset(KEY)
    frames = [np.asarray(state.inner.obs["observation"])] * 3
    np.testing.assert_array_equal(state.obs["observation"], np.concatenate(frames))
    for action in ACTIONS[:4]:
        state = env.step(state, action)
        frames = [np.asarray(state.inner.obs["observation"]), *frames[:2]]
        np.testing.assert_array_equal(state.obs["observation"], np.concatenate(frames))
    np.testing.assert_array_equal(env.with_goal(state, jnp.zeros(2)).obs["observation"], state.obs["observation"])
    assert env.observation_size == 12


def test_frames_keep_their_noise():
    env = FrameStack(ObservationNoise(Point(), 0.1), 2)
    state = env.reset(KEY)
    following = env.step(state, ACTIONS[0])
    np.testing.assert_array_equal(following.obs["observation"][4:], state.obs["observation"][:4])


def test_arguments_of_any_environment_wrap_it():
    env = envs.make("test_wrappers:Point", speed=0.2, **ALL)
    order = []
    while hasattr(env, "env"):
        order.append(type(env))
        env = env.env
    assert order == [FrameStack, ObservationNoise, ActionDelay, ActionFilter]
    assert env.speed == 0.2
    assert "obs_noise" not in vars(env)


class OwnNoise(Point):
    def __init__(self, obs_noise: float = 0.0):
        super().__init__()
        self.own = obs_noise


def test_an_argument_of_the_constructor_stays_its_own():
    env = envs.make("test_wrappers:OwnNoise", obs_noise=0.5)
    assert isinstance(env, OwnNoise)
    assert env.own == 0.5


@pytest.mark.parametrize("name", ["push", "my_arm:Reach"])
def test_a_task_has_its_members_when_wrapped(name):
    """Engine, sizes and start are those of the task, and its object can be moved."""
    plain = envs.make(name, engine="native")
    env = envs.make(name, engine="native", **ALL)
    assert (env.engine.name, env.dt, env.name, env.goal_size) == ("native", plain.dt, plain.name, 3)
    assert contract.env_spec(env).observation_size == env.observation_size == 3 * plain.observation_size
    state = jax.jit(env.reset)(KEY)
    np.testing.assert_array_equal(state.physics.qpos, plain.reset(KEY).physics.qpos)
    state = jax.jit(env.step)(state, np.ones(env.action_size, np.float32))
    assert (int(state.step), bool(state.failed)) == (1, False)
    if env.has_object:
        moved = jax.jit(env.with_object)(state, jnp.array([1.3, 0.7, 0.425]))
        np.testing.assert_allclose(moved.obs["achieved_goal"], [1.3, 0.7, 0.425])
        assert jax.tree.structure(moved) == jax.tree.structure(state)
    env.check()
    assert not hasattr(env, "first_state")  # it would lack the wrapper's memory


class Absolute(my_arm.Reach):
    control = my_arm.MujocoTask.control


def test_a_delayed_position_servo_holds_the_start():
    env = ActionDelay(Absolute(engine="native"), 5)
    state, step = env.reset(KEY), jax.jit(env.step)
    start = state.physics.qpos
    for _ in range(5):
        state = step(state, np.ones(env.action_size, np.float32))
    assert (
        np.abs(state.physics.qpos - start).max() < 0.1 < np.abs(step(state, np.ones(6, np.float32)).physics.qpos - start).max()
    )


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("obs_noise", value) for value in (-0.1, float("nan"), 1e20, True, "much")),
        *(("action_delay", value) for value in (-1, 2.5, 10**20, True, "2-", "3-1")),
        *(("action_filter", value) for value in (-0.1, 1.0, float("nan"), "x")),
        *(("frame_stack", value) for value in (0, 1.5, 10**20, True)),
    ],
)
def test_values_out_of_range_are_rejected(field, value):
    with refuses(field):
        envs.make("test_wrappers:Point", **{field: value})


def test_shapes_that_do_not_fit_are_rejected():
    with refuses("obs_noise", 4, 3):
        ObservationNoise(Point(), [0.1, 0.1, 0.1])
    for wrapper in (ActionDelay(Point(), 2), ActionFilter(Point(), 0.5)):
        with refuses("action", 2, 1):
            wrapper.step(wrapper.reset(KEY), jnp.zeros(1))


def test_an_action_may_be_a_list_and_infinity_arrives_where_it_is_clipped():
    for wrapper in (FrameStack(Point(), 2), ActionFilter(Point(), 0.0)):
        state = wrapper.reset(KEY)
        for action in ([0.5, -0.5], np.array([0.5, -0.5])):
            np.testing.assert_allclose(wrapper.step(state, action).inner.obs["observation"][:2], [0.5, -0.5])
        with refuses("action", 2, 3):
            wrapper.step(state, [0.0, 0.0, 0.0])
        infinite = wrapper.step(state, jnp.array([jnp.inf, -jnp.inf]))
        np.testing.assert_array_equal(infinite.inner.obs["observation"][:2], [1.0, -1.0])
    env = envs.make("reach", engine="native", frame_stack=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # JAX warns of shapes of lists
        env.step(env.reset(KEY), [0.0] * 4)
        env.env.step(env.env.reset(KEY), [0.0] * 4)
