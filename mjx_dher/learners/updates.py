"""A round of updates of the critics, with actor and target updates when they are due."""

from __future__ import annotations

import functools
from typing import Any

import jax

from mjx_dher import check, learners
from mjx_dher.config import HParams
from mjx_dher.learners import Learner
from mjx_dher.types import Batch, Metrics, PyTree


def update_round(learner: Learner, period: int, hparams: HParams, state: PyTree, batches: Batch) -> tuple[PyTree, Metrics]:
    """Makes one update per batch, and moves the targets every `period` updates.

    Leaves of `batches` lead with the larger of `period` and the learner's policy_delay.
    """
    delay = learners.policy_delay(learner)
    if delay > period:
        return _delayed_update(learner, period, hparams, state, batches)
    groups = jax.tree.map(lambda x: x.reshape(period // delay, delay, *x.shape[1:]), batches)
    state, losses = jax.lax.scan(functools.partial(_delayed_update, learner, period, hparams), state, groups)
    return _move_targets(learner, hparams, state), losses


def _delayed_update(learner: Learner, period: int, hparams: HParams, state: PyTree, batches: Batch) -> tuple[PyTree, Metrics]:
    """Makes `policy_delay` updates, the last with the actor, and moves targets that are due. Returns the last metrics."""
    delay = learners.policy_delay(learner)
    for number in range(1, delay + 1):
        batch = jax.tree.map(lambda x, i=number - 1: x[i], batches)
        flags: dict[str, Any] = {} if number == delay else {"with_actor": False}
        state, losses = learners.check_update(state, learner.update(state, batch, hparams, **flags))
        if delay > period and number % period == 0:
            state = _move_targets(learner, hparams, state)
    return state, losses


def _move_targets(learner: Learner, hparams: HParams, state: PyTree) -> PyTree:
    moved = learner.update_target(state, hparams)
    check.kept("learner.update_target", state, moved)
    return moved
