"""One's own robot, with what a first user gets nearly right: units, names, thresholds, starts and loops."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import envs
from mjx_dher.envs import Simulator, wrappers
from mjx_dher.envs.kinematics import pick, rounded
from mjx_dher.envs.observations import Entry
from mjx_dher.envs.robot import RobotLoop
from mjx_dher.envs.task import JointDelta, JointPosition, Joints, Mocap, MujocoTask, Pose, Position, Rotation, Start

XML = """
<mujoco><compiler angle="radian"/><option timestep="0.002"/>
<default><joint damping="2" armature="0.02"/><position kp="200" kv="20"/></default>
<worldbody><geom name="table" type="box" size="0.5 0.5 0.05" pos="0.4 0 -0.05"/>
  <body pos="0 0 0.2"><joint name="yaw" axis="0 0 1" range="-2 2"/>
    <geom type="capsule" fromto="0.1 0 0 0.3 0 0" size="0.03" contype="0" conaffinity="0"/>
    <body pos="0.3 0 0"><joint name="elbow" axis="0 1 0" range="-1 2.5"/>
      <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" contype="0" conaffinity="0"/>
      <site name="ee" pos="0.25 0 0"/><site name="ee - x" pos="0.2 0 0"/></body></body>
  <body name="box" pos="0.4 0 0.03"><freejoint/><geom name="box" type="box" size="0.03 0.03 0.03" mass="0.2"/></body>
</worldbody>
<actuator><position name="a_yaw" joint="yaw" ctrlrange="-2 2"/>
  <position name="a_elbow" joint="elbow" ctrlrange="-1 2.5"/></actuator>
