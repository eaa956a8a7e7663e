"""Timesteps of the engine jax on random models, against MuJoCo C: servos, force limits, damping and free bodies."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses
from mujoco import mjx

from mjx_dher.envs.engines import Controls, Physics, make_engine
from mjx_dher.envs.engines.corrections import Equality, equalities_of, gyroscopic

NUM = 64
BOX = '<geom type="box" size=".1 .2 .3" pos="{}" contype="0"/>'
FREE = f"""
<body pos="0 0 1"><freejoint/>{BOX.format("0 0 0")}</body>
<body pos="0 0 2"><joint type="free" damping="0.3" armature="0.2"/>{BOX.format("0.1 -0.2 0.05")}
  <body pos="0 0.1 0" quat="1 2 3 4">{BOX.format("0 0.2 0.1")}</body></body>
<body pos="0 0 3"><freejoint/>{BOX.format("0.1 0 0")}
  <body><joint axis="0 1 1" damping="0.1"/>{BOX.format("0.1 0 0")}</body></body>"""


def servos(seed, integrator):
    """Six arms of one or two joints with actuators of all kinds, and three free bodies: with parts, and with a joint."""
    rng = np.random.default_rng(seed)

    def some(name, *values):
        return f'{name}="{" ".join(f"{value:.2f}" for value in values)}"' if rng.random() < 0.5 else ""

    arms, actuators = "", ""
    for arm in range(6):
        for link in range(1 + arm % 2):
            name, gain, kv = f"j{arm}{link}", *rng.uniform(0, 5, 2)
            joint = f"{some('damping', rng.uniform(0, 2))} {some('actuatorfrcrange', -2, 3)}"
            arms += f'<body pos="0.1 0 0.2"><joint name="{name}" axis="0 1 0.2" {joint}/>{BOX.format("0.1 0 0.05")}'
            limits = f"{some('forcerange', -rng.uniform(0, 3), 2)} {some('ctrlrange', 0, 0.7)}"
            affine = f'gaintype="affine" gainprm="3 1 -{gain}" biastype="affine" biasprm="0 -1 -1"'
            actuators += rng.choice(
                [
                    f'<position joint="{name}" kp="20" kv="{kv}" gear="{rng.uniform(-2, 2)}" {limits}/>',
                    f'<velocity joint="{name}" kv="{kv}" {limits}/>',
                    f'<damper joint="{name}" kv="{kv}" ctrlrange="0 1"/>',
                    f'<general joint="{name}" {affine} {limits}/>',
                    f'<general joint="{name}" dyntype="filter" dynprm="0.1" {affine} {limits}/>',
                ]
            )
        arms += "</body>" * (1 + arm % 2)
    bodies = f'<option integrator="{integrator}"/><worldbody>{FREE}{arms}</worldbody>'
    return mujoco.MjModel.from_xml_string(f"<mujoco>{bodies}<actuator>{actuators}</actuator></mujoco>")


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "integrator"), [(0, "Euler"), (1, "implicitfast"), (2, "implicitfast"), (3, "implicitfast")])
def test_a_timestep_of_random_servos_and_free_bodies_is_mujoco_c_s(seed, integrator):
    model, rng = servos(seed, integrator), np.random.default_rng(seed)
    qpos, qvel = np.tile(model.qpos0, (NUM, 1)), 3 * rng.normal(size=(NUM, model.nv))
    for joint, at in enumerate(model.jnt_qposadr):
        if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE):
            quat = rng.normal(size=(NUM, 4))
            qpos[:, at + 3 : at + 7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        else:
            qpos[:, at] = rng.normal(size=NUM)
    act, ctrl = rng.uniform(0, 1, (NUM, model.na)), rng.uniform(0, 1, (NUM, model.nu))
    qpos, qvel, act, ctrl = (x.astype(np.float32) for x in (qpos, qvel, act, ctrl))
    advance = jax.jit(jax.vmap(make_engine("jax", model, 1).advance))
    here = advance(Physics(qpos, qvel, np.zeros_like(qvel), act), Controls(ctrl, jnp.zeros((NUM, 0, 7))))
    data, at_limit = mujoco.MjData(model), 0
    for i in range(NUM):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = qpos[i], qvel[i], act[i], ctrl[i]
        mujoco.mj_step(model, data)
        at_limit += np.count_nonzero(model.actuator_forcelimited & np.isin(data.actuator_force, model.actuator_forcerange))
        changed = np.abs(data.qvel - qvel[i])
        assert np.all(np.abs(here.qvel[i] - data.qvel) <= 2e-6 + 2e-5 * changed)
        np.testing.assert_allclose(here.qpos[i], data.qpos, atol=1e-6)
        np.testing.assert_allclose(here.act[i], data.act, atol=1e-6)
    assert at_limit > NUM / 2


def held_together(*equalities):
    """Five bodies in two trees, sites on two of them, and a mocap body."""
    return f"""
