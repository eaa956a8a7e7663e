"""Tasks from an MJCF (`envs.task`): controls, goals, observations and starts, by values computed by hand."""

import copy
import dataclasses
import pickle

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import testing
from mjx_dher.envs import task
from mjx_dher.envs.engines import Physics
from mjx_dher.viewer.player import Player, make_game

# Two hinges with servos, a motor on a slide, and a free box: nothing touches anything, and there is no gravity.
MACHINE = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0" timestep="0.01"/>
  <default><joint damping="1" armature="1"/></default>
  <worldbody>
    <body name="one"><joint name="a" axis="0 0 1" range="-1 2"/><geom size=".02" pos=".5 0 0"/>
      <body name="two" pos=".5 0 0"><joint name="b" axis="0 0 1" range="-2 2"/><geom size=".02" pos=".5 0 0"/>
        <site name="tip" pos=".5 0 0"/></body></body>
    <body name="cart" pos="0 5 0"><joint name="c" type="slide" axis="1 0 0"/><geom size=".1"/></body>
    <body name="box" pos="0 0 1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
    <body name="hand" mocap="true" pos="3 0 0"/>
    <body name="held" pos="3 0 0"><freejoint/><geom size=".1"/></body>
  </worldbody>
  <equality><weld body1="hand" body2="held" relpose="0 0 0 1 0 0 0"/></equality>
  <actuator>
    <position name="servo" joint="a" kp="10" kv="1" gear="2"/>
    <position joint="b" kp="10" kv="1" ctrlrange="-1 1.5"/>
    <motor joint="c" ctrlrange="-4 4"/>
  </actuator>
  <keyframe><key name="bent" qpos="0.3 -0.2 0 0 0 1 1 0 0 0 3 0 0 1 0 0 0" ctrl="0.1 0.2 0.3"/></keyframe>
