"""Tasks from models with unusual parts: welds with an offset, filtered and tendon servos, unlimited slides, odd names."""

import contextlib
import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import testing
from mjx_dher.envs import task
from mjx_dher.envs.engines.variation import Variation
from mjx_dher.envs.robot import RobotLoop
from mjx_dher.viewer.player import Player, make_game


def arm(actuators, joint="", more="", sensors=""):
    """MJCF of one hinge `j` that starts at 1 rad, without gravity."""
    return f"""
<mujoco>
  <compiler angle="radian"/><option gravity="0 0 0"/>
  <worldbody>
    <body name="link"><joint name="j" axis="0 0 1" range="-2 2" damping="1" {joint}/>
      <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="1"/><site name="arm:tip" pos=".3 0 0"/></body>
    {more}
  </worldbody>
  <tendon><fixed name="pull"><joint joint="j" coef="0.5"/></fixed></tendon>
  <actuator>{actuators}</actuator>
  <sensor>{sensors}</sensor>
</mujoco>"""


POSITION = '<position name="servo" joint="j" kp="20"/>'
BALL = '<body name="ball" pos="0 0 1"><freejoint/><geom size=".1"/></body>'


def make(model, **declared):
    declared = {"goal": task.Joints("j"), "control": task.JointDelta("j"), **declared}
    return type("Odd", (task.MujocoTask,), {"model": model, **declared})(engine="native")


@pytest.mark.parametrize(
    "actuator",
    [
        POSITION,
        '<position joint="j" kp="20" timeconst="0.1"/>',  # its input goes through a filter
        '<position tendon="pull" kp="80" ctrlrange="-2 2"/>',
        '<intvelocity joint="j" kp="20" actrange="-2 2" ctrlrange="-0.5 0.5"/>',
    ],
)
def test_settling_holds_each_drawn_start(actuator):
    control = task.Actuators() if "range" in actuator else task.JointDelta("j")
    env = make(arm(actuator), control=control, start=task.Start(ranges={"j": (-1.0, 1.0)}, settle=20))
    key = jax.random.key(3)
    expected = env.start.draw(key)
    np.testing.assert_allclose(jax.jit(env.start_physics)(key).qpos, expected, atol=1e-3)
    assert abs(float(expected[0])) > 0.1


def test_settling_works_with_sensors():
    env = make(
        arm(POSITION, sensors='<jointpos name="p" joint="j"/>'),
        observations=("sensor:p", "qvel:j"),
        start=task.Start(ranges={"j": (0.5, 0.6)}, settle=2),
    )
    state = env.step(env.reset(jax.random.key(0)), jnp.zeros(1))
    np.testing.assert_allclose(state.obs["observation"][0], state.physics.qpos[0], atol=1e-6)


def test_sensors_are_read_on_the_engine_s_threads():
    model = arm(POSITION, sensors='<jointpos name="p" joint="j"/>')
    declared = {"model": model, "goal": task.Joints("j"), "observations": ("sensor:p",)}
    env = type("Odd", (task.MujocoTask,), declared)(engine="native", num_threads=3)
    assert env.engine._num_threads == env._sensors._reader._num_threads == 3


class Height(task.Goal):
    """A goal of one's own, with what training needs."""

    size, threshold = 1, 0.1

    def achieved(self, physics):
        return physics.qpos

    def sample(self, key):
        return jax.random.uniform(key, (1,))

    @staticmethod
    def distance(achieved, desired):
        return jnp.abs(achieved - desired)[..., 0]


def test_a_goal_of_one_s_own_without_marks_is_played_and_not_drawn():
    env = make(arm(POSITION), goal=Height())
    player = Player(make_game(env), lambda obs: np.zeros(1, np.float32), seed=1)
    player.step()
    assert (player.marks, env.goal_bounds, env.robot_interface["goal"]["kind"]) == ([], None, "Height")


WELDED = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="target" mocap="true" pos="0 0 .6" euler="0 0 90"/>
    <body name="hand" pos=".1 0 .4" euler="30 0 0"><freejoint/><geom type="box" size=".05 .02 .02"/>
      <site name="grip" pos=".2 0 0"/></body>
  </worldbody>
  <equality><weld {}/></equality>
