"""Checks of goal generators, and of priorities that renew weights or choose transitions."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import check, learners, priorities, replay
from mjx_dher import context as context_lib
from mjx_dher.config import Config, HParams
from mjx_dher.context import Context
from mjx_dher.contract import check_with_goal, env_spec
from mjx_dher.contrib import generators
from mjx_dher.contrib.generators import GenerateFn, Generator
from mjx_dher.learners import Learner
from mjx_dher.priorities import CANDIDATES, ChooseFn, Priority
from mjx_dher.relabel import relabel
from mjx_dher.replay import ReplayState
from mjx_dher.samplers import future
from mjx_dher.testing.trial import EPISODES, attempt, compiled, expect, expect_range, random_episodes, run
from mjx_dher.types import Env, Episode, GoalObs, PRNGKey

NUMBER = 8  # transitions that a priority is asked to choose
BATCHES = 8  # of candidates that it chooses from, one after another


def as_arrays(hparams: HParams) -> HParams:
    """Numbers as traced runs have them: float32 arrays []."""
    return jax.tree.map(functools.partial(jnp.asarray, dtype=jnp.float32), hparams)


def trial_context(env: Env, hparams: HParams | None = None, learner: Learner | None = None) -> Context:
    """Context in the middle of a run of an untrained learner (None: `ddpg`)."""
    numbers = as_arrays(hparams or HParams())
    made = learner or learners.make("ddpg", Config(hidden_sizes=(16,)), env_spec(env))
    values = learners.values_of(made, made.init(jax.random.key(0)), numbers) if hasattr(made, "value") else None
    return context_lib.of_env(env, numbers, progress=jnp.float32(0.5), values=values)


def ring_of(episodes: Episode, ends: bool = False) -> ReplayState:
    """A ring that holds `episodes`, half of its rows empty."""
    empty = replay.init(jax.tree.map(lambda x: x[0], episodes), 2 * episodes.action.shape[0], ends)
    return replay.add(empty, episodes)


def check_generator(
    generator: str | Generator | GenerateFn,
    env: Env,
    hparams: HParams | None = None,
    episodes: Episode | None = None,
    learner: Learner | None = None,
) -> str:
    """Asks a goal generator for the goals of random resets, with an empty ring and with random episodes in it.

    They must be floats [N, G], the same for the same key, and finite for some reset once there are episodes. The environment
    must have `with_goal`.

    Args:
      generator: what `generators.make` takes.
      env: the environment.
      hparams: numbers; None for the defaults.
      episodes: in the ring; None for random ones.
      learner: untrained learner whose values a generator may read; None for `ddpg`.

    Returns:
      A line: how many of the goals are not those of the reset.

    Raises:
      ComponentError: names the first violation.
    """
    made = attempt("generator", generators.make, generator)
    attempt("generator", check_with_goal, env)
    if made.uses_values and learner is not None:
        attempt("generator", learners.check_values, learner)
    episodes, context = episodes or random_episodes(env), trial_context(env, hparams, learner)
    first = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), EPISODES))
    ends = env_spec(env).ends
    full, empty = ring_of(episodes, ends), replay.init(jax.tree.map(lambda x: x[0], episodes), EPISODES, ends)

    def ask(obs: GoalObs, ring: ReplayState) -> jax.Array:
        goals = made(jax.random.key(2), obs, ring, context)
        return check.array("generator: goals [N, G]", goals, obs["desired_goal"].shape)

    goals = np.asarray(run("generator", ask, first.obs, full))
    attempt("generator, with an empty ring,", jax.jit(ask), first.obs, empty)
    finite = np.isfinite(goals).all(axis=-1)
    expect(finite.any(), "generator: no goal is finite, so every episode would be played for the reset's own")
    own = np.asarray(first.obs["desired_goal"])
    set_goals: Any = jax.vmap(env.with_goal)  # type: ignore[attr-defined]
    attempt("env: with_goal", set_goals, first, jnp.asarray(np.where(finite[:, None], goals, own)))
    other = np.mean(finite & (goals != own).any(axis=-1))
    return f"generator as it should be: {other:.0%} of the goals are not those of the reset"


def check_choice(
    priority: Priority, env: Env, hparams: HParams | None, episodes: Episode, learner: Learner | None
) -> list[str]:
    """Checks `renew` and `choose` of a priority, if it has them; returns a line for each.

    Raises:
      ComponentError: names the first violation.
    """
    if priority.uses_values and learner is not None:
        attempt("priority", learners.check_values, learner)
    context, ring = trial_context(env, hparams, learner), ring_of(episodes, env_spec(env).ends)
    lines = []
    if (renew := priority.renew) is not None:
        weights = np.asarray(run("priority: renew", lambda ring: renew(ring, context), ring))
        attempt("priority: renew", jax.jit(lambda ring: priorities.renew(priority, ring, context)), ring)
        lines.append(f"renewed weights {expect_range('priority: weights', weights[: episodes.action.shape[0]])}")
    if priority.choose is not None:
        _check_picks(priority.choose, ring, context)
        lines.append(f"{NUMBER} of {CANDIDATES * NUMBER} transitions chosen")
    return lines


def _check_picks(choose: ChooseFn, ring: ReplayState, context: Context) -> None:
    """Checks the indices that `choose` gives of the candidates of several batches."""

    def pick(key: PRNGKey) -> jax.Array:
        sample_key, goal_key, choose_key = jax.random.split(key, 3)
        sample = replay.sample(ring, sample_key, CANDIDATES * NUMBER)
        batch = relabel(sample, future, context, goal_key).batch
        indices = choose(choose_key, sample, batch, NUMBER, context)
        return check.array("priority: indices [B] of choose", indices, (NUMBER,), jnp.integer)

    keys = jax.random.split(jax.random.key(3), BATCHES)
    program = compiled("priority: choose", pick, keys[0])
    picked = np.stack([program(key) for key in keys])
    outside = picked[(picked < 0) | (picked >= CANDIDATES * NUMBER)]
    expect(not outside.size, f"priority: choose gives indices of {CANDIDATES * NUMBER} candidates; one is {outside[:1]}")
    same = (picked == picked[:, :1]).all()
    expect(not same, f"priority: choose must give different transitions; all {NUMBER} are one, in each of {BATCHES} batches")
    first = (picked == CANDIDATES * np.arange(NUMBER)).all()
    expect(not first, f"priority: choose keeps the first of each {CANDIDATES} candidates, whatever they are; it must choose")