</mujoco>"""


class Machine(task.MujocoTask):
    model = MACHINE
    goal = task.Position("site:tip", (0.3, 0.3, 0.0), (0.6, 0.6, 0.0), threshold=0.1)
    hz = 20.0


def make(**declared):
    return type("Declared", (Machine,), declared)(engine="native")


START = Physics(
    qpos=jnp.array([0.3, -0.2, 0.5, 0, 0, 1, 1, 0, 0, 0, 3, 0, 0, 1, 0, 0, 0]), qvel=jnp.arange(15.0), warmstart=0, act=0
)


CONTROLS = [
    # From the middle of the range of a servo with gear 2, whose joint has -1 to 2, and of one with -1 to 1.5.
    (task.JointPosition(), [0.0, 1.0], [1.0, 1.5, 0], None),
    (task.JointPosition("b"), [-1.0], [0, -1.0, 0], None),
    (task.JointDelta("servo b", scale=0.5), [1.0, -1.0], [2 * 0.8, -0.7, 0], None),
    (task.JointDelta("b", scale=9.0), [1.0], [0, 1.5, 0], None),
    (task.Torque("c"), [-0.5], [0, 0, -2.0], None),
    (task.Actuators("c *"), [1.0, 1.0, 1.0], [4.0, 1.5, 4.0], None),
    (task.JointPosition("servo b", together=True), [-1.0], [-2.0, -1.0, 0], None),
    (task.Mocap("hand", scale=0.1), [1.0, 0.0, -1.0], [0, 0, 0], [3.1, 0, -0.1, 1, 0, 0, 0]),
    (task.Mocap("hand", turn=np.pi / 2), [0, 0, 0, 0, 0, 1.0], [0, 0, 0], [3, 0, 0, 2**-0.5, 0, 0, 2**-0.5]),
    ((task.Torque(), task.Mocap("hand", scale=1.0)), [0.5, 0, 1.0, 0], [0, 0, 2.0], [3, 1, 0, 1, 0, 0, 0]),
]


def test_controls():
    tasks = [make(control=control) for control, *_ in CONTROLS]
    assert [env.action_size for env in tasks] == [len(action) for _, action, *_ in CONTROLS]
    actions = [jnp.array(action) for _, action, *_ in CONTROLS]
    results = jax.jit(lambda *actions: [env.controls(START, action) for env, action in zip(tasks, actions)])(*actions)
    for (_, _, ctrl, mocap), controls in zip(CONTROLS, results, strict=True):
        np.testing.assert_allclose(controls.ctrl, ctrl, atol=1e-6)
        np.testing.assert_allclose(controls.mocap[0], [3, 0, 0, 1, 0, 0, 0] if mocap is None else mocap, atol=1e-6)


def test_observations():
    parts = {
        "site:tip": [0.5 * np.cos(0.3) + 0.5 * np.cos(0.1), 0.5 * np.sin(0.3) + 0.5 * np.sin(0.1), 0],
        "body:two": [0.5 * np.cos(0.3), 0.5 * np.sin(0.3), 0],
        "body:box - body:two": [-0.5 * np.cos(0.3), -0.5 * np.sin(0.3), 1],
        "rot:tip": [np.cos(0.1), np.sin(0.1), 0, -np.sin(0.1), np.cos(0.1), 0],
        "rot:box": [1, 0, 0, 0, 1, 0],
        "angvel:tip": [0, 0, 0 + 1],
        "vel:two": [0, 0, 0],  # the first joint is at rest
        "vel:site:tip": [-0.5 * np.sin(0.1), 0.5 * np.cos(0.1), 0],
        "vel:box": [3, 4, 5],
        "angvel:box": [6, 7, 8],
        "qpos:a c": [0.3, 0.5],
        "qvel:?": [0, 1, 2],
        "qpos:joint_3": [0, 0, 1, 1, 0, 0, 0],  # of the box
        "qpos:a - qpos:b - qpos:c": [0.3 + 0.2 - 0.5],
    }
    env = make(observations=tuple(parts), control=task.Torque())
    observed = jax.jit(env.observe)(START)
    assert list(env.layout) == list(parts)
    assert observed.shape == (env.observation_size,) == (sum(map(len, parts.values())),)
    for text, value in parts.items():
        np.testing.assert_allclose(observed[env.layout[text]], value, atol=1e-6, err_msg=text)
    assert make(observations=("qpos:*",)).observation_size == env.model.nq
    with refuses("joint", "'joint_*'"):  # of joints without a name
        make(observations=("qpos:joint_*",))


def turned(angle, axis=2):
    """The goal of a turn about one of the world's axes."""
    mat = np.zeros(9)
    mujoco.mju_axisAngle2Quat(quat := np.zeros(4), np.eye(3)[axis], angle)
    mujoco.mju_quat2Mat(mat, quat)
    return mat.reshape(3, 3)[:, :2].T.ravel()


GOALS = [
    (task.Position("body:box", (0, 0, 1), (1, 0, 2)), [0, 0, 1], [0.3, 0, 1.4], 0.5),
    (task.Rotation("box"), turned(0), turned(1e-3, axis=1), 1e-3),
    (task.Rotation("box", axis=(0, 0, 1)), turned(0), turned(np.pi), np.pi),
    (task.Pose("box", (0, 0, 0), (1, 1, 1)), [0, 0, 1, *turned(0)], [0, 0, 1.04, *turned(0.2, axis=0)], 0.1),
    (task.Pose("box", (0, 0, 0), (1, 1, 1)), [0, 0, 1, *turned(0)], [0, 0, 2, *turned(0.2, axis=0)], 1.0),
    (task.Joints("a b"), [0.3, -0.2], [0.4, 0.2], 0.4),
    (task.Joints("c", low=[-1], high=[1]), [0.5], [0.25], 0.25),
]


