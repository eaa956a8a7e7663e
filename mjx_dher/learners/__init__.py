"""Learners: the protocol `Learner`, and `make`."""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Collection
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from mjx_dher import check, components, networks
from mjx_dher.config import Config, HParams
from mjx_dher.context import Values
from mjx_dher.networks import NetworksFn
from mjx_dher.types import Array, Batch, EnvSpec, GoalObs, Metrics, PRNGKey, PyTree, check_size

# Metrics of the loop and the log; a learner must use other names.
RESERVED = frozenset(
    (
        *("success_rate", "reset_success_rate", "return_mean", "train_success_rate", "train_return_mean", "priority_mean"),
        *("relabelled_share", "relabel_distance", "discarded_episodes", "bad_rewards", "bad_success", "no_goal_share"),
        *("epoch", "env_steps", "updates", "wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes"),
        *("train_length_mean", "digest", "file"),
    )
)


class Learner(Protocol):
    """A learner: pure functions of a state, which is a pytree of arrays. `hparams` holds traced numbers.

    A learner defines `init`, `act`, `explore` and `update`. Subclasses inherit the other methods; any other object must define
    them too. Optional members:

    - `value(state, obs, action [..., A], hparams) -> [...]`: estimated return of an action, followed by the policy.
      Needed by priorities, metrics and goal generators that use the learner's values.
    - `axis_name`: a dataclass field, None by default. If several devices share a run, it is the name of their mapped axis.
      `update` then averages its gradients over the axis (`jax.lax.pmean`), and `update_normalizers` its moments.
    """

    policy_delay: int = 1
    """Updates per actor update. If it is above 1, the others are called with the additional argument `with_actor=False`."""

    def init(self, key: PRNGKey) -> PyTree:
        """Initial state."""

    def act(self, state: Any, obs: GoalObs, hparams: HParams) -> Array:
        """Actions [..., A] in [-1, 1] of the deterministic policy, for evaluation and export.

        Args:
          obs: observations [..., D] and goals [..., G], with any leading axes.
        """

    def explore(self, state: Any, obs: GoalObs, noise: Any, hparams: HParams) -> Array:
        """Actions [N, A] in [-1, 1] of the exploring policy, for the N environments of a rollout.

        Args:
          obs: observations [N, D] and goals [N, G].
          noise: one step of the result of `noise`; leaves lead with [N]. By default it is one key per environment.
        """

    def update(self, state: Any, batch: Batch, hparams: HParams) -> tuple[PyTree, Metrics]:
        """Takes one gradient step and leaves the targets unchanged.

        Args:
          batch: transitions [B]. `batch.discount` [B] is the factor of the next observation's value.

        Returns:
          The next state, with the same structure, shapes and dtypes, and scalar metrics, whose names are not in `RESERVED`. An
          epoch's mean metrics are logged.
        """

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, hparams: HParams) -> PyTree:
        """Draws the exploration noise of a whole rollout, because one large draw is faster than many small ones.

        Args:
          num_steps: T.
          num_envs: N.

        Returns:
          A pytree whose leaves lead with [T, N].
        """
        return jax.random.split(key, (num_steps, num_envs))

    def update_normalizers(self, state: Any, observation: Array, goal: Array, hparams: HParams, valid: Array) -> PyTree:
        """Updates the statistics of the inputs. By default does nothing.

        Args:
          observation: [N, T+1, D] of the rollout's episodes.
          goal: relabelled goals [B, G].
          valid: bool [N], or [N, T+1] if episodes can end early. Where it is False, observations may be NaN; ignore them.

        Returns:
          The next state.
        """
        return state

    def update_target(self, state: Any, hparams: HParams) -> PyTree:
        """Moves the target networks, if there are any. Called every `target_period` updates."""
        return state

    def summary(self, state: Any) -> Metrics:
        """Scalar metrics of the state, logged once per epoch. Their names differ from the metrics of `update`."""
        return {}

    def export(self, state: Any, hparams: HParams) -> Any:
        """Policy as a `policy.Policy`, which needs only NumPy. If None, the learner's state is saved instead."""
        return None


# make(config, spec, networks) -> Learner
LearnerFn = Callable[[Config, EnvSpec, NetworksFn], Learner]


def make(name: str | LearnerFn, config: Config, spec: EnvSpec, network: str | NetworksFn = "mlp") -> Learner:
    """Makes the learner called `name`.

    Args:
      name: a built-in name, "module:attribute", or a function (config, spec, networks) -> Learner.
      config: sizes and dtype of the networks.
      spec: spec of the environment (`contract.env_spec`).
      network: networks, as in `networks.make`.

    Raises:
      ValueError: the learner or networks do not exist, lack a method, or do not combine.
    """
    make_learner = components.load("learner", name, "config", "spec", "networks")
    learner = make_learner(config, spec, networks.make(network))
    check_methods(name, learner)
    return learner


def check_methods(name: Any, learner: Any) -> None:
    """Raises ValueError unless `learner` has the methods of a `Learner`. Messages call it `name`."""
    methods = [method for method, function in vars(Learner).items() if callable(function) and not method.startswith("_")]
    if missing := [method for method in methods if not callable(getattr(learner, method, None))]:
        raise ValueError(f"learner {name!r} is no learner: it has no {', '.join(missing)} (see mjx_dher.learners.Learner)")
    delay = policy_delay(learner)
    check_size("policy_delay of the learner", delay)
    if delay > 1 and "with_actor" not in inspect.signature(learner.update).parameters:
        raise ValueError(f"learner {name!r} has a policy_delay of {delay}, so its update must take with_actor")


