"""Learners as values: each is one file, over shared pieces. `Learner` says what one has, `make` makes one by name."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from mjx_dher import components, networks
from mjx_dher.config import Config, HParams
from mjx_dher.context import Values
from mjx_dher.networks import NetworksFn
from mjx_dher.parallel.split import Split
from mjx_dher.types import Array, Batch, GoalObs, Metrics, PRNGKey, PyTree, Sizes, check_size

# What the loop and the log call theirs: a learner's metrics have other names.
RESERVED = frozenset(
    (
        *("success_rate", "reset_success_rate", "return_mean", "train_success_rate", "train_return_mean", "priority_mean"),
        *("relabelled_share", "relabel_distance", "discarded_episodes", "bad_rewards", "bad_success", "no_goal_share"),
        *("epoch", "env_steps", "updates", "wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes"),
    )
)


class Learner(Protocol):
    """A learner: pure functions of a state of its own, a pytree of arrays. Numbers come in as HParams, traced.

    It may have `policy_delay`, an integer of more than 1, and `update_critic`, which is called like `update`: of so many
    updates all but the last are then made by `update_critic`. It has `uses_discount`, True, where it takes the `discount` of a
    batch, as returns of several steps need. It may have `value(state, obs, action, hparams)`, the estimated return [...] of
    actions [..., A] and then following the policy, at observations [..., D] and goals [..., G]: priorities, distances and goal
    generators that ask for the learner's values need it. It has `split_over`, a method that takes a `split.Split` and returns
    a learner, where one run of it can be on several devices: that learner's `update` averages gradients by `Split.mean`, and
    its `update_normalizers` takes in the values of all parts.
    """

    def init(self, key: PRNGKey) -> PyTree:
        """Makes a first state."""

    def update_normalizers(self, state: Any, observation: Array, goal: Array, hparams: HParams, valid: Array) -> PyTree:
        """Returns the state after it has taken in new observations [N, T+1, D], of valid [N] episodes, and goals [B, G]."""

    def act(self, state: Any, obs: GoalObs, hparams: HParams) -> Array:
        """Returns the deterministic policy's actions [..., A] in [-1, 1]."""

    def noise(self, key: PRNGKey, num_steps: int, num_envs: int, hparams: HParams) -> PyTree:
        """Draws what `explore` takes in the steps of a rollout; leaves lead with [T, N]."""

    def explore(self, state: Any, obs: GoalObs, noise: Any, hparams: HParams) -> Array:
        """Returns the exploring policy's actions [N, A]; leaves of `noise` lead with [N]."""

    def update(self, state: Any, batch: Batch, hparams: HParams) -> tuple[PyTree, Metrics]:
        """Takes one gradient step on a batch [B]; returns metrics [] to be averaged over an epoch, not called as `RESERVED`."""

    def update_target(self, state: Any, hparams: HParams) -> PyTree:
        """Moves the target networks; called once every `target_period` updates."""

    def summary(self, state: Any) -> Metrics:
        """Returns metrics [] of the state at the end of an epoch, with names that `update` does not use."""

    def export(self, state: Any, hparams: HParams) -> Any:
        """Returns the policy as a `policy.Policy`, which needs NumPy alone, or None where that cannot be."""


# make(config, sizes, networks) -> Learner
LearnerFn = Callable[[Config, Sizes, NetworksFn], Learner]


def make(name: str | LearnerFn, config: Config, sizes: Sizes, network: str | NetworksFn = "mlp") -> Learner:
    """Makes the learner called `name`.

    Args:
      name: a built-in name, "module:attribute", or a function (config, sizes, networks) -> Learner.
      config: sizes of the networks, dtype and kernels.
      sizes: of the environment.
      network: what `networks.make` takes.

    Raises:
      ValueError: no such learner or networks, something that lacks a method of `Learner`, or parts that do not combine.
    """
    make_learner = components.load("learner", name, "config", "sizes", "networks")
    learner = make_learner(config, sizes, networks.make(network))
    check_methods(name, learner)
    check_discount(learner, config)
    return learner


def check_methods(name: Any, learner: Any) -> None:
    """Raises ValueError unless `learner`, which messages call `name`, has the methods of a `Learner`."""
    methods = [method for method in vars(Learner) if not method.startswith("_")]
    if missing := [method for method in methods if not callable(getattr(learner, method, None))]:
        raise ValueError(f"learner {name!r} is no learner: it has no {', '.join(missing)} (see mjx_dher.learners.Learner)")
    delay = policy_delay(learner)
    check_size("policy_delay of the learner", delay)
    if delay > 1 and not callable(getattr(learner, "update_critic", None)):
        raise ValueError(f"learner {name!r} has a policy_delay of {delay}, and no update_critic")