def test_goals():
    tasks = [make(goal=goal, control=task.Torque()) for goal, *_ in GOALS]

    @jax.jit
    def ask():
        def one(env, achieved, other):
            achieved, many = jnp.float32(achieved), jnp.float32([other, achieved])
            drawn = jax.vmap(env.sample_goal)(jax.random.split(jax.random.key(0), 500))
            results = (function(achieved, many) for function in (env.goal_distance, env.reached, env.compute_reward))
            return env.achieved(START), *results, drawn

        return [one(env, achieved, other) for env, (_, achieved, other, _) in zip(tasks, GOALS, strict=True)]

    for env, (_, achieved, _, distance), (seen, distances, reached, rewards, drawn) in zip(tasks, GOALS, ask(), strict=True):
        np.testing.assert_allclose(seen, achieved, atol=1e-6)
        assert env.goal_size == len(achieved)
        np.testing.assert_allclose(distances, [distance, 0], rtol=1e-4, atol=1e-6)
        near = distance <= env.distance_threshold
        assert (list(reached), list(rewards)) == ([near, True], [0 if near else -1, 0])
        assert np.isfinite(drawn).all()
        if env.goal.low is not None:
            part = drawn[:, : len(env.goal.low)]
            np.testing.assert_allclose([part.min(0), part.max(0)], [env.goal.low, env.goal.high], atol=0.02)
        if env.goal_size in (6, 9):
            angles = task.Rotation.distance(drawn[:, -6:], jnp.float32(turned(0)))
            assert angles.min() < 0.5 < 3 < angles.max()


def test_goals_are_drawn_as_balls_and_ghosts():
    """A site's goal is drawn by its body, at the pose that brings the site to the goal."""
    qpos = np.asarray(START.qpos)
    marks = [
        env.goal_marks(qpos, np.float32(goal))
        for env, goal in (
            (make(), [0.3, 0.4, 0]),
            (make(goal=task.Rotation("tip")), turned(np.pi / 2)),
            (make(goal=task.Joints("b")), [np.pi / 2 - 0.3]),
        )
    ]
    data = mujoco.MjData(make().model)
    data.qpos[:] = qpos
    mujoco.mj_forward(make().model, data)
    tip, two = data.site("tip").xpos, data.body("two")
    ((body, pos, _),), (turn,), (bent,) = marks
    assert body == -1
    np.testing.assert_allclose(pos, [0.3, 0.4, 0], atol=1e-6)
    for (body, pos, quat), place in ((turn, tip - [0, 0.5, 0]), (bent, two.xpos)):
        assert body == two.id
        np.testing.assert_allclose(pos, place, atol=1e-6)
        np.testing.assert_allclose(quat, [2**-0.5, 0, 0, 2**-0.5], atol=1e-6)


class Settled(Machine):
    """Everything of a start: a keyframe, ranges and settling."""

    start = task.Start("bent", ranges={"box": ((1, 1, 1), (2, 1, 3)), "a": (0.2, 0.4)}, settle=3)
    control = task.JointDelta("b")


def test_starts():
    env = Settled(engine="native")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))
    qpos = np.asarray(states.physics.qpos)
    np.testing.assert_allclose([qpos[:, 3:6].min(0), qpos[:, 3:6].max(0)], [[1, 1, 1], [2, 1, 3]], atol=0.2)
    assert len(np.unique(qpos[:, 3])) == len(np.unique(qpos[:, 5])) == 64
    np.testing.assert_array_equal(qpos[:, 6:10], np.tile([1, 0, 0, 0], (64, 1)))
    assert np.ptp(qpos[:, 0]) > 0.05  # the first joint has moved from where it was drawn, held by the keyframe's inputs
    data = mujoco.MjData(env.model)
    mujoco.mj_resetDataKeyframe(env.model, data, 0)
    for _ in range(15):  # 3 steps of 50 ms
        mujoco.mj_step(env.model, data)
    np.testing.assert_allclose(qpos[:, 1:3], np.tile(data.qpos[1:3], (64, 1)), atol=0.02)


@pytest.mark.slow
def test_it_is_an_environment():
    testing.check_env(Settled(engine="native"))


