"""A trial of a learner and of networks of one's own: one update on random episodes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher import context, learners, replay
from mjx_dher.config import Config, HParams
from mjx_dher.learners import Learner, LearnerFn
from mjx_dher.networks import NetworksFn
from mjx_dher.policy import Policy
from mjx_dher.relabel import relabel
from mjx_dher.rollout import env_spec
from mjx_dher.samplers import future
from mjx_dher.testing.trial import EPISODES, PartError, attempt, expect_finite, random_episodes
from mjx_dher.types import Batch, Env, Episode

BATCH = 8


def check_learner(
    learner: str | LearnerFn,
    env: Env,
    config: Config | None = None,
    hparams: HParams | None = None,
    networks: str | NetworksFn = "mlp",
    episodes: Episode | None = None,
) -> None:
    """Makes a learner, lets it act, explore and learn from one batch, and looks at what it gives.

    - `init` gives a pytree of arrays, `noise` arrays that lead with [T, N].
    - `act` and `explore` give finite actions [N, A] in [-1, 1]; `act` takes any leading axes.
    - `value`, if present, gives one finite number for each action, for any leading axes.
    - `update`, `update_target` and `update_normalizers` keep the state's structure, shapes and types, as `lax.scan` needs, and
      numbers finite; `update` changes it.
    - Metrics of `update` and `summary` are dicts of scalars, with names that nothing else is logged by.
    - What `update_normalizers` is to leave out, because it is not valid, changes nothing.
    - `export` gives a `policy.Policy` that acts as `act` does, or None.

    Args:
      learner: what `learners.make` takes.
      env: the environment.
      config: sizes; the defaults where None.
      hparams: numbers; the defaults where None.
      networks: what `networks.make` takes.
      episodes: to learn from; random ones where None.

    Raises:
      ValueError: names the first violation.
    """
    config, hparams = config or Config(), hparams or HParams()
    episodes = episodes or random_episodes(env)
    made: Learner = attempt("learner", learners.make, learner, config, attempt("env", env_spec, env), networks)
    numbers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), hparams)
    state = attempt("learner.init", jax.jit(made.init), jax.random.key(0))
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if not isinstance(leaf, jax.Array):
            raise PartError(
                f"learner.init must give a pytree of arrays; {jax.tree_util.keystr(path)} is a {type(leaf).__name__}"
            )
    expect_finite("the state that learner.init gives", state)
    batch = _batch(env, episodes, numbers)
    valid = jnp.arange(EPISODES) > 0
    observation = jax.tree.map(lambda x: _invalid(x, valid), episodes.observation)
    normalize = lambda s, n: made.update_normalizers(s, observation, batch.desired_goal, n, valid)  # noqa: E731
    state = _step("update_normalizers", jax.jit(normalize), state, numbers)
    _check_acting(made, state, episodes, env, numbers)
    updated, metrics = _update(made, state, batch, numbers)
    expect_finite("metrics of learner.update", metrics)
    moved = _step("update_target", jax.jit(made.update_target), updated, numbers)
    summary = attempt("learner.summary", jax.jit(made.summary), moved)
    learners.check_metrics("summary", summary, metrics)
    expect_finite("metrics of learner.summary", summary)
    _check_export(made, moved, episodes, hparams, numbers)


def _invalid(x: jax.Array, valid: jax.Array) -> jax.Array:
    """Floats [N, ...] with NaN where `valid` [N] is False; other numbers as they are."""
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return x
    return jnp.where(jnp.expand_dims(valid, range(1, x.ndim)), x, jnp.nan)


def _batch(env: Env, episodes: Episode, hparams: HParams) -> Batch:
    """Returns a batch [8] of random episodes, relabelled by `future`."""
    ring = replay.add(replay.init(jax.tree.map(lambda x: x[0], episodes), EPISODES, env_spec(env).ends), episodes)
    sample_key, relabel_key = jax.random.split(jax.random.key(1))
    return relabel(replay.sample(ring, sample_key, BATCH), future, context.of_env(env, hparams), relabel_key).batch


def _step(name: str, function: Any, state: Any, *args: Any) -> Any:
    """Returns the state that a method of the learner gives, checked to be like `state` and finite."""
    after = attempt(f"learner.{name}", function, state, *args)
    learners.check_kept(name, state, after)
    expect_finite(f"the state that learner.{name} gives", after)
    return after


def _check_acting(made: Learner, state: Any, episodes: Episode, env: Env, hparams: HParams) -> None:
    obs: Any = {
        "observation": jax.tree.map(lambda x: x[:, 0], episodes.observation),
        "achieved_goal": episodes.achieved_goal[:, 0],
        "desired_goal": episodes.desired_goal,
    }
    noise = attempt("learner.noise", made.noise, jax.random.key(2), env.episode_length, EPISODES, hparams)
    learners.check_noise(noise, env.episode_length, EPISODES)
    first = jax.tree.map(lambda x: x[0], noise)
    explored = attempt("learner.explore", jax.jit(made.explore), state, obs, first, hparams)
    _check_actions("explore", explored, (EPISODES, env.action_size))
    action = attempt("learner.act", jax.jit(made.act), state, obs, hparams)
    _check_actions("act", action, (EPISODES, env.action_size))
    one = attempt("learner.act on one observation [D]", made.act, state, jax.tree.map(lambda x: x[0], obs), hparams)
    _check_actions("act on one observation [D]", one, (env.action_size,))
    if not jnp.allclose(one, action[0], atol=1e-3):
        raise PartError("learner.act of a batch must be that of each of its observations; it depends on the others")
    if hasattr(made, "value"):
        values = learners.values_of(made, state, hparams)
        several = jax.tree.map(lambda x: jnp.stack([x, x]), (obs["observation"], obs["desired_goal"], action))
        expect_finite("numbers of learner.value", attempt("learner.value", jax.jit(values.value), *several))


def _check_actions(name: str, action: Any, shape: tuple[int, ...]) -> None:
    if getattr(action, "shape", None) != shape:
        given = list(action.shape) if hasattr(action, "shape") else f"a {type(action).__name__}"
        raise PartError(f"learner.{name} must give actions [..., A] = {list(shape)}; they are {given}")
    expect_finite(f"actions of learner.{name}", action)
    if float(jnp.abs(action).max()) > 1.0 + 1e-6:
        raise PartError(f"learner.{name} must give actions in [-1, 1]; one is {float(jnp.abs(action).max()):.3g} in magnitude")


def _update(made: Learner, state: Any, batch: Batch, hparams: HParams) -> tuple[Any, Any]:
    result = attempt("learner.update", jax.jit(made.update), state, batch, hparams)
    updated, metrics = learners.check_update(state, result)
    expect_finite("the state that learner.update gives", updated)
    if all(bool(jnp.array_equal(a, b)) for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(updated))):
        raise PartError("learner.update must change the state; nothing in it is changed")
    return updated, metrics


def _check_export(made: Learner, state: Any, episodes: Episode, hparams: HParams, numbers: HParams) -> None:
    policy = attempt("learner.export", made.export, jax.device_get(state), hparams)
    if policy is None:
        return
    if not isinstance(policy, Policy):
        raise PartError(f"learner.export must give a policy.Policy or None; it gives a {type(policy).__name__}")
    obs: Any = {"observation": episodes.observation[:, 0], "desired_goal": episodes.desired_goal}
    theirs = attempt("the policy of learner.export", policy, obs)
    ours = made.act(state, obs, numbers)
    if theirs.shape != ours.shape or not jnp.allclose(theirs, ours, atol=1e-3):
        raise PartError("the policy of learner.export must act as learner.act does; it does not")
