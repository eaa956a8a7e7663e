"""Trials of samplers, metrics, kernels, priorities and generators of one's own, on random episodes."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import components, learners, priorities, samplers
from mjx_dher.components import reads
from mjx_dher.config import HParams
from mjx_dher.distance_normalization import NormalizationFn
from mjx_dher.learners import Learner
from mjx_dher.lookup import is_import_path
from mjx_dher.priorities import Priority, PriorityFn
from mjx_dher.rollout import env_spec
from mjx_dher.samplers import KernelFn, LearnedMetric, LogWeightsFn, MetricFn, Sampler
from mjx_dher.spec import RunSpec, custom_components
from mjx_dher.testing.env import check_env
from mjx_dher.testing.learner import check_learner
from mjx_dher.testing.methods import check_choice, check_generator, trial_context
from mjx_dher.testing.trial import PartError, attempt, random_episodes
from mjx_dher.types import Env, Episode

TOLERANCE = 1e-3


def check_parts(env: Env, spec: RunSpec) -> Iterator[str]:
    """Tries out the parts of a run that are named as module:attribute; yields a sentence for each that is as it should be.

    Args:
      env: the environment, made.
      spec: of the run.

    Raises:
      ValueError: names the part, and what is wrong with it.
    """
    if is_import_path(spec.env):
        check_env(env)
        yield f"env {spec.env}: as it should be, in random episodes"
    if not custom_components(spec).keys() - {"env"}:
        return
    episodes = random_episodes(env)
    learner = attempt("learner", learners.make, spec.learner, spec.config, env_spec(env), spec.networks)
    yield from _check_replayed(env, spec, episodes, learner)
    if is_import_path(spec.learner) or is_import_path(spec.networks):
        check_learner(spec.learner, env, spec.config, spec.hparams, spec.networks, episodes)
        yield f"learner {spec.learner}, networks {spec.networks}: as they should be, in one update"


def _check_replayed(env: Env, spec: RunSpec, episodes: Episode, learner: Learner) -> Iterator[str]:
    """Tries out what a run names of its own that decides what is learned from."""
    if is_import_path(spec.metric):
        yield check_metric(spec.metric, env, episodes, learner)
    if is_import_path(spec.weight_kernel):
        yield check_kernel(spec.weight_kernel)
    if is_import_path(spec.weight_normalization):
        yield check_normalization(spec.weight_normalization)
    read = [field for field in ("metric", "weight_kernel", "weight_normalization") if reads(vars(spec), field)]
    if any(is_import_path(getattr(spec, field)) for field in ("sampler", *read)):
        yield f"{spec.sampler}: {check_sampler(samplers.make(*spec.sampler_choice), env, spec.hparams, episodes, learner)}"
    if is_import_path(spec.priority):
        yield check_priority(spec.priority, env, spec.hparams, episodes, learner)
    if is_import_path(spec.generator):
        yield check_generator(spec.generator, env, spec.hparams, episodes, learner)


def check_sampler(
    sampler: str | Sampler | LogWeightsFn,
    env: Env,
    hparams: HParams | None = None,
    episodes: Episode | None = None,
    learner: Learner | None = None,
) -> str:
    """Asks a sampler for the log weights of every step of random episodes.

    They must be [T+1] floating-point numbers, below +inf and not NaN, not all -inf at every step, and the same under
    `jax.vmap` as alone.

    Args:
      sampler: what `samplers.make` takes.
      env: the environment.
      hparams: numbers; the defaults where None.
      episodes: to ask about; random ones where None.
      learner: whose values a score may ask for, untrained; `ddpg` where None.

    Returns:
      A sentence: at how many of the steps it offers no goal, and whether it offers goals of the past.

    Raises:
      PartError: names the first violation.
    """
    made, hparams = attempt("sampler", samplers.make, sampler), HParams() if hparams is None else hparams
    episodes = episodes or random_episodes(env)
    steps = jnp.arange(env.episode_length)
    score = jnp.zeros((episodes.action.shape[0], env.episode_length + 1))
    if made.score is not None:
        score = attempt("sampler: score", samplers.score_episodes, made, episodes, trial_context(env, hparams, learner))

    def of_step(achieved: Any, desired: Any, score: Any, step: Any) -> Any:
        return samplers.weigh(made, achieved, desired, step, _as_arrays(hparams), score)

    of_episode = jax.vmap(of_step, in_axes=(None, None, None, 0))
    asked = episodes.achieved_goal, episodes.desired_goal, score
    log_weights = attempt("sampler", jax.jit(jax.vmap(of_episode, in_axes=(0, 0, 0, None))), *asked, steps)
    alone = attempt("sampler, alone,", of_step, *(x[0] for x in asked), steps[-1])
    return _check_log_weights(np.asarray(log_weights), np.asarray(alone))


def _check_log_weights(values: NDArray, alone: NDArray) -> str:
    """Checks log weights [N, T, T+1], and those of episode 0 at its last step, computed `alone`; returns a sentence."""
    for name, wrong in (("NaN", np.isnan(values)), ("+inf", values == np.inf)):
        if wrong.any():
            _, t, i = np.argwhere(wrong)[0]
            raise PartError(
                f"sampler: log weights must be finite, or -inf for what is not to be chosen; that of goal {i} at step {t} is"
                f" {name}"
            )
    weights = _weights(values)
    offers = (values > -np.inf).any(axis=-1)
    if not offers.any():
        raise PartError("sampler: it offers no goal at any step: all log weights are -inf")
    if not np.allclose(weights[0, -1], _weights(alone), rtol=TOLERANCE, atol=TOLERANCE):
        raise PartError("sampler: log weights under jax.vmap must be those alone; they depend on other episodes or steps")
    num_steps = values.shape[1]
    past = np.tril(np.ones((num_steps, num_steps + 1), bool))[None]
    missing = f"no goal at {1 - offers.mean():.0%} of the steps, which keep their own; " if not offers.all() else ""
    return f"sampler as it should be: {missing}goals of the past {'too' if (weights[:, past[0]] > 0).any() else 'never'}"


def _weights(log_weights: NDArray) -> NDArray:
    """Returns weights [..., T+1] of which the largest is 1, of log weights [..., T+1]; 0 where all of these are -inf."""
    largest = log_weights.max(axis=-1, keepdims=True)
    return np.exp(log_weights - np.where(np.isfinite(largest), largest, 0.0))


def check_metric(
    metric: str | MetricFn | LearnedMetric, env: Env, episodes: Episode | None = None, learner: Learner | None = None
) -> str:
    """Asks a metric for the distances of random episodes' goals.

    They must be [T+1], finite and not negative, and not all alike.

    Returns:
      A sentence: in which range they lie.

    Raises:
      PartError: names the first violation.
    """
    made = attempt("metric", samplers.make_metric, metric)
    episodes = episodes or random_episodes(env)
    if isinstance(made, LearnedMetric):
        sampler, context = samplers.make("closest", metric=made), trial_context(env, learner=learner)
        distances = np.asarray(attempt("metric", samplers.score_episodes, sampler, episodes, context))
    else:
        compute = jax.jit(jax.vmap(functools.partial(samplers.measure, made)))
        distances = np.asarray(attempt("metric", compute, episodes.achieved_goal, episodes.desired_goal))
    if not np.isfinite(distances).all():
        raise PartError("metric: distances must be finite; one is not")
    if distances.min() < 0:
        raise PartError(f"metric: distances must not be negative; the least is {distances.min():.3g}")
    if distances.min() == distances.max():
        raise PartError(f"metric: it tells no goals apart: all distances are {distances.min():.3g}")
    return f"metric as it should be: distances from {distances.min():.3g} to {distances.max():.3g}"


def check_kernel(kernel: str | KernelFn) -> str:
    """Asks a kernel for the log weights of relative distances from 0 to 3, at temperatures of 0.3, 1 and 3.

    They must be as many as the distances, below +inf and not NaN, and not all -inf.

    Returns:
      A sentence: the weights, of which a kernel gives the logarithms, at some distances.

    Raises:
      PartError: names the first violation.
    """
    made = attempt("weight_kernel", components.load, "weight_kernel", kernel, "relative", "temperature")
    relative = jnp.linspace(0.0, 3.0, 31)
    for temperature in (0.3, 1.0, 3.0):
        compute = jax.jit(lambda r, t: jnp.asarray(made(r, t)))
        log_weights = np.asarray(attempt("weight_kernel", compute, relative, jnp.float32(temperature)))
        if log_weights.shape != relative.shape:
            raise PartError(f"weight_kernel: log weights must be {list(relative.shape)}; they are {list(log_weights.shape)}")
        if log_weights.dtype.kind != "f":
            raise PartError(f"weight_kernel: log weights must be floating-point numbers; they are {log_weights.dtype}")
        for name, wrong in (("NaN", np.isnan(log_weights)), ("+inf", log_weights == np.inf)):
            if wrong.any():
                place = f"relative distance {float(relative[np.argmax(wrong)]):g} and temperature {temperature:g}"
                raise PartError(f"weight_kernel: log weights must be finite or -inf; it is {name} at {place}")
        if not (log_weights > -np.inf).any():
            raise PartError(f"weight_kernel: every log weight is -inf at temperature {temperature:g}: it takes no goal")
        if temperature == 1.0:
            near, mean, far = np.exp(log_weights[[0, 10, 20]])
    return f"weight_kernel as it should be: weights {near:.3g}, {mean:.3g} and {far:.3g} at relative distances 0, 1 and 2"


def check_normalization(normalization: str | NormalizationFn) -> str:
    """Asks a normalization for the relative distances of 20 candidates among 30 distances, at scales of 0.01, 0.05 and 1.

    They must be as many floating-point numbers as there are distances, not NaN, and finite for candidates: those whose
    distances are 0.01 to 0.2, those whose distances are all 0.1, or all 0, and where one alone is left.

    Returns:
      A sentence: in which range they lie for distances of 0.01 to 0.2.

    Raises:
      PartError: names the first violation.
    """
    parameters = ("distance", "candidates", "scale")
    made = attempt("weight_normalization", components.load, "weight_normalization", normalization, *parameters)
    later, last = jnp.arange(30) >= 10, jnp.arange(30) == 29
    rising = jnp.where(later, jnp.linspace(-0.09, 0.2, 30), 0.0)
    cases = {
        "from 0.01 to 0.2": (rising, later),
        "of 0.1 throughout": (jnp.full(30, 0.1), later),
        "of 0 throughout": (jnp.zeros(30), later),
        "of which one alone is left": (rising, last),
    }
    lowest = highest = 0.0
    for told, (distance, candidates) in cases.items():
        for scale in (0.01, 0.05, 1.0):
            compute = jax.jit(lambda d, c, s: jnp.asarray(made(d, c, s)))
            relative = np.asarray(attempt("weight_normalization", compute, distance, candidates, jnp.float32(scale)))
            if relative.shape != (30,) or relative.dtype.kind != "f":
                given = f"{relative.dtype} {list(relative.shape)}"
                raise PartError(f"weight_normalization: relative distances must be floats [30]; they are {given}")
            if np.isnan(relative).any() or not np.isfinite(relative[np.asarray(candidates)]).all():
                raise PartError(f"weight_normalization: a relative distance is not finite, for distances {told}")
            if distance is rising and candidates is later:
                lowest, highest = float(relative[10:].min()), float(relative[10:].max())
    return f"weight_normalization as it should be: {lowest:.3g} to {highest:.3g} for distances from 0.01 to 0.2 m"


def check_priority(
    priority: str | Priority | PriorityFn,
    env: Env,
    hparams: HParams | None = None,
    episodes: Episode | None = None,
    learner: Learner | None = None,
) -> str:
    """Asks a priority for the weights of random episodes: scalars, finite and not negative.

    One that renews weights, or that chooses among transitions, is asked for that, too.

    Returns:
      A sentence: in which range weights lie.

    Raises:
      PartError: names the first violation.
    """
    made, hparams = attempt("priority", priorities.make, priority), HParams() if hparams is None else hparams

    episodes = episodes or random_episodes(env)
    more = check_choice(made, env, hparams, episodes, learner) if isinstance(made, Priority) else []
    of_episode = priorities.whole(made).weigh
    if of_episode is None:
        return f"priority as it should be: {'; '.join(more)}"

    def weigh(episode: Any) -> Any:
        return jnp.asarray(of_episode(episode, trial_context(env, hparams, learner)))

    weights = np.asarray(attempt("priority", jax.jit(jax.vmap(weigh)), episodes))
    _check_weights(weights)
    alone = attempt("priority, alone,", weigh, jax.tree.map(lambda x: x[0], episodes))
    if not np.allclose(alone, weights[0], rtol=TOLERANCE, atol=TOLERANCE):
        raise PartError("priority: weights under jax.vmap must be those alone; they depend on other episodes")
    none = ": while none is above 0, episodes are drawn uniformly" if weights.max() == 0 else ""
    told = [f"weights from {weights.min():.3g} to {weights.max():.3g}{none}", *more]
    return f"priority as it should be: {'; '.join(told)}"


def _check_weights(weights: NDArray) -> None:
    """Raises PartError unless weights are numbers [N], finite and not negative."""
    if weights.ndim != 1:
        raise PartError(f"priority: it must give one weight [] for an episode; it gives {list(weights.shape[1:])}")
    if weights.dtype.kind not in "fiub":
        raise PartError(f"priority: weights must be numbers; they are {weights.dtype}")
    if not np.isfinite(weights).all():
        raise PartError("priority: weights must be finite; one is not")
    if weights.min() < 0:
        raise PartError(f"priority: weights must not be negative; the least is {weights.min():.3g}")


def _as_arrays(hparams: HParams) -> HParams:
    return jax.tree.map(functools.partial(jnp.asarray, dtype=jnp.float32), hparams)
