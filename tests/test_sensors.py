"""Sensors as observations, against MuJoCo's own."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher.envs.engines import Controls, Physics
from mjx_dher.envs.engines.mjx import MjxEngine
from mjx_dher.envs.robot import RobotLoop
from mjx_dher.envs.task import MujocoTask, Position

PRESS = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <body name="finger" pos="0 0 .4"><joint name="lift" type="slide" axis="0 0 1" range="-.5 .2" damping="5"/>
      <geom type="sphere" size=".05" mass="0.5"/><site name="pad" size=".06"/></body>
    <body name="box" pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
  <actuator><position name="lift" joint="lift" kp="200" kv="20" ctrlrange="-.5 .2"/></actuator>
  <sensor>
    <framepos name="where" objtype="site" objname="pad"/><touch name="touch" site="pad"/><jointpos joint="lift"/>
    <actuatorfrc name="push" actuator="lift"/><accelerometer name="acceleration" site="pad"/>
  </sensor>
</mujoco>"""


class Press(MujocoTask):
    """A finger that presses a box onto the floor."""

    model = PRESS
    goal = Position("body:box", (-0.3, -0.3, 0.1), (0.3, 0.3, 0.1))
    observations = ("qpos:lift", "sensor:touch", "sensor:push where - sensor:push where", "sensor:sensor_2", "sensor:*")


@pytest.mark.parametrize(
    ("engine", "options"),
    [
        ("native", {}),
        pytest.param("jax", {}, marks=pytest.mark.slow),
        pytest.param("warp", {"allow_cpu": True}, marks=pytest.mark.slow),  # the fused kernel
        pytest.param("warp", {"allow_cpu": True, "path": "graph"}, marks=pytest.mark.slow),
    ],
)
def test_sensors_are_those_of_the_present_state(engine, options):
    env = Press(engine=engine, **options)
    data = mujoco.MjData(env.model)

    def expected():
        mujoco.mj_forward(env.model, data)  # mj_step leaves them a timestep behind
        sensors = data.sensordata
        return np.concatenate([data.qpos[:1], sensors[3:4], np.zeros(4), sensors[4:5], sensors])

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))
    np.testing.assert_allclose(state.obs["observation"][1], expected(), atol=1e-5)
    step = jax.jit(jax.vmap(env.step))
    data.ctrl[0] = -0.15 - 0.9 * 0.35
    for _ in range(5):
        state = step(state, jnp.full((2, 1), -0.9))
        mujoco.mj_step(env.model, data, nstep=8)
    assert data.sensordata[3] > 10.0  # N: it touches
    np.testing.assert_allclose(state.obs["observation"][1], expected(), rtol=1e-3, atol=1e-3)
    env.check()


HELD = """
<mujoco>
  <worldbody>
    <body pos="0 0 1"><joint axis="0 1 0"/><geom size=".05" mass="1" pos=".2 0 0"/><site name="end" pos=".4 0 0"/></body>
    <body pos=".4 0 1"><freejoint/><geom size=".05" mass=".5" pos="0 0 -.3"/><site name="top"/><site name="imu" pos="0 0 -.3"/>
    </body>
  </worldbody>
  <equality><connect site1="end" site2="top"/></equality>
  <sensor><accelerometer site="imu"/><gyro site="imu"/><framepos objtype="site" objname="imu"/></sensor>
</mujoco>"""


def test_an_accelerometer_on_a_held_body_is_mujoco_c_s():
    """On `jax`, whose equalities lack a term of the acceleration in MJX."""
    model = mujoco.MjModel.from_xml_string(HELD)
    data = mujoco.MjData(model)
    data.qvel[:] = [3, 0, 0, -1.2, 0, 2, 0]
    mujoco.mj_forward(model, data)
    physics = Physics(*map(jnp.float32, (data.qpos, data.qvel, np.zeros(model.nv), np.zeros(0))))
    controls = Controls(ctrl=jnp.zeros(0), mocap=jnp.zeros((0, 7)))
    found = jax.jit(MjxEngine(model, 1, iterations=50, sensors=True).read_sensors)(physics, controls)
    np.testing.assert_allclose(found, data.sensordata, atol=1e-3)
    assert abs(data.sensordata[0]) > 0.03  # m/s^2: 0 without the term


def test_a_robots_loop_takes_sensors():
    env = Press(engine="native")
    loop = RobotLoop(env, lambda obs: obs["observation"][1:2] / 100)  # the touch
    sensors, zeros = np.zeros(env.model.nsensordata), (np.float32(env.model.qpos0), np.zeros(env.model.nv), np.zeros(3))
    sensors[3] = 50.0
    assert loop(*zeros, sensors).ctrl[0] == pytest.approx(-0.15 + 0.5 * 0.35)
    with refuses("sensors", "None"):
        loop(*zeros)
    assert env.robot_interface["sensors"]["sensor:push where - sensor:push where"] == ["push", "where"]


def test_a_robots_loop_takes_the_sensor_of_a_difference():
    class Apart(Press):
        observations = ("site:pad - sensor:where", "qpos:lift")

    env = Apart(engine="native")
    loop = RobotLoop(env, lambda obs: obs["observation"][2:3])  # heights: of the pad, minus the sensor's
    sensors, zeros = np.zeros(env.model.nsensordata), (np.float32(env.model.qpos0), np.zeros(env.model.nv), np.zeros(3))
    sensors[2] = 0.1
    assert loop(*zeros, sensors).ctrl[0] == pytest.approx(-0.15 + 0.3 * 0.35)
    assert env.robot_interface["sensors"] == {"site:pad - sensor:where": ["where"]}
    assert env.robot_interface["joints"] == {"qpos:lift": ["lift"]}


def test_a_sensor_that_is_missing_is_named():
    with refuses("sensor", "'tuoch'", "touch"):
        type("Wrong", (Press,), {"observations": ("sensor:tuoch",)})(engine="native")


@pytest.mark.parametrize(("geom", "asset"), [("box", ""), ("cylinder", '<asset><material name="m"/></asset>')])
def test_mjx_has_no_rays_that_hit_cylinders_or_need_a_material(geom, asset):
    """They would pass through the cylinder. Without a material, reading them is a TypeError."""
    far = f'{asset}<sensor><rangefinder name="far" site="pad"/>'
    model = PRESS.replace('type="box"', f'type="{geom}"').replace("<sensor>", far)
    with refuses("jax", "rangefinders", "cylinders", "material", "native"):
        type("Far", (Press,), {"model": model, "observations": ("sensor:far",)})(engine="jax")
