"""Goal samplers: which achieved goal takes the place of the desired one.

Every sampler is a probability over the T+1 achieved goals of one episode, given as unnormalized log weights: -inf marks a goal
that it may not choose. `draw` makes a choice from them. So a sampler is a pure function that a test can compare with a table.

    log_weights(achieved [T+1, G], desired [G], step [], hparams) -> [T+1]

The transition under relabelling leads from `step` to `step + 1`; its *future* is the goals at step+1 ... T, never `step`
itself. In tasks whose episodes can end early, goals after the end have no weight, and a sampler may take the keyword `length`
[], the index of the last goal. A transition without any weight, or with a weight of NaN or +inf, keeps its own goal, and
training counts it (`no_goal_share`).
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher import check, components, distance_normalization, lookup
from mjx_dher.config import HParams
from mjx_dher.context import Context, euclidean, of_each_episode, one_of
from mjx_dher.distance_normalization import NormalizationFn
from mjx_dher.types import Array, DistanceFn, Episode, PRNGKey

# log_weights(achieved [T+1, G], desired [G], step [], hparams) -> [T+1]; with a score, (..., hparams, score [T+1])
LogWeightsFn = Callable[..., Array]
# metric(achieved [T+1, G], desired [G]) -> [T+1], finite and not negative
MetricFn = Callable[[Array, Array], Array]
# kernel(relative distance [T+1], temperature []) -> log weight [T+1]
KernelFn = Callable[[Array, Array | float], Array]
# score(episode, context) -> [T+1]
ScoreFn = Callable[[Episode, Context], Array]


@struct.dataclass
class Sampler:
    """A goal sampler: its log weights, and whose achieved goals they choose from."""

    log_weights: LogWeightsFn = struct.field(pytree_node=False)
    # Goals of any episode instead of its own. A function of HParams if the answer is traced (`join`).
    cross_episode: bool | Callable[[HParams], Array] = struct.field(pytree_node=False, default=False)
    # Numbers for the goals of each stored episode, computed once a cycle and passed to `log_weights` as its last argument.
    score: ScoreFn | None = struct.field(pytree_node=False, default=None)


@struct.dataclass
class LearnedMetric:
    """A distance that the learner knows: those of an episode's achieved goals to its desired one, finite and not negative."""

    score: ScoreFn = struct.field(pytree_node=False)


def position(achieved: Array, desired: Array) -> Array:
    """Euclidean distances [T+1] of `achieved` [T+1, G] to `desired` [G]: the default metric."""
    return euclidean(achieved, desired[None])


def future_mask(num_goals: int, step: Array, length: Array | None = None) -> Array:
    """Mask [T+1] of the goals after `step`, up to the index `length` of the last one."""
    index = jnp.arange(num_goals)
    return index > step if length is None else (index > step) & (index <= length)


def _uniform(mask: Array) -> Array:
    return jnp.where(mask, 0.0, -jnp.inf)


def episode(achieved: Array, desired: Array, step: Array, hparams: HParams) -> Array:
    """Allows any goal of the episode, each with the same probability."""
    del desired, step, hparams
    return jnp.zeros(achieved.shape[0])


def distances(metric: MetricFn, achieved: Array, desired: Array) -> Array:
    """Distances [T+1] of `achieved` [T+1, G] to `desired` [G] by `metric`; a negative one becomes NaN.

    A sampler whose weights are NaN offers no goal, which training counts.
    """
    distance = measure(metric, achieved, desired)
    return distance if metric is position else jnp.where(distance >= 0, distance, jnp.nan)


def measure(metric: MetricFn, achieved: Array, desired: Array) -> Array:
    """What a metric gives [T+1] for `achieved` [T+1, G] and `desired` [G]. Raises ValueError unless it is numbers [T+1]."""
    return check.array("metric: distances [T+1]", metric(achieved, desired), achieved.shape[:1], jnp.number)


def future(achieved: Array, desired: Array, step: Array, hparams: HParams, length: Array | None = None) -> Array:
    """Allows any goal after the step, each with the same probability (Andrychowicz et al. 2017, the paper's baseline)."""
    del desired, hparams
    return _uniform(future_mask(achieved.shape[0], step, length))


def final(achieved: Array, desired: Array, step: Array, hparams: HParams, length: Array | None = None) -> Array:
    """Allows only the episode's last goal."""
    del desired, step, hparams
    last = achieved.shape[0] - 1 if length is None else length
    return _uniform(jnp.arange(achieved.shape[0]) == last)


def closest(
    achieved: Array, desired: Array, step: Array, hparams: HParams, metric: MetricFn = position, length: Array | None = None
) -> Array:
    """Allows the future goal nearest to the desired one (the paper's method 1); equally near ones share."""
    del hparams
    mask = future_mask(achieved.shape[0], step, length)
    distance = jnp.where(mask, distances(metric, achieved, desired), jnp.inf)
    return _uniform(distance == jnp.min(distance))


