"""Learners as values: each is one file, over shared pieces. `Learner` says what one has, `make` makes one by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from mjx_dher import names, networks
from mjx_dher.config import Config, HParams
from mjx_dher.networks import NetworksFn
from mjx_dher.spec import LEARNERS
from mjx_dher.types import Array, Batch, GoalObs, Metrics, PRNGKey, PyTree, Sizes


class Learner(Protocol):
    """A learner: pure functions of a state of its own, a pytree of arrays. Numbers come in as HParams, traced."""

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
        """Takes one gradient step on a batch [B]; returns metrics [] to be averaged over an epoch."""

    def update_target(self, state: Any, hparams: HParams) -> PyTree:
        """Moves the target networks; called once every `target_period` updates."""

    def summary(self, state: Any) -> Metrics:
        """Returns metrics [] of the state at the end of an epoch."""

    def export(self, state: Any, hparams: HParams) -> Any:
        """Returns the policy as a `policy.Policy`, which needs NumPy alone, or None where that cannot be."""


# make(config, sizes, networks) -> Learner
LearnerFn = Callable[[Config, Sizes, NetworksFn], Learner]


def make(name: str | LearnerFn, config: Config, sizes: Sizes, network: str | NetworksFn = "mlp") -> Learner:
    """Makes the learner called `name`.

    Args:
      name: one of `spec.LEARNERS`, "module:attribute", or a function (config, sizes, networks) -> Learner.
      config: sizes of the networks, dtype and kernels.
      sizes: of the environment.
      network: what `networks.make` takes.

    Raises:
      ValueError: no such learner or networks, something that lacks a method of `Learner`, or parts that do not combine.
    """
    make_learner = names.resolve("learner", name, LEARNERS, ("config", "sizes", "networks"))
    learner = make_learner(config, sizes, networks.make(network))
    methods = [method for method in vars(Learner) if not method.startswith("_")]
    if missing := [method for method in methods if not callable(getattr(learner, method, None))]:
        raise ValueError(f"learner {name!r} is no learner: it has no {', '.join(missing)} (see mjx_dher.learners.Learner)")
    return learner
