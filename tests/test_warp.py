"""The warp engine, on a CPU: the kernels are those of a GPU, compiled for another device."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import envs
from mjx_dher.envs import engines
from mjx_dher.envs.engines import warp as warp_engine


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
    """Grasping and falling cubes, nested vmap."""
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
    np.testing.assert_array_equal(played[:, ~bad], clean[:, ~bad])
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
    np.testing.assert_array_equal(again, fresh)


def test_where_it_cannot_run_it_says_why_and_names_the_extra(monkeypatch):
    with refuses("engine", "warp", "cpu", "[cuda]"):
        envs.make("push", engine="warp")
    monkeypatch.setattr(engines, "_has_warp", lambda: False)
    with refuses("engine", "warp", "warp-lang", "cuda"):
        envs.make("push", engine="warp")


def test_a_driver_that_is_too_old_for_warp_is_named(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(warp_engine.wp, "is_cuda_available", lambda: False)
    with refuses("Warp", "driver"):
        envs.make("push", engine="warp")


def test_auto_is_native_on_a_cpu_warp_on_a_gpu_and_jax_where_warp_is_missing(monkeypatch):
    assert engines.resolve_engine("auto") == "native"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert engines.resolve_engine("auto") == "warp"
    monkeypatch.setattr(engines, "_has_warp", lambda: False)
    assert engines.resolve_engine("auto") == "jax"
