"""JaxGCRL's arm tasks: what they compute, by hand and by MuJoCo, and what the missing marker of the goal changes."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial import cKDTree

from mjx_dher import envs
from mjx_dher.envs import arms
from mjx_dher.envs.robot import RobotLoop

MARKER = '<body name="marker" pos="-0.3 0.6 0.07" gravcomp="1"><freejoint/><geom type="box" size=".03 .03 .03"/></body>'


@pytest.fixture(scope="module")
def push():
    return envs.make("arm_push_easy", engine="native")


def test_a_simulated_marker_of_the_goal_changes_nothing(push):
    """JaxGCRL simulates one, without contacts and gravity; it must not move the arm or the cube."""
    text = arms.ArmPushEasy.model
    key = text.index("<keyframe>")
    texts = text, text[:key].replace("</worldbody>", f"{MARKER}</worldbody>") + "</mujoco>"
    models = [mujoco.MjModel.from_xml_string(text) for text in texts]
    plain, marked = (mujoco.MjData(model) for model in models)
    assert models[1].nv == models[0].nv + 6
    rng, nq, touched = np.random.default_rng(0), models[0].nq, 0
    plain.qpos[:] = marked.qpos[:nq] = models[0].key_qpos[0]
    controls = jax.jit(lambda action: push.controls(jax.tree.map(jnp.asarray, push._rest), action).ctrl)
    for _ in range(30):
        ctrl = controls(rng.uniform(-1, 1, 5).astype(np.float32))
        for model, data in zip(models, (plain, marked)):
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data, nstep=25)
        touched += plain.ncon
        np.testing.assert_allclose(marked.qpos[:nq], plain.qpos, atol=1e-6)
    assert touched > 30
    np.testing.assert_allclose(marked.qpos[nq : nq + 3], [-0.3, 0.6, 0.07], atol=1e-9)


def test_actions_are_targets_of_four_joints_and_the_gripper(push):
    start = jax.tree.map(jnp.asarray, push._rest)
    for action, joints, fingers in (
        (-1.0, [0.3491, 0.0, 0, -3.0718, 0, 2.3562, 1.4487], 255.0),
        (1.0, [2.7925, 1.48353, 0, -0.0698, 0, 3.7525, 1.4487], 0.0),
    ):
        controls = push.controls(start, jnp.full(5, action))
        np.testing.assert_allclose(controls.ctrl, [*joints, fingers, fingers], rtol=1e-5)


def test_the_arm_at_rest_is_near_half_of_the_goals_of_arm_reach():
    """Some servos' gain is below their stiffness, as in JaxGCRL: they rest at gain / stiffness of their targets."""
    env, rng = envs.make("arm_reach", engine="native"), np.random.default_rng(0)
    share = env.model.actuator_gainprm[:, 0] / -env.model.actuator_biasprm[:, 1]
    np.testing.assert_allclose(share[[0, 1, 3, 5]], [1, 1, 4 / 7, 1 / 2])
    start, actions = jax.tree.map(jnp.asarray, env._rest), rng.uniform(-1, 1, (40_000, 4)).astype(np.float32)
    inputs = np.asarray(jax.jit(jax.vmap(lambda action: env.controls(start, action).ctrl))(actions))
    data, ends = mujoco.MjData(env.model), []
    for ctrl in inputs:
        data.qpos[:] = share * ctrl
        mujoco.mj_kinematics(env.model, data)
        ends.append(data.body("link7").xpos.copy())
    goals = rng.uniform(env.goal.low, env.goal.high, (2_000, 3))
    near = (cKDTree(ends).query(goals)[0] < env.goal.threshold).mean()
    assert abs(near - 0.5) < 0.03
    assert f"of {near:.1f} of the goals" in (ROOT / "docs" / "environments.md").read_text()


@pytest.mark.parametrize(
    ("name", "dofs", "scale"),
    [("arm_push_easy", range(6, 13), 0.1 / 19), pytest.param("arm_grasp", (13, 14), 0.05, marks=pytest.mark.slow)],
)
def test_the_last_observations_are_the_fingers_distance_and_the_servos_forces(name, dofs, scale):
    env = envs.make(name, engine="native")
    action = jnp.array([0.2, -0.4, 0.3, 0.8, 1.0])

    @jax.jit
    def play(key):
        first = env.reset(key)
        return first, env.controls(first.physics, action).ctrl, env.step(first, action)

    first, ctrl, state = play(jax.random.key(3))
    data = mujoco.MjData(env.model)
    for each, inputs in ((first, np.zeros(9)), (state, ctrl)):  # no input has been given at the start
        data.qpos[:], data.qvel[:], data.ctrl[:] = each.physics.qpos, each.physics.qvel, inputs
        mujoco.mj_forward(env.model, data)
        force = scale * data.qfrc_actuator[list(dofs)].sum()
        ends = [
            data.body(f"{side}_finger").xpos if name == "arm_push_easy" else data.site(f"{side}_tip").xpos
            for side in ("left", "right")
        ]
        np.testing.assert_allclose(
            each.obs["observation"][-2:], [np.linalg.norm(ends[0] - ends[1]), force], rtol=1e-3, atol=1e-3
        )
    assert env.layout["force"] == slice(env.observation_size - 1, env.observation_size)


def test_the_cube_is_gripped_if_the_fingertips_are_around_it():
    goal = arms.Gripped()
    wanted = np.asarray(goal.wanted, np.float32)
    shifted, apart, wide = wanted.copy(), wanted.copy(), wanted.copy()
    shifted[[1, 4]] += 0.04  # both tips by 4 cm: so is their middle
    apart[[0, 3]] += [0.03, -0.03]  # away from each other: the middle stays
    wide[6] += 0.03
    distances = jax.jit(goal.distance)(np.stack([wanted, shifted, apart, wide]), wanted)
    np.testing.assert_allclose(distances, [0.0, 0.8, 0.0, 1.5], atol=1e-6)


def test_the_arm_moves_as_in_jaxgcrl():
    """One action from the start; MJX's numbers, of JaxGCRL's model and settings (JaxGCRL 0.2.8, Brax 0.14.2, MuJoCo 3.17.0)."""
    env = envs.make("arm_reach", engine="native")
    state = jax.jit(env.step)(jax.jit(env.reset)(jax.random.key(0)), jnp.array([0.5, -0.5, 0.3, 0.2]))
    expected = [1.6079, 0.746, -0.0046, -1.503, 0.0004, 3.0013, 1.4116]
    np.testing.assert_allclose(state.physics.qpos, expected, atol=1e-4)
    np.testing.assert_allclose(state.physics.qvel, [1.3563, 0.1707, -0.0732, 2.627, 0.0069, -2.0323, -1.4378], atol=1e-3)


def test_a_robots_loop_takes_the_force(push):
    observations = []
    loop = RobotLoop(push, lambda obs: np.tanh(observations.append(obs["observation"]) or obs["observation"][:5]))
    state = jax.jit(push.reset)(jax.random.key(0))
    state = jax.jit(push.step)(state, jnp.ones(5))
    sent = loop(state.physics.qpos, state.physics.qvel, state.obs["desired_goal"], state.physics.sensors)
    np.testing.assert_allclose(observations[-1], state.obs["observation"], atol=1e-6)
    expected = push.controls(state.physics, jnp.tanh(state.obs["observation"][:5]))
    np.testing.assert_allclose(sent.ctrl, expected.ctrl, atol=1e-5)
