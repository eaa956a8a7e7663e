import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import envs
from mjx_dher.envs.arm_kinematics import Chain
from mjx_dher.envs.kinematics import Place, to_quat

FETCH = ("pick_and_place", "push", "reach", "slide")


@pytest.mark.parametrize("name", FETCH)
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
    for name in FETCH:
        env = envs.make(name, engine="native")
        grip, _ = jax.jit(env.arm.site_motion)(jnp.array(env.task.arm_qpos), jnp.array(env.task.arm_qvel))
        np.testing.assert_allclose(grip, env.task.initial_grip_pos, atol=2e-4)


def test_a_batch_is_what_its_rows_are():
    """In batches of any size: XLA on a CPU (JAX 0.10) makes wrong sums, from 512 on, of some ways to write them."""
    env = envs.make("push", engine="native")
    angles, rates = jax.random.normal(jax.random.key(0), (2, 1024, 7))

    def everything(angles, rates):
        return env.arm.pose(angles), env.arm.site_motion(angles, rates)

    together = jax.jit(jax.vmap(everything))(angles, rates)
    few = jax.jit(everything)
    for row in range(0, 1024, 64):
        alone = few(angles[row], rates[row])
        jax.tree.map(lambda x, y, row=row: np.testing.assert_allclose(x[row], y, atol=3e-6), together, alone)


def test_links_with_orientations_of_their_own():
    """The Fetch arm's are all the identity: a chain whose are not, joints in a row and a last body without one."""
    body = '<body pos="{}" quat="{}">{}<geom size=".1"/>'
    hinge = '<joint type="hinge" axis="{}"/>'
    parts = [
        body.format(".1 .2 .3", ".9 .1 -.3 .2", hinge.format("0 1 0")),
        body.format("-.2 .1 .4", "1 0 0 0", ""),
        body.format("0 .3 .1", ".2 .8 .1 -.4", hinge.format("1 2 -1")),
        body.format(".3 0 -.2", ".5 -.5 .6 .1", hinge.format("0 0 1")),
        body.format(".1 .1 .1", ".7 0 .7 .3", "").replace("<body", '<body name="end"') + '<site name="tip" pos=".2 -.1 .3"/>',
    ]
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(parts)}{'</body>' * 5}</worldbody></mujoco>")
    chain, data = Chain(model, body="end", site="tip"), mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0.4, -1.2, 2.0], [1.5, -0.7, 0.3]
    mujoco.mj_forward(model, data)
    pos, quat = chain.pose(jnp.asarray(data.qpos, jnp.float32))
    np.testing.assert_allclose(pos, data.body("end").xpos, atol=1e-6)
    np.testing.assert_allclose(quat, data.body("end").xquat, atol=1e-6)
    site_pos, site_vel = chain.site_motion(jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32))
    twist = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, 0, twist, 0)
    np.testing.assert_allclose(site_pos, data.site("tip").xpos, atol=1e-6)
    np.testing.assert_allclose(site_vel, twist[3:], atol=3e-6)


def test_a_body_that_slides_is_refused():
    env = envs.make("pick_and_place", engine="native")
    with refuses("finger_r", "hinge"):
        Chain(env.model, body="finger_r", site="grip")


# A free body and a chain of two ball joints, slides with a reference, and two hinges of one body beside their anchors.
TREE = """
<mujoco>
  <worldbody>
    <body name="base" pos=".1 .2 .3" euler="20 30 40">
      <joint name="slide" type="slide" axis="1 1 0" ref=".2"/><geom size=".1"/>
      <body name="ball" pos=".3 0 0"><joint type="ball" pos="0 .1 0"/><geom size=".1"/>
        <body name="hinges" pos="0 0 .4" euler="0 10 0">
          <joint axis="0 1 0" pos=".1 0 0" ref="10"/><joint axis="1 0 1" pos="0 .1 .1"/><geom size=".1"/>
          <body name="fixed" pos=".1 0 0" euler="30 0 0"><geom size=".1"/><site name="tip" pos=".1 .2 0" euler="0 0 50"/></body>
        </body>
      </body>
    </body>
    <body name="cube" pos="1 0 0"><freejoint/><geom size=".1"/><site name="corner" pos=".1 .1 .1"/></body>
    <body name="target" mocap="true"><body name="held"/></body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize("name", ["site:tip", "body:fixed", "body:hinges", "body:ball", "site:corner", "cube", "world"])
def test_kinematics_are_mujoco_s_for_every_kind_of_joint(name):
    model = mujoco.MjModel.from_xml_string(TREE)
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    place = Place(model, name)
    pose, motion = jax.jit(place.pose), jax.jit(place.motion)
    for _ in range(3):
        data.qpos[:], data.qvel[:] = rng.normal(size=model.nq), rng.normal(size=model.nv)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        kind, _, rest = place.name.partition(":")
        mine, kind = (
            (data.site(rest), mujoco.mjtObj.mjOBJ_SITE) if kind == "site" else (data.body(rest), mujoco.mjtObj.mjOBJ_XBODY)
        )
        pos, mat = pose(jnp.float32(data.qpos))
        np.testing.assert_allclose(pos, mine.xpos, atol=2e-6)
        np.testing.assert_allclose(mat.ravel(), mine.xmat, atol=2e-6)
        back = np.zeros(9)
        mujoco.mju_quat2Mat(back, np.asarray(to_quat(mat), float))
        np.testing.assert_allclose(back, mine.xmat, atol=2e-6)
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, kind, mine.id, twist, 0)
        linear, angular = motion(jnp.float32(data.qpos), jnp.float32(data.qvel))
        np.testing.assert_allclose(linear, twist[3:], atol=1e-5)
        np.testing.assert_allclose(angular, twist[:3], atol=1e-5)


def test_a_place_that_the_state_does_not_determine_is_rejected():
    model = mujoco.MjModel.from_xml_string(TREE)
    with refuses("held", "target"):
        Place(model, "body:held")
    with refuses("site", "tap", "tip"):
        Place(model, "site:tap")
    with refuses("joint:x", "joint", "site", "body"):
        Place(model, "joint:x")
