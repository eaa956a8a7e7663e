"""Physics that engines once got wrong in silence: tendons across branches, connects, slippery contacts, odd actions."""

import re
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses
from mujoco import mjx
from mujoco.mjx._src import derivative

from mjx_dher import envs
from mjx_dher.envs import Simulator
from mjx_dher.envs.engines import Controls, Physics, corrections, make_engine

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


def test_a_tendon_damps_across_branches_as_in_mujoco_c():
    """By its own damping, and by a velocity actuator on it."""
    actuator = '<actuator><velocity tendon="t" kv="30"/></actuator>'
    model = mujoco.MjModel.from_xml_string(BRANCHES.format(damping=' damping="50"', actuator=actuator))
    start = [1.0, 0.5, 0.0]
    np.testing.assert_allclose(played("jax", model, start, 1), played("native", model, start, 1), atol=1e-5)


SLIDES = """<body pos="0.3 0.2 0.1"><joint name="a" type="slide" axis="1 0 0"/><joint name="b" type="slide" axis="0 1 0"/>{}
<geom size="0.1" mass="1" contype="0"/><site name="s" pos="0.05 0.3 0.1"/></body>"""
COUPLED = {  # bodies, and the entries of the mass matrix that their joints share
    SLIDES.format(""): 2,  # diagonal
    SLIDES.format('<body pos="0 0 1"><joint axis="0 1 0"/><geom size="0.1" mass="1" contype="0"/></body>'): 9,
    re.sub("<joint.*/>", "<freejoint/>", SLIDES).format(""): 36,
    re.sub("<joint.*/>", '<joint type="ball"/>', SLIDES).format(""): 3,
    re.sub("<joint.*/>", '<joint type="ball"/>', SLIDES).format("").replace("<geom", '<geom pos="0.1 0.05 0"'): 9,
}
SPINS = re.sub("<joint.*/>", "<freejoint/>", SLIDES).format("").replace('size="0.1"', 'type="box" size="0.1 0.2 0.3"')


