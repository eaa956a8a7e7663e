"""Own methods of a task: what they change, what a policy file says of them, and what a user gets nearly right."""

import copy
import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses
from test_odd_robots import Reach

from mjx_dher.contract import robot_interface
from mjx_dher.envs import wrappers
from mjx_dher.envs.controls import Control
from mjx_dher.envs.fetch import Push
from mjx_dher.envs.goals import Goal
from mjx_dher.envs.kinematics import Place
from mjx_dher.envs.robot import RobotLoop
from mjx_dher.envs.task import JointDelta, MujocoTask
from mjx_dher.testing import check_env
from mjx_dher.testing.trial import ComponentError


@functools.cache
def made(base):
    return base("native")


class Longer(Reach):
    def observe(self, physics):
        return jnp.concatenate([Reach.observe(self, physics), jnp.sin(physics.qpos[:2])])


class Slower(Reach):
    def controls(self, physics, action):
        return super().controls(physics, 0.1 * action)


class Reversed:
    def observe(self, physics):
        return super().observe(physics)[::-1]


class Vouched(Longer):
    describe = Reach.describe


class Both(Reach):
    observe, describe = Longer.observe, MujocoTask.describe


def own(**methods):
    return type("Own", (Reach,), methods)


SEEN = ["layout", "joints", "sensors"]


@pytest.mark.parametrize(
    ("task", "lost", "own"),
    [
        (Longer, SEEN, "observe"),
        (Slower, ["controls"], "controls"),
        (own(achieved=lambda self, physics: physics.qpos[:3]), ["goal"], "achieved"),
        (own(sample_goal=lambda self, key: jnp.zeros(3)), ["goal"], "sample_goal"),
        (own(goal_distance=lambda self, achieved, desired: jnp.sum(achieved - desired, -1)), ["goal"], "goal_distance"),
        (own(reached=lambda self, achieved, desired: achieved[..., 0] > 0), ["goal"], "reached"),
        (type("Mixed", (Reversed, Reach), {}), SEEN, "observe"),
        (type("Mixed", (Reversed, Push), {}), SEEN, "observe"),
    ],
)
def test_a_policy_file_leaves_out_what_own_methods_may_contradict(task, lost, own):
    env, base = task("native"), Push if issubclass(task, Push) else Reach
    plain = made(base).robot_interface
    assert env.robot_interface == {name: value for name, value in plain.items() if name not in lost} | {"own": [own]}

    def policy(obs):
        return np.zeros(env.action_size)

    for policy.interface in (env.robot_interface, plain):  # `plain` as of an older version
        RobotLoop(env, policy)
    policy.interface = env.robot_interface
    with refuses("own", own, "policy"):
        RobotLoop(made(base), policy)
    policy.interface = {**plain, "dt": 0.05}
    with refuses("dt", "policy"):
        RobotLoop(env, policy)


class Halved(wrappers.Wrapper):
    def act(self, memory, action):
        return memory, 0.5 * action


@pytest.mark.parametrize(
    ("name", "lost"),
    [
        ("advance", ["controls"]),
        ("step", ["controls"]),
        ("observed", SEEN),
        ("observe_goal", [*SEEN, "goal"]),
        ("Halved", ["controls", *SEEN, "goal"]),
    ],
)
def test_a_loop_refuses_what_it_would_not_do(name, lost):
    task = own(**{name: lambda self, *args: getattr(Reach, name)(self, *args)})
    env = Halved(made(Reach)) if name == "Halved" else task("native")
    assert robot_interface(env).keys() == {"dt", *made(Reach).robot_interface.keys() - set(lost), "own"}
    assert robot_interface(env)["own"] == [name]
    with refuses(name, "policy"):
        RobotLoop(wrappers.ActionDelay(env, 1), lambda obs: np.zeros(2))


class Softer(wrappers.ActionFilter):
    pass


def test_a_loop_takes_the_policy_of_an_own_filter():
    def policy(obs):
        return np.zeros(2)

    env = Softer(made(Reach), 0.5)
    policy.interface = robot_interface(env)
    assert policy.interface == {"dt": 0.04, "own": ["Softer"]}
    RobotLoop(env, policy)
    with refuses("own", "Softer"):
        RobotLoop(made(Reach), policy)


