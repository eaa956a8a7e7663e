"""docs/your_robot.md, docs/real_robot.md and their arm, docs/examples/my_arm.py: from an MJCF to ONNX, on every engine."""

import json
import re

import jax
import jax.numpy as jnp
import my_arm
import numpy as np
import pytest
import seven_joints
from conftest import EXAMPLES, ROOT, refuses

import mjx_dher
import point_mass
from mjx_dher import cli, envs
from mjx_dher.envs.kinematics import Place
from mjx_dher.envs.robot import RobotLoop
from mjx_dher.envs.task import JointDelta, JointPosition, Joints, MujocoTask, Start
from mjx_dher.runs.folder import fingerprint
from mjx_dher.spec import RunSpec

PAGE, REAL = ((ROOT / "docs" / name).read_text() for name in ("your_robot.md", "real_robot.md"))


def test_the_page_shows_the_example():
    code = (EXAMPLES / "my_arm.py").read_text()
    shown = [block for block in re.findall(r"```python\n(.*?)```", PAGE, re.S) if "class " in block]
    assert [block.count("class ") for block in shown] == [1, 1]
    for block in shown:
        assert block.partition("class ")[2] in code
    assert len(code.splitlines()) <= 40


@pytest.mark.slow
def test_the_page_works_line_by_line(tmp_path, monkeypatch, capsys):
    """From `check` to ONNX; and a robot's loop gives the action that the policy gives in simulation."""
    monkeypatch.chdir(tmp_path)
    script = "".join(re.findall(r"```bash\n(.*?)```", PAGE, re.S))
    for line in script.replace("\\\n", "").splitlines():
        command = line.removeprefix("python train.py ").split()
        if command[0] not in ("view", "render"):
            assert cli.main(command) == 0, line
    assert float(re.findall(r"^success ([\d.]+)", capsys.readouterr().out, re.M)[0]) >= 0.9
    assert (tmp_path / "arm.onnx").stat().st_size > 10_000
    assert json.loads((tmp_path / "runs/arm/config.json").read_text())["interface"]["dt"] == 0.04
    (robot,) = [block for block in re.findall(r"```python\n(.*?)```", REAL, re.S) if "RobotLoop" in block]
    env = my_arm.Reach()
    state = env.reset(jax.random.key(0))
    names = {"Reach": my_arm.Reach, "qpos": state.physics.qpos, "qvel": state.physics.qvel, "goal": state.obs["desired_goal"]}
    exec(compile(robot, "real_robot.md", "exec"), names)
    action = mjx_dher.load_policy("runs/arm")(jax.tree.map(np.asarray, state.obs))
    np.testing.assert_allclose(names["targets"], env.controls(state.physics, jnp.asarray(action)).ctrl, atol=1e-6)


def test_a_robots_loop_sends_what_the_wrapped_task_sends():
    """Three frames and a filter: the loop's targets are those of the environment at each step, also after `start`."""
    env = envs.make("my_arm:Reach", engine="native", action_filter=0.5, action_delay=2, frame_stack=3)
    weights = np.random.default_rng(0).normal(size=(env.observation_size, env.action_size))

    def policy(obs):
        return np.tanh(obs["observation"] @ weights)

    loop, step, reset = RobotLoop(env, policy), jax.jit(env.step), jax.jit(env.reset)
    controls = jax.jit(loop.task.controls)
    for key in range(2):
        loop.start()
        state, filtered = reset(jax.random.key(key)), np.zeros(env.action_size)
        for _ in range(4):
            action = policy(jax.tree.map(np.asarray, state.obs))
            filtered = 0.5 * filtered + 0.5 * action
            expected = controls(state.physics, np.float32(filtered)).ctrl
            found = loop(state.physics.qpos, state.physics.qvel, state.obs["desired_goal"]).ctrl
            np.testing.assert_allclose(found, expected, atol=1e-6)
            state = step(state, action)
    with refuses("qpos", [1.0] * 6):
        loop([1.0] * 6, state.physics.qvel, state.obs["desired_goal"])
    with refuses("goal", [np.nan] * 3):
        loop(state.physics.qpos, state.physics.qvel, [np.nan] * 3)
    with refuses("env", "PointMass"):
        RobotLoop(point_mass.PointMass(), policy)


