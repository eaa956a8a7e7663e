"""Functions of several critics' values: the target, the loss, and the value for the actor.

C critics return values [C, B, M]. M is 1 for an expected return, or the number of quantiles of the return's distribution. A
target has K atoms, one for an expected return.
"""

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
    """Number of critics, and the functions of their values."""

    number: int  # C
    size: int  # M
    combine: CombineFn
    loss: LossFn
    judge: JudgeFn
    num_judges: int | None = None  # number of critics that judge the actor's actions; None: all

    def init(self, network: Any, key: PRNGKey, *inputs: PyTree) -> PyTree:
        """Parameters for an observation [D], a goal [G] and an action [A]; leaves lead with [C]."""
        return jax.vmap(lambda key: network.init(key, *inputs))(jax.random.split(key, self.number))

    def judges(self, params: PyTree) -> PyTree:
        """Parameters of the critics that judge the actor's actions."""
        return jax.tree.map(lambda x: x[: self.num_judges], params)

    def returns(self, outputs: Array, low: Array | float, high: Array | float) -> Array:
        """Estimated returns [C, B, K] of the networks' outputs [C, B, M], for returns in [low, high]."""
        return outputs

    def error(self, outputs: Array, atoms: Array, low: Array | float, high: Array | float) -> Array:
        """Loss [] of the networks' outputs [C, B, M] for a target's atoms [B, K], for returns in [low, high]."""
        return self.loss(outputs, atoms)


class Categorical(Critics):
    """Critics that classify the return: M logits for M values, evenly spaced over all possible returns.

    They learn by cross-entropy to the target as a mixture of its two nearest values, whose mean is the target ("two-hot",
    Farebrother et al. 2024, "Stop Regressing"). `loss` takes logits, and atoms in [0, M - 1].
    """

    def returns(self, outputs: Array, low: Array | float, high: Array | float) -> Array:
        """Mean returns [C, B, 1]."""
        share = jnp.linspace(0.0, 1.0, self.size, dtype=jnp.float32)
        return low + (high - low) * jnp.sum(jax.nn.softmax(outputs) * share, axis=-1, keepdims=True)

    def error(self, outputs: Array, atoms: Array, low: Array | float, high: Array | float) -> Array:
        """Cross-entropy []."""
        return self.loss(outputs, (atoms - low) / (high - low) * (self.size - 1))


def two_hot(logits: Array, atoms: Array) -> Array:
    """Cross-entropy of logits [C, B, M] to atoms [B, K] in [0, M - 1]; means over samples and atoms, summed over critics."""
    distance = jnp.abs(atoms[..., None] - jnp.arange(logits.shape[-1], dtype=atoms.dtype))
    target = jnp.mean(jnp.maximum(1.0 - distance, 0.0), axis=1)
    return -jnp.sum(jnp.mean(jnp.sum(target * jax.nn.log_softmax(logits), axis=-1), axis=-1))


def values(network: Any, params: PyTree, observation: Array, goal: Array, action: Array) -> Array:
    """Values [C, B, M] of C critics: one after the other on a CPU, where a `vmap` over few critics takes longer."""
    if jax.default_backend() != "cpu":
        return cast(Array, jax.vmap(lambda one: network.apply(one, observation, goal, action))(params))
    each = (jax.tree.map(lambda x, i=i: x[i], params) for i in range(len(jax.tree.leaves(params)[0])))
    return jnp.stack([network.apply(one, observation, goal, action) for one in each])


def smallest(values: Array, key: PRNGKey) -> Array:
    """Smallest of the critics' values, the target [B, M] (Fujimoto et al. 2018, algorithm 1)."""
    return jnp.min(values, axis=0)


def smallest_of(number: int) -> CombineFn:
    """Makes the function that takes the smallest value of `number` random critics (Chen et al. 2021, algorithm 1)."""

    def combine(values: Array, key: PRNGKey) -> Array:
        drawn = jax.random.choice(key, values.shape[0], (number,), replace=False)
        return jnp.min(values[drawn], axis=0)

    return combine


def truncated(dropped: int) -> CombineFn:
    """Makes the function that pools all quantiles and drops the `dropped` * C largest (Kuznetsov et al. 2020, equation 11)."""

    def combine(values: Array, key: PRNGKey) -> Array:
        num_critics, batch_size, size = values.shape
        pooled = jnp.moveaxis(values, 0, 1).reshape(batch_size, num_critics * size)
        return least(pooled, num_critics * (size - dropped))

    return combine


def squared_error(values: Array, atoms: Array) -> Array:
    """Mean squared difference between values [C, B, 1] and the target [B, 1], summed over the critics."""
    return jnp.sum(jnp.mean(jnp.square(values - atoms), axis=(1, 2)))


def least(numbers: Array, count: int) -> Array:
    """The `count` smallest of `numbers` [B, K] in ascending order, [B, count].

    It compares all pairs, which is ten times faster than sorting for so few numbers.
    """
    size, order = numbers.shape[-1], jnp.arange(numbers.shape[-1])

    def is_before(j: Any) -> Array:
        other = numbers[:, j, None]
        return ((other < numbers) | ((other == numbers) & (j < order))).astype(jnp.int32)

    rank = _sum(is_before, size)
    return _sum(lambda j: jnp.where(rank[:, j, None] == jnp.arange(count), numbers[:, j, None], 0.0), size)


@jax.custom_vjp
def quantile_huber(values: Array, atoms: Array) -> Array:
    """Quantile Huber loss between quantiles [C, B, M] and atoms [B, K], summed over the critics.

    Dabney et al. 2018 (QR-DQN), equation 10, with kappa = 1: the mean over samples, quantiles and atoms of |tau_m - [u < 0]|
    huber(u), where u = atom - quantile and tau_m = (m + 1/2) / M. Atoms have no gradient.
    """
    return _quantile_huber(values, atoms)[0]


def _quantile_huber(values: Array, atoms: Array) -> tuple[Array, tuple[Array, Array]]:
    """The loss, its gradient with respect to `values` from the same pass over the atoms, and the atoms."""

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
    """Leaf-wise sum term(0) + ... + term(number - 1): a loop on a CPU, where it stays in cache, else vectorized."""
    if jax.default_backend() != "cpu":
        return jax.tree.map(lambda x: jnp.sum(x, axis=0), jax.vmap(term)(jnp.arange(number)))
    return jax.lax.fori_loop(1, number, lambda j, total: jax.tree.map(jnp.add, total, term(j)), term(0))


def lowest(values: Array) -> Array:
    """Smallest of the critics' values [B]. SAC's actor loss uses it, and TD3's with the first critic alone."""
    means = jnp.mean(values, axis=-1)
    # Not jnp.min. Its gradient compares the minimum with the values, and XLA may compute these twice, in two ways that round
    # differently. Then no value equals the minimum, and the gradient is 0 / 0.
    return jnp.take_along_axis(means, jnp.argmin(means, axis=0)[None], axis=0)[0]


def mean(values: Array) -> Array:
    """Mean of all values [B], for the actor loss of REDQ and TQC."""
    return jnp.mean(values, axis=(0, 2))
