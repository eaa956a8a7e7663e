"""Mirror images: of transitions in a batch, and of the Fetch tasks, whose physics follows them."""

import dataclasses

import configs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import HParams, envs, make_train, mirror
from mjx_dher.envs.fetch import Push, fetch_observation
from mjx_dher.envs.task import MujocoTask
from mjx_dher.envs.wrappers import ActionDelay, FrameStack, ObservationNoise, Wrapper
from mjx_dher.mirror import half
from mjx_dher.testing import check_env
from mjx_dher.types import Batch
from point_mass import PointMass
from probes import Least

MIRRORED = dataclasses.replace(configs.TINY, augmentation="mirror", updates_per_cycle=250, batch_size=80)


class Plane(PointMass):
    """A point that starts right of the axis x = 0, in whose mirror image left and right are exchanged."""

    def reset(self, key):
        return self._state(*jax.random.uniform(key, (2, 2), minval=2.0, maxval=3.0))

    def mirror(self, observation, goal, action):
        across = jnp.array([-1.0, 1.0])
        return observation * across, goal * across, action * across


class Turned(Plane):
    def mirror(self, observation, goal, action):
        observation, goal, action = super().mirror(observation, goal, action)
        return observation[..., ::-1], goal, action


class Sheared(Plane):
    """(x, y) becomes (x, x - y): twice is nothing, but distances change."""

    def mirror(self, observation, goal, action):
        shear = jnp.array([[1.0, 1.0], [0.0, -1.0]])
        return observation @ shear, goal @ shear, action


class Unseen(Plane):
    def mirror(self, observation, goal, action):
        return observation, *super().mirror(observation, goal, action)[1:]


class At(Plane):
    """The same by an update of single numbers, which NumPy's arrays have not."""

    def mirror(self, observation, goal, action):
        return tuple(x.at[..., 0].multiply(-1.0) for x in (observation, goal, action))


class Shorter(Plane):
    def mirror(self, observation, goal, action):
        return observation, goal[..., :1], action


