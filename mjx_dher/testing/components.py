"""Checks of custom samplers, metrics, kernels, normalizations and priorities, on random episodes."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import check, components, learners, priorities, samplers
from mjx_dher.components import reads
from mjx_dher.config import HParams
from mjx_dher.contract import env_spec
from mjx_dher.distance_normalization import NormalizationFn
from mjx_dher.learners import Learner
from mjx_dher.lookup import is_import_path
from mjx_dher.priorities import Priority, PriorityFn
from mjx_dher.samplers import KernelFn, LearnedMetric, LogWeightsFn, MetricFn, Sampler
from mjx_dher.spec import RunSpec, custom_components
from mjx_dher.testing.env import check_env
from mjx_dher.testing.learner import check_learner
from mjx_dher.testing.methods import as_arrays, check_choice, check_generator, trial_context
from mjx_dher.testing.trial import TOLERANCE, attempt, compiled, expect, expect_range, expect_same, random_episodes, run
from mjx_dher.types import Env, Episode


def check_components(env: Env, spec: RunSpec, with_env: bool = True) -> Iterator[str]:
    """Checks the custom components of a run; yields a line for each that passes.

    Args:
      env: the environment.
      spec: the run.
      with_env: whether to check a custom environment, too.

    Raises:
      ComponentError: names the component, and the first violation.
    """
    custom = custom_components(spec)
    if "env" in custom and with_env:
        check_env(env)
        yield f"env {spec.env}: as it should be, in random episodes"
    if not custom.keys() - {"env"}:
        return
    episodes = random_episodes(env)
    learner = attempt("learner", learners.make, spec.learner, spec.config, env_spec(env), spec.networks)
    if "metric" in custom:
        yield check_metric(spec.metric, env, episodes, learner)
    if "weight_kernel" in custom:
        yield check_kernel(spec.weight_kernel)
    if "weight_normalization" in custom:
        yield check_normalization(spec.weight_normalization)
    read = [field for field in ("metric", "weight_kernel", "weight_normalization") if reads(vars(spec), field)]
    if custom.keys() & {"sampler", *read}:
        yield f"{spec.sampler}: {check_sampler(samplers.make(*spec.sampler_choice), env, spec.hparams, episodes, learner)}"
    if "priority" in custom:
        yield check_priority(spec.priority, env, spec.hparams, episodes, learner)
    if "generator" in custom:
        yield check_generator(spec.generator, env, spec.hparams, episodes, learner)
    if is_import_path(spec.learner) or is_import_path(spec.networks):
        check_learner(spec.learner, env, spec.config, spec.hparams, spec.networks, episodes)
        yield f"learner {spec.learner}, networks {spec.networks}: as they should be, in one update"


def check_sampler(
    sampler: str | Sampler | LogWeightsFn,
    env: Env,
    hparams: HParams | None = None,
    episodes: Episode | None = None,
    learner: Learner | None = None,
) -> str:
    """Asks a sampler for the log weights of every step of random episodes.

    They must be floats [T+1], below +inf and not NaN, not all -inf at every step, and the same under `jax.vmap` as alone and in
    a second call.

    Args:
      sampler: what `samplers.make` takes.
      env: the environment.
      hparams: numbers; None for the defaults.
      episodes: to ask about; None for random ones.
      learner: untrained learner whose values a score may read; None for `ddpg`.

    Returns:
      A line: at how many of the steps it offers no goal, and whether it offers goals of the past.

    Raises:
      ComponentError: names the first violation.
    """
    made, hparams = attempt("sampler", samplers.make, sampler), hparams or HParams()
    episodes = episodes or random_episodes(env)
    steps = jnp.arange(env.episode_length)
    score = jnp.zeros((episodes.action.shape[0], env.episode_length + 1))
    if made.score is not None:
        score = attempt("sampler: score", samplers.score_episodes, made, episodes, trial_context(env, hparams, learner))

    def of_step(achieved: Any, desired: Any, score: Any, step: Any) -> Any:
        return samplers.weigh(made, achieved, desired, step, as_arrays(hparams), score)

    of_episode = jax.vmap(of_step, in_axes=(None, None, None, 0))
    asked = episodes.achieved_goal, episodes.desired_goal, score
    log_weights = run("sampler", jax.vmap(of_episode, in_axes=(0, 0, 0, None)), *asked, steps)
    alone = attempt("sampler, alone,", jax.jit(of_step), *(x[0] for x in asked), steps[-1])
    return _check_log_weights(np.asarray(log_weights), np.asarray(alone))


def _check_log_weights(values: NDArray, alone: NDArray) -> str:
    """Checks log weights [N, T, T+1], and those of episode 0 at its last step, computed `alone`; returns a line."""
    wrong = np.argwhere(~(values < np.inf))  # NaN, too
    if len(wrong):
        n, t, i = wrong[0]
        expect(False, f"sampler: log weights must be finite or -inf; that of goal {i} at step {t} is {values[n, t, i]}")
    weights = _weights(values)
    offers = (values > -np.inf).any(axis=-1)
    expect(offers.any(), "sampler: it offers no goal at any step: all log weights are -inf")
    same = np.allclose(weights[0, -1], _weights(alone), rtol=TOLERANCE, atol=TOLERANCE)
    expect(same, "sampler: log weights under jax.vmap must be those alone; they depend on other episodes or steps")
    num_steps = values.shape[1]
    past = np.tril(np.ones((num_steps, num_steps + 1), bool))
    missing = f"no goal at {1 - offers.mean():.0%} of the steps, which keep their own; " if not offers.all() else ""
    return f"sampler as it should be: {missing}goals of the past {'too' if (weights[:, past] > 0).any() else 'never'}"


def _weights(log_weights: NDArray) -> NDArray:
    """Weights [..., T+1] of which the largest is 1, from log weights [..., T+1]; 0 if all of these are -inf."""
    largest = log_weights.max(axis=-1, keepdims=True)
    return np.exp(log_weights - np.where(np.isfinite(largest), largest, 0.0))


def check_metric(
    metric: str | MetricFn | LearnedMetric, env: Env, episodes: Episode | None = None, learner: Learner | None = None
) -> str:
    """Asks a metric for the distances of random episodes' goals: [T+1], finite, not negative and not all alike.

    Returns:
      A line: their range.

    Raises:
      ComponentError: names the first violation.
    """
    made = attempt("metric", samplers.make_metric, metric)
    episodes = episodes or random_episodes(env)
    if isinstance(made, LearnedMetric):
        sampler, context = samplers.make("closest", metric=made), trial_context(env, learner=learner)
        distances = np.asarray(attempt("metric", samplers.score_episodes, sampler, episodes, context))
    else:
        compute = jax.vmap(functools.partial(samplers.measure, made))
        distances = np.asarray(run("metric", compute, episodes.achieved_goal, episodes.desired_goal))
    text = expect_range("metric: distances", distances)
    expect(distances.min() < distances.max(), f"metric: it tells no goals apart: all distances are {distances.min():.3g}")
    return f"metric as it should be: distances {text}"


def check_kernel(kernel: str | KernelFn) -> str:
    """Asks a kernel for the log weights of relative distances from 0 to 3, at temperatures of 0.3, 1 and 3.

    They must be as many as the distances, below +inf and not NaN, not all -inf, and not all alike.

    Returns:
      A line: the weights at some distances.

    Raises:
      ComponentError: names the first violation.
    """
    made = attempt("weight_kernel", components.load, "weight_kernel", kernel, "relative", "temperature")
    relative = jnp.linspace(0.0, 3.0, 31)
    ask = lambda r, t: check.array("weight_kernel: log weights", made(r, t), r.shape)  # noqa: E731
    compute = compiled("weight_kernel", ask, relative, jnp.float32(1))
    for temperature in (0.3, 3.0, 1.0):
        log_weights = np.asarray(compute(relative, jnp.float32(temperature)))
        wrong = np.flatnonzero(~(log_weights < np.inf))  # NaN, too
        if len(wrong):
            place = f"relative distance {float(relative[wrong[0]]):g} and temperature {temperature:g}"
            expect(False, f"weight_kernel: log weights must be finite or -inf; it is {log_weights[wrong[0]]} at {place}")
        message = f"weight_kernel: every log weight is -inf at temperature {temperature:g}: it takes no goal"
        expect((log_weights > -np.inf).any(), message)
    expect(np.ptp(np.exp(log_weights)) > 0, "weight_kernel: it tells no distances apart: every weight is the same")
    near, mean, far = np.exp(log_weights[[0, 10, 20]])  # at temperature 1
    return f"weight_kernel as it should be: weights {near:.3g}, {mean:.3g} and {far:.3g} at relative distances 0, 1 and 2"


def check_normalization(normalization: str | NormalizationFn) -> str:
    """Asks a normalization for the relative distances of 20 candidates among 30 distances, at scales of 0.01, 0.05 and 1.

    They must be as many floats as there are distances, not NaN, and finite for candidates: those whose distances are 0.01 to
    0.2, which it must tell apart, or all 0.1, or all 0, and a single candidate.

    Returns:
      A line: their range for distances of 0.01 to 0.2.

    Raises:
      ComponentError: names the first violation.
    """
    field = "weight_normalization"
    made = attempt(field, components.load, field, normalization, "distance", "candidates", "scale")
    ask = lambda d, c, s: check.array(f"{field}: relative distances", made(d, c, s), d.shape)  # noqa: E731
    later, last = jnp.arange(30) >= 10, jnp.arange(30) == 29
    rising = jnp.where(later, jnp.linspace(-0.09, 0.2, 30), 0.0)
    cases = {
        "of 0.1 throughout": (jnp.full(30, 0.1), later),
        "of 0 throughout": (jnp.zeros(30), later),
        "of one candidate": (rising, last),
        "from 0.01 to 0.2": (rising, later),
    }
    compute = compiled(field, ask, rising, later, jnp.float32(1))
    for name, (distance, candidates) in cases.items():
        for scale in (0.01, 0.05, 1.0):
            relative = np.asarray(compute(distance, candidates, jnp.float32(scale)))
            fine = not np.isnan(relative).any() and np.isfinite(relative[np.asarray(candidates)]).all()
            expect(fine, f"{field}: a relative distance is not finite, for distances {name}")
    shown = relative[10:]
    expect(shown.min() < shown.max(), f"{field}: it tells no distances apart: all relative distances are {shown.min():.3g}")
    return f"{field} as it should be: {shown.min():.3g} to {shown.max():.3g} for distances from 0.01 to 0.2 m"


def check_priority(
    priority: str | Priority | PriorityFn,
    env: Env,
    hparams: HParams | None = None,
    episodes: Episode | None = None,
    learner: Learner | None = None,
) -> str:
    """Asks a priority for the weights of random episodes, and for renewed weights and transitions if it has a say in them.

    Weights must be scalars, finite and not negative.

    Returns:
      A line: the range of the weights.

    Raises:
      ComponentError: names the first violation.
    """
    made, hparams = attempt("priority", priorities.make, priority), hparams or HParams()
    episodes = episodes or random_episodes(env)
    more = check_choice(made, env, hparams, episodes, learner) if isinstance(made, Priority) else []
    of_episode = priorities.whole(made).weigh
    if of_episode is None:
        return f"priority as it should be: {'; '.join(more)}"
    context = trial_context(env, hparams, learner)

    def weigh(episode: Any) -> Any:
        return check.array("priority: weight []", of_episode(episode, context), (), jnp.number)

    weights = np.asarray(run("priority", jax.vmap(weigh), episodes))
    text = expect_range("priority: weights", weights)
    alone = attempt("priority, alone,", jax.jit(weigh), jax.tree.map(lambda x: x[0], episodes))
    expect_same("priority, alone and under jax.vmap,", alone, weights[0])
    none = ": while none is above 0, episodes are drawn uniformly" if weights.max() == 0 else ""
    return f"priority as it should be: {'; '.join([f'weights {text}{none}', *more])}"