def test_a_loop_applies_shipped_wrappers_and_leaves_out_noise_and_delay():
    wrapped = wrappers.ActionFilter(wrappers.ActionDelay(wrappers.ObservationNoise(made(Reach), 0.5), 2), 0.0)
    assert robot_interface(wrapped) == robot_interface(made(Reach))
    env, measured = made(Reach), np.asarray(made(Reach).start.physics.qpos)
    loops = [RobotLoop(each, lambda obs: np.tanh(obs["observation"][:2])) for each in (env, wrapped)]
    np.testing.assert_array_equal(*(loop(measured, np.zeros(env.model.nv), np.zeros(3)).ctrl for loop in loops))


def test_an_own_observation_may_be_longer_and_its_class_may_vouch_for_the_layout():
    for task in (Longer, Vouched, Both):
        env = task("native")
        assert (env.observation_size, env.spec.observation.shape) == (7, (7,))
    for task in (Vouched, Both):
        assert task("native").robot_interface == Reach("native").robot_interface
    assert type("Mixed", (Longer,), {"describe": Reach.describe})("native").observation_size == 7
    fetch = type("Short", (Push,), {"observe": lambda self, physics: Push.observe(self, physics)[:9]})("native")
    assert (fetch.observation_size, list(fetch.robot_interface)) == (9, ["controls", "own"])
    check_env(fetch)


# Their physics is the same, and so are their observations.
@pytest.mark.parametrize("task", [Longer, *(pytest.param(task, marks=pytest.mark.slow) for task in (Vouched, Both))])
def test_tasks_with_a_longer_observation_pass_the_check(task):
    check_env(task("native"))


def test_an_own_method_may_use_what_its_constructor_sets_later_and_varied_factors():
    class Later(Reach):
        varied = "damping:*=0.5-2"

        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.tip, self.scale = Place(self.model, "site:ee"), 2.0

        def observe(self, physics):
            return self.scale * super().observe(physics)

        def achieved(self, physics):
            return self.tip.position(physics.qpos)

    check_env(Later("native"))

    def observe(self, physics):
        return jnp.append(Reach.observe(self, physics), physics.factors)

    assert own(varied=Later.varied, observe=observe)("native").observation_size == 6


def test_an_own_contract_may_have_observations_of_other_ranks():
    def spec(self):
        return dataclasses.replace(Reach.spec.fget(self), observation=jax.ShapeDtypeStruct((2, 5), jnp.float32))

    def observe(self, physics):
        return jnp.tile(Reach.observe(self, physics), (2, 1))

    env = own(spec=property(spec), observe=observe)("native")
    assert env.reset(jax.random.key(0)).obs["observation"].shape == env.spec.observation.shape
    dense = own(spec=property(lambda self: dataclasses.replace(Reach.spec.fget(self), ends=False)), observe=Longer.observe)
    check_env(dense("native"))


def test_own_distances_count():
    class Far(Reach):
        def goal_distance(self, achieved, desired):
            return 100 * jnp.max(jnp.abs(achieved - desired), axis=-1)

    env = Far("native")
    near = jnp.array([0.03, 0.02, 0.0])
    assert not env.reached(jnp.zeros(3), near)
    assert Reach("native").reached(jnp.zeros(3), near)
    np.testing.assert_allclose(env.goal_distance(jnp.zeros(3), near), 3.0)


class Grip(Control):
    size = 2

    def apply(self, physics, action, controls):
        return dataclasses.replace(controls, ctrl=controls.ctrl.at[:2].set(action))


class Corner(Goal):
    size, threshold = 2, 0.1

    def achieved(self, physics):
        return physics.qpos[:2]

    def sample(self, key):
        return jax.random.uniform(key, (2,))

    def distance(self, achieved, desired):
        return jnp.linalg.norm(achieved - desired, axis=-1)


def test_an_own_control_and_an_own_goal_need_few_methods():
    env = type("Own", (Reach,), {"control": Grip(), "goal": Corner()})("native")
    assert (env.action_size, env.goal_size) == (2, 2)
    check_env(env)