def check_discount(learner: Any, config: Config) -> None:
    """Raises ValueError where batches have returns of several steps and the learner does not take their discount."""
    if config.n_step > 1 and not getattr(learner, "uses_discount", False):
        raise ValueError(
            f"n_step {config.n_step} needs a learner that takes a batch's discount; {learner!r} has no uses_discount"
        )


def check_values(learner: Any) -> None:
    """Raises ValueError where a part of a run asks for a learner's values and it has no method for them."""
    if not callable(getattr(learner, "value", None)):
        raise ValueError(
            f"a priority, metric or generator of this run asks for the learner's values, and {learner!r} has no method"
            " value(state, obs, action, hparams)"
        )


def values_of(learner: Any, state: PyTree, hparams: HParams) -> Values:
    """Returns a learner's policy and values, as it is in `state`, as functions of observations and goals."""

    def obs_of(observation: Array, goal: Array) -> GoalObs:
        return GoalObs(observation=observation, achieved_goal=goal, desired_goal=goal)

    def value(observation: Array, goal: Array, action: Array) -> Array:
        result = learner.value(state, obs_of(observation, goal), action, hparams)
        if getattr(result, "shape", None) != action.shape[:-1]:
            given = list(result.shape) if hasattr(result, "shape") else f"a {type(result).__name__}"
            raise ValueError(f"learner.value must give one number for each action, {list(action.shape[:-1])}; it gives {given}")
        return result

    return Values(lambda observation, goal: learner.act(state, obs_of(observation, goal), hparams), value)


def split_over(learner: Any, split: Split) -> Learner:
    """Returns the learner of a run in parts.

    Raises:
      ValueError: it has no `split_over`, so that its parts would learn apart.
    """
    if not callable(getattr(learner, "split_over", None)):
        raise ValueError(
            f"devices: one run of learner {type(learner).__name__} cannot be on {split.number} devices, because it has no"
            " split_over (see mjx_dher.learners.Learner); runs side by side can"
        )
    made: Learner = learner.split_over(split)
    check_methods(type(learner).__name__, made)
    return made


def policy_delay(learner: Any) -> int:
    """Returns how many updates a learner makes for one of its actor; 1 where it does not say."""
    return getattr(learner, "policy_delay", 1)


def check_kept(method: str, before: PyTree, after: PyTree) -> None:
    """Raises ValueError unless a method of a learner keeps its state's structure, shapes and types, as `lax.scan` needs."""
    old, new = (
        {jax.tree_util.keystr(path): f"{jnp.result_type(x)}{list(jnp.shape(x))}" for path, x in _leaves(state)}
        for state in (before, after)
    )
    differing = [f"{name} is {old[name]} and becomes {new[name]}" for name in old if name in new and old[name] != new[name]]
    differing += [f"only one of them has {name}" for name in {**old, **new} if (name in old) != (name in new)]
    structure: Any = jax.tree.structure(before)
    if structure != jax.tree.structure(after) or differing:
        reason = (differing or ["its type or its static fields differ"])[0]
        raise ValueError(f"learner.{method} must keep the state's structure, shapes and types; {reason}")


def check_update(state: PyTree, result: Any, method: str = "update") -> tuple[PyTree, Metrics]:
    """Returns what a learner's `update` gave for `state`; raises ValueError unless it is a state like it, and metrics."""
    if not (isinstance(result, tuple) and len(result) == 2):
        raise ValueError(f"learner.{method} must give (state, metrics); it gives a {type(result).__name__}")
    updated, metrics = result
    check_kept(method, state, updated)
    check_metrics(method, metrics)
    return updated, metrics


def check_metrics(method: str, metrics: Any, taken: Collection[str] = ()) -> None:
    """Raises ValueError unless a learner's metrics are scalars [] by names that are not in `RESERVED`, nor `taken`."""
    if not isinstance(metrics, dict):
        raise ValueError(f"metrics of learner.{method} must be a dict of scalars; they are a {type(metrics).__name__}")
    for name, value in metrics.items():
        if not isinstance(name, str) or name in RESERVED or name in taken:
            reason = "is another's" if isinstance(name, str) else "is no text"
            raise ValueError(f"metrics of learner.{method} must have names of their own; {name!r} {reason}")
        if jnp.shape(value) != ():
            raise ValueError(f"metrics of learner.{method} must be scalars, []; {name} is {list(jnp.shape(value))}")


def check_noise(noise: PyTree, num_steps: int, num_envs: int) -> None:
    """Raises ValueError unless the leaves of a learner's noise lead with [T, N]."""
    leading = (num_steps, num_envs)
    for path, leaf in _leaves(noise):
        if jnp.shape(leaf)[:2] != leading:
            name, shape = f"noise{jax.tree_util.keystr(path)}", list(jnp.shape(leaf))
            raise ValueError(f"learner.noise must give arrays that lead with [T, N] = {list(leading)}; {name} is {shape}")


def _leaves(tree: PyTree) -> Any:
    return jax.tree_util.tree_leaves_with_path(tree)
