"""Any model by MuJoCo C from inside compiled programs, beside plain loops over `mj_step`."""

import copy
import gc
import pickle
import warnings
import weakref
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from any_model import FIGURE
from conftest import refuses
from mujoco.batch import DATA_FIELDS

from mjx_dher.envs import Simulator, make
from mjx_dher.envs.engines import Controls, batches, host_call, native
from mjx_dher.envs.engines.fields import REJECTED
from mjx_dher.tools import gym_cache

# Whatever a state can have: an actuator with activation, a mocap body with a weld, a tendon, a delayed sensor, a keyframe.
RICH = """
<mujoco>
  <size nuserdata="2"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body name="hand" mocap="true" pos="0 0 1"/>
    <body name="box" pos="0 0 1"><freejoint/><geom name="box" type="box" size="0.1 0.1 0.1"/></body>
    <body name="arm" pos="1 0 0.5">
      <joint name="swing" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.04"/>
      <body pos="0.4 0 0"><joint name="bend" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/></body>
    </body>
  </worldbody>
  <equality><weld body1="hand" body2="box"/></equality>
  <tendon><fixed name="pull"><joint joint="swing" coef="1"/><joint joint="bend" coef="-0.5"/></fixed></tendon>
  <actuator>
    <general joint="swing" dyntype="filter" dynprm="0.1" gainprm="5"/>
    <motor tendon="pull" gear="2"/>
  </actuator>
  <sensor><jointpos joint="swing" nsample="4" delay="0.006"/><framepos objtype="body" objname="box"/></sensor>
  <keyframe><key name="up" qpos="0 0 2 1 0 0 0 0.5 -0.5" ctrl="0.1 0.2"/></keyframe>
</mujoco>
"""
STATE = native.STATE


def load(model, data, values):
    """Puts a state, as it was between steps, into an MjData."""
    for name in STATE:
        value = np.asarray(getattr(values, name))
        if name == "time":
            data.time = float(value)
        else:
            getattr(data, name)[...] = value.reshape(getattr(data, name).shape)


def loop(model, first, controls, substeps):
    """States after each step of a loop over `mj_step` that keeps float32 between steps, as lists of arrays by name."""
    model = copy.copy(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    data, states = mujoco.MjData(model), []
    load(model, data, first)
    for ctrl in controls:
        data.ctrl[:] = ctrl
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        state = {name: np.float32(getattr(data, name)) for name in (*STATE, "xpos", "sensordata")}
        states.append(state)
        time, history = data.time, data.history.copy()
        data = mujoco.MjData(model)
        load(model, data, SimpleNamespace(**{name: state[name] for name in STATE}))
        data.time, data.history[:] = time, history  # float64 between steps, too
    return states


@pytest.mark.parametrize("xml", [FIGURE, RICH], ids=["figure", "rich"])
def test_a_scan_of_a_batch_is_a_loop_over_mj_step(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    sim = Simulator(model, derived=["xpos", "sensordata"], substeps=3, num_threads=2)
    controls = jax.random.uniform(jax.random.key(0), (20, 4, model.nu), minval=-1, maxval=1)
    first = jax.jit(jax.vmap(lambda x: sim.make_data().replace(qvel=x * jnp.ones(model.nv))))(jnp.linspace(-0.5, 0.5, 4))

    def step(data, ctrl):
        data = jax.vmap(sim.step)(data, ctrl)
        return data, data

    states = jax.jit(lambda data: jax.lax.scan(step, data, controls)[1])(first)
    first, states, controls = jax.device_get((first, states, controls))
    assert np.ptp(states.qpos, axis=1).max() > 0.1  # they went different ways
    for i in range(4):
        expected = loop(model, jax.tree.map(lambda x, i=i: x[i], first), controls[:, i], substeps=3)
        for t, state in enumerate(expected):
            for name in STATE:
                np.testing.assert_array_equal(getattr(states, name)[t, i].ravel(), state[name].ravel(), err_msg=name)
            for name in ("xpos", "sensordata"):
                np.testing.assert_array_equal(states.derived[name][t, i], state[name], err_msg=name)


def test_alone_nested_and_through_grad_s_stop():
    sim = Simulator(mujoco.MjModel.from_xml_string(FIGURE), num_threads=1)
    data = sim.make_data()
    alone = jax.jit(sim.step)(data, jnp.ones(4))
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (2, 3, *x.shape)), data)
    nested = jax.jit(jax.vmap(jax.vmap(sim.step)))(many, jnp.ones((2, 3, 4)))
    for one, all_of_them in zip(jax.tree.leaves(alone), jax.tree.leaves(nested), strict=True):
        np.testing.assert_array_equal(all_of_them[1, 2], one)
    with pytest.raises(ValueError, match="cannot be differentiated"):
        jax.grad(lambda ctrl: sim.step(data, ctrl).qvel.sum())(jnp.ones(4))


