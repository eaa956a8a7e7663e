"""Physics that engines once got wrong in silence: tendons across branches, connects, slippery contacts, odd actions."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import envs
from mjx_dher.envs import Simulator
from mjx_dher.envs.engines import Controls, Physics, make_engine

# Two sliders that a tendon damps, and on the first a third one, which another tendon damps with its parent.
BRANCHES = """
<mujoco><option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/><worldbody>
<body><joint name="a" type="slide" axis="1 0 0"/><geom size="0.1" mass="1" contype="0"/>
  <body pos="0 0 1"><joint name="c" type="slide" axis="1 0 0"/><geom size="0.1" mass="1" contype="0"/></body></body>
<body pos="0 1 0"><joint name="b" type="slide" axis="1 0 0"/><geom size="0.1" mass="1" contype="0"/></body></worldbody>
<tendon><fixed name="t"{damping}><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed>
<fixed damping="7"><joint joint="a" coef="1"/><joint joint="c" coef="2"/></fixed></tendon>{actuator}</mujoco>"""
CONNECT = """
<mujoco><worldbody><body name="a"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" contype="0"/>
<body name="b" pos="0.4 0 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" contype="0"/>
</body></body></worldbody><equality><connect body1="b" anchor="0.4 0 0"/></equality></mujoco>"""
BALL = """
<mujoco><option cone="{}"/><worldbody><geom type="plane" size="1 1 0.1" friction="0" condim="1"/>
<body pos="0 0 0.1"><freejoint/><geom name="ball" size="0.1" friction="{}" condim="{}"/></body></worldbody></mujoco>"""


def played(engine, model, qvel, calls, **options):
    physics = Physics(jnp.asarray(model.qpos0, jnp.float32), jnp.asarray(qvel, jnp.float32), jnp.zeros(model.nv), jnp.zeros(0))
    advance = jax.jit(make_engine(engine, model, 10, **options).advance)
    for _ in range(calls):
        physics = advance(physics, Controls(jnp.zeros(model.nu), jnp.zeros((0, 7))))
    return np.concatenate([physics.qpos, physics.qvel])


@pytest.mark.parametrize(
    ("damping", "actuator"),
    [(' damping="50"', ""), ("", '<actuator><velocity tendon="t" kv="50"/></actuator>')],
)
def test_a_tendon_damps_across_branches_as_in_mujoco_c(damping, actuator):
    model = mujoco.MjModel.from_xml_string(BRANCHES.format(damping=damping, actuator=actuator))
    start = [1.0, 0.5, 0.0]
    np.testing.assert_allclose(played("jax", model, start, 1), played("native", model, start, 1), atol=1e-5)


def test_a_connect_has_the_speed_of_its_own_timestep():
    pytest.importorskip("warp")
    model = mujoco.MjModel.from_xml_string(CONNECT)
    graph = played("warp", model, [3.0, -6.0], 2, path="graph", allow_cpu=True)
    np.testing.assert_allclose(graph, played("native", model, [3.0, -6.0], 2), atol=1e-4)


@pytest.mark.parametrize(
    ("engine", "path", "cone", "friction", "least"),
    [
        ("jax", None, "pyramidal", 0.005, "0.01"),
        ("jax", None, "elliptic", 0.0, "0.001"),
        ("warp", "fused", "pyramidal", 0.03, "0.04"),
        ("warp", "graph", "pyramidal", 0.005, "0.01"),
    ],
)
def test_contacts_that_slide_too_easily_are_refused(engine, path, cone, friction, least):
    options = {} if path is None else {"path": path, "allow_cpu": True}
    if path:
        pytest.importorskip("warp")
    model = mujoco.MjModel.from_xml_string(BALL.format(cone, friction, 3))
    with refuses(engine, f"sliding friction below {least}", cone, "ball"):
        make_engine(engine, model, 1, **options)
    make_engine(engine, mujoco.MjModel.from_xml_string(BALL.format(cone, float(least), 3)), 1, **options)
    if cone == "pyramidal":  # else MJX lacks it
        make_engine(engine, mujoco.MjModel.from_xml_string(BALL.format(cone, friction, 1)), 1, **options)  # has no friction


def test_varied_friction_stays_where_an_engine_computes_it():
    with refuses("varied", "engine jax", "sliding friction below 0.01", "object", "native"):
        envs.make("slide", engine="jax", varied="friction:object=0.05-1")
    envs.make("slide", engine="jax", varied="friction:object=0.1-1")
    envs.make("slide", engine="native", varied="friction:object=0.05-1")


def test_an_arms_observed_force_follows_its_varied_gain():
    env = envs.make("arm_push_easy", engine="native", varied={"gain:joint*": (2.0, 2.0)})
    action = jnp.array([0.5, 0.2, -0.3, 0.4, 1.0])
    before = env.reset(jax.random.key(0))
    physics = (after := env.step(before, action)).physics
    simulator = Simulator(env.model, derived=["actuator_force"], varied=["gain:joint*"])
    ctrl = env.controls(before.physics, action).ctrl
    data = simulator.make_data().replace(qpos=physics.qpos, qvel=physics.qvel, ctrl=ctrl, factors=physics.factors)
    true = env.scale * simulator.forward(data).derived["actuator_force"][env.forces].sum()
    assert abs(true) > 0.01
    np.testing.assert_allclose(after.obs["observation"][env.layout["force"]], [true], atol=1e-4)


@pytest.mark.parametrize("arguments", [{}, {"frame_stack": 2}])
@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_an_action_that_is_not_finite_fails(arguments, value):
    env = envs.make("reach", engine="native", **arguments)
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), jnp.zeros(4).at[1].set(value))
    assert bool(getattr(state, "inner", state).failed)
    assert not bool(getattr(fine := jax.jit(env.step)(env.reset(jax.random.key(0)), jnp.full(4, 9.0)), "inner", fine).failed)