</mujoco>"""
PLACE = task.Position("body:hand", (0, 0, 0.2), (0.2, 0.2, 0.6))


@pytest.mark.parametrize("at", [-2.01, 2.0005])
def test_a_keyframe_outside_a_joint_s_range_is_rejected(at):
    model = arm(POSITION).replace("</mujoco>", f'<keyframe><key name="bent" qpos="{at}"/></keyframe></mujoco>')
    with refuses("bent", "'j'", "-2.01", "-2 to 2") if at < -2 else contextlib.nullcontext():
        make(model, start=task.Start("bent"))
    make(model, start=task.Start("bent", ranges={"j": (0, 1)}))
    make(model.replace("<worldbody>", '<option><flag limit="disable"/></option><worldbody>'), start=task.Start("bent"))


def test_a_default_configuration_outside_joints_ranges_is_rejected():
    """The joints' zeros lie outside the ranges, as in many robots' MJCFs. Free and ball joints have none."""
    turning = '<body pos="0 0 2"><joint type="ball" range="0 1"/><geom size=".1"/></body>'
    other = '<body pos="0 0 3"><joint name="k" range="0.01 1"/><geom size=".1"/></body>'
    model = arm(POSITION, more=BALL + turning + other).replace('range="-2 2"', 'range="-2 -1"')
    with refuses("default configuration", "'j' at 0", "-2 to -1", "'k' at 0", "0.01 to 1", "keyframe", "`ranges`"):
        make(model)
    make(model, start=task.Start(ranges={"j": (-2, -1.5), "k": (0.5, 0.5)}))


@pytest.mark.parametrize("turn", [pytest.param(0.0, marks=pytest.mark.slow), 0.2])
@pytest.mark.parametrize(
    "weld",
    [
        'body1="target" body2="hand"',
        'body1="hand" body2="target"',
        'body1="target" body2="hand" anchor="0.2 0.1 0"',
        'body1="hand" body2="target" relpose="0 0.1 0.2 0.6 0 0.8 0"',
    ],
)
def test_a_mocap_target_is_relative_to_the_welded_body(weld, turn):
    start = task.Start(settle=300 if "relpose" in weld else 0)  # there the model's own poses do not fit the weld
    env = make(
        WELDED.format(weld), goal=PLACE, control=task.Mocap("target", 0.05, turn), observations=("body:hand",), start=start
    )
    first = state = jax.jit(env.reset)(jax.random.key(0))
    step, still = jax.jit(env.step), jnp.zeros(env.action_size)
    for _ in range(10):
        state = step(state, still)
    np.testing.assert_allclose(state.physics.qpos[:3], first.physics.qpos[:3], atol=2e-3)
    np.testing.assert_allclose(np.abs(state.physics.qpos[3:7]), np.abs(first.physics.qpos[3:7]), atol=5e-3)
    for _ in range(10):
        state = step(state, still.at[1].set(1.0))
    moved = np.asarray(state.physics.qpos[:3] - first.physics.qpos[:3])
    assert moved[1] > 0.1
    np.testing.assert_allclose(moved[[0, 2]], 0.0, atol=0.06 if turn else 0.02)  # without a fixed orientation it can turn


@pytest.mark.parametrize("turn", [0.0, 0.2])
def test_a_mocap_target_follows_a_drawn_start_while_it_settles(turn):
    declared = {"goal": PLACE, "control": task.Mocap("target", 0.05, turn), "observations": ("body:hand", "sensor:acc")}
    start = task.Start(ranges={"hand": ((0, 0, 0.2), (0.2, 0.2, 0.6))}, settle=20)
    sensor = '<sensor><framelinacc name="acc" objtype="body" objname="hand"/></sensor></mujoco>'
    env = make(WELDED.format('body1="target" body2="hand"').replace("</mujoco>", sensor), start=start, **declared)
    key = jax.random.key(3)
    np.testing.assert_allclose(jax.jit(env.start_physics)(key).qpos, env.start.draw(key), atol=1e-3)
    np.testing.assert_allclose(jax.jit(env.reset)(key).physics.sensors, 0.0, atol=0.1)  # the target is at the hand there, too


@pytest.mark.parametrize("weld", ['site1="at" site2="grip"', 'body1="target" body2="hand" active="false"'])
def test_a_mocap_body_needs_an_active_weld_of_bodies(weld):
    model = WELDED.format(weld).replace('euler="0 0 90"/>', 'euler="0 0 90"><site name="at"/></body>')
    with refuses("target", 0):
        make(model, goal=PLACE, control=task.Mocap("target"), observations=("body:hand",))


def test_goals_far_along_an_unlimited_slide_are_reachable():
    model = """<mujoco><option gravity="0 0 0"/><worldbody><body name="base">
      <joint name="x" type="slide" axis="1 0 0" damping="1"/><joint name="y" type="slide" axis="0 1 0" damping="1"/>
      <geom size=".1"/></body></worldbody>
      <actuator><motor joint="x" ctrlrange="-1 1"/><motor joint="y" ctrlrange="-1 1"/></actuator></mujoco>"""
    make(model, goal=task.Position("body:base", (40, 40, 0), (80, 80, 0)), control=task.Torque())


def test_one_end_of_a_joint_goal_is_enough():
    goal = make(arm(POSITION), goal=task.Joints("j", low=[-0.5])).goal
    np.testing.assert_allclose([goal.low, goal.high], [[-0.5], [2.0]])


def test_a_rate_that_an_error_names_is_accepted():
    with pytest.raises(ValueError, match="near") as raised:
        make(arm(POSITION), hz=7)
    for rate in re.findall(r"[\d.]+", str(raised.value).rsplit("near", 1)[1]):
        assert make(arm(POSITION), hz=float(rate)).dt == pytest.approx(1 / float(rate))


def test_names_may_have_brackets_and_colons():
    model = arm(POSITION.replace('"j"', '"x[1]"')).replace('name="j"', 'name="x[1]"').replace('joint="j"', 'joint="x[1]"')
    env = make(
        model,
        control=task.JointDelta("x[1]"),
        goal=task.Position("site:arm:tip", (0.2, -0.2, 0), (0.3, 0.2, 0)),
        observations=("qpos:x[1]", "site:arm:tip", "vel:arm:tip", "vel:site:arm:tip"),
    )
    assert env.observation_size == 10


def test_names_may_have_spaces():
    model = arm(POSITION.replace("servo", "my servo"), sensors='<jointpos name="my p" joint="j"/>').replace('"j"', '"my j"')
    env = make(
        model,
        control=task.JointDelta("my j"),
        goal=task.Joints("my j"),
        observations=("qpos:my j", "qvel:my?j *", "sensor:my p"),
        varied={"gain:my servo": (0.5, 2)},
    )
    assert (env.parts[0].moved, env.goal.moved, env.observation_size) == (["my servo"], ["my j"], 3)
    for name in ("your j", "my k"):
        with refuses("my servo", "my j", f"got {name.split()[0]!r}"):
            make(model, control=task.JointDelta(name), goal=task.Joints("my j"))


def test_an_actuator_s_name_comes_before_a_joint_s():
    other = '<body pos="0 1 0"><joint name="k" axis="0 0 1" damping="1"/><geom size=".1"/></body>'
    model = arm('<motor name="k" joint="j" ctrlrange="-1 1"/><motor name="m" joint="k" ctrlrange="-1 1"/>', more=other)
    assert make(model, control=task.Torque("k")).parts[0].moved == ["k"]
    assert make(model, control=task.Torque("?")).parts[0].moved == ["k", "m"]


def test_controls_that_are_not_finite_fail_the_step():
    class Broken(task.MujocoTask):
        model, goal, control = arm(POSITION), task.Joints("j"), task.JointDelta("j")

        def controls(self, physics, action):
            return super().controls(physics, jnp.where(action > 0.5, jnp.nan, action))

    env = Broken(engine="native")
    first = env.reset(jax.random.key(0))
    assert not env.step(first, jnp.zeros(1)).failed
    assert env.step(first, jnp.ones(1)).failed


def test_a_robot_that_is_too_fast_in_its_units_is_told_of_max_speed():
    with refuses("failed", "max_speed", "0.01"):
        testing.check_env(make(arm(POSITION), max_speed=0.01))


def test_starts_with_nan_are_not_blamed_on_speed_alone():
    class Broken(task.MujocoTask):
        model, goal, control = arm(POSITION), task.Joints("j"), task.JointDelta("j")

        def start_physics(self, key):
            physics = super().start_physics(key)
            return dataclasses.replace(physics, qpos=jnp.full_like(physics.qpos, jnp.nan))

    with refuses("starts", "NaN", "max_speed"):
        testing.check_env(Broken(engine="native"))


@pytest.mark.parametrize(
    ("control", "actuators", "parts"),
    [
        (task.JointDelta, '<motor name="m" joint="j" ctrlrange="-1 1"/>', ("JointDelta", "m (motor)", "Torque")),
        (task.Torque, POSITION, ("Torque", "servo (position servo)", "JointPosition")),
        (task.Torque, '<velocity joint="j" ctrlrange="-1 1"/>', ("actuator_0 (other)", "Actuators")),
        (task.Actuators, "", ("Actuators", "the model has no actuators")),
        (task.Torque, '<motor name="m" joint="j" ctrlrange="-1 1" ctrllimited="false"/>', ('ctrllimited="true"', "'m'")),
    ],
)
def test_a_model_without_actuators_for_its_control_says_what_it_has(control, actuators, parts):
    with refuses(*parts):
        make(arm(actuators), control=control())


def test_a_robots_loop_rejects_a_quaternion_without_length():
    env = make(
        WELDED.format('body1="target" body2="hand"'), goal=PLACE, control=task.Mocap("target"), observations=("body:hand",)
    )
    loop = RobotLoop(env, lambda obs: np.zeros(3))
    with refuses("qpos"):
        loop(np.zeros(7), np.zeros(6), np.zeros(3))


@pytest.mark.parametrize("joint", ["freejoint", 'joint type="ball"'])
def test_a_first_state_needs_quaternions_with_a_length(joint):
    env = make(arm(POSITION, more=BALL.replace("freejoint", joint)))
    physics = jax.tree.map(jnp.asarray, env.start.physics)
    for length in (1e-30, 0.0):  # the square of the first is 0, too
        with refuses("qpos", "quaternion"):
            env.first_state(physics.replace(qpos=physics.qpos.at[-4:].set(length)), jnp.zeros(1))


@pytest.mark.parametrize(
    ("model", "declared", "parts"),
    [
        (arm('<intvelocity joint="j" kp="20" actrange="-2 2" ctrlrange="-1 1"/>'), {}, ["JointDelta", "j"]),
        (arm(POSITION, sensors='<clock name="c"/>'), {"observations": ("sensor:c",)}, ["c", "clock"]),
        (arm(POSITION), {"observations": None}, ["observations", None]),
        (arm(POSITION), {"goal": task.Position(3, (0, 0, 0), (1, 1, 1))}, ["place", "`of`", "site", 3]),
        (arm(POSITION), {"goal": task.Joints("j", high=(1, 2, 3))}, ["goal", 1]),
        (arm(POSITION).replace('gravity="0 0 0"', 'timestep="0"'), {}, ["timestep", 0.0]),
        (arm(POSITION).replace('gravity="0 0 0"', 'timestep="-0.004"'), {}, ["timestep", -0.004]),
        (arm(POSITION).replace('gravity="0 0 0"', 'wind="0 0 nan"'), {}, ["NaN", "wind"]),
        (arm(POSITION).replace('kp="20"', 'kp="nan"'), {}, ["NaN", "actuator_gainprm"]),
        (arm(POSITION).replace('mass="1"', 'friction="nan"'), {}, ["NaN", "geom_friction"]),
        (arm(POSITION).replace("<option", '<option actuatorgroupdisable="0 3"'), {}, ["JointDelta", "j"]),
        (arm(POSITION).replace("/><option", '/><option><flag actuation="disable"/></option><option'), {}, ["JointDelta", "j"]),
        (arm('<motor joint="j" ctrlrange="-inf inf"/>'), {"control": task.Torque()}, ["j", "ctrlrange"]),
        (arm('<motor joint="j" ctrlrange="-1e20 1e20"/>'), {"control": task.Torque()}, ["j", "ctrlrange"]),
        (arm(POSITION, more=BALL), {"start": task.Start(ranges={"ball": ((0, 0, 1), (0, 0, 1e20))})}, ["ball", "1e+20"]),
        (arm(POSITION), {"goal": task.Rotation("link", threshold=10)}, ["threshold", "rad", 10]),
        (arm(POSITION), {"goal": task.Pose("link", (0, 0, 0), (1, 1, 1), angle=10.0)}, ["threshold", "rad", "10"]),
        (arm(POSITION), {"goal": task.Rotation("world")}, ["joint", "body:world"]),
        (arm(POSITION), {"controls": task.JointDelta("j")}, ["controls", "field", "control"]),
    ],
)
def test_an_unusual_declaration_is_rejected(model, declared, parts):
    with refuses(*parts):
        make(model, **declared)


@pytest.mark.parametrize("path", ["", ".", Path()])
def test_a_folder_is_no_model(path, capfd):
    with refuses("Odd", str(path), "folder"):
        make(path)
    assert capfd.readouterr() == ("", "")


def test_polynomial_damping_cannot_vary():
    model = mujoco.MjModel.from_xml_string(arm(POSITION).replace('damping="1"', 'damping=".5 1 2"'))
    with refuses("damping:j", "j", "polynomial"):
        Variation(model, ["damping:j"])


@pytest.mark.parametrize("length", [1e-30, 1e30])
def test_the_length_of_an_axis_does_not_matter(length):
    env = make(arm(POSITION), goal=task.Rotation("body:link", axis=(0, 0, length)))
    goals = jax.jit(jax.vmap(env.sample_goal))(jax.random.split(jax.random.key(0), 20))
    assert np.ptp(np.asarray(goals)[:, 0]) > 1.0