def check_values(learner: Any) -> None:
    """Raises ValueError if a learner has no values but a component of the run needs them."""
    if not callable(getattr(learner, "value", None)):
        raise ValueError(
            f"learner must have a method value(state, obs, action, hparams), which a priority, metric or generator of this run"
            f" uses; {type(learner).__name__} has none"
        )


def values_of(learner: Any, state: PyTree, hparams: HParams) -> Values:
    """Policy and values of a learner at `state`, as functions of observations and goals."""

    def obs_of(observation: Array, goal: Array) -> GoalObs:
        return GoalObs(observation=observation, achieved_goal=goal, desired_goal=goal)

    def value(observation: Array, goal: Array, action: Array) -> Array:
        result = learner.value(state, obs_of(observation, goal), action, hparams)
        return check.array("learner.value, one number for each action,", result, action.shape[:-1])

    return Values(lambda observation, goal: learner.act(state, obs_of(observation, goal), hparams), value)


def over_axis(learner: Any, axis_name: str | None) -> Learner:
    """Learner of a run that several devices share. Raises ValueError without a field `axis_name`: copies would diverge."""
    if not hasattr(learner, "axis_name"):
        raise ValueError(
            f"devices: learner {type(learner).__name__} cannot share one run between devices, because it has no field axis_name"
            " (see mjx_dher.learners.Learner); parallel runs are possible"
        )
    made: Learner = dataclasses.replace(learner, axis_name=axis_name)
    return made


def policy_delay(learner: Any) -> int:
    """Updates of a learner per actor update."""
    return getattr(learner, "policy_delay", 1)


def check_update(state: PyTree, result: Any) -> tuple[PyTree, Metrics]:
    """Returns the result of a learner's `update`. Raises ValueError unless it is a state like the one before, and metrics."""
    if not (isinstance(result, tuple) and len(result) == 2):
        raise ValueError(f"learner.update must return (state, metrics); got a {type(result).__name__}")
    updated, metrics = result
    check.kept("learner.update", state, updated)
    check_metrics("update", metrics)
    return updated, metrics


def update_round(learner: Learner, period: int, hparams: HParams, state: PyTree, batches: Batch) -> tuple[PyTree, Metrics]:
    """Makes one update per batch, and moves the targets every `period` updates.

    Leaves of `batches` lead with the larger of `period` and the learner's policy_delay.
    """
    delay = policy_delay(learner)
    if delay > period:
        return _delayed_update(learner, period, hparams, state, batches)
    groups = jax.tree.map(lambda x: x.reshape(period // delay, delay, *x.shape[1:]), batches)
    state, losses = jax.lax.scan(functools.partial(_delayed_update, learner, period, hparams), state, groups)
    return _move_targets(learner, hparams, state), losses


def _delayed_update(learner: Learner, period: int, hparams: HParams, state: PyTree, batches: Batch) -> tuple[PyTree, Metrics]:
    """Makes `policy_delay` updates, the last with the actor, and moves targets that are due. Returns the last metrics."""
    delay = policy_delay(learner)
    for number in range(1, delay + 1):
        batch = jax.tree.map(lambda x, i=number - 1: x[i], batches)
        flags: dict[str, Any] = {} if number == delay else {"with_actor": False}
        state, losses = check_update(state, learner.update(state, batch, hparams, **flags))
        if delay > period and number % period == 0:
            state = _move_targets(learner, hparams, state)
    return state, losses


def _move_targets(learner: Learner, hparams: HParams, state: PyTree) -> PyTree:
    moved = learner.update_target(state, hparams)
    check.kept("learner.update_target", state, moved)
    return moved


def check_metrics(method: str, metrics: Any, taken: Collection[str] = ()) -> None:
    """Raises ValueError unless a learner's metrics are scalars with names that are neither in `RESERVED` nor `taken`."""
    if not isinstance(metrics, dict):
        raise ValueError(f"metrics of learner.{method} must be a dict of scalars; they are a {type(metrics).__name__}")
    for name, value in metrics.items():
        fits_csv = isinstance(name, str) and name.isprintable() and not set(name) & set(',"') and name
        if not fits_csv or name in RESERVED or name in taken:
            reason = "is taken" if fits_csv else "is not a string without commas, quotes and line breaks"
            raise ValueError(f"metrics of learner.{method} must have unique names; {name!r} {reason}")
        check.array(f"metric {name} of learner.{method}", value, (), jnp.number)


def check_noise(noise: PyTree, num_steps: int, num_envs: int) -> None:
    """Raises ValueError unless the leaves of a learner's noise lead with [T, N]."""
    leading = (num_steps, num_envs)
    for path, leaf in jax.tree_util.tree_leaves_with_path(noise):
        if jnp.shape(leaf)[:2] != leading:
            name, shape = f"noise{jax.tree_util.keystr(path)}", list(jnp.shape(leaf))
            raise ValueError(f"learner.noise must return arrays that lead with [T, N] = {list(leading)}; {name} is {shape}")