<keyframe><key name="home" qpos="0 0.6 0.4 0 0.03 1 0 0 0"/></keyframe></mujoco>"""


class Reach(MujocoTask):
    model = XML
    control = JointPosition("*")
    start = Start("home", ranges={"yaw": (-1.5, 1.5)})
    goal = Position("site:ee", (0.5, -0.1, 0.1), (0.56, 0.1, 0.2))
    observations = ("site:ee", "qpos:yaw elbow")


class Turn(Reach):
    start = Start("home")
    goal = Pose("box", (0.3, -0.15, 0.03), (0.45, 0.15, 0.03), threshold=0.05, angle=0.1)


def hold(env, state):
    """Action that holds the present joints."""
    return env.rest_of(state.physics, measured=True)


@pytest.mark.parametrize("wrapped", [{"action_filter": 0.9}, {"action_delay": 3}, {"action_delay": 2, "action_filter": 0.5}])
def test_filters_and_delays_begin_where_the_start_is_drawn(wrapped):
    env = Reach("native")
    outer = env
    for name, value in wrapped.items():
        outer = {"action_filter": wrappers.ActionFilter, "action_delay": wrappers.ActionDelay}[name](outer, value)
    reset, step = jax.jit(jax.vmap(outer.reset)), jax.jit(jax.vmap(outer.step))
    state = reset(jax.random.split(jax.random.key(0), 4))
    first = np.asarray(state.physics.qpos[:, 0])
    assert np.ptp(first) > 1.0
    action = jax.vmap(env.rest_of)(state.inner.physics if outer is not env else state.physics)
    for _ in range(6):
        state = step(state, action)
    np.testing.assert_allclose(state.physics.qpos[:, 0], first, atol=2e-3)


def test_the_rest_of_a_keyframe_with_inputs_is_its_inputs_and_of_a_robot_its_positions():
    given = Reach.model.replace('qpos="0 0.6', 'ctrl="0.5 1" qpos="0 0.6')
    env = type("Given", (Reach,), {"model": given, "start": Start("home")})("native")
    np.testing.assert_allclose(env.rest_action, [0.25, (1 - 0.75) / 1.75], atol=1e-6)
    physics = dataclasses.replace(env.start_physics(jax.random.key(0)), qpos=jnp.asarray(env._rest.qpos).at[0].set(1.5))
    np.testing.assert_allclose(env.rest_of(physics), env.rest_action, atol=1e-6)
    np.testing.assert_allclose(env.rest_of(physics, measured=True), [0.75, (0.6 - 0.75) / 1.75], atol=1e-6)


@pytest.mark.parametrize("inputs", ["", 'ctrl="0.5 1" '])
def test_a_robot_s_first_filtered_target_is_where_it_is(inputs):
    env = type("Given", (Reach,), {"model": XML.replace('qpos="0 0.6', f'{inputs}qpos="0 0.6'), "start": Start("home")})(
        "native"
    )
    still = JointPosition("*").bind(env.model)

    def policy(obs):
        return np.asarray(still.rest(jnp.asarray(obs["observation"][3:5])))

    loop = RobotLoop(wrappers.ActionFilter(env, 0.9), policy)
    measured = np.asarray(env.start.physics.qpos).copy()
    measured[:2] = 1.5, 0.5
    for _ in range(3):
        np.testing.assert_allclose(loop(measured, np.zeros(env.model.nv), np.zeros(3)).ctrl, [1.5, 0.5], atol=1e-5)


@pytest.mark.parametrize("change", [{"hz": 50}, {"control": JointDelta("elbow yaw")}, {"observations": ("qpos:*", "site:ee")}])
def test_a_loop_has_the_period_the_controls_and_the_observation_of_its_policy(change):
    def policy(obs):
        return np.zeros(2)

    policy.interface = {**Reach("native").robot_interface, "dt": 0.04}
    RobotLoop(Reach("native"), policy)
    with refuses({"hz": "dt", "control": "controls"}.get(*change, "layout"), "policy"):
        RobotLoop(type("Other", (Reach,), change)("native"), policy)


def test_actuators_with_several_inputs_are_named():
    odd = '<body pos="0 3 1"><joint name="spare"/><geom size=".1"/></body></worldbody>'
    text = XML.replace("</worldbody>", odd, 1).replace("</actuator>", '<pid name="odd" joint="spare"/></actuator>')
    text = text[: text.index("<keyframe>")] + "</mujoco>"
    with refuses("every actuator must have one input", "'odd'"):
        type("Several", (Reach,), {"model": text})("native")
    with refuses("every actuator must have one input", "'odd'"):
        Simulator(mujoco.MjModel.from_xml_string(text), varied=["gain:*"])
    Simulator(mujoco.MjModel.from_xml_string(text), varied=["mass:*"])


class Tracked(Turn):
    observations = ("site:ee", "body:box", "rot:box")


def test_a_lost_measurement_leaves_the_frames_and_the_call_can_be_repeated():
    env, asked = wrappers.FrameStack(Tracked("native"), 3), []

    def policy(obs):
        asked.append(np.array(obs["observation"]))
        if len(asked) == failing:
            raise TimeoutError
        return np.full(2, len(asked) / 10)

    failing = 0
    loop, still = RobotLoop(env, policy), np.zeros(env.model.nv)
    first = np.array(env.env.start.physics.qpos)
    lost = np.append(first[:5], np.zeros(4))  # the tracker has lost the box
    second = first + np.array([0.1, 0, 0, 0, 0, 0, 0, 0, 0])
    loop(first, still, np.zeros(env.goal_size))
    with refuses("observation", "qpos"):
        loop(lost, still, np.zeros(env.goal_size))
    failing = len(asked) + 1
    with pytest.raises(TimeoutError):
        loop(second, still, np.zeros(env.goal_size))
    loop(second, still, np.zeros(env.goal_size))
    failed, repeated = asked[-2:]
    np.testing.assert_array_equal(failed, repeated)
    assert np.isfinite(repeated).all()


class Joint(Reach):
    observations = ("qpos:*", "qvel:*")


def test_a_loop_has_the_joints_and_the_goal_of_its_policy():
    def policy(obs):
        return np.zeros(2)

    own = Joint("native").robot_interface
    trained = {**own, "joints": {name: list(reversed(joints)) for name, joints in own["joints"].items()}}
    for policy.interface, name in ((trained, "joints"), ({**own, "goal": {**own["goal"], "of": "site:ee - x"}}, "goal")):
        with refuses(name, "policy"):
            RobotLoop(Joint("native"), policy)
    older = {name: own[name] for name in ("controls", "layout")}
    older["controls"] = [{name: each[name] for name in ("kind", "moves")} for each in own["controls"]]
    policy.interface = older  # of a version that described less
    RobotLoop(Joint("native"), policy)
    policy.interface = {**own, "goal": {**own["goal"], "threshold": 0.5}}
    RobotLoop(Joint("native"), policy)


def test_frames_begin_anew_where_the_object_is_set():
    env = envs.make("push", engine="native", frame_stack=3)
    state = env.with_object(env.reset(jax.random.key(3)), jnp.array([1.4, 0.8, 0.425]))
    frames = np.asarray(state.obs["observation"]).reshape(3, -1)
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], frames[2])


def test_a_threshold_of_a_pose_leaves_its_angle():
    def turned(angle):
        c, s = np.cos(angle), np.sin(angle)
        return jnp.array([0.4, 0, 0.03, c, s, 0, -s, c, 0], jnp.float32)

    for threshold in (None, 0.02, 0.5):
        env = Turn("native", distance_threshold=threshold)
        assert [bool(env.reached(turned(a), turned(0.0))) for a in (0.08, 0.12)] == [True, False]
        assert env.robot_interface["goal"]["threshold"] == (threshold or 0.05)


def test_goals_are_tested_with_the_threshold_in_use():
    far = type("Far", (Reach,), {"goal": Position("site:ee", (0.64, 0, 0.2), (0.68, 0, 0.2))})
    with refuses("goal", "0.05"):
        far("native")
    far("native", distance_threshold=0.3)
    with refuses("threshold", 5):
        type("Upright", (Reach,), {"goal": Rotation("box")})("native", distance_threshold=5)


def test_a_mocap_target_turns_by_its_angle():
    model = """<mujoco><worldbody><body name="hand" mocap="true"/>
      <body name="tip"><freejoint/><geom size=".1"/></body></worldbody>
      <equality><weld body1="hand" body2="tip"/></equality></mujoco>"""
    control = Mocap("hand", turn=3.0).bind(mujoco.MjModel.from_xml_string(model))
    controls = dataclasses.make_dataclass("Inputs", ["mocap"])(jnp.zeros((1, 7)))
    physics = dataclasses.make_dataclass("State", ["qpos"])(jnp.array([0.0, 0, 0, 1, 0, 0, 0]))
    for action in (np.array([0, 0, 0, 0, 0, 1.0]), np.array([0, 0, 0, 0.5, 0, 0]), np.zeros(6)):
        quat = control.apply(physics, jnp.asarray(action, jnp.float32), controls).mocap[0, 3:]
        assert 2 * np.arccos(np.clip(quat[0], -1, 1)) == pytest.approx(3 * np.linalg.norm(action), abs=2e-3)
    with refuses("turn", 90.0):
        Mocap("hand", turn=90.0).bind(mujoco.MjModel.from_xml_string(model))


def test_a_joint_and_a_body_of_one_name_are_told_apart():
    same = XML.replace('name="yaw"', 'name="box"').replace('joint="yaw"', 'joint="box"')
    with refuses("start", "box", 2.9):
        Start("home").bind(mujoco.MjModel.from_xml_string(same.replace('qpos="0 0.6', 'qpos="2.9 0.6')))
    with refuses("start", "box", "rename"):
        Start("home", ranges={"box": (-1, 1)}).bind(mujoco.MjModel.from_xml_string(same))


def test_names_are_one_text_and_may_have_a_minus():
    with refuses("actuator of control JointDelta", "one text"):
        JointDelta(["yaw", "elbow"]).bind(mujoco.MjModel.from_xml_string(XML))
    with refuses("joint of the goal", "one text"):
        Joints(["yaw"]).bind(mujoco.MjModel.from_xml_string(XML))
    model = mujoco.MjModel.from_xml_string(XML)
    assert Entry(model, "site:ee - x").size == 3
    assert len(Entry(model, "site:ee - body:box")._parts) == 2
    assert pick("joint", "yaw elbow", ["yaw", "elbow"]) == [0, 1]


def test_small_limits_keep_their_digits():
    assert rounded([4e-7, -0.1234567891, 2.0943951, 0.0]) == [4e-7, -0.123457, 2.094395, 0.0]
    assert rounded(1e-9) == 1e-9


def test_units_and_overlaps_of_drawn_starts_are_told():
    degrees = XML.replace('ctrlrange="-2 2"', 'ctrlrange="-115 115"')
    with pytest.warns(UserWarning, match="a_yaw.*same unit"):
        JointPosition("*").bind(mujoco.MjModel.from_xml_string(degrees))
    low = type("Low", (Reach,), {"start": Start("home", ranges={"box": ((0.3, -0.15, -0.09), (0.45, 0.15, 0.15))})})
    with pytest.warns(UserWarning, match=r"overlap by .* at the start, and geoms do in [3-6]\d% of the starts"):
        low("native")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Reach("native")


@pytest.mark.parametrize(
    ("name", "value", "field"),
    [("ctrl", JointDelta("yaw"), "control"), ("moves", JointDelta("yaw"), "control"), ("reward_range", (0.0, 1.0), "spec")],
)
def test_a_declaration_under_another_name_is_refused(name, value, field):
    parts = {"model": XML, "goal": Joints("yaw")}
    type("Own", (MujocoTask,), {**parts, "spare": Joints("elbow")})(engine="native")  # allowed where the field is set
    with refuses(f"{name} is no field of a task; set {field} instead"):
        type("Own", (MujocoTask,), {**parts, name: value})(engine="native")
