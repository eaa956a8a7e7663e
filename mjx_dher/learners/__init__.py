"""Learners: `Learner` is the protocol, `make` makes one by name."""

from __future__ import annotations

import dataclasses
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

# What the loop and the log call theirs: a learner's metrics have other names.
RESERVED = frozenset(
    (
        *("success_rate", "reset_success_rate", "return_mean", "train_success_rate", "train_return_mean", "priority_mean"),
        *("relabelled_share", "relabel_distance", "discarded_episodes", "bad_rewards", "bad_success", "no_goal_share"),
        *("epoch", "env_steps", "updates", "wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes"),
        "train_length_mean",
    )
)


class Learner(Protocol):
    """A learner: pure functions of a state, which is a pytree of arrays. `hparams` holds traced numbers.

    A learner defines `init`, `act`, `explore` and `update`. A subclass of this class inherits the other methods; any other
    object must have them, too. Optional members:

      value(state, obs, action [..., A], hparams) -> [...]: estimated return of taking an action and then following the policy.
        Priorities, metrics and goal generators that use the learner's values need it.
      axis_name: a field, None by default, of a dataclass. A run that is split over devices replaces it by the name of a mapped
        axis. `update` then averages its gradients over this axis (`jax.lax.pmean`), and `update_normalizers` its moments.
    """

    policy_delay: int = 1
    """Updates for each update of the actor. If it is above 1, all updates but every policy_delay-th are called with the further
    argument `with_actor=False`."""

    def init(self, key: PRNGKey) -> PyTree:
        """Makes the first state."""

    def act(self, state: Any, obs: GoalObs, hparams: HParams) -> Array:
        """Deterministic policy: actions [..., A] in [-1, 1] for observations [..., D] and goals [..., G].

        Evaluation and the exported policy use it. Any leading axes are possible, or none.
        """

    def explore(self, state: Any, obs: GoalObs, noise: Any, hparams: HParams) -> Array:
        """Exploring policy: actions [N, A] in [-1, 1] for the N environments of a rollout.

        `noise` is what `noise` drew for this step; its leaves lead with [N]. By default it is a key [N] for each environment.
        """

    def update(self, state: Any, batch: Batch, hparams: HParams) -> tuple[PyTree, Metrics]:
        """Takes one gradient step on a batch [B] of transitions.

        The value of the next observation counts `batch.discount` [B]: gamma, 0 after a terminal transition, or with n-step
        returns gamma^n. Targets stay as they are. Returns the next state, which has the same structure, shapes and types, and
        metrics []. These are averaged over an epoch and logged; their names are not in `RESERVED`.
        """

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, hparams: HParams) -> PyTree:
        """Draws the randomness of exploration for a whole rollout, at once, because that is faster; leaves lead with [T, N]."""
        return jax.random.split(key, (num_steps, num_envs))

    def update_normalizers(self, state: Any, observation: Array, goal: Array, hparams: HParams, valid: Array) -> PyTree:
        """Returns the state after a rollout's observations [N, T+1, D] and relabelled goals [B, G].

        Observations with `valid` [N] False may be NaN and must be ignored. By default nothing is learned from either.
        """
        return state

    def update_target(self, state: Any, hparams: HParams) -> PyTree:
        """Moves the target networks, if there are any; called once every `target_period` updates."""
        return state

    def summary(self, state: Any) -> Metrics:
        """Metrics [] of the state, logged at the end of an epoch; their names differ from those of `update`."""
        return {}

    def export(self, state: Any, hparams: HParams) -> Any:
        """Policy as a `policy.Policy`, which needs only NumPy. If None, the policy is saved as the learner's state."""
        return None


# make(config, spec, networks) -> Learner
LearnerFn = Callable[[Config, EnvSpec, NetworksFn], Learner]


def make(name: str | LearnerFn, config: Config, spec: EnvSpec, network: str | NetworksFn = "mlp") -> Learner:
    """Makes the learner called `name`.

    Args:
      name: a built-in name, "module:attribute", or a function (config, spec, networks) -> Learner.
      config: sizes of the networks, dtype and kernels.
      spec: of the environment (`contract.env_spec`).
      network: what `networks.make` takes.

    Raises:
      ValueError: no such learner or networks, something that lacks a method of `Learner`, or parts that do not combine.
    """
    make_learner = components.load("learner", name, "config", "spec", "networks")
    learner = make_learner(config, spec, networks.make(network))
    check_methods(name, learner)
    return learner


