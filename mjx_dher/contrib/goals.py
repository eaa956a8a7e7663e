"""Choice of hindsight goals and of rollout goals: Next-Future, and Hindsight Goal Generation."""

import jax
import jax.numpy as jnp

from mjx_dher import replay
from mjx_dher.config import HParams
from mjx_dher.context import Context
from mjx_dher.contrib.generators import Generator
from mjx_dher.replay import ReplayState
from mjx_dher.samplers import future
from mjx_dher.types import Array, GoalObs, PRNGKey

_START_WEIGHT = 3.0  # c of HGG
_LIPSCHITZ = 5.0  # L of HGG
STILL = 0.01  # m; an episode offers no goal if its last one is this near to its first
_SOFTNESS = 0.05  # softness of the matching, as a fraction of the mean cost
_SINKHORN_ROUNDS = 50


def next_future(achieved: Array, desired: Array, step: Array, hparams: HParams, length: Array | None = None) -> Array:
    """The next goal with probability 1/k, else any future one. k is `her_k`, at least 1.

    In Özgür, Zurbrügg & Kumar 2025 ("Next-Future"), the first of k virtual goals is the next achieved one.
    """
    share = 1.0 / jnp.maximum(hparams.her_k, 1.0)
    following = (jnp.arange(achieved.shape[0]) == step + 1).astype(jnp.float32)
    return jnp.log(share * following + (1.0 - share) * jax.nn.softmax(future(achieved, desired, step, hparams, length)))


def match(cost: Array, usable: Array, softness: Array | float = _SOFTNESS, rounds: int = _SINKHORN_ROUNDS) -> Array:
    """Soft matching of N rows to P columns at costs [N, P]: log probabilities [N, P] that a row takes a column.

    Every row has the same mass, and so has every column that the mask `usable` [P] selects, at least one (Sinkhorn & Knopp
    1967; Cuturi 2013). Computed in logarithms, so that no mass vanishes. `softness` is a fraction of the mean cost. The smaller
    it is, the nearer the result is to the assignment of least cost.
    """
    open_to = jnp.broadcast_to(usable[None], cost.shape)
    mean = jnp.sum(jnp.where(open_to, jnp.abs(cost), 0.0)) / jnp.sum(open_to, dtype=cost.dtype)
    plan = jnp.where(open_to, -cost / (softness * jnp.maximum(mean, 1e-12)), -jnp.inf)

    def balance(plan: Array, _: None) -> tuple[Array, None]:
        by_column = jax.nn.logsumexp(jnp.where(open_to, plan, 0.0), axis=0, keepdims=True)
        plan = jnp.where(open_to, plan - by_column, -jnp.inf)
        return plan - jax.nn.logsumexp(plan, axis=1, keepdims=True), None

    return jax.lax.scan(balance, plan, length=rounds)[0]


def _nearest(achieved: Array, easy: Array, desired: Array) -> tuple[Array, Array]:
    """Minimum over t of |g - a_t| - easy_t, and its t, for N desired goals and P episodes, both [N, P].

    `achieved` is [P, T+1, G], `easy` [P, T+1], `desired` [N, G].
    """

    def earlier(best: tuple[Array, Array], at: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
        goals, bonus, step = at
        squares = sum(jnp.square(desired[:, None, i] - goals[None, :, i]) for i in range(goals.shape[-1]))
        cost = jnp.sqrt(squares) - bonus[None]
        return (jnp.minimum(best[0], cost), jnp.where(cost < best[0], step, best[1])), None

    shape = (desired.shape[0], achieved.shape[0])
    start = jnp.full(shape, jnp.inf, achieved.dtype), jnp.zeros(shape, jnp.int32)
    steps = jnp.arange(achieved.shape[1], dtype=jnp.int32)
    return jax.lax.scan(earlier, start, (jnp.moveaxis(achieved, 1, 0), easy.T, steps))[0]


def hindsight_goals(key: PRNGKey, obs: GoalObs, ring: ReplayState, context: Context) -> Array:
    """Previously achieved goals [N, G], each on the way to a desired one (Ren et al. 2019, "HGG").

    N uniformly drawn stored episodes are matched to the N resets at the least total cost

        w(j, p) = c |a_p0 - a_j| + min_t (|g_j - a_pt| - (1 - gamma) V(s_p0, a_pt) D / L)

    where a_j and g_j are the achieved and desired goal of reset j, D is the largest |g_j - a_j|, c = 3 and L = 5. The result
    is the a_pt of the minimum. The authors solve a minimum-cost flow on the host. Here the matching is soft (`match`), and
    each reset draws an episode from its row. If nothing moved in any of the episodes, resets keep their goals.
    """
    values = context.learner_values()
    row_key, match_key = jax.random.split(key)
    start, desired = obs["achieved_goal"], obs["desired_goal"]
    number = desired.shape[0]
    rows = replay.randint_from_bits(jax.random.bits(row_key, (number,), jnp.uint32), ring.size)
    achieved = ring.episodes.achieved_goal[rows]
    shape = achieved.shape[:2]
    first = jax.tree.map(lambda x: jnp.broadcast_to(x[rows, :1], (*shape, *x.shape[2:])), ring.episodes.observation)
    diameter = jnp.max(jnp.linalg.norm(desired - start, axis=-1))
    value = jnp.clip(values.of_state(first, achieved), *context.bounds())
    least, step = _nearest(achieved, value * (1.0 - context.hparams.gamma) * diameter / _LIPSCHITZ, desired)
    cost = least + _START_WEIGHT * jnp.linalg.norm(start[:, None] - achieved[None, :, 0], axis=-1)
    moved = jnp.linalg.norm(achieved[:, -1] - achieved[:, 0], axis=-1) > STILL
    row = jax.random.categorical(match_key, match(cost, moved | ~jnp.any(moved)), axis=-1)
    goals = achieved[row, step[jnp.arange(number), row]]
    return jnp.where((ring.size > 0) & jnp.any(moved), goals, desired)


hgg = Generator(hindsight_goals, uses_values=True)