class Bound(Goal):
    size, achieved, distance = 2, Corner.achieved, Corner.distance

    def __init__(self):
        self.sample = lambda key: jax.random.uniform(key, (2,))

    def bind(self, model):
        bound = super().bind(model)
        bound.threshold = 0.05 * model.stat.extent
        return bound


def test_an_own_goal_may_have_methods_of_an_instance_and_a_threshold_of_its_model():
    env = own(goal=Bound())("native")
    assert env.threshold == pytest.approx(0.05 * env.model.stat.extent)


class Lost(Grip):
    def bind(self, model):
        copy.copy(self)


def without(name):
    """A complete goal without a name."""
    return type("Bare", (Goal,), {key: value for key, value in vars(Corner).items() if key != name})()


@pytest.mark.parametrize(
    ("declared", "parts"),
    [
        ({"threshold": 0.01}, ("threshold", "the goal's threshold")),
        ({"dt": 0.1}, ("dt", "hz")),
        *(({name: 7}, (name, "set observations ")) for name in ("observation_size", "layout")),
        ({"goal_size": 7}, ("goal_size", "set goal ")),
        ({"action_size": 7}, ("action_size", "set control ")),
        ({"rest_action": 7}, ("rest_action", "set start ")),
        ({"control": "yaw"}, ("control", "'yaw'")),
        ({"control": type("Bare", (Control,), {"size": 1})()}, ("Bare", "apply")),
        ({"control": type("Bare", (Control,), {"apply": Grip.apply})()}, ("control Bare needs size,",)),
        ({"control": Lost()}, ("bind of control Lost returns", "Control object", "None")),
        *(
            ({"goal": without(name)}, (f"goal Bare needs {name},",))
            for name in ("size", "threshold", "achieved", "sample", "distance")
        ),
        ({"achieved": lambda self, physics: physics.qpos[:2]}, ("achieved", "[3]", "[2]")),
        ({"goal_distances": lambda self, achieved, desired: 0}, ("goal_distances", "'goal_distance'")),
        ({"compute_rewards": Reach.compute_reward}, ("compute_rewards", "'compute_reward'")),
        ({"observe": lambda self, physics: physics.qpos[None]}, ("observe", "vector")),
        ({"observe": lambda self, physics: [physics.qpos]}, ("observe", "array", "list")),
    ],
)
def test_what_an_own_task_gets_nearly_right_is_named(declared, parts):
    with refuses(*parts):
        type("Own", (Reach,), declared)("native")


def test_helpers_of_own_methods_may_have_near_names():
    zero = lambda self, *args: jnp.zeros(())  # noqa: E731
    own(goal_distances=zero, goal_distance=zero, _sample_goals=zero, observe_box=zero)("native")


JOINT = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="j" type="{}"/><geom size="0.1"/></body></worldbody>
<actuator><position joint="j" ctrlrange="{}" gear="{}"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("kind", "ends", "gear", "told"),
    [
        ("hinge", "-2 2", 1, "j by 5 per action, and its range is 4 wide"),
        ("hinge", "-4 4", 2, "j by 5 per action, and its range is 4 wide"),
        ("hinge", "-4 4", -2, "j by 5 per action, and its range is 4 wide"),
        ("hinge", "3.4 8.4", 1, None),  # as wide as the scale, up to rounding
        ("hinge", "-4 4", 0.5, None),
        ("hinge", "-2 2", 0, None),
        ("slide", "-2 2", 1, None),  # has no degrees
    ],
)
def test_a_scale_in_degrees_is_told(kind, ends, gear, told):
    model = mujoco.MjModel.from_xml_string(JOINT.format(kind, ends, gear))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        JointDelta(scale=5.0).bind(model)
    assert [str(each.message).partition("moves ")[2].partition(":")[0] for each in caught] == [told] * (told is not None)


def test_a_reached_that_is_no_boolean_and_a_constant_reward_are_told():
    reached = lambda self, achieved, desired: self.goal_distance(achieved, desired)  # noqa: E731
    with refuses("reached of goals [3]", "booleans", "float32", error=ComponentError):
        check_env(type("Own", (Reach,), {"reached": reached})("native"))
    with pytest.warns(UserWarning, match="compute_reward is 0 for all goals"):
        check_env(Reach("native", distance_threshold=9.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(Reach("native"))