def test_forward_makes_current_what_step_leaves_a_timestep_behind():
    model = mujoco.MjModel.from_xml_string(RICH)
    sim = Simulator(model, derived=["xpos"])
    data = sim.make_data("up")
    assert data.qpos[2] == 2
    np.testing.assert_allclose(data.ctrl, [0.1, 0.2])
    np.testing.assert_allclose(data.derived["xpos"][2], [0, 0, 2])
    np.testing.assert_array_equal(data.derived["xpos"], sim.make_data(0).derived["xpos"])
    fallen = sim.step(sim.step(data))
    current = sim.forward(fallen)
    assert fallen.derived["xpos"][2, 2] != fallen.qpos[2]
    np.testing.assert_array_equal(current.derived["xpos"][2], fallen.qpos[:3])
    np.testing.assert_array_equal(current.qpos, fallen.qpos)


def test_few_states_are_stepped_by_one_thread_if_that_is_faster():
    sim = Simulator(mujoco.MjModel.from_xml_string(FIGURE), num_threads=2)
    step = jax.jit(jax.vmap(sim.step))
    data = jax.tree.map(lambda x: jnp.stack([x, x + 0.1]), sim.make_data())
    seen = []
    for fast in (1, 2):
        for rows in sim._batches[True].kept.get(2, []):
            rows.seconds = 1.0 if rows.batch.nthread == fast else 2.0
        seen.append(jax.block_until_ready(step(data)))
        if len(seen) == 1:
            continue  # the first call made the batches
        slower = max(sim._batches[True].kept[2], key=lambda rows: rows.seconds)
        assert slower.batch.nthread == 3 - fast
        assert slower.seconds == 2.0 * 0.998  # until it is tried again
    np.testing.assert_array_equal(seen[0].qpos, seen[1].qpos)


def test_mujoco_s_clock_stands_still_only_during_a_call(monkeypatch):
    sim, clock, run, seen = Simulator(mujoco.MjModel.from_xml_string(FIGURE)), batches.UNTIMED._clock, batches.Batch.step, []
    monkeypatch.setattr(batches.Batch, "step", lambda *args, **kw: (seen.append(clock.value), run(*args, **kw)))
    before, data = clock.value, sim.make_data()
    assert before is not None  # the bindings export it on this system
    sim.step(data)
    with batches.UNTIMED:  # a second simulator, in another thread
        sim.step(data)
        assert clock.value is None
    assert (seen, clock.value) == ([None, None], before)


