"""The warp engine, on a CPU: the kernels are those of a GPU, compiled for another device."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_dher import envs
from mjx_dher.envs import engines
from mjx_dher.envs.engines import warp_substep
from mjx_dher.envs.engines.base import last_below, with_stand_ins
from mjx_dher.envs.engines.warp import capacities, mujoco_warp, wp


@pytest.fixture(scope="module")
def warp():
    return envs.make("pick_and_place", engine="warp", allow_cpu=True)


@pytest.fixture(scope="module")
def native():
    return envs.make("pick_and_place", engine="native")


@functools.cache
def starts(env):
    """4 first states [2, 2]; in two of them a cube lies between the open fingers."""
    keys = jax.random.split(jax.random.key(0), 4)
    states = jax.jit(jax.vmap(env.reset))(keys)
    x, y, z = env.task.initial_grip_pos
    held = jnp.array([x, y, z - 0.01, 1.0, 0.0, 0.0, 0.0])
    qpos = states.physics.qpos.at[:2, env._object_qpos].set(held).at[:2, env._finger_qpos].set(0.04)
    states = states.replace(physics=states.physics.replace(qpos=qpos))
    return jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), states)


@functools.cache
def compiled(env):
    """(states [2, 2], actions [T, 2, 2, 4]) -> (states, (observations, failed)), once for each environment."""

    def step(states, actions):
        states = jax.vmap(jax.vmap(env.step))(states, actions)
        return states, (states.obs["observation"], states.failed)

    return jax.jit(lambda states, actions: jax.lax.scan(step, states, actions))


def play(env, states, actions):
    """Observations [T, 2, 2, 25] and whether physics failed, under two vmaps; two steps at a time, by one program."""
    played = []
    for two in actions.reshape(-1, 2, *actions.shape[1:]):
        states, seen = compiled(env)(states, two)
        played.append(seen)
    return jax.block_until_ready(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *played))


def test_it_follows_native(warp, native):
    """Grasping and falling cubes, nested vmap. float32 and 8 iterations against float64 run to 1e-8: measured 0.3 mm."""
    actions = jax.random.uniform(jax.random.key(1), (12, 2, 2, 4), minval=-1, maxval=1).at[..., 3].set(-1.0)
    (here, failed), (there, _) = (play(env, starts(native), actions) for env in (warp, native))
    moved = np.ptp(np.asarray(there)[..., :6], axis=0)
    assert (moved[0, :, 3:].max(axis=-1) > 0.03).all()  # the gripper carried the cubes
    np.testing.assert_allclose(here[..., :3], there[..., :3], atol=5e-4)
    np.testing.assert_allclose(here[..., 3:6], there[..., 3:6], atol=2e-3)
    assert not failed.any()
    warp.check()


def test_a_failed_environment_leaves_the_others_alone(warp):
    states = starts(warp)
    qpos = states.physics.qpos.at[0, 1, 9].set(jnp.nan)
    qvel = states.physics.qvel.at[1, 0, 2].set(1e9)
    hurt = states.replace(physics=states.physics.replace(qpos=qpos, qvel=qvel))
    actions = jax.random.uniform(jax.random.key(2), (4, 2, 2, 4), minval=-1, maxval=1)
    (clean, _), (played, failed) = play(warp, states, actions), play(warp, hurt, actions)
    bad = np.array([[False, True], [True, False]])
    np.testing.assert_array_equal(failed, np.broadcast_to(bad, (4, 2, 2)))
    np.testing.assert_allclose(played[:, ~bad], clean[:, ~bad], atol=1e-4)  # rounding: atomic sums
    assert np.isfinite(played).all()


def test_a_step_depends_on_nothing_that_came_before(warp):
    """Where environments blew up, were put back to a start, and go on with other actions: as if nothing had been."""
    start = starts(warp)
    actions = jax.random.uniform(jax.random.key(3), (2, 2, 2, 4), minval=-1, maxval=1)
    fresh, _ = play(warp, start, actions)
    qvel = start.physics.qvel.at[:].set(jnp.nan)
    _, failed = play(warp, start.replace(physics=start.physics.replace(qvel=qvel)), actions)
    assert failed.all()
    again, failed = play(warp, start, actions)
    assert not failed.any()
    np.testing.assert_allclose(again, fresh, atol=1e-4)  # rounding: atomic sums


def simulated(model, num_envs, seed):
    """Model and Data of MuJoCo Warp; at random states, in which the fingers touch table and object."""
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=num_envs, naconmax=64 * num_envs, njmax=256)
    rng = np.random.default_rng(seed)
    qpos = np.tile(model.qpos0, (num_envs, 1)) + 0.05 * rng.standard_normal((num_envs, model.nq))
    d.qpos = wp.array(qpos, dtype=wp.float32)
    d.qvel = wp.array(0.5 * rng.standard_normal((num_envs, model.nv)), dtype=wp.float32)
    d.ctrl = wp.array(0.05 * rng.standard_normal((num_envs, model.nu)), dtype=wp.float32)
    return m, d


@pytest.mark.parametrize(
    "task", ["pick_and_place", *(pytest.param(task, marks=pytest.mark.slow) for task in ("reach", "push", "slide"))]
)
def test_a_substep_is_mujoco_warp_s_where_that_knows_the_velocities(task, monkeypatch):
    env = envs.make(task, engine="warp", allow_cpu=True)
    results = []
    for needed in ([], ["all"]):
        m, d = simulated(env.engine._model, 16, seed=0)
        assert warp_substep.unsupported_features(env.engine._model, m) == []
        with monkeypatch.context() as patch:
            patch.setattr(warp_substep, "unsupported_features", lambda model, m, needed=needed: needed)
            substep = warp_substep.make_substep(env.engine._model, m, d)
        substep(), substep()  # the second finds what the first has left behind
        results.append({name: getattr(d, name).numpy() for name in ("nefc", "M", "qfrc_smooth", "qacc", "qvel", "qpos")})
    here, there = results
    assert there["nefc"].max() > (6 if env.has_object else 5)  # the weld, and contacts
    np.testing.assert_array_equal(here["nefc"], there["nefc"])
    for name, scale in (("M", 1e-5), ("qfrc_smooth", 1e-5), ("qacc", 1e-3), ("qvel", 1e-4), ("qpos", 1e-5)):
        size = np.abs(there[name]).max()
        np.testing.assert_allclose(here[name], there[name], atol=scale * size, rtol=0, err_msg=name)


@pytest.mark.parametrize(
    ("attribute", "what"),
    [
        ('<option integrator="implicitfast"/>', "an integrator other than Euler"),
        ('<option><flag gravity="disable"/></option>', "options disabled or enabled"),
        ('<option density="1.2"/>', "a medium"),
        ('<sensor><jointpos joint="j"/></sensor>', "sensors"),
        ('<default><joint stiffness="1 2"/></default>', "springs or damping that are not linear"),
        (
            '<worldbody><body><joint type="ball" stiffness="1"/><geom size="1"/></body></worldbody>',
            "springs of free or ball joints",
        ),
        ('<tendon><fixed><joint joint="j" coef="1"/></fixed></tendon>', "tendons"),
        ('<worldbody><body gravcomp="1"><freejoint/><geom size="1"/></body></worldbody>', "gravity compensation"),
    ],
)
def test_a_model_with_more_to_it_is_stepped_by_mujoco_warp(attribute, what, monkeypatch):
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{attribute}<worldbody><body><joint name='j'/><geom size='1'/></body></worldbody></mujoco>"
    )
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model)
    assert warp_substep.unsupported_features(model, m) == [what]
    stepped = []
    monkeypatch.setattr(mujoco_warp, "step", lambda *given: stepped.append(given))
    warp_substep.make_substep(model, m, d)()
    assert stepped == [(m, d)]


def test_bodies_below_one_another_are_neighbours():
    """1 has 2 and 4 below it, 2 has 3, 4 has 5."""
    body = "<body>{}</body>".format
    tree = body(body(body("")) + body(body(""))) + body("")
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{tree}</worldbody></mujoco>")
    assert last_below(model).tolist() == [6, 5, 3, 3, 5, 5, 6]


@pytest.mark.parametrize(("memory", "kind"), [({"contacts": 1}, "narrowphase"), ({"constraints": 8}, "nefc")])
def test_lost_contacts_are_an_error_that_names_the_memory_to_use(memory, kind, native):
    env = envs.make("pick_and_place", engine="warp", allow_cpu=True, **memory)
    play(env, starts(native), jnp.zeros((2, 2, 2, 4)))
    contacts, constraints = capacities(env.model)
    with pytest.raises(ValueError, match=f"{kind}.*contacts={contacts} and constraints={constraints} are always enough"):
        env.check()
    env.check()  # said once


def test_capacities_are_what_all_pairs_can_give_at_once():
    """slide: two fingers on a sphere 1 contact of 6 rows each, two fingers on a plane and the puck on two 4 each of 4 rows; the
    weld 6 rows, and 2 for each finger's limits."""
    found = capacities(with_stand_ins(envs.make("slide", engine="native").model))
    assert found == (2 * 1 + 2 * 4 + 2 * 4, 6 + 2 * 2 + 2 * 6 + 2 * 16 + 2 * 16)
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom name='a' type='ellipsoid' size='1 1 1'/>"
        "<body><freejoint/><geom name='b' size='1' type='capsule' fromto='0 0 0 1 0 0'/></body></worldbody>"
        "<contact><pair geom1='a' geom2='b'/></contact></mujoco>"
    )
    with pytest.raises(ValueError, match="no bound on the contacts between capsule and ellipsoid"):
        capacities(model)


def test_where_it_cannot_run_it_says_why_and_names_the_extra(monkeypatch):
    with pytest.raises(ValueError, match=r"engine warp needs JAX on an NVIDIA GPU, and JAX runs on cpu here: .*\[cuda\]"):
        envs.make("push", engine="warp")
    monkeypatch.setattr(engines, "_has_warp", lambda: False)
    with pytest.raises(ValueError, match=r'engine warp needs warp-lang, which the extra "cuda" installs'):
        envs.make("push", engine="warp")


def test_auto_is_native_on_a_cpu_warp_on_a_gpu_and_jax_where_warp_is_missing(monkeypatch):
    assert engines.resolve_engine("auto") == "native"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert engines.resolve_engine("auto") == "warp"
    monkeypatch.setattr(engines, "_has_warp", lambda: False)
    assert engines.resolve_engine("auto") == "jax"