def test_a_simulation_that_blows_up_fails_and_goes_back_to_the_start():
    env = make(start=task.Start("bent"), control=task.Torque())
    first = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(env.step)
    still = first.physics.qvel
    for qvel, action in ((still.at[0].set(jnp.nan), 0.0), (still.at[2].set(1e30), 0.0), (still, jnp.nan)):
        state = step(dataclasses.replace(first, physics=first.physics.replace(qvel=qvel)), jnp.array([action]))
        assert (bool(state.failed), float(state.success)) == (True, 0.0)
        np.testing.assert_array_equal(state.physics.qpos, first.physics.qpos)
        assert env.with_goal(state, state.obs["achieved_goal"]).success == 0
        state = step(state, jnp.zeros(1))
        assert np.isfinite(np.append(state.obs["observation"], 0 if state.failed else np.nan)).all()


def test_a_start_that_diverged_fails_and_shows_the_rest():
    class Settles(Machine):
        start = task.Start("bent")

        def start_physics(self, key):
            physics = super().start_physics(key)
            return dataclasses.replace(physics, qpos=jnp.full_like(physics.qpos, jnp.nan))

    state = Settles(engine="native").reset(jax.random.key(0))
    assert (bool(state.failed), float(state.success)) == (True, 0.0)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state.obs, state.physics)))


