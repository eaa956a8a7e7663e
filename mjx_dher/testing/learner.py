"""Check of a custom learner or custom networks: one update on random episodes."""

from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher import check, context, learners, replay, trainer
from mjx_dher.config import Config, HParams
from mjx_dher.contract import env_spec
from mjx_dher.learners import Learner, LearnerFn
from mjx_dher.networks import NetworksFn
from mjx_dher.policy import Policy
from mjx_dher.relabel import relabel
from mjx_dher.replay import ReplayState
from mjx_dher.samplers import future
from mjx_dher.testing.trial import EPISODES, TOLERANCE, Trial, attempt, expect, expect_finite, run, trial_of
from mjx_dher.types import Batch, Env, EnvSpec, Episode, PyTree

BATCH = 8


def check_learner(
    learner: str | LearnerFn,
    env: Env | Trial,
    config: Config | None = None,
    hparams: HParams | None = None,
    networks: str | NetworksFn = "mlp",
) -> None:
    """Makes a learner, lets it act, explore and learn from one batch, and checks the results.

    - `init` returns a pytree of arrays, and `noise` returns arrays that lead with [T, N].
    - `act` and `explore` return finite actions [N, A] in [-1, 1]. `act` takes any leading axes.
    - `value`, if present, returns one finite number per action, for any leading axes.
    - `update`, `update_target` and `update_normalizers` keep the state finite, with the same structure, shapes and dtypes.
      `update` changes it. `act`, `explore` and `update` are deterministic.
    - Metrics of `update` and `summary` are dicts of scalars with unique names.
    - `update_normalizers` ignores invalid observations.
    - `export` returns a `policy.Policy` that acts like `act`, or None.

    Args:
      learner: learner, as in `learners.make`.
      env: the environment, or a `Trial`.
      networks: networks, as in `networks.make`.

    Raises:
      ComponentError: names the first violation.
    """
    trial = trial_of(env, hparams, None)
    hparams, episodes, spec = trial.hparams, trial.episodes, env_spec(trial.env)
    made: Learner = attempt("learner", learners.make, learner, config or Config(), spec, networks)
    numbers = trainer.as_arrays(hparams)
    state = attempt("learner.init", jax.jit(made.init), jax.random.key(0))
    expect_finite("the state that learner.init gives", state)

    @jax.jit
    def draw(ring: ReplayState) -> Batch:
        sample = replay.sample(ring, jax.random.key(1), BATCH)
        return relabel(sample, future, context.of_env(trial.env, numbers), jax.random.key(4)).batch

    batch = draw(trial.ring)
    valid = jnp.arange(EPISODES) > 0
    hide = lambda x: x.at[0].set(jnp.nan) if jnp.issubdtype(x.dtype, jnp.floating) else x  # noqa: E731
    played = jax.tree.map(hide, episodes.observation), batch.desired_goal, numbers, valid
    state = _step("update_normalizers", jax.jit(made.update_normalizers), state, *played)
    obs = _check_acting(made, state, episodes, spec, numbers)
    result = run("learner.update", made.update, state, batch, numbers)
    updated, metrics = attempt("learner.update", learners.check_update, state, result)
    expect_finite("the state that learner.update gives", updated)
    same = all(bool(jnp.array_equal(a, b)) for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(updated)))
    expect(not same, "learner.update must change the state; nothing in it is changed")
    expect_finite("metrics of learner.update", metrics)
    moved = _step("update_target", jax.jit(made.update_target), updated, numbers)
    summary = attempt("learner.summary", jax.jit(made.summary), moved)
    attempt("learner.summary", learners.check_metrics, "summary", summary, metrics)
    expect_finite("metrics of learner.summary", summary)
    _check_export(made, moved, obs, hparams)


def _check_export(made: Learner, state: Any, obs: PyTree, hparams: HParams) -> None:
    policy = attempt("learner.export", made.export, jax.device_get(state), hparams)
    if policy is not None:
        what = f"learner.export must give a policy.Policy or None; it gives a {type(policy).__name__}"
        expect(isinstance(policy, Policy), what)
        theirs, ours = (
            attempt("the policy of learner.export", policy, obs),
            jax.jit(made.act)(state, obs, trainer.as_arrays(hparams)),
        )
        same = theirs.shape == ours.shape and bool(jnp.allclose(theirs, ours, atol=TOLERANCE))
        expect(same, "the policy of learner.export must act as learner.act does; it does not")


def _step(name: str, function: Any, state: Any, *args: Any) -> Any:
    """State after a method of the learner. It must be finite and like `state`."""
    after = attempt(f"learner.{name}", function, state, *args)
    attempt(f"learner.{name}", check.kept, f"learner.{name}", state, after)
    expect_finite(f"the state that learner.{name} gives", after)
    return after


def _check_acting(made: Learner, state: Any, episodes: Episode, spec: EnvSpec, hparams: HParams) -> PyTree:
    """Checks actions and values for the first observations of the episodes. Returns these observations."""
    start: Any = {"observation": episodes.observation, "achieved_goal": episodes.achieved_goal}
    obs = {**jax.tree.map(lambda x: x[:, 0], start), "desired_goal": episodes.desired_goal}
    noise = attempt("learner.noise", made.noise, jax.random.key(2), spec.episode_length, EPISODES, hparams)
    attempt("learner.noise", learners.check_noise, noise, spec.episode_length, EPISODES)
    explored = run("learner.explore", made.explore, state, obs, jax.tree.map(lambda x: x[0], noise), hparams)
    _check_actions("explore", explored, (EPISODES, spec.action_size))
    action = run("learner.act", made.act, state, obs, hparams)
    _check_actions("act", action, (EPISODES, spec.action_size))
    one = attempt("learner.act on one observation [D]", jax.jit(made.act), state, jax.tree.map(lambda x: x[0], obs), hparams)
    _check_actions("act on one observation [D]", one, (spec.action_size,))
    alone = jnp.allclose(one, action[0], atol=TOLERANCE)
    expect(alone, "learner.act of a batch must be that of each of its observations; it depends on the others")
    if hasattr(made, "value"):
        values = learners.values_of(made, state, hparams)
        several = [jax.tree.map(lambda x: jnp.stack([x, x]), x) for x in (obs["observation"], obs["desired_goal"], action)]
        expect_finite("numbers of learner.value", attempt("learner.value", jax.jit(values.value), *several))
    return obs


def _check_actions(name: str, action: Any, shape: tuple[int, ...]) -> None:
    action = attempt(name, check.array, f"learner.{name}: actions [..., A]", action, shape)
    expect_finite(f"actions of learner.{name}", action)
    largest = float(jnp.abs(action).max())
    expect(largest <= 1.0 + 1e-6, f"learner.{name} must give actions in [-1, 1]; one is {largest:.3g} in magnitude")
