"""Choices among relabelled transitions: how many are drawn, which are candidates of a place, and how often each is kept."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_methods import CONTEXT, HP, candidates, chosen, ring_with

from mjx_dher import priorities, relabel, replay
from mjx_dher.contrib import priorities as contributed
from mjx_dher.runs.program import Lane
from mjx_dher.spec import RunSpec

BY_GOAL = priorities.by_weight(lambda sample, batch, context: batch.desired_goal[:, 0])


@pytest.mark.parametrize("number", [13, 17, 18, 50, 1024, 10_240])
def test_no_two_choices_share_two_candidates_of_one_weighing(number):
    """Each transition is a candidate of four. By the choices of a draw in which it alone has a weight."""
    for heavy in (0, number // 2):
        goals_ = np.where(np.arange(number) == heavy, 1.0, 0.0)
        kept = chosen(
            priorities.Priority(choose=BY_GOAL, candidates=1), 0, *candidates(goals_, goals_, number), number, CONTEXT
        )
        places = np.flatnonzero(kept.desired_goal[:, 0])
        apart = (places[:, None] - places) % number
        assert len(places) == 4
        assert len(set(apart[~np.eye(4, dtype=bool)])) == 12


def test_as_many_are_drawn_as_a_priority_or_the_neediest_of_several_asks_for():
    drawn = []

    def every_other(key, sample, batch, number, context):
        drawn.append((len(sample.step), len(batch.reward), number))
        return 2 * jnp.arange(number)

    ring = ring_with([[[0.05, 0.0], [0.05, 0.0]], [[0.5, 0.0], [0.5, 0.0]]])
    for candidates_ in (1, 4):
        own = priorities.Priority(choose=every_other, candidates=candidates_)
        relabel.draw_batches(ring, jax.random.key(0), (2, 3), "future", CONTEXT, replay.cumulative(ring), priority=own)
    assert drawn == [(6, 6, 6), (24, 24, 6)]
    drawn.clear()  # of several, each gets as many as it asks for
    joined = priorities.join([dataclasses.replace(own, candidates=2), contributed.curriculum])
    for lane in (0, 1):
        hparams = Lane(*HP, choice=0, priority_choice=lane, generator_choice=0)
        context = CONTEXT._replace(hparams=hparams)
        relabel.draw_batches(ring, jax.random.key(0), (6,), "future", context, replay.cumulative(ring), priority=joined)
    assert set(drawn) == {(12, 12, 6)}
    joined = {name: priorities.join(["td_error_shared", name]).candidates for name in ("eventful", "energy", "curriculum")}
    assert joined == {"eventful": 1, "energy": 1, "curriculum": 2}


@pytest.mark.parametrize("number", [2, 3, 8])
def test_every_candidate_can_be_kept(number):
    sample, batch = candidates([1.0] * number * 50, [0.0] * number * 50, 50)
    choose = jax.jit(jax.vmap(lambda key: BY_GOAL(key, sample, batch, 50, CONTEXT)))
    indices = np.asarray(choose(jax.random.split(jax.random.key(0), 100)))
    np.testing.assert_array_equal(indices // number, np.broadcast_to(np.arange(50), (100, 50)))
    assert set(indices.ravel()) == set(range(number * 50))


def test_what_draws_other_numbers_has_a_program_of_its_own():
    """In one program a lane would draw as many candidates as the neediest, and so other ones than alone."""
    alike = ("td_error", "dpp", "not_misleading")
    programs = [RunSpec(priority=name).program for name in (*alike, "td_error_shared", "curriculum", "eventful")]
    assert len(set(programs)) == 4
    assert len(set(programs[:3])) == 1


def test_weights_are_kept_in_proportion():
    sample, batch = candidates([1.0, 2.0, 0.0, 5.0] * 4000, [0.0] * 16000, 4000)
    indices = jax.jit(lambda key, *data: BY_GOAL(key, *data, 4000, CONTEXT))(jax.random.key(0), sample, batch)
    found = np.bincount(np.asarray(indices) % 4, minlength=4)
    expected = 4000 * np.array([1, 2, 5]) / 8
    assert found[2] == 0
    assert np.sum((found[[0, 1, 3]] - expected) ** 2 / expected) < 13.8  # 99.9 % point at 2 degrees of freedom


@pytest.mark.slow
def test_half_a_batch_may_be_chosen_and_the_other_half_drawn_as_ever():
    sample, batch = candidates([0.0, 0.0, 0.0, 1.0] * 2000, [0.5] * 8000, 2000)
    half = CONTEXT._replace(hparams=HP._replace(priority_fraction=0.5))
    kept = chosen(priorities.Priority(choose=BY_GOAL), 0, sample, batch, 2000, half)
    assert abs(float(kept.desired_goal[:, 0].mean()) - 0.5) < 0.05
