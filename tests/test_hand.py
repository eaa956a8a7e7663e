"""The Shadow-hand tasks: goals against formulas of the original, starts, and models against the original's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT, refuses
from scipy.spatial.transform import Rotation

from mjx_dher import envs, presets
from mjx_dher.components import robot
from mjx_dher.envs import hand
from mjx_dher.tools import transfer
from mjx_dher.viewer import sources

HANDS = [name for name in envs.list_envs() if robot(name) == "hand"]


@pytest.fixture(scope="module")
def block():
    return envs.make("block", engine="native")


def unit(rng, *shape):
    quat = rng.normal(size=(*shape, 4))
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def signed_angle(a, b):
    """2 arccos of the scalar part of a b*, in float64."""
    return 2 * np.arccos(np.clip(np.sum(a * b, axis=-1), -1, 1))


def from_euler(angles):
    """The product of three quaternions of half angles, in float64."""
    turns = [
        np.insert(np.zeros(3), 0, np.cos(angle / 2)) + np.insert(np.eye(3)[i] * np.sin(angle / 2), 0, 0.0)
        for i, angle in enumerate(angles)
    ]
    product = turns[0]
    for w, *v in turns[1:]:
        v = np.array(v)
        product = np.array([product[0] * w - product[1:] @ v, *(product[0] * v + w * product[1:] + np.cross(product[1:], v))])
    return product


def test_the_sign_of_a_quaternion_counts():
    rng = np.random.default_rng(0)
    a, b = unit(rng, 500), unit(rng, 500)
    goals = [jnp.float32(np.concatenate([np.zeros((500, 3)), quat], axis=1)) for quat in (a, b, -a)]
    distance = hand.ObjectPose("xyz").distance
    np.testing.assert_allclose(distance(goals[0], goals[1]), signed_angle(a, b), atol=2e-5)
    np.testing.assert_allclose(distance(goals[0], goals[2]), 2 * np.pi, atol=1e-5)
    assert not distance(goals[0], goals[0]).any()


def test_a_pen_s_third_angle_does_not_count():
    rng = np.random.default_rng(1)
    a, b = unit(rng, 200), unit(rng, 200)
    want = []
    for first, second in zip(a, b):
        angles, others = (Rotation.from_quat(quat, scalar_first=True).as_euler("XYZ") for quat in (first, second))
        want.append(signed_angle(from_euler([*angles[:2], others[2]]), second))
    goals = [jnp.float32(np.concatenate([np.zeros((200, 3)), quat], axis=1)) for quat in (a, b)]
    np.testing.assert_allclose(jax.jit(hand.ObjectPose("xyz", ignores_z=True).distance)(*goals), want, atol=1e-4)


def test_a_pen_reaches_its_own_goal_and_others_with_its_direction():
    env = envs.make("pen_rotate", engine="native")
    state = jax.tree.map(jnp.asarray, env._rest)
    pose_of = jax.jit(lambda quat: env.achieved(state.replace(qpos=state.qpos.at[27:].set(quat))))
    reached = jax.jit(env.reached)
    for quat in unit(np.random.default_rng(2), 20):
        pose = pose_of(quat)
        assert reached(pose, pose)
        angles = Rotation.from_quat(quat, scalar_first=True).as_euler("XYZ")
        assert reached(pose_of(from_euler([*angles[:2], 0.3])), pose)


def test_a_position_counts_as_much_as_an_angle(block):
    goal = jnp.array([1.0, 0.9, 0.2, 1.0, 0.0, 0.0, 0.0])
    near, far = (goal.at[0].add(apart) for apart in (0.0099, 0.0101))
    assert block.compute_reward(near, goal) == 0
    assert block.compute_reward(far, goal) == -1
    np.testing.assert_allclose(block.goal_distance(far, goal), 0.101, rtol=1e-4)
    np.testing.assert_allclose(envs.make("pen", engine="native").goal_distance(far, goal), 0.0202, rtol=1e-3)
    turned = goal.at[3:].set(jnp.array([np.cos(0.06), 0, 0, np.sin(0.06)]))
    np.testing.assert_allclose(
        envs.make("block", engine="native", reward_type="dense").compute_reward(turned, far), -0.221, rtol=1e-4
    )


def test_the_faces_of_a_cube_are_24():
    quats = np.array(hand._from_euler(jnp.float32(hand.FACES)))
    matrices = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    assert len({tuple(np.round(matrix).astype(int).ravel()) for matrix in matrices}) == 24
    np.testing.assert_allclose(matrices, np.round(matrices), atol=1e-6)


@pytest.mark.parametrize("kind", hand.ROTATIONS)
def test_rotations_are_drawn_as_in_the_original(kind):
    draw = jax.jit(jax.vmap(lambda key: hand.draw_rotation(key, kind)))
    quats = np.array(draw(jax.random.split(jax.random.key(0), 2000)))
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-6)
    if kind == "parallel":
        faces = Rotation.from_quat(quats, scalar_first=True).as_matrix()[:, 2]
        np.testing.assert_allclose(np.abs(faces).max(axis=1), 1, atol=1e-5)
        assert np.ptp(np.argmax(np.abs(faces), axis=1)) == 2
        return
    assert quats[:, 0].min() >= 0
    angles = np.sort(2 * np.arctan2(np.linalg.norm(quats[:, 1:], axis=1), quats[:, 0]))
    assert np.abs(angles / np.pi - np.linspace(0, 1, 2000)).max() < 0.045  # uniform: Kolmogorov-Smirnov at 0.1 %
    assert (kind == "z") == (not quats[:, 1:3].any())


def test_goals_have_unit_quaternions_or_raise(block):
    physics = jax.tree.map(jnp.asarray, block._rest)
    goal = jnp.array([1.0, 0.9, 0.2, 0.0, 3.0, 0.0, 4.0])
    state = block.first_state(physics, goal)
    np.testing.assert_allclose(state.obs["desired_goal"][3:], [0, 0.6, 0, 0.8], atol=1e-7)
    np.testing.assert_allclose(block.with_goal(state, 2 * goal).obs["desired_goal"][3:], [0, 0.6, 0, 0.8], atol=1e-7)
    for bad in (goal.at[3:].set(0.0), goal.at[4].set(jnp.nan), goal.at[4].set(jnp.inf)):
        with refuses("desired_goal", "quaternion"):
            block.with_goal(state, bad)
        assert jax.jit(block.with_goal)(state, bad).success == 0
    with refuses("desired_goal", "[3]", "[7]"):
        block.with_goal(state, goal[:3])
    with refuses("qpos", "[7]", "[31]"):
        block.init_state(jnp.zeros(7), goal)
    with refuses("qvel", "[6]", "[30]"):
        block.init_state(physics.qpos, goal, jnp.zeros(6))
    with refuses("qpos", "quaternion"):
        block.init_state(physics.qpos.at[27:].set(0.0), goal)
    there = block.init_state(jnp.concatenate([physics.qpos[:24], goal]), goal)  # its quaternions have length 5
    assert there.success == 1
    np.testing.assert_allclose(there.obs["achieved_goal"], there.obs["desired_goal"], atol=1e-6)


def test_fingertips_are_seen_one_timestep_late():
    import mujoco

    env, rng = envs.make("hand_reach", engine="native"), np.random.default_rng(0)
    data = mujoco.MjData(env.model)
    mujoco.mj_resetDataKeyframe(env.model, data, 0)
    data.qvel[:] = rng.normal(size=24)
    mujoco.mj_step(env.model, data)
    physics = jax.tree.map(jnp.asarray, env._rest).replace(qpos=jnp.float32(data.qpos), qvel=jnp.float32(data.qvel))
    want = np.concatenate([data.site(name).xpos for name in hand.TIPS])  # of the state before the step
    np.testing.assert_allclose(jax.jit(env.achieved)(physics), want, atol=1e-6)
    np.testing.assert_allclose(jax.jit(env.observe)(physics)[48:], want, atol=1e-6)
    goals = np.array(jax.jit(jax.vmap(env.sample_goal))(jax.random.split(jax.random.key(0), 2000))).reshape(-1, 5, 3)
    moved = np.linalg.norm(goals - env.goal.first, axis=-1) > 1e-6
    stays = ~moved.any(axis=1)
    assert abs(stays.mean() - 0.1) < 0.03
    assert (moved[~stays].sum(axis=1) == 2).all()
    assert moved[~stays, 4].all()
    apart = np.linalg.norm(
        goals[~stays, 4] - goals[~stays][moved[~stays, :4].nonzero()[0], moved[~stays, :4].nonzero()[1]], axis=-1
    )
    assert apart.max() < 0.0101


def test_settled_objects_lie_in_the_hand(block):
    """And goals of the pose lie around where they came to rest."""
    state = jax.jit(jax.vmap(block.reset))(jax.random.split(jax.random.key(3), 4))
    assert (state.physics.qpos[:, 26] > 0.1).all()
    assert np.abs(np.array(state.physics.qvel[:, :24])).max() < 1.0
    offsets = np.array(state.obs["desired_goal"][:, :3] - state.obs["achieved_goal"][:, :3])
    assert (offsets >= np.array(hand.OFFSETS[0]) - 1e-6).all()
    assert (offsets <= np.array(hand.OFFSETS[1]) + 1e-6).all()


def test_an_object_that_falls_is_dropped_again(block, monkeypatch):
    """A start whose object is below the palm is drawn again; after the last attempt it is taken as it is."""
    heights = jnp.array([0.01, jnp.nan, 0.2])
    key = jax.random.key(0)
    keys = jnp.stack([jax.random.key_data(jax.random.fold_in(key, count))[1] for count in range(3)])
    monkeypatch.setattr(hand.MujocoTask, "start_physics", lambda self, key: _dropped(self, key, keys, heights))
    assert block.start_physics(key).qpos[26] == jnp.float32(0.2)
    monkeypatch.setattr(hand, "ATTEMPTS", 1)
    assert block.start_physics(key).qpos[26] == jnp.float32(0.01)


def _dropped(env, key, keys, heights):
    rest = jax.tree.map(jnp.asarray, env._rest)
    return rest.replace(qpos=rest.qpos.at[26].set(heights[jnp.argmax(jax.random.key_data(key)[1] == keys)]))


def test_a_policy_of_one_hand_task_is_not_played_in_another(tmp_path):
    from conftest import save_policy

    from mjx_dher import RunSpec, policy
    from mjx_dher.runs.folder import run_folder

    out = tmp_path / "egg"
    run_folder.write_config(out, RunSpec(env="egg", engine="native"), "native", {})
    layers = ((np.zeros((68, 20), np.float32), np.zeros(20, np.float32)),)
    zeros, ones = (np.zeros(61), np.zeros(7)), (np.ones(61), np.ones(7))
    save_policy(out, policy.Policy(layers, zeros[0], ones[0], zeros[1], ones[1], norm_clip=5.0, obs_clip=200.0))
    assert sources.of_run("mine", out, "egg").env == "egg"
    with refuses("mine", "egg", "pen_rotate"):
        sources.of_run("mine", out, "pen_rotate")


@pytest.mark.parametrize("name", presets.PRESETS)
def test_presets_are_valid_for_hands(name):
    from mjx_dher import spec

    for env in HANDS:
        spec.validate(presets.preset(name, env))
    assert presets.preset("gpu", "block_rotate_z").learner == "dtqc"


@pytest.mark.parametrize(
    ("name", "episodes", "steps"),
    [
        ("egg_rotate", 3, 20),
        *(pytest.param(name, 15, 100, marks=pytest.mark.slow) for name in ("egg_rotate", "pen_rotate", "hand_reach")),
    ],
)
def test_recorded_episodes_of_the_original_are_replayed_to_rounding(name, episodes, steps):
    """But for those of the block: MuJoCo 3.17 and 3.11, which recorded them, differ in contacts of boxes."""
    with np.load(ROOT / "tests" / "data" / f"hand_{name}.npz") as file:
        recorded = {key: file[key][:episodes] for key in file.files}
    env = envs.make(name, engine="native")
    steps = min(steps, env.episode_length)

    @jax.jit
    @jax.vmap
    def play(qpos, qvel, goal, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, (state.physics.qpos, state.reward)

        return jax.lax.scan(step, env.init_state(qpos, goal, qvel), actions)[1]

    actions = recorded["action"][:, :steps] / np.float32(127)
    qpos, reward = play(recorded["qpos"][:, 0], recorded["qvel"], recorded["goal"], actions)
    there = recorded["qpos"][:, 1 : 1 + steps // 10]
    median = np.median(np.abs(qpos[:, 9::10] - there).max(axis=-1), axis=0)
    np.testing.assert_array_less(median, 1e-5)  # rad and m; contacts amplify rounding in some episodes
    assert np.mean(np.array(reward) == recorded["reward"][:, :steps]) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("name", ["block_rotate_xyz", "egg_rotate", "pen_rotate", "hand_reach"])
def test_starts_and_goals_are_distributed_as_in_the_original(name):
    """Kolmogorov-Smirnov at 0.1 %, coordinate by coordinate, against 200 recorded resets."""
    with np.load(ROOT / "tests" / "data" / f"hand_{name}.npz") as file:
        starts, goals = file["starts"], file["goals"]
    env = envs.make(name, engine="native")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 400))
    pairs = [(np.array(state.physics.qpos)[:, 24:], starts), (np.array(state.obs["desired_goal"]), goals)]
    for ours, theirs in pairs:
        for a, b in zip(ours.T, theirs.T, strict=True):
            grid = np.sort(np.concatenate([a, b])) + 1e-6  # constant coordinates differ by rounding
            shares = [np.searchsorted(np.sort(each), grid, "right") / len(each) for each in (a, b)]
            assert np.abs(shares[0] - shares[1]).max() < 1.95 * np.sqrt(1 / len(a) + 1 / len(b))


def test_a_hand_has_20_servos_and_the_original_s_observation():
    assert len(HANDS) == 9
    assert set(HANDS) < set(transfer.ORIGINALS)
    for name in ("block_rotate_z", "egg", "pen_rotate", "hand_reach"):
        env = envs.make(name, engine="native")
        size = (63, 15, 50) if name == "hand_reach" else (61, 7, 100)
        assert (env.observation_size, env.goal_size, env.episode_length) == size
        assert (env.action_size, env.dt) == (20, pytest.approx(0.04))
        assert env.layout["qpos:??J?"] == slice(0, 24)
        assert [env.model.joint(i).name for i in (0, 2, 23)] == ["WRJ1", "FFJ3", "THJ0"]
