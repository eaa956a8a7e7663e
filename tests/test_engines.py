"""The engines: against one another, against plain MuJoCo, and against recorded episodes of the originals."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import load_recorded

from mjx_dher import envs
from mjx_dher.envs.engines.mjx import with_stand_ins

ENGINES = ("native", "jax")
RECORDED = ("push", "pick_and_place", "slide")


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        ("push", "native"),
        # Two programs of half a minute; that MJX follows native in each of a nested batch is tested below.
        pytest.param("reach", "jax", marks=pytest.mark.slow),
    ],
)
def test_batching_is_vmap_in_any_nesting(name, engine):
    """Each environment of a batch does what it does alone, under vmap, nested vmap, scan and jit."""
    env = envs.make(name, engine=engine)
    keys = jax.random.split(jax.random.key(2), 6).reshape(2, 3)
    actions = jax.random.uniform(jax.random.key(3), (2, 3, 4, 4), minval=-1, maxval=1)

    def step(state, action):
        following = env.step(state, action)
        return following, following.obs["observation"]

    def episode(key, actions):
        return jax.lax.scan(step, env.reset(key), actions)[1]

    nested = jax.jit(jax.vmap(jax.vmap(episode)))(keys, actions)
    assert nested.shape == (2, 3, 4, env.observation_size)
    alone = jax.jit(episode)
    for i in range(2):
        for j in range(3):
            # native: rounding in the arm's kinematics; under vmap MJX's solver stops with the slowest environment, too
            np.testing.assert_allclose(
                nested[i, j], alone(keys[i, j], actions[i, j]), atol=1e-4 if engine == "native" else 5e-3
            )


def test_native_is_a_plain_loop_over_mj_step(native, task):
    model, data = native.model, mujoco.MjData(native.model)
    state, step = task("push").reset(jax.random.key(4)), task("push").step
    pose = jax.jit(native.arm.pose)
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 4)).astype(np.float32):
        data.qpos[:], data.qvel[:] = state.physics.qpos, state.physics.qvel
        data.qacc_warmstart[:] = state.physics.warmstart
        pos, quat = pose(state.physics.qpos[native.arm.qpos])
        data.mocap_pos[0], data.mocap_quat[0] = pos + np.float32(0.05) * action[:3], quat + np.float32([1, 0, 1, 0])
        for _ in range(20):
            mujoco.mj_step(model, data)
        state = step(state, action)
        # The target is computed in float32 in another order; all else is the same.
        np.testing.assert_allclose(state.physics.qpos, data.qpos, atol=1e-5)
        np.testing.assert_allclose(state.physics.qvel, data.qvel, atol=1e-3)


def replay(task, recorded, episodes):
    """Observations [E, T+1, D] of recorded actions, open loop from the recorded start."""
    starts = (recorded["object_qpos"][episodes, 0], recorded["goal"][episodes])
    state = jax.jit(jax.vmap(task.env.init_state))(*(x.astype(np.float32) for x in starts))
    seen = [state.obs["observation"]]
    for action in recorded["action"][episodes].swapaxes(0, 1):
        state = task.step_all(state, action)
        seen.append(state.obs["observation"])
    return np.stack(seen, axis=1)


@pytest.mark.parametrize(
    ("name", "object_error"), [("push", 0.010), pytest.param("pick_and_place", 0.005, marks=pytest.mark.slow), ("slide", 0.020)]
)
def test_open_loop_replay_follows_the_original(name, object_error, task):
    """On the 30 recorded scripted episodes of each task; docs/fidelity.md has what was measured."""
    recorded = load_recorded(name)
    episodes = np.flatnonzero(recorded["policy"] == 2)
    seen = replay(task(name), recorded, episodes)
    grip, obj = seen[..., :3], seen[..., 3:6]
    there, grip_there = recorded["achieved"][episodes], recorded["grip"][episodes]
    error = np.linalg.norm(grip - grip_there, axis=-1)
    assert error.mean() < 0.002
    assert np.percentile(error, 95) < 0.008
    moved, moved_there = (np.linalg.norm(path[:, -1] - path[:, 0], axis=-1) > 0.02 for path in (obj, there))
    assert np.mean(moved == moved_there) >= 0.97
    assert np.median(np.linalg.norm(obj[:, -1] - there[:, -1], axis=-1)) < object_error


@pytest.mark.slow
def test_engines_follow_the_same_episode(task, recorded):
    """`jax` against `native` on recorded scripted episodes.

    Both integrate the same model. `native` works in float64 with its solver run to 1e-8; `jax` in float32 with 8 Newton
    iterations a substep, and its box-box collision makes up to 4 contact points where C makes up to 8. The
    cube's place is compared over the 10 steps from the start, because a push amplifies any difference (the original does, too,
    when its start is moved by 0.1 mm).
    """
    episodes = np.flatnonzero(recorded["policy"] == 2)
    native = replay(task("push"), recorded, episodes)[:8]  # all of them, for which there is a program already
    mjx = replay(task("push", "jax"), recorded, episodes[:8])
    error = np.linalg.norm((native - mjx)[..., :3], axis=-1)
    # Measured 0.07 and 0.27 mm.
    assert error.mean() < 0.5e-3
    assert np.percentile(error, 95) < 1e-3
    assert np.linalg.norm((native - mjx)[:, :10, 3:6], axis=-1).max() < 2e-3


@pytest.mark.slow
def test_engines_agree_where_nothing_is_touched():
    """Rounding alone: 0.01 mm after 20 steps of free motion, in each environment of a nested batch."""
    keys = jax.random.split(jax.random.key(2), 6).reshape(2, 3)
    actions = jax.random.uniform(jax.random.key(0), (2, 3, 20, 4), minval=-0.5, maxval=0.5)

    def path(engine):
        env = envs.make("reach", engine=engine)

        def step(state, action):
            following = env.step(state, action)
            return following, following.obs["achieved_goal"]

        def episode(key, actions):
            return jax.lax.scan(step, env.reset(key), actions)[1]

        return np.asarray(jax.jit(jax.vmap(jax.vmap(episode)))(keys, actions))

    native, mjx = path("native"), path("jax")
    assert np.ptp(native, axis=2).max(axis=-1).min() > 0.02
    assert np.linalg.norm(native - mjx, axis=-1).max() < 1e-5


def test_where_a_cylinder_meets_a_box_one_of_them_has_a_stand_in():
    model = envs.make("slide", engine="native").model
    replaced = with_stand_ins(model)

    def ends(model):
        names = [[model.geom(g).name for g in pair] for pair in zip(model.pair_geom1, model.pair_geom2)]
        return {frozenset(pair) for pair in names}

    fingers = ("finger_r", "finger_l")
    assert ends(model) - ends(replaced) == {frozenset(("object", other)) for other in ("table", *fingers)}
    stand_ins = {frozenset(("object_stand_in", finger)) for finger in fingers}
    assert ends(replaced) - ends(model) == {frozenset(("object", "table_stand_in"))} | stand_ins
    alone = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom name='a' type='box' size='1 1 1'/><body><freejoint/>"
        "<geom name='b' type='cylinder' size='1 1'/></body></worldbody><contact><pair geom1='a' geom2='b'/></contact></mujoco>"
    )
    with pytest.raises(ValueError, match="geoms 'b', a cylinder, and 'a', a box, meet"):
        with_stand_ins(alone)


def test_slides_fingers_give_way_and_are_put_back(task):
    """Random actions drag them over the table. Replayed open loop, their joints are at 0 after every step, as in the original,
    and what is left of the push is seen as their velocity: up to 2 cm a step there, and here alike."""
    recorded, slide = load_recorded("slide"), task("slide")
    dragged = np.flatnonzero(recorded["policy"] == 0)
    here = replay(slide, recorded, dragged)[:, 1:]
    there = recorded["observation"][dragged, 1:]
    assert not here[..., 9:11].any()
    assert np.abs(there[..., 23:]).max() > 0.02
    assert np.corrcoef(here[..., 23:].ravel(), there[..., 23:].ravel())[0, 1] > 0.98
    at_reset = np.asarray(slide.reset(jax.random.key(0)).obs["observation"])
    np.testing.assert_allclose(at_reset[23:], recorded["observation"][0, 0, 23:], atol=1e-6)


@pytest.mark.parametrize(("task", "margin", "grown"), [("push", 0.001, "box"), ("slide", 0.001, "sphere")])
def test_jax_makes_up_for_the_margins_that_mjx_ignores(task, margin, grown):
    """One geom of each pair with a box is larger by the margin, which is 0 then; the environment's own model stays."""
    jax_env, native_env = envs.make(task, engine="jax"), envs.make(task, engine="native")
    there, here = jax_env.engine._model, native_env.engine._model
    assert here.pair_margin.max() == margin
    larger = np.flatnonzero(np.any(np.asarray(there.geom_size) != here.geom_size.astype(np.float32), axis=1))
    assert len(larger) == 1
    kind = mujoco.mjtGeom(here.geom_type[larger[0]]).name
    assert kind == f"mjGEOM_{grown.upper()}"
    growth = np.asarray(there.geom_size)[larger[0]] - here.geom_size[larger[0]]
    assert np.allclose(growth[: 3 if grown == "box" else 1], margin, atol=1e-6)
    both = np.isin(np.stack([there.pair_geom1, there.pair_geom2], axis=1), larger).any(axis=1)
    assert (np.asarray(there.pair_margin)[both] == 0).all()
    np.testing.assert_array_equal(jax_env.model.geom_size, native_env.model.geom_size)