def transitions(number):
    """Transitions that differ from their images in all parts, with two leading axes."""
    keys = jax.random.split(jax.random.key(0), 5)
    parts = [jax.random.uniform(key, (2, number // 2, 2), minval=0.1, maxval=1.0) for key in keys]
    reward = jnp.arange(float(number)).reshape(2, -1)
    names = ("observation", "next_observation", "desired_goal", "action", "hindsight_goal")
    return Batch(**dict(zip(names, parts)), reward=reward, discount=-reward, row=reward.astype(jnp.int32))


def test_half_of_a_batch_is_mirrored_whole():
    batch = transitions(2000)
    result = half(batch, Plane().mirror, jax.random.key(1))
    for name in ("reward", "discount", "row"):
        np.testing.assert_array_equal(getattr(result, name), getattr(batch, name))
    side = np.sign(result.observation[..., 0])
    assert 900 < (side < 0).sum() < 1100  # 4.5 standard deviations
    for name in ("observation", "next_observation", "desired_goal", "action", "hindsight_goal"):
        expected = getattr(batch, name) * np.stack([side, np.ones_like(side)], axis=-1)
        np.testing.assert_array_equal(getattr(result, name), expected)
    by_hand = half(dataclasses.replace(batch, hindsight_goal=None), Plane().mirror, jax.random.key(1))
    assert by_hand.hindsight_goal is None
    np.testing.assert_array_equal(by_hand.desired_goal, result.desired_goal)


class Sides(Least):
    """Learns the share of transitions to the left of the axis."""

    def update(self, state, batch, hparams):
        left = jnp.mean(batch.observation[..., 0] < 0)
        return {"w": state["w"] + left / MIRRORED.updates_per_cycle}, {"q_mean": left}


@pytest.mark.parametrize(("augmentation", "share"), [("mirror", 0.5), ("none", 0.0)])
def test_the_learner_gets_mirror_images_and_the_ring_does_not(augmentation, share):
    train = make_train(Plane(), dataclasses.replace(MIRRORED, augmentation=augmentation), learner=Sides())
    state, _ = jax.jit(train.epoch)(train.init(jax.random.key(0), HParams()))
    np.testing.assert_allclose(state.learner["w"], share, atol=0.02)  # of 20,000 transitions
    assert state.replay.episodes.observation[..., 0].min() >= 0  # empty rows are 0


def test_a_task_without_mirror_is_refused():
    with refuses("augmentation", "mirror"):
        make_train(PointMass(), MIRRORED)


def test_a_mirror_that_is_none_is_named_by_the_check():
    check_env(Plane())
    check_env(At())
    for wrong, problem in (
        (Turned, "mirror of a mirror image must give the same result; observation"),
        (Unseen, r"mirror must move observation and goal alike; observation\[0:2\] is the achieved goal"),
        (Sheared, "compute_reward of mirrored goals"),
        (Shorter, r"mirror must keep structure, shapes and types; \['goal'\] is float32\[2\] and becomes float32\[1\]"),
    ):
        with pytest.raises(ValueError, match=problem):
            check_env(wrong())
    two = lambda observation, goal, action: (observation, goal)  # noqa: E731
    for wrong, problem in (
        (Shorter().mirror, r"\['goal'\] is .*\[2\] and"),
        (two, "observation, goal, action; got 2 of"),
    ):
        with pytest.raises(ValueError, match=problem):
            half(transitions(4), wrong, jax.random.key(0))


def test_each_frame_of_a_stack_is_mirrored():
    env = FrameStack(Plane(), 2)
    observation, goal, action = env.mirror(jnp.arange(4.0), jnp.ones(2), jnp.ones(2))
    np.testing.assert_array_equal(observation, [0.0, 1.0, -2.0, 3.0])
    np.testing.assert_array_equal([goal, action], [[-1.0, 1.0]] * 2)
    assert not hasattr(FrameStack(PointMass(), 2), "mirror")
    check_env(env)


def test_the_image_of_a_fetch_observation():
    """By hand, for Push: y is mirrored at y0, and a rotation about x or z turns the other way."""
    env = envs.make("push")
    y0 = env.task.initial_grip_pos[1]
    seen, goal, action = env.mirror(
        jnp.array([1.3, y0 + 0.1, 0.5, 1.2, y0, 0.4, -0.1, -0.1, -0.1, 0.01, 0.02, *range(1, 13), 0.3, 0.4]),
        jnp.array([1.2, y0 - 0.2, 0.4]),
        jnp.array([0.1, 0.2, 0.3, 0.4]),
    )
    turned = [-1, 2, -3, 4, -5, 6, -7, 8, -9, 10, -11, 12]
    expected = [1.3, y0 - 0.1, 0.5, 1.2, y0, 0.4, -0.1, 0.1, -0.1, 0.02, 0.01, *turned, 0.4, 0.3]
    np.testing.assert_allclose(seen, expected, atol=1e-6)
    np.testing.assert_allclose(goal, [1.2, y0 + 0.2, 0.4], atol=1e-6)
    np.testing.assert_allclose(action, [0.1, -0.2, 0.3, 0.4], atol=1e-6)


class Backward(Push):
    def observe(self, physics):
        return super().observe(physics)[::-1]

    def describe(self):
        return {}


class Own(Backward):
    def mirror(self, observation, goal, action):
        return observation, goal, action


class Kept(Push):
    keeps_mirror = True


class Reversed(Wrapper):
    def see(self, memory, observation):
        return memory, observation[..., ::-1]


class Delayed(ActionDelay):
    def act(self, memory, action):
        return super().act(memory, action[::-1])


class Stacked(FrameStack):
    def act(self, memory, action):
        return memory, action[::-1]


def test_an_inherited_mirror_that_may_be_wrong_is_refused():
    """It would be wrong without an error where the sizes agree."""
    config = dataclasses.replace(MIRRORED, replay_size=1000)
    for env, name in (
        (Backward("native"), "Backward"),
        (FrameStack(Backward("native"), 2), "Backward"),
        (type("Same", (Kept,), {})("native"), "Same"),
        (Reversed(Plane()), "Reversed"),
        (Delayed(Plane(), 1), "Delayed"),
        (Stacked(Plane(), 2), "Stacked"),
    ):
        with pytest.raises(AttributeError, match=f"mirror may contradict {name}"):
            mirror.own(env)
        with pytest.raises(
            ValueError, match=f"augmentation mirror needs .* mirror may contradict {name}, .* augmentation none"
        ):
            make_train(env, config)
    make_train(Own("native"), config)
    make_train(Kept("native"), config)
    with refuses("mirror", "function"):
        make_train(type("Flat", (PointMass,), {"mirror": 3})(), config)
    assert hasattr(ActionDelay(ObservationNoise(Plane(), 0.1), 2), "mirror")
    with refuses("mirror", "observation"):
        envs.make("push").mirror(jnp.ones(26), jnp.ones(3), jnp.ones(4))


def test_a_subclass_of_an_own_task_must_say_that_it_keeps_its_mirror():
    """Its observations may be others, whose image would be wrong without an error."""
    base = type("Base", (MujocoTask,), {"mirror": lambda self, *parts: parts})
    mixin = type("Mixin", (), {"mirror": lambda self, *parts: parts})
    wider = type("Wider", (base,), {"observations": ("qvel:*",)})
    mixed = type("Mixed", (mixin, MujocoTask), {})

    def has(cls):
        try:
            mirror.own(object.__new__(cls))
        except AttributeError:
            return False
        return True

    assert [has(cls) for cls in (MujocoTask, base, wider, mixed)] == [False, True, False, True]
    assert [has(type("Deeper", (cls,), {})) for cls in (wider, mixed)] == [False, False]
    for cls in (wider, mixed):
        assert has(type("Kept", (cls,), {"keeps_mirror": True}))
        assert has(type("Own", (cls,), {"mirror": lambda self, *parts: parts}))


def test_the_image_of_an_observation_is_the_observation_of_the_image():
    """The observation of a mirrored object and gripper, computed from their positions, is the mirrored observation."""
    env, rng = envs.make("push"), np.random.default_rng(0)
    across, turned = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])
    place = lambda x: x * across + [0.0, 2 * env.task.initial_grip_pos[1], 0.0]  # noqa: E731
    for _ in range(5):
        grip, grip_vel, pos, vel, spin, goal = rng.normal(size=(6, 3))
        quat, fingers = rng.normal(size=4), rng.normal(size=(2, 2))
        quat /= np.linalg.norm(quat)
        image = quat * [1.0, -1.0, 1.0, -1.0]
        of = fetch_observation(grip, grip_vel, np.array([*pos, *quat]), np.array([*vel, *spin]), *fingers)
        moved = np.array([*vel * across, *spin * turned])  # the spin is given in the object's axes
        expected = fetch_observation(place(grip), grip_vel * across, np.array([*place(pos), *image]), moved, *fingers[:, ::-1])
        np.testing.assert_allclose(env.mirror(of, goal, np.ones(4))[0], expected, atol=1e-5)


def play_twice(env, first, actions):
    """Last observation [D] of an episode from `first`, and of one with the mirrored start and actions."""
    observation, goal = first.obs["observation"], first.obs["desired_goal"]
    ends = []
    for seen, aim, played in ((observation, goal, actions), env.mirror(observation, goal, actions)):
        start = jnp.array([*seen[3:6], 1.0, 0.0, 0.0, 0.0]) if env.has_object else None
        states, _ = jax.lax.scan(lambda state, action: (env.step(state, action), None), env.init_state(start, aim), played)
        ends.append(states.obs["observation"])
    return ends


@pytest.mark.parametrize("task", ["reach", pytest.param("pick_and_place", marks=pytest.mark.slow), "slide"])
def test_fetch_moves_in_a_mirror_as_its_image(task):
    """After half a second of random actions, both episodes are mirror images within millimetres."""
    env = envs.make(task, engine="native")
    first = env.reset(jax.random.key(0))
    actions = jax.random.uniform(jax.random.key(1), (12, 4), minval=-1.0, maxval=1.0)
    one, other = play_twice(env, first, actions)
    assert np.linalg.norm(one[:3] - first.obs["observation"][:3]) > 0.05
    assert abs(one[1] - other[1]) > 0.02
    np.testing.assert_allclose(env.mirror(one, first.obs["desired_goal"], actions[0])[0], other, atol=2e-3)


def test_a_puck_that_is_hit_slides_in_a_mirror_as_its_image():
    env = envs.make("slide", engine="native")
    first = env.reset(jax.random.key(0))
    towards = jnp.sign(first.obs["observation"][6:8]) * 0.7
    actions = jax.random.uniform(jax.random.key(1), (12, 4), minval=-0.3, maxval=0.3).at[:, :2].add(towards)
    one, other = play_twice(env, first, actions)
    assert np.linalg.norm(one[3:6] - first.obs["observation"][3:6]) > 0.05
    assert abs(one[4] - other[4]) > 0.02
    np.testing.assert_allclose(env.mirror(one, first.obs["desired_goal"], actions[0])[0][3:6], other[3:6], atol=0.01)
