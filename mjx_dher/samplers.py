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
from mjx_dher.context import Context, euclidean, of_each_episode, one_of
from mjx_dher.types import Array, DistanceFn, Episode, PRNGKey

# log_weights(achieved [T+1, G], desired [G], step [], hparams) -> [T+1]; with a score, (..., hparams, score [T+1])
LogWeightsFn = Callable[..., Array]
# metric(achieved [T+1, G], desired [G]) -> [T+1], finite and not negative
MetricFn = Callable[[Array, Array], Array]
# kernel(relative distance [T+1], temperature []) -> log weight [T+1]
KernelFn = Callable[[Array, Array | float], Array]
# normalization(distance [T+1], candidates [T+1] bool, scale [] in metres) -> relative distance [T+1]
NormalizationFn = Callable[[Array, Array, Array | float], Array]
# score(episode, context) -> [T+1]
ScoreFn = Callable[[Episode, Context], Array]


@struct.dataclass
class Sampler:
    """A goal sampler: its log weights, and the episodes whose goals it chooses from."""

    log_weights: LogWeightsFn = struct.field(pytree_node=False)
    # Whether goals come from any episode instead of the transition's own. A function of HParams if traced (`join`).
    cross_episode: bool | Callable[[HParams], Array] = struct.field(pytree_node=False, default=False)
    # Scores of each stored episode's goals, computed once per cycle and passed to `log_weights` as its last argument.
    score: ScoreFn | None = struct.field(pytree_node=False, default=None)
    # The sampler for another goal distance. None unless it measures by the environment's (`of_distance`).
    measure_by: "Callable[[DistanceFn], Sampler] | None" = struct.field(pytree_node=False, default=None, kw_only=True)


@struct.dataclass
class LearnedMetric:
    """A distance computed by the learner, between an episode's achieved goals and its desired goal. Finite and not negative."""

    score: ScoreFn = struct.field(pytree_node=False)


def position(achieved: Array, desired: Array) -> Array:
    """Euclidean distances [T+1] between `achieved` [T+1, G] and `desired` [G]: the default metric."""
    return euclidean(achieved, desired[None])


def future_mask(num_goals: int, step: Array, length: Array | None = None) -> Array:
    """Mask [T+1] of the goals after `step`, up to index `length`."""
    index = jnp.arange(num_goals)
    return index > step if length is None else (index > step) & (index <= length)


def uniform(mask: Array) -> Array:
    """Log weights [T+1] of equally likely goals."""
    return jnp.where(mask, 0.0, -jnp.inf)


def episode(achieved: Array, desired: Array, step: Array, hparams: HParams) -> Array:
    """Any goal of the episode, uniformly."""
    return jnp.zeros(achieved.shape[0])


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
    metric: str | MetricFn | LearnedMetric = "position",
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
    if not isinstance(name, str):
        return _to_sampler(name)
    sampler, row = components.load("sampler", name), components.COMPONENTS["sampler"].get(name)
    if (weighs := row is not None and "weight_kernel" in row.reads) or (kernel, normalization) != ("linear", "mean"):
        kernel = components.load("weight_kernel", kernel, "relative", "temperature")
        normalization = components.load("weight_normalization", normalization, "distance", "candidates", "scale")
    if row is None or "metric" not in row.reads:
        return _to_sampler(sampler)
    if weighs:
        sampler = functools.partial(sampler, kernel=kernel, normalization=normalization)
    by = functools.partial(_by_metric, sampler)
    made = by(make_metric(metric, goal_distance or euclidean))
    if metric != "position" or goal_distance is not None:
        return made
    return Sampler(made.log_weights, measure_by=lambda distance: by(make_metric("position", distance)))


def of_distance(sampler: Sampler, goal_distance: DistanceFn) -> Sampler:
    """The sampler with an environment's goal distance, if it was made without one and measures distances."""
    return sampler if sampler.measure_by is None or goal_distance is euclidean else sampler.measure_by(goal_distance)


def make_metric(metric: Any, goal_distance: DistanceFn = euclidean) -> MetricFn | LearnedMetric:
    """Loads a metric. `make` documents its values."""
    if metric == "position" and goal_distance is not euclidean:
        return lambda achieved, desired: goal_distance(achieved, jnp.broadcast_to(desired, achieved.shape))
    value = components.load("metric", metric)
    if isinstance(value, LearnedMetric):
        lookup.check_function("metric: score", value.score, ("episode", "context"))
        return value
    return lookup.check_function("metric", value, ("achieved", "desired"))