@pytest.mark.slow  # MJX takes long to compile Slide; the engines are compared on Push and Reach
def test_the_puck_slides_alike_on_both_engines(task):
    """A puck set in motion, and left alone: the same distance, and friction 0.1 stops it where Coulomb says."""
    start, speed = jnp.array([1.2, 0.75, 0.42, 1, 0, 0, 0]), 0.5
    for engine in ENGINES:
        slide = task("slide", engine)
        state = slide.env.init_state(start, jnp.ones(3))
        qvel = state.physics.qvel.at[slide.env._object_qvel].set(jnp.array([speed, 0, 0, 0, 0, 0]))
        state = state.replace(physics=state.physics.replace(qvel=qvel))
        for _ in range(30):
            state = slide.step(state, jnp.zeros(4))
        travelled = state.obs["achieved_goal"] - start[:3]
        np.testing.assert_allclose(travelled, [speed**2 / (2 * 0.1 * 9.81), 0, 0], atol=0.004)


def test_the_object_rests_and_the_table_holds_it(native, task):
    """Left alone, away from the gripper, the cube stays within 0.1 mm of where it was put."""
    state = jax.jit(native.init_state)(jnp.array([1.4, 0.9, 0.42489222, 1, 0, 0, 0]), jnp.ones(3))
    for _ in range(50):
        state = task("push").step(state, jnp.zeros(4))
    assert np.linalg.norm(state.obs["achieved_goal"] - np.array([1.4, 0.9, 0.42489222])) < 1e-4