<mujoco><worldbody><body name="hand" mocap="true" pos="0.6 0.1 1"/>
<body name="a" pos="0 0 1"><joint axis="0 1 0.3"/>{BOX.format("0 0 0")}
  <body name="b" pos="0.3 0 0"><joint type="ball"/>{BOX.format("0 0.1 0")}
    <site name="s" pos="0.1 0.05 0" euler="10 20 30"/></body></body>
<body name="c" pos="0.6 0 1"><freejoint/>{BOX.format("0 0 0")}
  <body name="d" pos="0 0.3 0"><joint axis="0 0 1"/>{BOX.format("0.1 0 0")}</body>
  <body name="e" pos="0 -0.3 0">{BOX.format("0 0 0")}<site name="t" pos="0 0 0.1" euler="50 0 10"/></body></body></worldbody>
<equality>{"".join(equalities)}</equality></mujoco>"""


CONNECTED = (
    '<connect body1="b" body2="c" anchor="0.1 0.05 0"/><connect body1="d" anchor="0 0 0.1"/>',
    '<connect body1="e" body2="a" anchor="0 0 0.1"/>',
)
CONNECTED_SITES = ('<connect site1="s" site2="t"/>',)
WELDED = (
    '<weld body1="b" body2="c" relpose="0.1 0 0 0.9 0.1 0 0.2" anchor="0.01 0.02 0" torquescale="0.3"/>',
    '<weld body1="d"/><weld body1="hand" body2="e" relpose="0.1 0 0 0.9 0.1 0 0"/>',
)
WELDED_SITES = ('<weld site1="s" site2="t" torquescale="2"/>',)


@pytest.mark.slow
@pytest.mark.parametrize("equalities", [CONNECTED, CONNECTED_SITES, WELDED[:1], WELDED[1:], WELDED_SITES])
def test_a_timestep_of_bodies_held_together_is_mujoco_c_s(equalities):
    """Bodies of two trees, a body and the world, a part of a free body, and a mocap body."""
    model, rng = mujoco.MjModel.from_xml_string(held_together(*equalities)), np.random.default_rng(0)
    qpos, qvel = np.tile(model.qpos0, (NUM, 1)).astype(np.float32), (2 * rng.normal(size=(NUM, model.nv))).astype(np.float32)
    advance = jax.jit(jax.vmap(make_engine("jax", model, 1, iterations=20, ls_iterations=20).advance))
    data = mujoco.MjData(model)
    mocap = np.tile(np.concatenate([data.mocap_pos, data.mocap_quat], axis=1).astype(np.float32), (NUM, 1, 1))
    given = Controls(jnp.zeros((NUM, 0)), jnp.asarray(mocap))
    here = advance(Physics(qpos, qvel, np.zeros_like(qvel), np.zeros((NUM, 0), np.float32)), given)
    for i in range(NUM):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(here.qvel[i], data.qvel, atol=5e-4)  # 0.2 without the velocity term


def test_velocity_terms_of_connects_and_welds_are_mujoco_c_s():
    """MuJoCo C's aref is -b J qvel - k d r - J' qvel."""
    text = held_together(
        *CONNECTED_SITES, *WELDED, *WELDED_SITES, *CONNECTED, '<connect body1="a" anchor="0 0 0" active="false"/>'
    )
    model, rng = mujoco.MjModel.from_xml_string(text), np.random.default_rng(0)
    data = mujoco.MjData(model)
    data.qvel[:] = 2 * rng.normal(size=model.nv)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 0.1)
    mujoco.mj_forward(model, data)
    stiffness, damping, impedance = data.efc_KBIP[:, :3].T
    biases = -data.efc_aref - damping * data.efc_vel - stiffness * impedance * data.efc_pos
    rows, here = equalities_of(model), mjx.put_data(model, data, impl="jax")
    order = [
        *np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_CONNECT),
        *np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_WELD),
    ]
    for index, row in zip(order, rows, strict=True):
        if model.eq_active0[index]:
            there = biases[data.efc_id[: data.ne] == index]
            assert isinstance(row, Equality)
            assert np.abs(there).max() > 0.1
            np.testing.assert_allclose(jax.jit(row.bias)(here), there, rtol=1e-4, atol=1e-4)
        else:
            assert row == 3


def test_rk4_without_velocity_terms_is_reported():
    rk4 = held_together(*WELDED).replace("<worldbody>", '<option integrator="RK4"/><worldbody>')
    with pytest.warns(UserWarning, match="velocity term.*RK4"):
        assert equalities_of(mujoco.MjModel.from_xml_string(rk4)) == []


def test_free_bodies_are_implicit_in_gyroscopic_forces_as_in_mujoco_c():
    """Without other forces, one timestep of bodies with and without a part, off their centres of mass."""
    for body, damping in enumerate((0.0, 0.3)):
        text = f'<mujoco><option integrator="{{}}" gravity="0 0 0"/><worldbody>{FREE}</worldbody></mujoco>'
        model, explicit = (mujoco.MjModel.from_xml_string(text.format(name)) for name in ("implicitfast", "Euler"))
        qvel, dofs = np.random.default_rng(0).normal(size=model.nv) * 10, slice(6 * body, 6 * body + 6)
        data, before = mujoco.MjData(model), mujoco.MjData(explicit)
        data.qvel[:] = before.qvel[:] = qvel
        mujoco.mj_step(model, data)
        mujoco.mj_forward(explicit, before)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(explicit, before, mass)
        block, frame, force = mass[dofs, dofs], before.xmat[1 + body].reshape(3, 3), before.qfrc_smooth[dofs]
        numbers = (-damping * np.eye(6), model.dof_armature[dofs], frame, qvel[dofs][3:], force)
        shift = gyroscopic(model.opt.timestep, *map(jnp.asarray, (block, *numbers)))
        implicit = block + model.opt.timestep * damping * np.eye(6)
        moved = qvel[dofs] + model.opt.timestep * np.linalg.solve(implicit, force + shift)
        assert np.abs(np.linalg.solve(implicit, shift)).max() > 0.01
        np.testing.assert_allclose(data.qvel[dofs], moved, rtol=1e-6, atol=1e-5)


RADIAN = '<mujoco><compiler angle="radian"/>'
NARROW = '<body><joint name="n" range="-.1 .1" limited="true" margin="{}"/><geom size="1"/></body>'


def test_what_only_mujoco_c_computes_is_rejected():
    for option, body, named in (
        ('integrator="discrete"', NARROW.format(0), "an integrator other than Euler, implicitfast and RK4"),
        ("", NARROW.format(0.15), "limits nearer to each other than twice their margin ('n')"),
    ):
        model = mujoco.MjModel.from_xml_string(f"{RADIAN}<option {option}/><worldbody>{body}</worldbody></mujoco>")
        with refuses("engine jax", named):
            make_engine("jax", model, 1)
    make_engine("jax", mujoco.MjModel.from_xml_string(f"{RADIAN}<worldbody>{NARROW.format(0.05)}</worldbody></mujoco>"), 1)


def test_cg_has_the_model_s_iterations():
    text = '<mujoco><option solver="{}" iterations="70" ls_iterations="30"/><worldbody/></mujoco>'
    for solver, expected in (("Newton", (8, 5)), ("CG", (70, 30))):
        model = mujoco.MjModel.from_xml_string(text.format(solver))
        options = make_engine("jax", model, 1)._mujoco_model.opt
        assert (options.iterations, options.ls_iterations) == expected
        assert make_engine("jax", model, 1, iterations=9)._mujoco_model.opt.iterations == 9


@pytest.mark.parametrize("numeric", ["max_contact_points", "max_geom_pairs"])
def test_numbers_for_mjx_leave_out_no_contact(numeric):
    """Three spheres on a plane, after 20 timesteps."""
    balls = "".join(f'<body pos="{i} 0 .099"><freejoint/><geom size=".1"/></body>' for i in range(3))
    text = f'<mujoco><custom><numeric name="{numeric}" data="1"/></custom><worldbody><geom type="plane" size="9 9 1"/>'
    model = mujoco.MjModel.from_xml_string(f"{text}{balls}</worldbody></mujoco>")
    still = Physics(jnp.asarray(model.qpos0, jnp.float32), *(jnp.zeros(n) for n in (model.nv, model.nv, 0)))
    controls = Controls(jnp.zeros(0), jnp.zeros((0, 7)))
    engines = [make_engine(name, model, 20) for name in ("jax", "native")]  # kept as long as their programs
    np.testing.assert_allclose(*(jax.jit(engine.advance)(still, controls).qpos for engine in engines), atol=1e-5)


def test_what_mjx_computes_otherwise_is_rejected():
    joint = '<mujoco><option integrator="{}">{}</option><worldbody><body><joint name="a" damping="1"/><geom size="1"/></body>'
    joint += '</worldbody><actuator><muscle name="biceps" joint="a" lengthrange="-1 1"/></actuator></mujoco>'
    with refuses("muscles", "implicitfast", "biceps"):
        make_engine("jax", mujoco.MjModel.from_xml_string(joint.format("implicitfast", "")), 1)
    for flag in ("spring", "damper"):
        model = mujoco.MjModel.from_xml_string(joint.format("Euler", f'<flag {flag}="disable"/>'))
        with refuses("flags", "springs", "dampers"):
            make_engine("jax", model, 1)
    assert make_engine("jax", mujoco.MjModel.from_xml_string(joint.format("Euler", "")), 1).name == "jax"
