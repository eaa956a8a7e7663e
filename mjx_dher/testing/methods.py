"""Trials of what asks for more than an episode: goal generators, priorities of transitions, scores by the learner."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import check, learners, priorities, replay
from mjx_dher import context as context_lib
from mjx_dher.config import Config, HParams
from mjx_dher.context import Context
from mjx_dher.contrib import generators
from mjx_dher.contrib.generators import GenerateFn, Generator
from mjx_dher.learners import Learner
from mjx_dher.priorities import CANDIDATES, Priority
from mjx_dher.relabel import relabel
from mjx_dher.replay import ReplayState
from mjx_dher.rollout import check_with_goal, env_spec
from mjx_dher.samplers import future
from mjx_dher.testing.trial import EPISODES, PartError, attempt, random_episodes
from mjx_dher.types import Env, Episode, GoalObs

NUMBER = 8  # transitions that a priority is asked to choose


def trial_context(env: Env, hparams: HParams | None = None, learner: Learner | None = None) -> Context:
    """Context in the middle of a run of an untrained learner (None: `ddpg`)."""
    numbers = jax.tree.map(functools.partial(jnp.asarray, dtype=jnp.float32), hparams or HParams())
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

    They must be floating-point numbers [N, G], the same goals for the same key, and finite for some reset once there are
    episodes; and the environment must have `with_goal`.

    Args:
      generator: what `generators.make` takes.
      env: the environment.
      hparams: numbers; the defaults where None.
      episodes: in the ring; random ones where None.
      learner: whose values a generator may ask for, untrained; `ddpg` where None.

    Returns:
      A sentence: how many of the goals are not those of the reset.

    Raises:
      PartError: names the first violation.
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

    goals, again = (np.asarray(attempt("generator", jax.jit(ask), first.obs, full)) for _ in range(2))
    attempt("generator, with an empty ring,", jax.jit(ask), first.obs, empty)
    if not np.array_equal(goals, again, equal_nan=True):
        raise PartError("generator: the same key and the same ring must give the same goals; they differ")
    return _told_of_goals(env, first, goals)


def _told_of_goals(env: Any, first: Any, goals: NDArray) -> str:
    """Sets goals [N, G] in first states; returns what to say of them."""
    finite = np.isfinite(goals).all(axis=-1)
    if not finite.any():
        raise PartError("generator: no goal is finite, so every episode would be played for the reset's own")
    own = np.asarray(first.obs["desired_goal"])
    attempt("env: with_goal", jax.vmap(env.with_goal), first, jnp.asarray(np.where(finite[:, None], goals, own)))
    other = np.mean(finite & (goals != own).any(axis=-1))
    return f"generator as it should be: {other:.0%} of the goals are not those of the reset"


def check_choice(
    priority: Priority, env: Env, hparams: HParams | None, episodes: Episode, learner: Learner | None
) -> list[str]:
    """Tries `renew` and `choose` of a priority, where it has them; returns what to say of them.

    Raises:
      PartError: names the first violation.
    """
    if priority.uses_values and learner is not None:
        attempt("priority", learners.check_values, learner)
    context, ring = trial_context(env, hparams, learner), ring_of(episodes, env_spec(env).ends)
    told = []
    if (renew := priority.renew) is not None:
        weights = np.asarray(attempt("priority: renew", jax.jit(lambda ring: renew(ring, context)), ring))
        attempt("priority: renew", jax.jit(lambda ring: priorities.renew(priority, ring, context)), ring)
        told.append(f"renewed weights {_range(weights[: episodes.action.shape[0]])}")
    if (choose := priority.choose) is not None:
        keys = jax.random.split(jax.random.key(3), 3)
        sample = replay.sample(ring, keys[0], CANDIDATES * NUMBER)
        batch = relabel(sample, future, context, keys[1]).batch
        pick = jax.jit(lambda key: choose(key, sample, batch, NUMBER, context))
        attempt("priority: choose", lambda: priorities.choose(priority, keys[2], sample, batch, NUMBER, context))
        indices = np.asarray(attempt("priority: choose", pick, keys[2]))
        if indices.min() < 0 or indices.max() >= CANDIDATES * NUMBER:
            raise PartError(f"priority: choose gives indices of {CANDIDATES * NUMBER} candidates; one is {indices.max()}")
        told.append(f"{NUMBER} of {CANDIDATES * NUMBER} transitions chosen")
    return told


def _range(weights: NDArray) -> str:
    if not np.isfinite(weights).all():
        raise PartError("priority: weights must be finite; one is not")
    if weights.min() < 0:
        raise PartError(f"priority: weights must not be negative; the least is {weights.min():.3g}")
    return f"from {weights.min():.3g} to {weights.max():.3g}"