def test_an_object_off_the_table_falls_to_the_floor_and_no_further(native, task):
    state = jax.jit(native.init_state)(jnp.array([1.7, 0.75, 0.42, 1, 0, 0, 0]), jnp.ones(3))
    for _ in range(50):
        state = task("push").step(state, jnp.zeros(4))
    assert abs(float(state.obs["achieved_goal"][2]) - 0.025) < 1e-3


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_physics_that_blows_up_is_quarantined(engine, task, monkeypatch, tmp_path):
    """NaN, Inf and 10^9 injected into half of the environments: these start anew and say so, the others do not notice."""
    monkeypatch.chdir(tmp_path)  # MuJoCo C writes MUJOCO_LOG.TXT
    push = task("push", engine)
    num_envs = 256 if engine == "native" else 8
    start = push.reset_all(jax.random.split(jax.random.key(0), num_envs))
    physics = start.physics
    kinds = np.random.default_rng(0).permutation(num_envs)[: num_envs // 2].reshape(4, -1)
    qpos = physics.qpos.at[kinds[0], 9].set(jnp.nan).at[kinds[1], 0].set(jnp.inf)
    qvel = physics.qvel.at[kinds[2], 1].set(1e9).at[kinds[3], 7].set(jnp.nan)
    hurt = start.replace(physics=physics.replace(qpos=qpos, qvel=qvel))
    actions = jax.random.uniform(jax.random.key(1), (4, num_envs, 4), minval=-1, maxval=1)

    def play(state):
        states = [state := push.step_all(state, action) for action in actions]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *states)

    clean, played = play(start), play(hurt)
    bad = np.isin(np.arange(num_envs), kinds)
    np.testing.assert_array_equal(played.failed, np.broadcast_to(bad, (4, num_envs)))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[:, ~bad], b[:, ~bad]), clean, played)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((played.physics, played.obs, played.reward)))
    assert not played.success[:, bad].any()
    assert not clean.failed.any()
    np.testing.assert_array_equal(played.obs["desired_goal"], clean.obs["desired_goal"])