def test_numpy_states_are_stepped_without_jax_to_the_same_numbers(monkeypatch):
    model = mujoco.MjModel.from_xml_string(RICH)
    sim = Simulator(model, derived=["xpos"], substeps=3, num_threads=1)
    ctrl = np.random.default_rng(0).uniform(-1, 1, (5, 4, 2)).astype(np.float32)
    first = jax.tree.map(lambda x: jnp.broadcast_to(x, (4, *x.shape)), sim.make_data("up"))
    expected = jax.jit(lambda data: jax.lax.scan(lambda x, u: (jax.vmap(sim.step)(x, u), None), data, ctrl)[0])(first)
    data = jax.tree.map(np.asarray, first)
    monkeypatch.setattr(host_call.jax.ffi, "ffi_call", None)
    for inputs in ctrl:
        data = sim.step(data, inputs)
    assert type(data.row) is np.ndarray
    np.testing.assert_array_equal(data.row, expected.row)
    one = jax.tree.map(lambda x: x[1], data).replace(time=3.0)
    np.testing.assert_array_equal(sim.step(one, [0.1, 0.2]).qpos, sim.step(expected, jnp.array([[0.1, 0.2]] * 4)).qpos[1])
    np.testing.assert_allclose(sim.step(one).time, 3.006)
    assert sim.step(jax.tree.map(lambda x: x[:0], data)).qpos.shape == (0, model.nq)


def test_what_blows_up_is_not_reset_behind_one_s_back():
    sim = Simulator(mujoco.MjModel.from_xml_string(FIGURE))
    data = sim.make_data()
    wild = jax.vmap(lambda v: sim.step(sim.step(data.replace(qvel=data.qvel.at[0].set(v)))))(jnp.array([0.0, jnp.inf]))
    assert np.isfinite(wild.qvel[0]).all()
    assert not np.isfinite(wild.qvel[1]).all()


def test_copies_and_pickles_step_alike():
    sim = Simulator(mujoco.MjModel.from_xml_string(FIGURE), derived=["xpos"])
    expected = sim.step(sim.make_data(), jnp.ones(4))
    for other in (copy.deepcopy(sim), pickle.loads(pickle.dumps(sim))):
        for a, b in zip(jax.tree.leaves(other.step(other.make_data(), jnp.ones(4))), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a, b)


def test_step_and_advance_are_the_same_physics():
    """Alternately, so that neither leaves anything behind for the other."""
    env = make("push", engine="native")
    sim = Simulator(env.model, derived=["xpos"], substeps=20)
    physics = jax.jit(env.reset)(jax.random.key(0)).physics
    data = sim.make_data().replace(qpos=physics.qpos, qvel=physics.qvel, mocap_pos=jnp.array([[1.3, 0.7, 0.5]]))
    controls = Controls(ctrl=data.ctrl, mocap=jnp.concatenate([data.mocap_pos, data.mocap_quat], axis=1))
    pushed = data.replace(xfrc_applied=data.xfrc_applied + 1.0)
    for _ in range(2):
        whole, few = sim.step(data), sim.advance(physics, controls)
        for name in ("qpos", "qvel"):
            np.testing.assert_array_equal(getattr(whole, name), getattr(few, name))
        assert np.abs(sim.step(pushed).qpos - whole.qpos).max() > 1e-6


def test_bad_arguments_are_rejected():
    cases = [  # a call, and what the error must name
        (lambda model: Simulator("figure.xml"), ["model", "mujoco.MjModel", "str"]),
        (lambda model: Simulator(model, derived="xpos"), ["derived", "xpos"]),
        (lambda model: Simulator(model, derived=None), ["derived", None]),
        (lambda model: Simulator(model, derived=["xposs"]), ["derived", "xposs", "xpos"]),
        (lambda model: Simulator(model, derived=["qpos"]), ["derived", "qpos"]),
        (lambda model: Simulator(model, derived=["qfrc_inverse"]), ["derived", "qfrc_inverse", "mj_inverse"]),
        (lambda model: Simulator(model, substeps=0), ["substeps", 0]),
        (lambda model: Simulator(model, num_threads=0), ["num_threads", 0]),
        (lambda model: Simulator(model).make_data("down"), ["keyframe", "down"]),
        (lambda model: Simulator(model).make_data(3), ["keyframe", 3]),
        (lambda model: Simulator(model).step(Simulator(model).make_data(), jnp.ones(3)), ["ctrl", "[3]", "[4]"]),
        (lambda model: Simulator(model).step(None), ["data", "NoneType"]),
        (lambda model: Simulator(model, derived=["xpos"]).step(Simulator(model).make_data()), ["data", "make_data"]),
        (lambda model: Simulator(model).make_data().replace(qpoz=0.0), ["field", "qpoz", "qpos"]),
        (lambda model: Simulator(model, derived=["xpos"]).make_data().replace(xpos=0.0), ["field", "xpos"]),
        (lambda model: Simulator(model).make_data().replace(time=np.zeros(2)), ["time", "[2]", "[]"]),
        (lambda model: Simulator(asleep(model)), ["sleep", "IPC"]),
    ]
    for call, parts in cases:
        with refuses(*parts):
            call(mujoco.MjModel.from_xml_string(FIGURE))