def _by_metric(log_weights: LogWeightsFn, metric: MetricFn | LearnedMetric) -> Sampler:
    if not isinstance(metric, LearnedMetric):
        return Sampler(functools.partial(log_weights, metric=metric))

    def by_score(
        achieved: Array, desired: Array, step: Array, hparams: HParams, score: Array, length: Array | None = None
    ) -> Array:
        return log_weights(achieved, desired, step, hparams, metric=lambda achieved, desired: score, length=length)

    return Sampler(by_score, score=metric.score)


def _to_sampler(sampler: Any) -> Sampler:
    if not isinstance(sampler, Sampler):
        sampler = Sampler(sampler)
    parameters = ("achieved", "desired", "step", "hparams")
    lookup.check_function("sampler", sampler.log_weights, parameters if sampler.score is None else (*parameters, "score"))
    if sampler.score is not None:
        lookup.check_function("sampler: score", sampler.score, ("episode", "context"))
        if sampler.cross_episode is True:
            raise ValueError("cross_episode of a sampler with a score must be False; got True")
    if not (isinstance(sampler.cross_episode, bool) or callable(sampler.cross_episode)):
        raise ValueError(f"cross_episode of a sampler must be True, False or a function; got {sampler.cross_episode!r}")
    return sampler


def weigh(
    sampler: Sampler,
    achieved: Array,
    desired: Array,
    step: Array,
    hparams: HParams,
    score: Array | None = None,
    length: Array | None = None,
) -> Array:
    """Log weights [T+1] of the goals of one episode.

    Args:
      achieved: achieved goals [T+1, G] to choose from.
      desired: desired goal [G] of the episode.
      step: index [] of the transition.
      score: scores [T+1] of the goals, for a sampler with a score.
      length: index [] of the episode's last goal. Default: T. Goals after it get no weight.

    Raises:
      ValueError: the sampler does not return floats [T+1], or `score` is missing.
    """
    if sampler.score is not None and score is None:
        raise ValueError("score is missing: this sampler needs Sample.score (samplers.score_episodes)")
    more = () if sampler.score is None else (score,)
    takes_length = length is not None and "length" in inspect.signature(sampler.log_weights).parameters
    value = sampler.log_weights(achieved, desired, step, hparams, *more, **({"length": length} if takes_length else {}))
    value = check.array("sampler: log weights [T+1]", value, achieved.shape[:1])
    return value if length is None else jnp.where(jnp.arange(achieved.shape[0]) <= length, value, -jnp.inf)


def score_episodes(sampler: Sampler, episodes: Episode, context: Context) -> Array | None:
    """Scores [E, T+1] of episodes (leaves lead with [E]), or None if the sampler has no score."""
    if sampler.score is None:
        return None
    return of_each_episode(lambda episode: _score(sampler, episode, context), episodes)


def _score(sampler: Sampler, episode: Episode, context: Context) -> Array:
    shape = episode.achieved_goal.shape[:1]
    return jnp.zeros(shape) if sampler.score is None else check.array("score [T+1]", sampler.score(episode, context), shape)


def join(choices: Sequence[Sampler | LogWeightsFn]) -> Sampler:
    """Joins samplers in one compiled program, in which the traced number `hparams.choice` selects a lane's sampler (`one_of`).

    `choice` is not a field of `HParams`; `runs.program` adds it. Raises ValueError for something other than a sampler.
    """
    samplers = [make(choice) for choice in choices]
    if len(samplers) == 1:
        return samplers[0]
    score = one_of([functools.partial(_score, sampler) for sampler in samplers], "choice")
    weighs = one_of([functools.partial(weigh, sampler) for sampler in samplers], "choice")
    crosses = one_of([lambda hparams, own=sampler.cross_episode: own for sampler in samplers], "choice")

    def log_weights(
        achieved: Array, desired: Array, step: Array, hparams: HParams, score: Array | None = None, length: Array | None = None
    ) -> Array:
        return weighs(achieved, desired, step, hparams, score, length)

    return Sampler(
        log_weights,
        cross_episode=crosses if any(sampler.cross_episode for sampler in samplers) else False,
        score=score if any(sampler.score for sampler in samplers) else None,
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
    cumulative = jnp.matmul(weights, jnp.triu(jnp.ones((num_goals, num_goals))), precision=jax.lax.Precision.HIGHEST)
    total = jnp.max(jnp.where(possible, cumulative, 0.0), axis=-1)
    threshold = jax.random.uniform(key, log_weights.shape[:-1]) * total
    reached = possible & (cumulative > threshold[..., None])
    return jnp.min(jnp.where(reached, jnp.arange(num_goals, dtype=jnp.int32), num_goals), axis=-1)
