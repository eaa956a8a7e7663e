"""Which attempts the viewer's player counts, and when it begins the next one."""

import numpy as np
from test_player import GAME, HOLD, LENGTH, follow

from mjx_dher.viewer.player import Player, Tally


def test_an_attempt_counts_once():
    """A hand's attempt has run out, and the goal is reached only then, where the task ends."""
    player = Player(GAME._replace(ends_at_goal=True), follow)
    player.move_goal(np.array([0.7, 0.0, 0.0]))
    for _ in range(7):
        player.step()
    assert (player.success, player.own) == (True, Tally(1, 0))


def test_the_next_begins_also_if_it_is_asked_for_after_the_end():
    player = Player(GAME, follow)
    player.set_renew(False)
    for _ in range(LENGTH + 5):
        player.step()
    player.set_renew(True)
    for _ in range(1 + HOLD):
        player.step()
    assert (player.clock, player.episodes) == (0, Tally(1, 1))


def test_the_user_s_own_setting_comes_back_with_the_next_episode():
    player = Player(GAME, follow)
    for wanted in (True, False):
        player.set_renew(wanted)
        player.move_goal(np.zeros(3))
        player.move_goal(np.zeros(3))
        assert not player.renew
        player.new_episode()
        assert player.renew is wanted
    player.move_goal(np.zeros(3))
    for changed in (True, False):  # by hand, after the move
        player.set_renew(changed)
    player.new_episode()
    assert not player.renew


def test_a_step_by_hand_does_not_wait_for_the_next_episode():
    player = Player(GAME, follow)
    for _ in range(LENGTH):
        player.step()
    player.step(by_hand=True)
    assert player.clock == 0


def test_what_two_policies_played_counts_for_neither():
    player = Player(GAME, follow)
    player.step()
    player.replace(follow, None)
    for _ in range(LENGTH + HOLD):
        player.step()
    assert (player.clock, player.episodes) == (1, Tally(0, 0))
    for _ in range(LENGTH):
        player.step()
    assert player.episodes == Tally(1, 1)