def check_methods(name: Any, learner: Any) -> None:
    """Raises ValueError unless `learner`, which messages call `name`, has the methods of a `Learner`."""
    methods = [method for method, function in vars(Learner).items() if callable(function) and not method.startswith("_")]
    if missing := [method for method in methods if not callable(getattr(learner, method, None))]:
        raise ValueError(f"learner {name!r} is no learner: it has no {', '.join(missing)} (see mjx_dher.learners.Learner)")
    delay = policy_delay(learner)
    check_size("policy_delay of the learner", delay)
    if delay > 1 and "with_actor" not in inspect.signature(learner.update).parameters:
        raise ValueError(f"learner {name!r} has a policy_delay of {delay}, and its update no parameter with_actor")


def check_values(learner: Any) -> None:
    """Raises ValueError unless a learner has values, which a component of this run uses."""
    if not callable(getattr(learner, "value", None)):
        raise ValueError(
            f"a priority, metric or generator of this run asks for the learner's values, and {learner!r} has no method"
            " value(state, obs, action, hparams)"
        )


def values_of(learner: Any, state: PyTree, hparams: HParams) -> Values:
    """A learner's policy and values at `state`, as functions of observations and goals."""

    def obs_of(observation: Array, goal: Array) -> GoalObs:
        return GoalObs(observation=observation, achieved_goal=goal, desired_goal=goal)

    def value(observation: Array, goal: Array, action: Array) -> Array:
        result = learner.value(state, obs_of(observation, goal), action, hparams)
        return check.array("learner.value, one number for each action,", result, action.shape[:-1])

    return Values(lambda observation, goal: learner.act(state, obs_of(observation, goal), hparams), value)


def over_axis(learner: Any, axis_name: str | None) -> Learner:
    """Learner of a run that is split over the devices of a mapped axis.

    Raises:
      ValueError: it has no field `axis_name`, so that the devices' copies would diverge.
    """
    if not hasattr(learner, "axis_name"):
        raise ValueError(
            f"devices: one run of learner {type(learner).__name__} cannot be on several devices, because it has no field"
            " axis_name (see mjx_dher.learners.Learner); runs side by side can"
        )
    made: Learner = dataclasses.replace(learner, axis_name=axis_name)
    return made


def policy_delay(learner: Any) -> int:
    """Updates of a learner for each update of its actor."""
    return getattr(learner, "policy_delay", 1)


def check_kept(method: str, before: PyTree, after: PyTree) -> None:
    """Raises ValueError unless a learner's method keeps its state's structure, shapes and types, as `lax.scan` needs."""
    old, new = (
        {jax.tree_util.keystr(path): f"{jnp.result_type(x)}{list(jnp.shape(x))}" for path, x in _leaves(state)}
        for state in (before, after)
    )
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    differing = [f"{name} is {old.get(name, 'absent')} and becomes {new.get(name, 'absent')}" for name in names]
    structure: Any = jax.tree.structure(before)
    if structure != jax.tree.structure(after) or differing:
        reason = (differing or ["its type or its static fields differ"])[0]
        raise ValueError(f"learner.{method} must keep the state's structure, shapes and types; {reason}")


def check_update(state: PyTree, result: Any) -> tuple[PyTree, Metrics]:
    """Returns the result of a learner's `update` of `state`; raises ValueError unless it is a state like it, and metrics."""
    if not (isinstance(result, tuple) and len(result) == 2):
        raise ValueError(f"learner.update must give (state, metrics); it gives a {type(result).__name__}")
    updated, metrics = result
    check_kept("update", state, updated)
    check_metrics("update", metrics)
    return updated, metrics


def check_metrics(method: str, metrics: Any, taken: Collection[str] = ()) -> None:
    """Raises ValueError unless a learner's metrics are scalars [] with names that are neither in `RESERVED` nor `taken`."""
    if not isinstance(metrics, dict):
        raise ValueError(f"metrics of learner.{method} must be a dict of scalars; they are a {type(metrics).__name__}")
    for name, value in metrics.items():
        if not isinstance(name, str) or name in RESERVED or name in taken:
            reason = "is taken" if isinstance(name, str) else "is no text"
            raise ValueError(f"metrics of learner.{method} must have names of their own; {name!r} {reason}")
        check.array(f"metric {name} of learner.{method}", value, (), jnp.number)


def check_noise(noise: PyTree, num_steps: int, num_envs: int) -> None:
    """Raises ValueError unless the leaves of a learner's noise lead with [T, N]."""
    leading = (num_steps, num_envs)
    for path, leaf in _leaves(noise):
        if jnp.shape(leaf)[:2] != leading:
            name, shape = f"noise{jax.tree_util.keystr(path)}", list(jnp.shape(leaf))
            raise ValueError(f"learner.noise must give arrays that lead with [T, N] = {list(leading)}; {name} is {shape}")


def _leaves(tree: PyTree) -> Any:
    return jax.tree_util.tree_leaves_with_path(tree)
