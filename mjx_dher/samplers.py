"""Goal samplers: distributions over achieved goals for relabelling.

A sampler is a pure function that returns unnormalized log weights of the T+1 achieved goals of one episode. A goal with -inf
is never chosen. `draw` samples from the weights.

    log_weights(achieved [T+1, G], desired [G], step [], hparams) -> [T+1]

The relabelled transition leads from `step` to `step + 1`. Its *future* is the goals at step+1 ... T, without `step` itself. If
episodes can end early, goals after the end get no weight; a sampler may take the keyword `length` [], the index of the last
goal. A transition keeps its own goal if it has no weights, or any weight is NaN or +inf. Training reports the fraction of such
transitions as `no_goal_share`.
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher import check, components, lookup
from mjx_dher.config import HParams
from mjx_dher.context import euclidean, one_of
from mjx_dher.types import Array, DistanceFn, PRNGKey

# log_weights(achieved [T+1, G], desired [G], step [], hparams) -> [T+1]
LogWeightsFn = Callable[..., Array]
# metric(achieved [T+1, G], desired [G]) -> [T+1], finite and not negative
MetricFn = Callable[[Array, Array], Array]
# kernel(relative distance [T+1], temperature []) -> log weight [T+1]
KernelFn = Callable[[Array, Array | float], Array]
# normalization(distance [T+1], candidates [T+1] bool, scale [] in metres) -> relative distance [T+1]
NormalizationFn = Callable[[Array, Array, Array | float], Array]


@struct.dataclass
class Sampler:
    """A goal sampler: its log weights, and the episodes whose goals it chooses from."""

    log_weights: LogWeightsFn = struct.field(pytree_node=False)
    # Whether goals come from any episode instead of the transition's own. A function of HParams if traced (`join`).
    cross_episode: bool | Callable[[HParams], Array] = struct.field(pytree_node=False, default=False)
    # The sampler for another goal distance. None unless it measures by the environment's (`of_distance`).
    measure_by: "Callable[[DistanceFn], Sampler] | None" = struct.field(pytree_node=False, default=None, kw_only=True)


def position(achieved: Array, desired: Array) -> Array:
    """Euclidean distances [T+1] between `achieved` [T+1, G] and `desired` [G]: the default metric."""
    return euclidean(achieved, desired[None])


def future_mask(num_goals: int, step: Array, length: Array | None = None) -> Array:
    """Mask [T+1] of the goals after `step`, up to index `length`."""
    index = jnp.arange(num_goals)
    return index > step if length is None else (index > step) & (index <= length)


def uniform(mask: Array) -> Array:
    """Log weights [T+1] of equally likely goals."""
    return jnp.where(mask, jnp.float32(0.0), -jnp.inf)


def episode(achieved: Array, desired: Array, step: Array, hparams: HParams) -> Array:
    """Any goal of the episode, uniformly."""
    return jnp.zeros(achieved.shape[0], jnp.float32)


def measure(metric: MetricFn, achieved: Array, desired: Array) -> Array:
    """Result [T+1] of a metric for `achieved` [T+1, G] and `desired` [G]. Raises ValueError unless it is numbers [T+1]."""
    return check.array("metric: distances [T+1]", metric(achieved, desired), achieved.shape[:1], jnp.number)


def future(achieved: Array, desired: Array, step: Array, hparams: HParams, length: Array | None = None) -> Array:
    """Any goal after the step, uniformly (Andrychowicz et al. 2017, the paper's baseline). See `weigh` for the arguments."""
    return uniform(future_mask(achieved.shape[0], step, length))


def final(achieved: Array, desired: Array, step: Array, hparams: HParams, length: Array | None = None) -> Array:
    """The last goal of the episode."""
    last = achieved.shape[0] - 1 if length is None else length
    return uniform(jnp.arange(achieved.shape[0]) == last)


def geometric(achieved: Array, desired: Array, step: Array, hparams: HParams, length: Array | None = None) -> Array:
    """Weighs the goal t steps later by gamma^t: then a contrastive critic estimates discounted occupancy (Eysenbach 2022)."""
    later = jnp.maximum(jnp.arange(achieved.shape[0]) - step, 0).astype(jnp.float32)
    return future(achieved, desired, step, hparams, length) + later * jnp.log(jnp.maximum(hparams.gamma, 1e-30))


random = Sampler(episode, cross_episode=True)


def __getattr__(name: str) -> Any:
    """The samplers that measure distances are in `by_distance`, which a run loads only if it uses one."""
    if name in ("closest", "epsilon_closest", "weighted"):
        from mjx_dher import by_distance

        return getattr(by_distance, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def make(
    name: str | Sampler | LogWeightsFn,
    kernel: str | KernelFn = "linear",
    metric: str | MetricFn = "position",
    normalization: str | NormalizationFn = "mean",
    goal_distance: DistanceFn | None = None,
) -> Sampler:
    """Makes the sampler called `name`.

    Args:
      name: a built-in name, "module:attribute", a `Sampler`, or a function like `Sampler.log_weights`. `random` chooses like
        `episode`, but from a random episode of the ring.
      kernel: for `weighted`: linear, inverse, softmax, "module:attribute", or a function (relative distance [T+1], temperature
        []) -> log weight [T+1].
      metric: for closest, epsilon_closest and weighted: position, "module:attribute", or a function (achieved [T+1, G],
        desired [G]) -> distance [T+1].
      normalization: for `weighted`: mean, sum, max, minmax, none, far, "module:attribute", or a function (distance [T+1],
        candidates [T+1], scale []) -> relative distance [T+1].
      goal_distance: distance for the metric position. Default: the environment's (`Context.goal_distance`).

    Raises:
      ValueError: an argument is unknown or invalid. The message suggests the nearest name.
    """
    sampler = components.load("sampler", name)
    row = components.COMPONENTS["sampler"].get(name) if isinstance(name, str) else None
    if (weighs := row is not None and "weight_kernel" in row.reads) or (kernel, normalization) != ("linear", "mean"):
        kernel = components.load("weight_kernel", kernel, "relative", "temperature")
        normalization = components.load("weight_normalization", normalization, "distance", "candidates", "scale")
    if metric != "position":
        metric = components.load("metric", metric, "achieved", "desired")
    if row is None or "metric" not in row.reads:
        return _to_sampler(sampler)
    if weighs:
        sampler = functools.partial(sampler, kernel=kernel, normalization=normalization)

    def by(metric: MetricFn) -> Sampler:
        return Sampler(functools.partial(sampler, metric=metric))

    made = by(make_metric(metric, goal_distance or euclidean))
    if metric != "position" or goal_distance is not None:
        return made
    return Sampler(made.log_weights, measure_by=lambda distance: by(make_metric("position", distance)))


def of_distance(sampler: Sampler, goal_distance: DistanceFn) -> Sampler:
    """The sampler with an environment's goal distance, if it was made without one and measures distances."""
    return sampler if sampler.measure_by is None or goal_distance is euclidean else sampler.measure_by(goal_distance)


def make_metric(metric: Any, goal_distance: DistanceFn = euclidean) -> MetricFn:
    """Loads a metric. `make` documents its values."""
    if metric == "position" and goal_distance is not euclidean:
        return lambda achieved, desired: goal_distance(achieved, jnp.broadcast_to(desired, achieved.shape))
    return components.load("metric", metric, "achieved", "desired")


def _to_sampler(sampler: Any) -> Sampler:
    if not isinstance(sampler, Sampler):
        sampler = Sampler(sampler)
    lookup.check_function("sampler", sampler.log_weights, ("achieved", "desired", "step", "hparams"))
    if not (isinstance(sampler.cross_episode, bool) or callable(sampler.cross_episode)):
        raise ValueError(f"cross_episode of a sampler must be True, False or a function; got {sampler.cross_episode!r}")
    return sampler


def weigh(
    sampler: Sampler, achieved: Array, desired: Array, step: Array, hparams: HParams, length: Array | None = None
) -> Array:
    """Log weights [T+1] of the goals of one episode.

    Args:
      achieved: achieved goals [T+1, G] to choose from.
      desired: desired goal [G] of the episode.
      step: index [] of the transition.
      length: index [] of the episode's last goal. Default: T. Goals after it get no weight.

    Raises:
      ValueError: the sampler does not return floats [T+1].
    """
    takes_length = length is not None and "length" in inspect.signature(sampler.log_weights).parameters
    value = sampler.log_weights(achieved, desired, step, hparams, **({"length": length} if takes_length else {}))
    value = check.array("sampler: log weights [T+1]", value, achieved.shape[:1])
    return value if length is None else jnp.where(jnp.arange(achieved.shape[0]) <= length, value, -jnp.inf)


def join(choices: Sequence[Sampler | LogWeightsFn]) -> Sampler:
    """Joins samplers in one compiled program, in which the traced number `hparams.choice` selects a lane's sampler (`one_of`).

    `choice` is not a field of `HParams`; `runs.program` adds it. Raises ValueError for something other than a sampler.
    """
    samplers = [make(choice) for choice in choices]
    if len(samplers) == 1:
        return samplers[0]
    weighs = one_of([functools.partial(weigh, sampler) for sampler in samplers], "choice")
    crosses = one_of([lambda hparams, own=sampler.cross_episode: own for sampler in samplers], "choice")

    def log_weights(achieved: Array, desired: Array, step: Array, hparams: HParams, length: Array | None = None) -> Array:
        return weighs(achieved, desired, step, hparams, length)

    return Sampler(
        log_weights,
        cross_episode=crosses if any(sampler.cross_episode for sampler in samplers) else False,
        measure_by=lambda distance: join([of_distance(sampler, distance) for sampler in samplers]),
    )


def probabilities(log_weights: Array) -> Array:
    """Probabilities [..., T+1] of log weights [..., T+1]."""
    return jax.nn.softmax(log_weights, axis=-1)


def draw(key: PRNGKey, log_weights: Array) -> Array:
    """Draws one index [B] per row of log weights [B, T+1], by inverting the cumulative distribution.

    A goal without weight is never drawn, despite rounding. A row without weights, or with NaN or +inf, gives T+1 (no index).
    """
    num_goals = log_weights.shape[-1]
    weights = jnp.exp(log_weights - jnp.max(log_weights, axis=-1, keepdims=True))
    possible = weights > 0
    # At these lengths, a product with a triangle of ones is a faster prefix sum than a scan. Its last bit may not be monotone,
    # so only possible indices count in the total and in the result.
    cumulative = jnp.matmul(weights, jnp.triu(jnp.ones([num_goals] * 2, jnp.float32)), precision=jax.lax.Precision.HIGHEST)
    total = jnp.max(jnp.where(possible, cumulative, 0.0), axis=-1)
    threshold = jax.random.uniform(key, log_weights.shape[:-1], jnp.float32) * total
    reached = possible & (cumulative > threshold[..., None])
    return jnp.min(jnp.where(reached, jnp.arange(num_goals, dtype=jnp.int32), num_goals), axis=-1)
