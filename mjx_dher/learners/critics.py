"""Pieces for learners with several critics: what their values become as a target, a loss, and the actor's judge.

Values of C critics with M numbers each are [C, B, M]. M is 1 for a critic that gives the expected return, and else the number
of quantiles of its distribution. A target has K numbers: the atoms of a distribution, one for an expected return.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp

from mjx_dher.types import Array, PRNGKey, PyTree

CombineFn = Callable[[Array, PRNGKey], Array]  # values of the target critics [C, B, M], key -> atoms [B, K]
LossFn = Callable[[Array, Array], Array]  # values [C, B, M], atoms [B, K] -> []
JudgeFn = Callable[[Array], Array]  # values [C, B, M] -> [B]
Term = TypeVar("Term", bound=Any)


@dataclasses.dataclass(frozen=True)
class Critics:
    """Number of the critics, and what is made of their values."""

    number: int  # C
    size: int  # M
    combine: CombineFn
    loss: LossFn
    judge: JudgeFn
    num_judges: int | None = None  # of the critics, those that judge the actor's actions; all where None

    def init(self, network: Any, key: PRNGKey, *inputs: PyTree) -> PyTree:
        """Makes parameters for an observation [D], a goal [G] and an action [A]; leaves lead with [C]."""
        return jax.vmap(lambda key: network.init(key, *inputs))(jax.random.split(key, self.number))

    def judges(self, params: PyTree) -> PyTree:
        """Returns the parameters of the critics that judge actions."""
        return jax.tree.map(lambda x: x[: self.num_judges], params)


def values(network: Any, params: PyTree, observation: Array, goal: Array, action: Array) -> Array:
    """Returns the values [C, B, M] of C critics that give [B, M]."""
    return cast(Array, jax.vmap(lambda one: network.apply(one, observation, goal, action))(params))


def smallest(values: Array, key: PRNGKey) -> Array:
    """Returns the smallest of the critics' values, as the target [B, M] (Fujimoto et al. 2018, algorithm 1)."""
    del key
    return jnp.min(values, axis=0)


def smallest_of(number: int) -> CombineFn:
    """Returns the rule that takes the smallest value of `number` critics drawn at random (Chen et al. 2021, algorithm 1)."""

    def combine(values: Array, key: PRNGKey) -> Array:
        drawn = jax.random.choice(key, values.shape[0], (number,), replace=False)
        return jnp.min(values[drawn], axis=0)

    return combine


def truncated(dropped: int) -> CombineFn:
    """Returns the rule that pools the quantiles of all critics and drops the `dropped` * C largest.

    Kuznetsov et al. 2020 (TQC), equation 11.
    """

    def combine(values: Array, key: PRNGKey) -> Array:
        del key
        num_critics, batch_size, size = values.shape
        pooled = jnp.moveaxis(values, 0, 1).reshape(batch_size, num_critics * size)
        return least(pooled, num_critics * (size - dropped))

    return combine


def squared_error(values: Array, atoms: Array) -> Array:
    """Returns the mean squared difference of values [C, B, 1] to the target [B, 1], summed over the critics."""
    return jnp.sum(jnp.mean(jnp.square(values - atoms), axis=(1, 2)))


def least(numbers: Array, count: int) -> Array:
    """Returns the `count` smallest of `numbers` [B, K] in rising order, [B, count].

    By comparing each with each, which is an order faster than a sort for as few as they are.
    """
    size, order = numbers.shape[-1], jnp.arange(numbers.shape[-1])

    def is_before(j: Any) -> Array:
        other = numbers[:, j, None]
        return ((other < numbers) | ((other == numbers) & (j < order))).astype(jnp.int32)

    rank = _sum(is_before, size)
    return _sum(lambda j: jnp.where(rank[:, j, None] == jnp.arange(count), numbers[:, j, None], 0.0), size)


@jax.custom_vjp
def quantile_huber(values: Array, atoms: Array) -> Array:
    """Returns the quantile Huber loss of quantiles [C, B, M] to atoms [B, K], summed over the critics.

    Dabney et al. 2018 (QR-DQN), equation 10, with kappa = 1: the mean over samples, quantiles and atoms of
    |tau_m - [u < 0]| huber(u), where u = atom - quantile and tau_m = (m + 1/2) / M. Atoms, a target, have no gradient.
    """
    return _quantile_huber(values, atoms)[0]


def _quantile_huber(values: Array, atoms: Array) -> tuple[Array, tuple[Array, Array]]:
    """Returns the loss; its gradient in `values`, by the same pass over the atoms; and the atoms."""

    def of_atom(k: Any) -> tuple[Array, Array, Array, Array]:
        u = atoms[:, k, None] - values
        above, below = jnp.clip(u, 0.0, 1.0), jnp.clip(u, -1.0, 0.0)
        return above, below, above * (u - 0.5 * above), below * (u - 0.5 * below)

    _, batch_size, size = values.shape
    slope_above, slope_below, above, below = _sum(of_atom, atoms.shape[1])
    tau = (jnp.arange(size, dtype=values.dtype) + 0.5) / size
    scale = 1.0 / (batch_size * size * atoms.shape[1])
    loss = scale * jnp.sum(tau * above + (1.0 - tau) * below)
    return loss, (-scale * (tau * slope_above + (1.0 - tau) * slope_below), atoms)


def _quantile_huber_gradient(kept: tuple[Array, Array], by_loss: Array) -> tuple[Array, Array]:
    gradient, atoms = kept
    return by_loss * gradient, jnp.zeros_like(atoms)


quantile_huber.defvjp(_quantile_huber, _quantile_huber_gradient)


def _sum(term: Callable[[Any], Term], number: int) -> Term:
    """Returns term(0) + ... + term(number - 1), leaf by leaf: a loop on a CPU, whose caches hold it, all at once elsewhere."""
    if jax.default_backend() != "cpu":
        return jax.tree.map(lambda x: jnp.sum(x, axis=0), jax.vmap(term)(jnp.arange(number)))
    return jax.lax.fori_loop(1, number, lambda j, total: jax.tree.map(jnp.add, total, term(j)), term(0))


def lowest(values: Array) -> Array:
    """Returns the smallest of the critics' values [B]: SAC's judge of actions, and, of the first critic alone, TD3's."""
    return jnp.min(jnp.mean(values, axis=-1), axis=0)


def mean(values: Array) -> Array:
    """Returns the mean of all values [B]: the judge of actions of REDQ and TQC."""
    return jnp.mean(values, axis=(0, 2))
