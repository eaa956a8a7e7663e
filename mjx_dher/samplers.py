"""Goal samplers: which achieved goal takes the place of the desired one.

Every sampler is a probability over the T+1 achieved goals of one episode, given as unnormalized log weights: -inf marks what
it may not choose. `draw` makes a choice from them. So a sampler is a pure function that a test can compare with a table.

    log_weights(achieved [T+1, G], desired [G], step [], hparams) -> [T+1]

The transition under relabelling leads from `step` to `step + 1`; its *future* is the goals at step+1 ... T, never `step`
itself. A transition for which no weight is left, or one is NaN or +inf, keeps its own goal, and training counts it
(`no_goal_share`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher import components, distance_normalization, lookup
from mjx_dher.config import HParams
from mjx_dher.context import pick
from mjx_dher.distance_normalization import NormalizationFn
from mjx_dher.scores import LearnedMetric, ScoreFn, make_metric, score_of
from mjx_dher.types import Array, Episode, PRNGKey

# log_weights(achieved [T+1, G], desired [G], step [], hparams) -> [T+1]; of a sampler with a score, (..., hparams, score [T+1])
LogWeightsFn = Callable[..., Array]
# metric(achieved [T+1, G], desired [G]) -> [T+1], finite and not negative
MetricFn = Callable[[Array, Array], Array]
# kernel(relative distance [T+1], temperature []) -> log weight [T+1]
KernelFn = Callable[[Array, Array | float], Array]


@struct.dataclass
class Sampler:
    """A goal sampler: its log weights, and whose achieved goals they choose from."""

    log_weights: LogWeightsFn = struct.field(pytree_node=False)
    # Goals of any episode, not of its own. A function where the answer is traced: see `one_of`.
    cross_episode: bool | Callable[[HParams], Array] = struct.field(pytree_node=False, default=False)
    # Numbers that the learner gives the goals of each stored episode, once a cycle; handed to `log_weights` as its last.
    score: ScoreFn | None = struct.field(pytree_node=False, default=None)


def position(achieved: Array, desired: Array) -> Array:
    """Returns the Euclidean distances [T+1] of `achieved` [T+1, G] to `desired` [G]: the metric `position`."""
    # Coordinate by coordinate: XLA on a CPU takes three times as long for a sum over an axis of 3.
    squares = jnp.square(achieved - desired[None])
    return jnp.sqrt(sum(squares[..., i] for i in range(squares.shape[-1])))


def future_mask(num_goals: int, step: Array) -> Array:
    """Returns [T+1], true at the goals that come after `step`."""
    return jnp.arange(num_goals) > step


def _uniform(mask: Array) -> Array:
    return jnp.where(mask, 0.0, -jnp.inf)


def episode(achieved: Array, desired: Array, step: Array, hparams: HParams) -> Array:
    """Allows any goal of the episode, each with the same probability."""
    del desired, step, hparams
    return jnp.zeros(achieved.shape[0])


def distances(metric: MetricFn, achieved: Array, desired: Array) -> Array:
    """Returns the distances [T+1] of `achieved` [T+1, G] to `desired` [G] by `metric`, NaN where one is no distance.

    A sampler that goes by NaN offers no goal, which training counts.

    Raises:
      ValueError: the metric does not give [T+1].
    """
    distance = measure(metric, achieved, desired)
    return distance if metric is position else jnp.where(distance >= 0, distance, jnp.nan)


def measure(metric: MetricFn, achieved: Array, desired: Array) -> Array:
    """Returns what a metric gives [T+1] for `achieved` [T+1, G] and `desired` [G].

    Raises:
      ValueError: it is no numbers [T+1].
    """
    return _checked(
        "a metric gives distances", metric, metric(achieved, desired), achieved.shape[0], (jnp.floating, jnp.integer)
    )


def _checked(told: str, function: Any, value: Any, num_goals: int, kinds: Sequence[Any] = (jnp.floating,)) -> Array:
    """Returns what `function` gave as an array [T+1]; raises ValueError, which begins with `told`, where it is none."""
    told, name = f"{told} [T+1] = [{num_goals}]", getattr(function, "__name__", function)
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(f"{told}; {name} gives a {type(value).__name__}") from None
    if array.shape != (num_goals,):
        raise ValueError(f"{told}; {name} gives {list(array.shape)}")
    if not any(jnp.issubdtype(array.dtype, kind) for kind in kinds):
        raise ValueError(f"{told}, as floating-point numbers; {name} gives {array.dtype}")
    return array


def future(achieved: Array, desired: Array, step: Array, hparams: HParams) -> Array:
    """Allows any goal after the step, each with the same probability (Andrychowicz et al. 2017, the paper's baseline)."""
    del desired, hparams
    return _uniform(future_mask(achieved.shape[0], step))


def final(achieved: Array, desired: Array, step: Array, hparams: HParams) -> Array:
    """Allows the episode's last goal alone."""
    del desired, step, hparams
    return _uniform(jnp.arange(achieved.shape[0]) == achieved.shape[0] - 1)


def closest(achieved: Array, desired: Array, step: Array, hparams: HParams, metric: MetricFn = position) -> Array:
    """Allows the future goal nearest to the desired one (the paper's method 1); equally near ones share."""
    del hparams
    distance = jnp.where(future_mask(achieved.shape[0], step), distances(metric, achieved, desired), jnp.inf)
    return _uniform(distance == jnp.min(distance))


def epsilon_closest(achieved: Array, desired: Array, step: Array, hparams: HParams, metric: MetricFn = position) -> Array:
    """Mixes any future goal, with probability `epsilon`, and the closest one (the paper's method 2)."""
    any_future = jax.nn.softmax(future(achieved, desired, step, hparams))
    nearest = jax.nn.softmax(closest(achieved, desired, step, hparams, metric))
    return jnp.log(hparams.epsilon * any_future + (1.0 - hparams.epsilon) * nearest)


def weighted(
    achieved: Array,
    desired: Array,
    step: Array,
    hparams: HParams,
    kernel: KernelFn,
    metric: MetricFn = position,
    normalization: NormalizationFn = distance_normalization.by_mean,
) -> Array:
    """Prefers future goals that are nearer to the desired goal (the paper's method 3).

    The weight of a candidate depends on its relative distance r, which `normalization` makes of d = metric(achieved, desired)
    over the candidates of the same transition, those after its step. By default it is

        r_i = d_i / mean_j d_j,

    so weights do not depend on the scale of the task, and equal distances (r_i = 1 for all) give `future` exactly. With
    temperature tau the kernels are, in r,

        linear    w = max(1 - (r - 1) / tau, 0)    at tau = 1: 2 - r, from 2 at the goal to 0 at twice the mean distance
        inverse   w = r^(-1/tau)
        softmax   w = exp(-(r - 1) / tau)

    They agree to first order around r = 1 and differ in what they do far from it: `inverse` all but always takes a
    candidate that lies on the goal, `linear` at tau = 1 never makes one more than twice as likely as one at the mean
    distance and drops those beyond twice the mean. The paper gives no formula: this is one reading of its words, with no
    number to tune and no single candidate able to crowd out the others. `readings` has others, and docs/samplers.md says
    how they differ.

    Where `linear` leaves no candidate a weight, the nearest has it, as it has in the limit of a small temperature.
    """
    mask = future_mask(achieved.shape[0], step)
    distance = jnp.where(mask, distances(metric, achieved, desired), 0.0)
    relative = normalization(distance, mask, hparams.weight_scale)
    relative = _checked("a normalization gives relative distances", normalization, relative, mask.size)
    log_weights = _checked("a kernel gives log weights", kernel, kernel(relative, hparams.temperature), mask.size)
    log_weights = jnp.where(mask, log_weights, -jnp.inf)
    if kernel is not linear or normalization in (distance_normalization.by_mean, distance_normalization.mirrored):
        return log_weights  # by the mean, some candidate has r <= 1, and a weight
    beyond = jnp.all(log_weights == -jnp.inf)
    relative = jnp.where(mask, relative, jnp.inf)
    return jnp.where(beyond, _uniform(relative == jnp.min(relative)), log_weights)


def linear(relative: Array, temperature: Array | float) -> Array:
    """Returns log max(1 - (r - 1) / temperature, 0), of relative distances r [T+1]."""
    return jnp.log(jnp.maximum(1.0 - (relative - 1.0) / temperature, 0.0))


def inverse(relative: Array, temperature: Array | float) -> Array:
    """Returns log r^(-1/temperature), of relative distances r [T+1]; below 0.001, r counts as 0.001."""
    return -jnp.log(jnp.maximum(relative, 1e-3)) / temperature


def softmax(relative: Array, temperature: Array | float) -> Array:
    """Returns -(r - 1) / temperature, of relative distances r [T+1]."""
    return -(relative - 1.0) / temperature


random = Sampler(episode, cross_episode=True)


def make(
    name: str | Sampler | LogWeightsFn,
    kernel: str | KernelFn = "linear",
    metric: str | MetricFn = "position",
    normalization: str | NormalizationFn = "mean",
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

    Raises:
      ValueError: no such sampler, module, attribute, kernel, metric or normalization (the message names the nearest), or
        something that is none.
    """
    if not isinstance(name, str):
        return _to_sampler(name)
    sampler = components.load("sampler", name)
    kernel = components.load("weight_kernel", kernel, "relative", "temperature")
    normalization = components.load("weight_normalization", normalization, "distance", "candidates", "scale")
    distance = make_metric(metric)
    if sampler is weighted:
        sampler = functools.partial(weighted, kernel=kernel, normalization=normalization)
    elif sampler not in (closest, epsilon_closest):
        return _to_sampler(sampler)
    return _by_metric(sampler, distance)


def _by_metric(log_weights: LogWeightsFn, metric: MetricFn | LearnedMetric) -> Sampler:
    """Returns the sampler that goes by `metric`."""
    if not isinstance(metric, LearnedMetric):
        return Sampler(functools.partial(log_weights, metric=metric))

    def of_score(achieved: Array, desired: Array, step: Array, hparams: HParams, score: Array) -> Array:
        return log_weights(achieved, desired, step, hparams, metric=lambda achieved, desired: score)

    return Sampler(of_score, score=metric.score)


def _to_sampler(sampler: Any) -> Sampler:
    if not isinstance(sampler, Sampler):
        sampler = Sampler(sampler)
    parameters = ("achieved", "desired", "step", "hparams")
    lookup.check_function("sampler", sampler.log_weights, parameters if sampler.score is None else (*parameters, "score"))
    if sampler.score is not None:
        lookup.check_function("sampler: score", sampler.score, ("episode", "view"))
        if sampler.cross_episode is True:
            raise ValueError("a sampler with a score takes goals of its own episode; this one has cross_episode, too")
    if not (isinstance(sampler.cross_episode, bool) or callable(sampler.cross_episode)):
        raise ValueError(f"cross_episode of a sampler must be True, False or a function; it is {sampler.cross_episode!r}")
    return sampler


def weigh(
    sampler: Sampler, achieved: Array, desired: Array, step: Array, hparams: HParams, score: Array | None = None
) -> Array:
    """Returns a sampler's log weights [T+1] of the goals [T+1, G] of one episode, of which it may want a score [T+1].

    Raises:
      ValueError: they are no floating-point numbers [T+1], or there is no score for a sampler that wants one.
    """
    if sampler.score is not None and score is None:
        raise ValueError("this sampler goes by what the learner says of an episode; hand in `scores` (scores.of_episodes)")
    more = () if sampler.score is None else (score,)
    value = sampler.log_weights(achieved, desired, step, hparams, *more)
    return _checked("a sampler gives log weights", sampler.log_weights, value, achieved.shape[0])


def one_of(choices: Sequence[Sampler | LogWeightsFn]) -> Sampler:
    """Joins several samplers in one compiled program: `hparams.choice`, a traced number, says which of them a run uses.

    All log weights are computed and one is kept, so that a run draws what it would have drawn with that sampler alone. A
    field `choice` is not in `HParams`: the caller, `sweep`, adds it.

    Raises:
      ValueError: no sampler, or something that is none.
    """
    samplers = [make(choice) for choice in choices]
    if not samplers:
        raise ValueError("one_of joins one or more samplers; got none")
    if len(samplers) == 1:
        return samplers[0]

    def log_weights(achieved: Array, desired: Array, step: Array, hparams: Any, score: Array | None = None) -> Array:
        return pick([weigh(sampler, achieved, desired, step, hparams, score) for sampler in samplers], hparams.choice)

    def score(episode: Episode, view: Any) -> Array:
        none = jnp.zeros(episode.achieved_goal.shape[0])
        return pick(
            [score_of(sampler.score, episode, view) if sampler.score else none for sampler in samplers], view.hparams.choice
        )

    crossing = [sampler.cross_episode for sampler in samplers]

    def crosses(hparams: Any) -> Array:
        return pick(crossing, hparams.choice)

    return Sampler(
        log_weights,
        cross_episode=crosses if any(crossing) else False,
        score=score if any(sampler.score for sampler in samplers) else None,
    )


def probabilities(log_weights: Array) -> Array:
    """Returns the probabilities [..., T+1] that log weights [..., T+1] stand for."""
    return jax.nn.softmax(log_weights, axis=-1)


def draw(key: PRNGKey, log_weights: Array) -> Array:
    """Draws an index [B] from each row of log weights [B, T+1], by inverting the cumulative distribution.

    This takes one random number a row.

    What has no weight is never drawn, whatever the rounding of the cumulative sum. A row without any weight, or with NaN or
    +inf among its log weights, gives T+1, which is no index.
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