def asleep(model):
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    return model


FALLING = RICH.replace('pos="0 0 1"><freejoint/>', 'pos="0 0 0.09"><freejoint/>').replace('pos="0 0 1"', 'pos="0 0 0.1"')
CLOTH = """
<mujoco><option integrator="implicit"/><worldbody><geom type="plane" size="5 5 .1"/><camera name="c"/><light/>
<flexcomp type="grid" count="3 3 1" spacing=".1 .1 .1" pos="0 0 .02" radius=".03" name="f" dim="2"><edge equality="true"/>
<contact selfcollide="none"/></flexcomp><body gravcomp="1"><freejoint/><site name="s"/><geom size="0.1" pos="2 0 2"/></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("xml", [FALLING, pytest.param(CLOTH, marks=pytest.mark.slow)], ids=["box", "cloth"])
def test_every_derived_field_is_what_mujoco_computes_or_rejected(xml):
    """Of two simulations in turn on one thread, so that one's numbers would show in the other's."""
    model = mujoco.MjModel.from_xml_string(xml)
    names = sorted(set(DATA_FIELDS) - set(STATE) - set(REJECTED))
    assert {"cfrc_ext", "cfrc_int", "cacc", "subtree_linvel", "subtree_angmom", "energy", "sensordata", "xpos"} <= set(names)
    sim = Simulator(model, derived=names, num_threads=1)
    qvel = np.random.default_rng(0).uniform(-0.1, 0.1, (2, model.nv)).astype(np.float32)
    many = jax.tree.map(lambda x: np.stack([x, x]), sim.make_data()).replace(qvel=qvel)
    functions = {name: jax.jit(jax.vmap(getattr(sim, name))) for name in ("step", "forward")}
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    for function in ("step", "forward", "step"):
        seen = jax.device_get(functions[function](many))
        for i in range(2):
            data = mujoco.MjData(model)
            load(model, data, jax.tree.map(lambda x, i=i: x[i], many))
            getattr(mujoco, f"mj_{function}")(model, data)
            mujoco.mj_rnePostConstraint(model, data)
            mujoco.mj_subtreeVel(model, data)
            for name in names:
                value = np.float32(getattr(data, name)).reshape(sim._shapes[name])
                # XLA takes numbers below 1e-38 for 0.
                np.testing.assert_allclose(seen.derived[name][i], value, rtol=0, atol=2e-38, err_msg=f"{name} after {function}")
        many = seen
    assert np.abs(seen.derived["energy"]).min() > 1e-4
    assert np.abs(seen.derived["cfrc_ext"]).max() > 1 or xml is CLOTH  # it touches the floor


@pytest.mark.parametrize("start", [0.0, 1e5, 1e9])
def test_time_advances_and_delays_last_as_in_a_loop_without_pause(start):
    model = mujoco.MjModel.from_xml_string(RICH)
    sim = Simulator(model, derived=["sensordata"], num_threads=1)
    data = mujoco.MjData(model)
    data.time = start
    for _ in range(3):  # until the history has times of its own
        mujoco.mj_step(model, data)
    exact = np.concatenate([[data.time], data.history])
    first = jax.tree.map(np.asarray, sim.make_data()).replace(residue=np.float32(batches.residue(exact)))
    first = first.replace(**{name: np.float32(getattr(data, name)) for name in STATE})
    last = jax.jit(lambda data: jax.lax.fori_loop(0, 100, lambda _, x: sim.step(x), data))(first)
    mujoco.mj_step(model, data, nstep=100)
    np.testing.assert_array_equal(last.time, np.float32(data.time))
    np.testing.assert_array_equal(np.float64(last.time) + np.float64(last.residue[:, 0]).sum(), data.time)
    np.testing.assert_allclose(last.derived["sensordata"], data.sensordata, atol=1e-5)
    assert abs(data.sensordata[0] - data.qpos[7]) > 1e-4  # the delay shows


def test_a_time_that_is_set_begins_there():
    sim = Simulator(mujoco.MjModel.from_xml_string(FIGURE), num_threads=1)
    late = sim.step(sim.make_data().replace(time=jnp.float32(1e5)))
    assert sim.step(late.replace(time=jnp.float32(0))).time == np.float32(0.004)


SPHERES = "".join(f'<body pos="{i % 10 * 0.3} {i // 10 * 0.3} .09"><freejoint/><geom size=".1"/></body>' for i in range(60))
CROWD = f'<mujoco><size memory="{{}}K"/><worldbody><geom type="plane" size="5 5 .1"/>{SPHERES}</worldbody></mujoco>'


def test_lost_contacts_are_reported_and_other_people_s_warnings_left_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = mujoco.get_mju_user_warning()
    full, room = (Simulator(mujoco.MjModel.from_xml_string(CROWD.format(size)), num_threads=1) for size in (80, 2000))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        room.step(room.make_data())
        room.check()
    for function in ("step", "forward"):
        with pytest.warns(UserWarning, match="contacts") if function == "step" else warnings.catch_warnings():
            data = jax.block_until_ready(getattr(full, function)(full.make_data()))
        with refuses("contacts", 2, "memory"):  # one of them in make_data
            full.check()
    full.check()
    wild = room.step(room.make_data().replace(qvel=data.qvel * jnp.nan))
    assert not np.isfinite(wild.qvel).all()
    assert mujoco.get_mju_user_warning() is before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_environments_of_gym_with_many_options_are_not_all_kept():
    made = [weakref.ref(gym_cache.programs("reach", {"distance_threshold": 0.01 * (1 + i)}).env) for i in range(20)]
    gc.collect()
    assert sum(ref() is not None for ref in made) <= 16
    gym_cache._compile.cache_clear()


@pytest.mark.slow
def test_memory_is_freed_with_the_simulator_and_sizes_are_bounded():
    sim = Simulator(mujoco.MjModel.from_xml_string(FIGURE), num_threads=1)
    data, program = sim.make_data(), jax.jit(sim.step)
    expected = program(data)
    compiled = program.lower(data).compile()
    row = np.asarray(data.row)
    for size in range(1, 3 + batches._KEPT):
        sim._on_step(np.tile(row, (size, 1)), np.empty((size, len(row)), np.float32))
    assert len(sim._batches[True].kept) == batches._KEPT
    kept = [weakref.ref(sim), weakref.ref(next(iter(sim._batches[True].kept.values()))[0].batch)]
    twin = copy.copy(sim)  # of the same name
    del sim, program
    jax.clear_caches()
    gc.collect()
    assert [ref() for ref in kept] == [None, None]
    np.testing.assert_array_equal(compiled(data).qpos, expected.qpos)
    del twin
    with refuses("simulator", "no longer exists", error=(jax.errors.JaxRuntimeError, ValueError)):
        jax.block_until_ready(compiled(data))