def epsilon_closest(
    achieved: Array, desired: Array, step: Array, hparams: HParams, metric: MetricFn = position, length: Array | None = None
) -> Array:
    """Mixes any future goal, with probability `epsilon`, and the closest one (the paper's method 2)."""
    any_future = jax.nn.softmax(future(achieved, desired, step, hparams, length))
    nearest = jax.nn.softmax(closest(achieved, desired, step, hparams, metric, length))
    return jnp.log(hparams.epsilon * any_future + (1.0 - hparams.epsilon) * nearest)


def weighted(
    achieved: Array,
    desired: Array,
    step: Array,
    hparams: HParams,
    kernel: KernelFn,
    metric: MetricFn = position,
    normalization: NormalizationFn = distance_normalization.by_mean,
    length: Array | None = None,
) -> Array:
    """Prefers future goals that are nearer to the desired goal (the paper's method 3).

    The weight of a candidate depends on its relative distance r, which `normalization` computes from d = metric(achieved,
    desired) over the candidates of the same transition, those after its step. By default it is

        r_i = d_i / mean_j d_j,

    so weights do not depend on the scale of the task, and equal distances (r_i = 1 for all) give `future` exactly. With
    temperature tau the kernels are, in r,

        linear    w = max(1 - (r - 1) / tau, 0)    at tau = 1: 2 - r, from 2 at the goal to 0 at twice the mean distance
        inverse   w = r^(-1/tau)
        softmax   w = exp(-(r - 1) / tau)

    They agree to first order around r = 1 and differ far from it: `inverse` almost always takes a candidate that lies on the
    goal, while `linear` at tau = 1 never makes one more than twice as likely as one at the mean distance and drops those
    beyond twice the mean. The paper gives no formula. This reading has no number to tune, and no single candidate can crowd
    out the others. `distance_normalization` has other readings; docs/samplers.md compares them.

    If `linear` leaves no candidate a weight, the nearest gets it, as in the limit of a small temperature.
    """
    mask = future_mask(achieved.shape[0], step, length)
    distance = jnp.where(mask, distances(metric, achieved, desired), 0.0)
    relative = normalization(distance, mask, hparams.weight_scale)
    relative = check.array("normalization: relative distances [T+1]", relative, mask.shape)
    log_weights = check.array("kernel: log weights [T+1]", kernel(relative, hparams.temperature), mask.shape)
    log_weights = jnp.where(mask, log_weights, -jnp.inf)
    always = (distance_normalization.by_mean, distance_normalization.mirrored)  # some candidate has r <= 1, and a weight
    if kernel is not distance_normalization.linear or normalization in always:
        return log_weights
    beyond = jnp.all(log_weights == -jnp.inf)
    relative = jnp.where(mask, relative, jnp.inf)
    return jnp.where(beyond, _uniform(relative == jnp.min(relative)), log_weights)


random = Sampler(episode, cross_episode=True)


def make(
    name: str | Sampler | LogWeightsFn,
    kernel: str | KernelFn = "linear",
    metric: str | MetricFn | LearnedMetric = "position",
    normalization: str | NormalizationFn = "mean",
    goal_distance: DistanceFn = euclidean,
) -> Sampler:
    """Makes the sampler called `name`.

    Args:
      name: a built-in name, "module:attribute", a `Sampler`, or a function like `Sampler.log_weights`. `random` chooses as
        `episode` does, but from a random episode of the ring.
      kernel: for `weighted`: linear, inverse, softmax, "module:attribute", or a function (relative distance [T+1],
        temperature []) -> log weight [T+1].
      metric: for closest, epsilon_closest and weighted: position, "module:attribute", or a function (achieved [T+1, G],
        desired [G]) -> distance [T+1].
      normalization: for `weighted`: mean, sum, max, minmax, none, far, "module:attribute", or a function (distance [T+1],
        candidates [T+1], scale []) -> relative distance [T+1].
      goal_distance: the environment's distance (`Context.goal_distance`), which the metric position computes.

    Raises:
      ValueError: no such sampler, module, attribute, kernel, metric or normalization (the message names the nearest), or
        something else in its place.
    """
    if not isinstance(name, str):
        return _to_sampler(name)
    sampler = components.load("sampler", name)
    kernel = components.load("weight_kernel", kernel, "relative", "temperature")
    normalization = components.load("weight_normalization", normalization, "distance", "candidates", "scale")
    distance = make_metric(metric, goal_distance)
    if sampler is weighted:
        sampler = functools.partial(weighted, kernel=kernel, normalization=normalization)
    elif sampler not in (closest, epsilon_closest):
        return _to_sampler(sampler)
    return _by_metric(sampler, distance)


