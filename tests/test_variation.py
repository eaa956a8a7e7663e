"""Masses, friction, damping and gains that differ between simulations and are drawn at each reset."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses
from engine_models import MODELS, SUBSTEPS, play, start

from mjx_dher import envs
from mjx_dher.envs import Simulator
from mjx_dher.envs.engines import Controls, Physics, make_engine
from mjx_dher.envs.engines.variation import Variation, to_ranges
from mjx_dher.envs.task import Actuators, MujocoTask, Position, Start

TWO = """
<mujoco><option gravity="0 0 0" timestep="0.001"/>
<worldbody>
<body name="cart"><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>
<body name="door" pos="0 1 0"><joint name="y" type="slide" axis="1 0 0" damping="3"/><geom size="0.1" mass="4"/></body>
</worldbody><actuator><motor name="push" joint="x" gear="4" ctrlrange="-1 1"/>
<position joint="y" kp="5"/></actuator></mujoco>"""
NAMES = ("mass:cart", "gain:push", "mass:door", "damping:y", "gain:y")
# Factors, and the accelerations of cart and door at a speed of 1 under an input of 1: 4 N on 2 kg, 5 - 3 N on 4 kg.
CASES = (
    ((1, 1, 1, 1, 1), (2, 0.5)),
    ((2, 1, 1, 1, 1), (1, 0.5)),
    ((1, 0.5, 2, 1, 1), (1, 0.25)),
    ((1, 1, 1, 1.5, 1), (2, 0.125)),
    ((4, 2, 1, 1, 3), (1, 3)),
)


@pytest.mark.parametrize(
    "engine", ["native", *(pytest.param(name, marks=pytest.mark.slow) for name in ("jax", "graph", "fused"))]
)
def test_twice_the_mass_is_half_the_acceleration(engine):
    engine, options = ("warp", {"path": engine, "allow_cpu": True}) if engine in ("graph", "fused") else (engine, {})
    made = make_engine(engine, mujoco.MjModel.from_xml_string(TWO), 1, varied=NAMES, **options)
    factors = jnp.asarray([case for case, _ in CASES], jnp.float32)
    zeros, none = jnp.zeros((len(CASES), 2)), jnp.zeros((len(CASES), 0))
    controls = Controls(jnp.ones((len(CASES), 2)), jnp.zeros((len(CASES), 0, 7)))
    after = jax.jit(jax.vmap(made.advance))(Physics(zeros, zeros + 1, zeros, none, factors=factors), controls)
    expected = np.array([acceleration for _, acceleration in CASES])
    # Damping is implicit: an acceleration a becomes a / (1 + timestep x damping / mass).
    np.testing.assert_allclose((after.qvel - 1) / 0.001, expected, rtol=2e-3)
    np.testing.assert_array_equal(after.factors, factors)
    unchanged = made.advance(Physics(zeros[0], zeros[0] + 1, zeros[0], none[0]), jax.tree.map(lambda x: x[0], controls))
    np.testing.assert_allclose(unchanged.qvel, after.qvel[0])
    assert unchanged.factors is None


def changed_by_hand(model, factors):
    """The model with its numbers multiplied, and what MuJoCo derives from them, but for the softness of constraints."""
    changed = copy.copy(model)
    body, joint, mass, friction, damping, gain = 1, 2, *factors
    changed.body_mass[body] *= mass
    changed.body_inertia[body] *= mass
    changed.geom_friction[:] *= friction
    changed.dof_damping[model.dof_jntid == joint] *= damping
    changed.actuator_gainprm[3] *= gain
    changed.actuator_biasprm[3] *= gain
    kept = {name: np.array(getattr(model, name)) for name in ("body_invweight0", "dof_invweight0", "actuator_acc0")}
    inertia = model.stat.meaninertia
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    for name, value in kept.items():
        getattr(changed, name)[:] = value
    changed.stat.meaninertia = inertia
    return changed


def test_native_with_factors_is_a_loop_over_mj_step_of_a_changed_model():
    """To the bit, with contacts, also after the rows of the batch have changed places."""
    model = mujoco.MjModel.from_xml_string(MODELS["arm"])
    names = ("mass:body_1", "friction:*", "damping:j1", "gain:j3")
    engine = make_engine("native", model, SUBSTEPS, varied=names, num_threads=2)
    first, controls = start(model, (3,))
    factors = np.float32([[1, 1, 1, 1], [0.5, 0.25, 2, 1.5], [3, 2, 0.5, 0.25]])
    played = jax.jit(jax.vmap(lambda *given: play(engine, *given)))
    for order in ([0, 1, 2], [2, 0, 1]):
        seen = played(first.replace(factors=jnp.asarray(factors[order])), controls)
        for i, number in enumerate(order):
            changed, data = changed_by_hand(model, factors[number].astype(float)), mujoco.MjData(model)
            data.qpos[:] = first.qpos[i]
            for t in range(8):
                data.ctrl[:] = controls.ctrl[i, t]
                for _ in range(SUBSTEPS):
                    mujoco.mj_step(changed, data)
                for name in ("qpos", "qvel", "qacc_warmstart"):
                    value = getattr(data, name)
                    value[:] = np.float32(value)
                np.testing.assert_array_equal(seen.qpos[i, t], np.float32(data.qpos), err_msg=f"{number} at {t}")


def test_a_simulator_has_the_factors_in_its_data():
    sim = Simulator(mujoco.MjModel.from_xml_string(TWO), derived=["qacc"], varied=NAMES)
    data = sim.make_data()
    np.testing.assert_array_equal(data.factors, np.ones(5))
    heavy = sim.step(data.replace(factors=data.factors.at[0].set(2.0)), jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(heavy.derived["qacc"][0], 1.0)
    np.testing.assert_allclose(sim.forward(data.replace(ctrl=jnp.array([1.0, 0.0]))).derived["qacc"][0], 2.0)
    np.testing.assert_array_equal(heavy.factors, [2, 1, 1, 1, 1])


class Cart(MujocoTask):
    model = TWO
    hz = 100
    control = Actuators("push")
    goal = Position("body:cart", (-1, 0, 0), (1, 0, 0))
    start = Start(ranges={"x": (-0.5, 0.5)})


def test_each_reset_draws_factors_and_all_else_as_without():
    plain, varied = Cart("native"), Cart("native", varied="mass:cart=0.5-2, gain:push=0.25-0.5")
    keys = jax.random.split(jax.random.key(0), 64)
    without, states = jax.jit(jax.vmap(plain.reset))(keys), jax.jit(jax.vmap(varied.reset))(keys)
    factors = np.asarray(states.physics.factors)
    assert factors.shape == (64, 2)
    for column, (low, high) in zip(factors.T, ((0.5, 2), (0.25, 0.5))):
        assert low <= column.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < column.max() <= high
    assert np.ptp(without.physics.qpos[:, 0]) > 0.5
    np.testing.assert_array_equal(states.physics.qpos, without.physics.qpos)
    np.testing.assert_array_equal(states.obs["desired_goal"], without.obs["desired_goal"])
    alone = varied.reset(keys[3])
    np.testing.assert_array_equal(alone.physics.factors, factors[3])
    step = jax.jit(varied.step)
    stepped, wild = step(alone, jnp.ones(1)), alone.replace(physics=alone.physics.replace(qvel=jnp.full(2, jnp.nan)))
    speed = 0.01 * 4 * factors[3, 1] / (2 * factors[3, 0])
    np.testing.assert_allclose(stepped.physics.qvel[0], speed, rtol=1e-4)
    failed = step(wild, jnp.ones(1))
    assert failed.failed
    for state in (stepped, failed):
        np.testing.assert_array_equal(state.physics.factors, factors[3])


@pytest.mark.parametrize(("name", "body"), [("push", "object"), pytest.param("block", "object", marks=pytest.mark.slow)])
def test_built_in_tasks_vary(name, body):
    state = envs.make(name, engine="native", varied=f"mass:{body}=0.5-0.75").reset(jax.random.key(0))
    assert 0.5 <= state.physics.factors[0] <= 0.75


def test_bad_factors_are_rejected():
    model = mujoco.MjModel.from_xml_string(TWO)
    cases = [  # a call, and what the error must name
        (lambda: Variation(model, ["weight:cart"]), ["weight", "mass"]),
        (lambda: Variation(model, ["mass:card"]), ["card", "cart"]),
        (lambda: Variation(model, ["mass:cart", "mass:*"]), ["mass", "cart"]),
        (lambda: Variation(model, ["damping:x"]), ["damping:x", 0]),
        (lambda: Variation(model, ["mass"]), ["mass", "cart"]),
        (lambda: Variation(model, "mass:cart"), ["mass:cart"]),
        (lambda: make_engine("native", model, 1, varied=None), [None]),
        (lambda: to_ranges("gain:y=1-2,gain:y=1-3"), ["gain:y=1-2,gain:y=1-3"]),
        (lambda: to_ranges("mass:cart=2"), ["mass:cart=2"]),
        (lambda: to_ranges("mass:cart=a-b"), ["mass:cart=a-b"]),
        (lambda: to_ranges({"mass:cart": (0, 1)}), ["mass:cart", "(0, 1000]"]),
        (lambda: to_ranges({"mass:cart": (2, 1)}), ["mass:cart", "(2, 1)"]),
        (lambda: to_ranges({"gain:y": (0.5, float("nan"))}), ["gain:y", "nan"]),
        (lambda: to_ranges({"gain:y": 2}), ["gain:y", 2]),
        (lambda: to_ranges(3), [3]),
    ]
    for call, parts in cases:
        with refuses(*parts):
            call()
    engine = make_engine("native", model, 1, varied=NAMES)
    state = Physics(*(jnp.zeros(n) for n in (2, 2, 2, 0)), factors=jnp.ones(3))
    with refuses("factors", "[3]", "[5]"):
        engine.advance(state, Controls(jnp.zeros(2), jnp.zeros((0, 7))))