def test_joints_have_the_order_in_which_they_are_named():
    class Swapped(my_arm.Reach):
        control = JointDelta("j3 j1")
        observations = ("qpos:j3 j1",)

    env = Swapped(engine="native")
    state = env.reset(jax.random.key(0))
    third, first = state.physics.qpos[env.model.jnt_qposadr[[env.model.joint(name).id for name in ("j3", "j1")]]]
    assert state.obs["observation"].tolist() == [third, first]
    ctrl = env.controls(state.physics, jnp.float32([0.5, 0])).ctrl - env.controls(state.physics, jnp.zeros(2)).ctrl
    np.testing.assert_allclose(ctrl, [0, 0, 0.05, 0, 0, 0], atol=1e-6)
    assert env.robot_interface["joints"]["qpos:j3 j1"] == env.robot_interface["controls"][0]["moves"] == ["j3", "j1"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Reach", "Push"])
def test_engines_agree_on_the_arm(name):
    """Ten steps from one start under random actions; warp by the path graph."""
    results = {}
    for engine, options in {"native": {}, "jax": {}, "warp": {"allow_cpu": True}}.items():
        env = getattr(my_arm, name)(engine=engine, **options)
        state, step = env.reset(jax.random.key(0)), jax.jit(env.step)
        for action in 0.5 * jax.random.normal(jax.random.key(1), (10, env.action_size)):
            state = step(state, action)
        results[engine] = state.obs["observation"]
    for observation in results.values():
        np.testing.assert_allclose(observation, results["native"], atol=1e-3)


@pytest.mark.parametrize(("name", "size"), [("Reach", 7), ("Push", 7), ("Pick", 8)])
def test_the_arm_of_seven_joints_has_the_published_sizes(name, size):
    """At zero angles the flange is 88 mm in front of the base, and 333 + 316 + 384 - 107 mm high."""
    env = getattr(seven_joints, name)(engine="native")
    assert env.action_size == size
    hand = Place(env.model, "body:hand").position(jnp.zeros(env.model.nq))
    np.testing.assert_allclose(hand, [0.088, 0, 0.926], atol=1e-6)


def test_an_edited_mjcf_changes_the_identity_of_a_run(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "robot_of_test.py").write_text('model = "robot.xml"')
    digests = []
    for files in ({"robot.xml": "a"}, {"robot.xml": "b"}, {"other.xml": "c"}):
        for name, content in files.items():
            (tmp_path / name).write_text(content)
        fingerprint._source.cache_clear()
        digests.append(fingerprint.sources(RunSpec(env="robot_of_test:Reach"))["env"])
    assert digests[0] != digests[1] == digests[2]


def test_an_mjcf_in_another_folder_and_an_included_one_belong_to_the_identity(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "robot_elsewhere_of_test.py").write_text('model = "parts/arm.xml"')
    (tmp_path / "parts" / "more").mkdir(parents=True)
    files = {"arm.xml": '<include file="more/a.xml"/>', "more/a.xml": "<include file='b.xml'/>", "more/b.xml": "", "c.xml": ""}
    digests = []
    for name, content in [*files.items(), ("arm.xml", files["arm.xml"] + " "), ("more/b.xml", "new"), ("c.xml", "new")]:
        (tmp_path / "parts" / name).write_text(content)
        fingerprint._source.cache_clear()
        digests.append(fingerprint.sources(RunSpec(env="robot_elsewhere_of_test:Reach"))["env"])
    assert digests[3] != digests[4] != digests[5] == digests[6]  # the last one is not named


SERVO = """
<mujoco><option gravity="0 0 0"/>
  <worldbody><body><joint name="j" axis="0 0 1" damping="1" range="-90 90"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="1"/></body></worldbody>
  <actuator><general joint="j" gear="2" gainprm="20" biastype="affine" biasprm="4 -40 -2"/></actuator>
  <keyframe><key name="home" qpos="1.0"/></keyframe>
</mujoco>"""


@pytest.mark.parametrize("moves", [JointPosition(), JointDelta("j")])
def test_a_servo_with_any_gain_and_bias_holds_the_start(moves):
    """Its force is 20 u + 4 - 40 (2 q) for the joint at q, so u = 4 q - 0.2."""

    class Turn(MujocoTask):
        model, control, goal, start = SERVO, moves, Joints("j", (-1.0,), (1.0,)), Start("home", settle=10)

    env = Turn(engine="native")
    state = env.reset(jax.random.key(0))
    np.testing.assert_allclose(state.physics.qpos, 1.0, atol=1e-4)
    rest = jnp.asarray(env.rest_action)
    np.testing.assert_allclose(env.controls(state.physics, rest).ctrl, 3.8, atol=1e-4)
    for _ in range(10):
        state = env.step(state, rest)
    np.testing.assert_allclose(state.physics.qpos, 1.0, atol=1e-4)
    if not isinstance(moves, JointDelta):
        np.testing.assert_allclose(env.controls(state.physics, jnp.ones(1)).ctrl, 4 * np.pi / 2 - 0.2, rtol=1e-5)