def make_metric(metric: Any, goal_distance: DistanceFn = euclidean) -> MetricFn | LearnedMetric:
    """Gives the metric that `metric` names, or is; `make` says what it takes."""
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
    """Log weights [T+1] of the goals [T+1, G] of one episode.

    Args:
      sampler: the sampler.
      achieved: [T+1, G] goals to choose from.
      desired: [G] the goal that the episode was played for.
      step: [] of the transition.
      hparams: numbers that the sampler reads.
      score: [T+1] scores of the goals, for a sampler with a score.
      length: [] index of the episode's last goal; None stands for T. Goals after it get no weight.

    Raises:
      ValueError: they are no floats [T+1], or a score is missing.
    """
    if sampler.score is not None and score is None:
        raise ValueError("score is missing: this sampler needs Sample.score (samplers.score_episodes)")
    more = () if sampler.score is None else (score,)
    takes_length = length is not None and "length" in inspect.signature(sampler.log_weights).parameters
    value = sampler.log_weights(achieved, desired, step, hparams, *more, **({"length": length} if takes_length else {}))
    value = check.array("sampler: log weights [T+1]", value, achieved.shape[:1])
    return value if length is None else jnp.where(jnp.arange(achieved.shape[0]) <= length, value, -jnp.inf)


def score_episodes(sampler: Sampler, episodes: Episode, context: Context) -> Array | None:
    """Scores [E, T+1] of episodes (leaves lead with [E]); None for a sampler without a score."""
    if sampler.score is None:
        return None
    return of_each_episode(lambda episode: _score(sampler, episode, context), episodes)


def _score(sampler: Sampler, episode: Episode, context: Context) -> Array:
    shape = episode.achieved_goal.shape[:1]
    return jnp.zeros(shape) if sampler.score is None else check.array("score [T+1]", sampler.score(episode, context), shape)


def join(choices: Sequence[Sampler | LogWeightsFn]) -> Sampler:
    """Joins samplers in one compiled program: the traced number `hparams.choice` says which of them a lane uses (`one_of`).

    `choice` is no field of `HParams`; `runs.program` adds it.

    Raises:
      ValueError: no sampler, or something else in its place.
    """
    samplers = [make(choice) for choice in choices]
    if not samplers:
        raise ValueError("join takes one or more samplers; got none")
    if len(samplers) == 1:
        return samplers[0]
    score = one_of([functools.partial(_score, sampler) for sampler in samplers], "choice")
    weighs = one_of([functools.partial(weigh, sampler) for sampler in samplers], "choice")
    crosses = one_of([functools.partial(_crosses, sampler) for sampler in samplers], "choice")

    def log_weights(
        achieved: Array, desired: Array, step: Array, hparams: HParams, score: Array | None = None, length: Array | None = None
    ) -> Array:
        return weighs(achieved, desired, step, hparams, score, length)

    return Sampler(
        log_weights,
        cross_episode=crosses if any(sampler.cross_episode for sampler in samplers) else False,
        score=score if any(sampler.score for sampler in samplers) else None,
    )


def _crosses(sampler: Sampler, hparams: HParams) -> Any:
    return sampler.cross_episode


def probabilities(log_weights: Array) -> Array:
    """Probabilities [..., T+1] of log weights [..., T+1]."""
    return jax.nn.softmax(log_weights, axis=-1)


def draw(key: PRNGKey, log_weights: Array) -> Array:
    """Draws an index [B] from each row of log weights [B, T+1], by inverting the cumulative distribution.

    This takes one random number a row. A goal without weight is never drawn, whatever the rounding of the cumulative sum. A row
    without any weight, or with NaN or +inf among its log weights, gives T+1, which is no index.
    """
    num_goals = log_weights.shape[-1]
    weights = jnp.exp(log_weights - jnp.max(log_weights, axis=-1, keepdims=True))
    possible = weights > 0
    # A product with a triangle of ones is a faster prefix sum than a scan, at such lengths. It may fail to be monotone in the
    # last bit; hence the mask, and the total taken where an index can be drawn.
    cumulative = jnp.matmul(weights, jnp.triu(jnp.ones((num_goals, num_goals))), precision=jax.lax.Precision.HIGHEST)
    total = jnp.max(jnp.where(possible, cumulative, 0.0), axis=-1)
    threshold = jax.random.uniform(key, log_weights.shape[:-1]) * total
    reached = possible & (cumulative > threshold[..., None])
    return jnp.min(jnp.where(reached, jnp.arange(num_goals, dtype=jnp.int32), num_goals), axis=-1)
