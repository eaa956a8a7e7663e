"""The viewer's player, in an environment that can be computed by hand: a point on a line that goes where it is told."""

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import refuses

from mjx_dher import envs
from mjx_dher.viewer import panel
from mjx_dher.viewer.player import Game, Player, Tally, bounds, make_game

LENGTH = 4  # steps of an episode
HOLD, SHOWN = 15, 250  # steps for which the end of an episode is shown, and that the curves show
REACH = 0.05  # m


def state(x, goal, failed=False):
    obs = {"observation": np.array([x]), "achieved_goal": np.array([x, 0, 0]), "desired_goal": np.asarray(goal, float)}
    success = float(np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"]) < REACH)
    return SimpleNamespace(obs=obs, success=success, failed=failed, physics=SimpleNamespace(qpos=np.array([x])))


GAME = Game(
    env=SimpleNamespace(episode_length=LENGTH, distance_threshold=REACH, goal_bounds=[[0, 0, 0], [1, 1, 0]]),
    reset=lambda seed: state(0.0, [0.4, 0, 0]),
    step=lambda before, action: state(before.obs["observation"][0] + action[0], before.obs["desired_goal"], abs(action[0]) > 9),
    move_goal=lambda before, position: state(before.obs["observation"][0], position),
    move_object=lambda before, position: state(position[0], before.obs["desired_goal"]),
)


def follow(obs):
    """Goes a tenth of a metre towards the goal."""
    return np.clip(obs["desired_goal"][:1] - obs["achieved_goal"][:1], -0.1, 0.1)


def test_it_keeps_time():
    player = Player(GAME, follow)
    assert player.advance(0.02) == 0
    assert player.advance(0.02) == 1  # 40 ms a step
    player.speed = 2.0
    assert player.advance(0.06) == 3
    assert (player.clock, player.episodes) == (4, Tally(1, 1))


def test_the_environment_says_how_long_a_step_takes():
    player = Player(GAME._replace(env=SimpleNamespace(**vars(GAME.env), dt=0.01)), follow)
    assert player.advance(0.04) == 4
    assert player.advance(3600) == 40
    assert player.history.maxlen == 1000  # 10 s
    assert [time for time, _, _ in player.history][:3] == [0.0, 0.01, 0.02]


def test_time_that_a_slow_machine_loses_is_not_made_up():
    player = Player(GAME, follow)
    assert player.advance(3600) == 10
    assert player.advance(0.04) == 1


def test_a_pause_stops_the_clock():
    player = Player(GAME, follow)
    player.playing = False
    assert player.advance(10) == 0
    player.step()
    assert player.clock == 1


def test_an_episode_ends_at_its_goal_if_the_task_says_so():
    player = Player(GAME._replace(move_object=None, ends_at_goal=True), lambda obs: np.array([0.2]))
    for _ in range(2):
        player.step()
    assert (player.clock, player.episodes) == (2, Tally(1, 1))


def test_an_episode_counts_as_an_evaluation_counts_it():
    """By its last step, whatever came before."""
    player = Player(GAME, follow)
    for _ in range(LENGTH):
        assert player.episodes == Tally(0, 0)
        player.step()
    assert player.episodes == Tally(1, 1)
    passes = Player(GAME, lambda obs: np.array([0.2]))  # it is at the goal after two steps, and beyond it after four
    for _ in range(LENGTH):
        passes.step()
    assert passes.episodes == Tally(1, 0)


def test_its_end_is_held_and_then_the_next_begins():
    player = Player(GAME, follow)
    for _ in range(LENGTH + HOLD - 1):
        player.step()
    assert player.clock == LENGTH
    player.step()
    assert (player.clock, player.qpos[0]) == (0, 0.0)
    player.renew = False
    for _ in range(LENGTH + HOLD + 3):
        player.step()
    assert player.clock == LENGTH + HOLD + 3  # the policy goes on from where it is
    assert player.episodes == Tally(2, 2)


def test_episodes_have_seeds_of_their_own():
    seeds = []
    player = Player(
        GAME._replace(reset=lambda seed: seeds.append(int(seed)) or state(0.0, [0.4, 0, 0])), follow, seed=2**32 - 1
    )
    player.new_episode()
    assert seeds == [2**32 - 1, 0]


def test_a_goal_that_is_moved_begins_an_attempt_of_its_own():
    player = Player(GAME, follow)
    player.step()
    player.move_goal(np.array([0.3, 0.0, 0.0]))
    assert (player.clock, player.is_own, player.renew) == (0, True, False)
    assert player.distance == pytest.approx(0.2)
    for _ in range(LENGTH + HOLD + 1):
        player.step()
    assert (player.own, player.episodes) == (Tally(1, 1), Tally(0, 0))
    assert player.qpos[0] == pytest.approx(0.3)  # nothing was reset
    player.move_goal(np.array([0.9, 0.0, 0.0]))  # too far for four steps of a tenth
    for _ in range(LENGTH):
        player.step()
    assert player.own == Tally(2, 1)
    player.new_episode()
    assert not player.is_own


def test_a_goal_that_is_dragged_counts_once():
    player = Player(GAME, follow)
    for x in np.linspace(0.1, 0.3, 20):
        player.move_goal(np.array([x, 0.0, 0.0]))
        player.step()
    for _ in range(LENGTH):
        player.step()
    assert player.own == Tally(1, 1)


def test_an_object_is_where_the_environment_says():
    env = SimpleNamespace(**vars(GAME.env), object_position=lambda state: state.physics.qpos + np.array([0.0, 1.0, 2.0]))
    player = Player(GAME._replace(env=env), follow)
    player.step()
    np.testing.assert_allclose(player.object_position, [0.1, 1.1, 2.1], atol=1e-6)
    player = Player(GAME, follow)
    player.step()
    np.testing.assert_allclose(player.object_position, [0.1, 0.0, 0.0], atol=1e-6)


def test_a_control_s_value_is_that_of_its_event():
    """A policy is chosen while another one compiles, at whose end the panel shows that one."""
    commands, done = panel.Commands(), []
    target = SimpleNamespace(value="chosen")
    asyncio.run(panel._put(commands, "policy", done.append)(SimpleNamespace(client_id=1, target=target)))
    target.value = "another"
    asyncio.run(panel._put(commands, "speed", done.append)(SimpleNamespace(client_id=None, target=target)))
    commands.run()
    assert done == ["chosen"]


def test_an_object_is_moved():
    player = Player(GAME, follow)
    player.move_object(np.array([0.38, 0.0, 0.0]))
    assert player.success
    assert player.is_own


def test_things_are_kept_where_resets_put_them():
    player = Player(GAME, follow)
    player.move_goal(np.array([7.0, -3.0, 0.4]))
    np.testing.assert_allclose(player.obs["desired_goal"], [1, 0, 0])


def test_a_position_that_is_none_is_refused():
    player = Player(GAME, follow)
    for position in ([np.nan, 0, 0], [np.inf, 0, 0], [0.0, 0.0], 1.0):
        with refuses("goal"):
            player.move_goal(np.array(position))
    with refuses("object"):
        Player(GAME._replace(move_object=None), follow).move_object(np.zeros(3))


def test_physics_that_blows_up_is_told_and_begins_anew():
    player = Player(GAME, lambda obs: np.array([10.0]))
    player.step()
    assert player.episodes == Tally(1, 0)
    assert "diverged" in panel.score(player)
    for _ in range(HOLD):
        player.step()
    assert (player.clock, player.note) == (0, "")
    player.step()
    player.move_goal(np.zeros(3))  # of a state that only a reset mends
    assert (player.qpos[0], player.is_own) == (0.0, True)


def test_physics_that_blows_up_is_shown_without_a_value():
    """The contract lets the observation of a failed state be NaN, for which no policy has an action."""
    asked = []
    player = Player(GAME, lambda obs: np.array([10.0]), value=lambda obs, action: asked.append(obs) or 1.0)
    player.step()
    assert "diverged" in panel.score(player)
    assert len(asked) == 1  # of the start
    assert np.isnan(player.history[-1][2])


def test_curves_show_the_last_steps():
    player = Player(GAME, follow, value=lambda obs, action: 10 * action[0])
    player.step()
    np.testing.assert_allclose(player.history, [(0.0, 0.4, 1.0), (0.04, 0.3, 1.0)], atol=1e-6)
    player.move_goal(np.array([0.6, 0.0, 0.0]))
    np.testing.assert_allclose(player.history, [(0.0, 0.4, 1.0), (0.04, 0.5, 1.0)], atol=1e-6)  # one number for a time
    player.replace(follow, None)
    assert np.isnan(player.history[-1][2])
    for _ in range(2 * SHOWN):
        player.step()
    assert len(player.history) == SHOWN


def test_charts_have_no_nan_in_them():
    player = Player(GAME, follow)
    player.step()
    player.value = lambda obs, action: 10 * action[0]
    player.step()
    times, distances, thresholds = panel.distance_curve(player)
    np.testing.assert_allclose([times, distances, thresholds], [[0, 0.04, 0.08], [40, 30, 20], [5, 5, 5]], atol=1e-5)
    np.testing.assert_allclose(panel.value_curve(player), [[0.08], [1.0]], atol=1e-6)


def test_counters_are_told():
    player = Player(GAME, follow)
    assert panel.score(player) == "Episodes reached: **0 of 0**  \nStep 0 of 4: 40.0 cm from the goal"
    for _ in range(LENGTH):
        player.step()
    assert panel.score(player) == "Episodes reached: **1 of 1 (100%)**  \nStep 4 of 4: **reached**"
    player.move_goal(np.array([0.0, 0.0, 0.0]))
    assert "Your own: **0 of 0**" in panel.score(player)


def test_commands_run_in_order_and_later_ones_wait():
    commands, done = panel.Commands(), []
    assert not commands.run()
    commands.put("first", lambda: done.append(1))
    commands.put("next", lambda: commands.put("first", lambda: done.append(3)))
    commands.put("last", lambda: done.append(2))
    assert commands.run()
    assert done == [1, 2]
    assert commands.run()
    assert done == [1, 2, 3]


def test_bounds_are_those_of_resets():
    """FetchPush: goal and cube within 15 cm of the gripper, on the table; FetchPickAndPlace: goals up to 45 cm above it."""
    push, lift = (_task(name) for name in ("push", "pick_and_place"))
    np.testing.assert_allclose(bounds(push, "goal"), [(1.2131, 1.5131), (0.5991, 0.8991), (0.4249, 0.4249)], atol=1e-4)
    np.testing.assert_allclose(bounds(push, "object"), [(1.2131, 1.5131), (0.5991, 0.8991), (0.4249, 0.4249)], atol=1e-4)
    np.testing.assert_allclose(bounds(lift, "goal")[2], (0.4249, 0.8749), atol=1e-4)
    slide = _task("slide")
    np.testing.assert_allclose(bounds(slide, "goal")[0], (1.1133, 1.7133), atol=1e-4)
    np.testing.assert_allclose(bounds(slide, "object")[0], (0.9133, 1.1133), atol=1e-4)
    reach = _task("reach")
    np.testing.assert_allclose(bounds(reach, "goal")[2], (0.3847, 0.6847), atol=1e-4)
    assert bounds(SimpleNamespace(), "goal") is None


def _task(name):
    from mjx_dher.envs import fetch

    tasks = {"push": fetch.Push, "pick_and_place": fetch.PickAndPlace, "slide": fetch.Slide, "reach": fetch.Reach}
    return tasks[name].task


@pytest.fixture(scope="module")
def push():
    return make_game(envs.make("push", engine="native", num_threads=1))


def test_a_custom_environment_s_goals_need_no_range_to_be_moved(push):
    class Hidden:
        """The task without its range of goals, but with `goal_marks`."""

        def goal_marks(self, qpos, goal):
            return []

        def __getattr__(self, name):
            if name == "goal_bounds":
                raise AttributeError(name)
            return getattr(push.env, name)

    assert make_game(Hidden()).move_goal is not None


def test_a_moved_cube_lies_at_rest_and_the_arm_stays(push):
    player = Player(push, lambda obs: np.zeros(4, np.float32), seed=3)
    for _ in range(3):
        player.step()
    before = player.obs["observation"].copy()
    player.move_object(np.array([1.3, 0.85, 0.0]))  # below the table: it is put onto it
    observation = player.obs["observation"]
    np.testing.assert_allclose(observation[:3], before[:3])
    np.testing.assert_allclose(observation[3:6], [1.3, 0.85, 0.42489222], atol=1e-6)
    np.testing.assert_allclose(observation[17:20], 0)
    np.testing.assert_allclose(player.obs["achieved_goal"], observation[3:6])
    for _ in range(10):
        player.step()
    np.testing.assert_allclose(player.obs["achieved_goal"], [1.3, 0.85, 0.42489222], atol=1e-3)


def test_the_policy_of_the_package_follows_a_goal_that_is_moved(push):
    from mjx_dher import load_policy

    player = Player(push, load_policy("push"), seed=1)
    center = np.mean(push.env.goal_bounds, axis=0)
    for x, y in ((0.1, 0.08), (-0.08, 0.1), (0.05, -0.1)):
        player.move_goal(center + np.array([x, y, 0]))
        for _ in range(player.length):
            player.step()
    assert player.own.attempts == 3
    assert player.own.reached >= 2


def test_a_cube_put_into_the_gripper_does_no_harm(push):
    player = Player(push, lambda obs: np.zeros(4, np.float32), seed=1)
    player.move_object(player.obs["observation"][:3])
    for _ in range(HOLD + 30):
        player.step()
    assert np.all(np.isfinite(player.qpos))