def test_a_damped_tendon_couples_the_joints_of_one_body_as_in_mujoco_c():
    """Each of several bodies has its own tendon. The last one spins."""
    bodies = [re.sub(r'name="(\w)"', rf'name="\g<1>{number}"', body) for number, body in enumerate((*COUPLED, SPINS))]
    tendon = '<spatial damping="50"><site site="w"/><site site="s{}"/></spatial>'
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/><worldbody>
<site name="w" pos="0.3 0.1 1"/>{"".join(bodies)}</worldbody>
<tendon>{"".join(map(tendon.format, range(len(bodies))))}</tendon></mujoco>""")
    places = [np.flatnonzero(model.body_rootid[model.dof_bodyid] == root) for root in np.unique(model.body_rootid[1:])]
    common = corrections.in_common(model)
    assert [common[np.ix_(own, own)].sum() for own in places] == [*COUPLED.values(), 36]
    assert common.sum() == sum(COUPLED.values()) + 36
    start = np.concatenate([np.resize([1.0, 0.5, -0.3], len(own)) * (np.arange(len(own)) < 3) for own in places[:-1]])
    start = np.concatenate([start, [1.0, 0.5, 0.3, 3.0, 1.4, 0.2]])
    np.testing.assert_allclose(played("jax", model, start, 1), played("native", model, start, 1), atol=1e-5)


def test_programs_that_are_traced_at_once_have_their_own_derivatives(monkeypatch):
    chain = re.sub(r"</body>\n(<body pos=\"0 1 0\">.*)</body></worldbody>", r"\1</body></body></worldbody>", BRANCHES)
    models = [mujoco.MjModel.from_xml_string(xml.format(damping=' damping="50"', actuator="")) for xml in (BRANCHES, chain)]
    both, implicit, before = threading.Barrier(2), mjx.implicit, derivative.deriv_smooth_vel
    monkeypatch.setattr(mjx, "implicit", lambda *args: both.wait(60) >= 0 and implicit(*args))
    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(lambda model: played("jax", model, [1.0, 0.5, 0.0], 1), models))
    for model, part in zip(models, parts):
        np.testing.assert_allclose(part, played("native", model, [1.0, 0.5, 0.0], 1), atol=1e-5)
    assert derivative.deriv_smooth_vel is before


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


@pytest.mark.parametrize("impratio", [100.0, 0.25])
def test_a_pyramid_is_as_steep_as_friction_over_the_root_of_impratio(impratio):
    least, steep = 0.01 * np.sqrt(impratio), BALL.replace('cone="{}"', f'cone="{{}}" impratio="{impratio}"')
    with refuses(f"sliding friction below {least:g} with the pyramidal cone and impratio {impratio:g}", "ball"):
        make_engine("jax", mujoco.MjModel.from_xml_string(steep.format("pyramidal", 0.9 * least, 3)), 1)
    make_engine("jax", mujoco.MjModel.from_xml_string(steep.format("pyramidal", least, 3)), 1)
    with refuses("sliding friction below 0.001 with the elliptic cone "):
        make_engine("jax", mujoco.MjModel.from_xml_string(steep.format("elliptic", 0.0009, 3)), 1)


def test_rounding_of_friction_and_contacts_without_forces_are_not_refused():
    for friction, flag in ((0.00999999, ""), (0.0, '<flag constraint="disable"/>')):
        xml = BALL.format("pyramidal", friction, 3).replace('"/><world', f'">{flag}</option><world')
        make_engine("jax", mujoco.MjModel.from_xml_string(xml), 1)


def test_varied_friction_stays_where_an_engine_computes_it():
    with refuses("varied", "engine jax", "sliding friction below 0.01", "object", "native"):
        envs.make("slide", engine="jax", varied="friction:object=0.05-1")
    envs.make("slide", engine="jax", varied="friction:object=0.1-1")
    pytest.importorskip("warp")
    for lowest, cure in ((0.3, '; use path="graph" or engine native'), (0.05, "; use engine native")):
        with refuses("engine warp does", "friction below 0.04", cure):
            envs.make("slide", engine="warp", allow_cpu=True, varied={"friction:object": (lowest, 1)})
    envs.make("slide", engine="native", varied="friction:object=0.05-1")


def test_an_arms_observed_force_follows_its_varied_gain():
    env = envs.make("arm_push_easy", engine="native", varied={"gain:joint*": (2.0, 2.0)})
    action = jnp.array([0.5, 0.2, -0.3, 0.4, 1.0])
    before = jax.jit(env.reset)(jax.random.key(0))
    physics = (after := jax.jit(env.step)(before, action)).physics
    simulator = Simulator(env.model, derived=["actuator_force"], varied=["gain:joint*"])
    ctrl = jax.jit(env.controls)(before.physics, action).ctrl
    state = {"qpos": physics.qpos, "qvel": physics.qvel, "ctrl": ctrl, "factors": physics.factors}
    forces = jax.jit(lambda state: simulator.forward(simulator.make_data().replace(**state)).derived["actuator_force"])
    true = env.scale * np.asarray(forces(state))[env.forces].sum()
    assert abs(true) > 0.01
    np.testing.assert_allclose(after.obs["observation"][env.layout["force"]], [true], atol=1e-4)


@pytest.mark.parametrize("arguments", [{}, {"frame_stack": 2}, {"action_filter": 0.5}, {"action_delay": 1}])
def test_an_action_that_is_not_finite_fails(arguments):
    env = envs.make("reach", engine="native", **arguments)
    step, first = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
    for value, fails in ((np.inf, True), (-np.inf, True), (np.nan, True), (9.0, False)):
        state = step(first, jnp.zeros(4).at[1].set(value))
        if "action_delay" in arguments:
            state = step(state, jnp.zeros(4))
        assert bool(getattr(state, "inner", state).failed) == fails


@pytest.mark.parametrize(("child", "refused"), [("", True), ('<body pos="0 0 1">{}</body>', False)])
def test_inertia_of_a_tendon_is_taken_between_joints_with_common_inertia_alone(child, refused):
    """Two slides of one body share none in MuJoCo C. On a body and its child they do."""
    second, geom = '<joint name="b" type="slide" axis="1 1 0" stiffness="50"/>', '<geom size="0.1" mass="1" contype="0"/>'
    inner = geom + child.format(second + geom) if child else second.replace("1 1 0", "0 1 0") + geom
    xml = f"""<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="a" type="slide" axis="1 0 0"/>{inner}</body>
</worldbody><tendon><fixed name="t" armature="2"><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>
</mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    if refused:
        with refuses("armature of tendons", "'t'"):
            make_engine("jax", model, 1)
    else:
        np.testing.assert_allclose(played("jax", model, [1.0, 0.5], 1), played("native", model, [1.0, 0.5], 1), atol=1e-4)