@pytest.mark.parametrize(
    ("declared", "parts"),
    [
        ({"goal": task.Position("site:tap", (0, 0, 0), (1, 1, 1))}, ("site", "tap", "tip")),
        ({"goal": task.Position("site:tip", (0, 0, 0), (1, 1))}, ("site:tip", 3)),
        ({"goal": task.Position("site:tip", (3, 0, 0), (4, 1, 1))}, ("goal", "site:tip", "3.", "4.")),
        ({"goal": task.Position("site:tip", (np.nan, 0, 0), (4, 1, 1))}, ("site:tip", "nan")),
        ({"goal": task.Joints("c")}, ("joint", "c")),
        ({"goal": task.Joints("a", low=[0], high=[2.5])}, ("a", 2, 2.5)),
        ({"goal": task.Joints("d")}, ("joint", "d", "a", "b", "c")),
        ({"control": task.JointPosition("c")}, ("JointPosition", "c", "servo", "b")),
        ({"control": task.Torque("servo")}, ("Torque", "servo", "c")),
        ({"control": task.Mocap("held")}, ("mocap", "held", "hand")),
        ({"observations": ("qpos:a", "site:tap")}, ("site", "tap", "tip")),
        ({"observations": ("places:tip",)}, ("places", "site", "body", "qvel")),
        ({"observations": ("site:tip - qpos:a",)}, ("site:tip - qpos:a", 3, 1)),
        ({"observations": ("body:hand",)}, ("body:hand",)),
        ({"start": task.Start("bend")}, ("keyframe", "bend", "bent")),
        ({"start": task.Start(ranges={"bx": (0, 1)})}, ("bx", "box", "a")),
        ({"start": task.Start(ranges={"box": (0, 1)})}, ("box", 3)),
        ({"start": task.Start(ranges={"a": (0, 3)})}, ("a", 2, "(0, 3)")),
        ({"start": task.Start(ranges={"a": 3})}, ("a", 3)),
        ({"start": task.Start(settle=-1)}, ("settle", -1)),
        ({"start": task.Start}, ("start", "Start")),
        ({"goal": task.Rotation("tip", axis=(0, 0, 0))}, ("axis", "(0, 0, 0)")),
        ({"goal": task.Rotation("tip", threshold=0)}, ("threshold", 0)),
        ({"control": (task.JointDelta("b"), task.JointPosition("b"))}, ("control", "b")),
        ({"control": task.JointDelta("b", scale=np.nan)}, ("scale", "nan")),
        ({"control": ()}, ("control",)),
        ({"observations": ("qpos:a", "qpos:a")}, ("observations", "qpos:a")),
        ({"max_speed": 0}, ("max_speed", 0)),
        ({"observation": ("qpos:a",)}, ("Declared.observation", "observations")),
        ({"episode_lenght": 30}, ("Declared.episode_lenght", "episode_length")),
        ({"distance_threshold": 0.01}, ("Declared.distance_threshold", "set the goal's threshold")),
        ({"hz": 30}, ("hz", 30, "0.01")),
        ({"model": "no_such.xml"}, ("Declared", "no_such.xml")),
        ({"model": MACHINE.replace('armature="1"', "")}, ("unstable", "a")),
    ],
)
def test_a_declaration_that_does_not_fit_the_model_is_rejected_before_training(declared, parts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with refuses(*parts):
        make(**declared)
    assert list(tmp_path.iterdir()) == []  # no MUJOCO_LOG.TXT


NAMELESS = """
<mujoco>
  <default><joint damping="1"/><geom size=".1"/></default>
  <worldbody>
    <body><joint axis="0 0 1"/><geom/><body pos=".3 0 0"><joint/><geom/><site name="s"/></body></body>
    <body pos="0 0 1"><freejoint/><geom/></body>
  </worldbody>
  <actuator><motor site="s" ctrlrange="-1 1"/></actuator>
  <keyframe><key qpos="0.5 0 0 0 2 1 0 0 0"/></keyframe>
</mujoco>"""


def test_objects_without_a_name_are_numbered():
    ranges = {"joint_1": (0, 1), "body_3": ((0, 0, 1), (1, 1, 1))}
    env = make(
        model=NAMELESS,
        control=task.Actuators(),
        goal=task.Position("body:body_2", (0.2, 0.2, 0), (0.2, 0.2, 0)),
        observations=("qpos:*", "qvel:*"),
        start=task.Start("key_0", ranges),
        hz=25,
    )
    assert (env.parts[0].moved, env.observation_size) == (["actuator_0"], 9 + 8)
    np.testing.assert_allclose(env.achieved(env.start.physics)[:2], [0.3 * np.cos(0.5), 0.3 * np.sin(0.5)], atol=1e-6)


def test_objects_that_overlap_at_the_start_are_reported():
    with pytest.warns(UserWarning, match=r"'two' and 'box' overlap by 0.12 m"):
        make(start=task.Start(ranges={"box": ((1, 0, 0), (1, 0, 0))}))


def test_a_pickle_is_the_same_task():
    env = Settled(engine="native")
    for copied in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        np.testing.assert_array_equal(jax.jit(copied.observe)(START), jax.jit(env.observe)(START))


def test_an_action_of_another_size_is_rejected():
    env = make(control=task.Torque())
    state = jax.eval_shape(env.reset, jax.random.key(0))
    with refuses("action", "(3,)", "(1,)"):
        jax.eval_shape(env.step, state, jnp.zeros(3))


def test_the_viewer_moves_goals_and_objects():
    """A pose keeps its orientation while its position is dragged; a goal of joints cannot be dragged."""
    game = make_game(make(start=Settled.start, goal=task.Pose("box", (0, 0, 0), (1, 1, 1)), control=task.Torque()))
    player = Player(game, lambda obs: np.zeros(1, np.float32), seed=1)
    rotation = player.obs["desired_goal"][3:]
    player.move_goal(np.array([0.5, 9.0, 0.25]))
    np.testing.assert_allclose(player.obs["desired_goal"], [0.5, 1, 0.25, *rotation], atol=1e-6)
    player.move_object(np.array([9.0, 1.0, 2.0]))
    np.testing.assert_allclose(player.obs["achieved_goal"], [2, 1, 2, *turned(0)], atol=1e-6)
    assert player.distance == pytest.approx(
        float(game.env.goal_distance(player.obs["achieved_goal"], player.obs["desired_goal"]))
    )
    assert [body for body, _, _ in player.marks] == [-1, game.env.model.body("box").id]
    player.turn_goal(np.array([2.0, 0.0, 0.0, 2.0]))
    np.testing.assert_allclose(player.obs["desired_goal"], [0.5, 1, 0.25, *turned(np.pi / 2)], atol=1e-6)
    for orientation in (np.zeros(4), np.full(4, np.nan), np.ones(3)):
        with refuses("goal"):
            player.turn_goal(orientation)
    joints = make_game(make(goal=task.Joints("a b c", [0] * 3, [1] * 3)))
    assert (joints.move_goal, joints.turn_goal) == (None, None)
