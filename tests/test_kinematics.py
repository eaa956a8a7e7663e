import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_dher import envs
from mjx_dher.envs.kinematics import Chain


@pytest.mark.parametrize("name", envs.list_envs())
def test_pose_and_motion_are_mujoco_s(name):
    """At random joint angles and rates, against mj_forward and mj_objectVelocity."""
    env = envs.make(name, engine="native")
    data, rng = mujoco.MjData(env.model), np.random.default_rng(0)
    for _ in range(5):
        angles, rates = rng.uniform(-2, 2, (2, 7)).astype(np.float32)
        data.qpos[env.arm.qpos], data.qvel[:] = angles, 0
        data.qvel[env.arm.qvel] = rates
        mujoco.mj_forward(env.model, data)
        pos, quat = env.arm.pose(jnp.asarray(angles))
        np.testing.assert_allclose(pos, data.body("gripper").xpos, atol=2e-6)
        np.testing.assert_allclose(quat, data.body("gripper").xquat, atol=2e-6)
        site_pos, site_vel = env.arm.site_motion(jnp.asarray(angles), jnp.asarray(rates))
        np.testing.assert_allclose(site_pos, data.site("grip").xpos, atol=2e-6)
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_SITE, data.site("grip").id, twist, 0)
        np.testing.assert_allclose(site_vel, twist[3:], atol=2e-5)


def test_the_settled_arm_holds_the_gripper_where_the_task_says():
    for name in envs.list_envs():
        env = envs.make(name, engine="native")
        grip, _ = jax.jit(env.arm.site_motion)(jnp.array(env.task.arm_qpos), jnp.array(env.task.arm_qvel))
        np.testing.assert_allclose(grip, env.task.initial_grip_pos, atol=2e-4)


def test_a_body_that_slides_is_refused():
    env = envs.make("pick_and_place", engine="native")
    with pytest.raises(ValueError, match="body 'finger_r' must have one hinge"):
        Chain(env.model, body="finger_r", site="grip")
