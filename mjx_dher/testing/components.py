"""Checks of custom samplers, metrics, kernels, normalizations, priorities and goal generators, on random episodes.

Each function takes a component, as the command line or a program does, and an environment, or a `Trial`. Other arguments are
the run's numbers (by default HParams()) and an untrained learner whose values the component may read (by default `ddpg`). Each
returns a line about its findings, and raises ComponentError for the first violation.
"""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import check, components, learners, priorities, replay, samplers, trainer
from mjx_dher.components import reads
from mjx_dher.config import HParams
from mjx_dher.contract import check_with_goal, env_spec
from mjx_dher.contrib import generators
from mjx_dher.contrib.generators import GenerateFn, Generator
from mjx_dher.learners import Learner
from mjx_dher.lookup import is_import_path
from mjx_dher.priorities import ChooseFn, Priority, PriorityFn
from mjx_dher.relabel import relabel
from mjx_dher.replay import ReplayState
from mjx_dher.samplers import KernelFn, LogWeightsFn, MetricFn, NormalizationFn, Sampler
from mjx_dher.spec import RunSpec, custom_components
from mjx_dher.testing.env import check_env
from mjx_dher.testing.learner import check_learner
from mjx_dher.testing.trial import EPISODES, Trial, attempt, compiled, expect, expect_range, expect_same, run, trial_of
from mjx_dher.types import Env, GoalObs, PRNGKey

NUMBER = 8  # transitions that a priority must choose
BATCHES = 8  # batches of candidates to choose from


def check_components(env: Env, spec: RunSpec, with_env: bool = True) -> Iterator[str]:
    """Checks the custom components of a run, including the environment if `with_env`. Yields a line for each that passes."""
    custom = custom_components(spec)
    if "env" in custom and with_env:
        check_env(env)
        yield f"env {spec.env}: as it should be, in random episodes"
    if not custom.keys() - {"env"}:
        return
    learner = attempt("learner", learners.make, spec.learner, spec.config, env_spec(env), spec.networks)
    trial = Trial(env, spec.hparams, learner)
    if "metric" in custom:
        yield check_metric(spec.metric, trial)
    if "weight_kernel" in custom:
        yield check_kernel(spec.weight_kernel)
    if "weight_normalization" in custom:
        yield check_normalization(spec.weight_normalization)
    read = [field for field in ("metric", "weight_kernel", "weight_normalization") if reads(vars(spec), field)]
    if custom.keys() & {"sampler", *read}:
        yield f"{spec.sampler}: {check_sampler(samplers.make(*spec.sampler_choice), trial)}"
    if "priority" in custom:
        yield check_priority(spec.priority, trial)
    if "generator" in custom:
        yield check_generator(spec.generator, trial)
    if is_import_path(spec.learner) or is_import_path(spec.networks):
        check_learner(spec.learner, trial, spec.config, networks=spec.networks)
        yield f"learner {spec.learner}, networks {spec.networks}: as they should be, in one update"


def check_sampler(sampler: str | Sampler | LogWeightsFn, env: Env | Trial, hparams: HParams | None = None) -> str:
    """Checks the log weights at every step of random episodes.

    They must be floats [T+1], below +inf, not NaN, not all -inf at every step, and equal in a second call and under `jax.vmap`.
    """
    made, trial = attempt("sampler", samplers.make, sampler), trial_of(env, hparams, None)
    episodes, numbers = trial.episodes, trainer.as_arrays(trial.hparams)
    steps = jnp.arange(episodes.action.shape[1])

    def of_step(achieved: Any, desired: Any, length: Any, step: Any) -> Any:
        return samplers.weigh(made, achieved, desired, step, numbers, length if ends else None)

    ends = env_spec(trial.env).ends
    of_episode = jax.vmap(of_step, in_axes=(None, None, None, 0))
    asked = episodes.achieved_goal, episodes.desired_goal, episodes.length
    log_weights = run("sampler", jax.vmap(of_episode, in_axes=(0, 0, 0, None)), *asked, steps)
    alone = attempt("sampler, alone,", jax.jit(of_step), *(x[0] for x in asked), steps[-1])
    played = np.asarray(steps < episodes.length[:, None])
    return _check_log_weights(np.asarray(log_weights), np.asarray(alone), played)


def _check_log_weights(values: NDArray, alone: NDArray, played: NDArray) -> str:
    """Checks log weights [N, T, T+1] of the steps that were `played` [N, T], and the weights of episode 0 at its last step,
    computed `alone`. Returns a line.
    """
    wrong = np.argwhere(~(values < np.inf) & played[..., None])  # NaN, too
    if len(wrong):
        n, t, i = wrong[0]
        expect(False, f"sampler: log weights must be finite or -inf; that of goal {i} at step {t} is {values[n, t, i]}")
    weights = _weights(values)
    offers = np.any(values > -np.inf, axis=-1)[played]
    expect(offers.any(), "sampler: it offers no goal at any step: all log weights are -inf")
    expect_same("sampler, alone and under jax.vmap,", _weights(alone), weights[0, -1])
    num_steps = values.shape[1]
    past = np.tril(np.ones((num_steps, num_steps + 1), bool))
    missing = f"no goal at {1 - offers.mean():.0%} of the steps, which keep their own; " if not offers.all() else ""
    taken = ((weights > 0) & past & played[..., None]).any()
    return f"sampler as it should be: {missing}goals of the past {'too' if taken else 'never'}"


def _weights(log_weights: NDArray) -> NDArray:
    """Weights [..., T+1] from log weights [..., T+1], scaled so that the largest is 1. All are 0 if all are -inf."""
    largest = log_weights.max(axis=-1, keepdims=True)
    return np.exp(log_weights - np.where(np.isfinite(largest), largest, 0.0))


def check_metric(metric: str | MetricFn, env: Env | Trial) -> str:
    """Checks distances of random episodes' goals: [T+1], finite, not negative and not all equal."""
    made, trial = attempt("metric", samplers.make_metric, metric), trial_of(env, None, None)
    compute = jax.vmap(functools.partial(samplers.measure, made))
    distances = np.asarray(run("metric", compute, trial.episodes.achieved_goal, trial.episodes.desired_goal))
    text = expect_range("metric: distances", distances)
    expect(distances.min() < distances.max(), f"metric: it tells no goals apart: all distances are {distances.min():.3g}")
    return f"metric as it should be: distances {text}"


def check_kernel(kernel: str | KernelFn) -> str:
    """Checks the log weights of relative distances from 0 to 3, at temperatures 0.3, 1 and 3.

    They must have the shape of the distances, be below +inf, not NaN, not all -inf and not all equal.
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
    """Checks the relative distances of 20 candidates among 30 distances, at scales 0.01, 0.05 and 1.

    They must be floats with the shape of the distances, not NaN, and finite for candidates. The candidates' distances are 0.01
    to 0.2, which must be distinguished, all 0.1, all 0, or a single candidate's.
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
    priority: str | Priority | PriorityFn, env: Env | Trial, hparams: HParams | None = None, learner: Learner | None = None
) -> str:
    """Checks the weights of random episodes, and renewed weights and chosen transitions if the priority has these functions.

    Weights must be scalars, finite and not negative. Indices must refer to candidates, and depend on these.
    """
    made, trial = priorities.whole(attempt("priority", priorities.make, priority)), trial_of(env, hparams, learner)
    if made.uses_values and trial.learner is not None:
        attempt("priority", learners.check_values, trial.learner)
    context, lines = trial.context, []
    if (of_episode := made.weigh) is not None:

        def weigh(episode: Any) -> Any:
            return check.array("priority: weight []", of_episode(episode, context), (), jnp.number)

        weights = np.asarray(run("priority", jax.vmap(weigh), trial.episodes))
        alone = attempt("priority, alone,", jax.jit(weigh), jax.tree.map(lambda x: x[0], trial.episodes))
        text = expect_range("priority: weights", weights)
        expect_same("priority, alone and under jax.vmap,", alone, weights[0])
        none = ": while none is above 0, episodes are drawn uniformly" if weights.max() == 0 else ""
        lines.append(f"weights {text}{none}")
    if (renew := made.renew) is not None:
        weights = np.asarray(run("priority: renew", lambda ring: renew(ring, context), trial.ring))
        attempt("priority: renew", jax.eval_shape, lambda ring: priorities.renew(made, ring, context), trial.ring)
        lines.append(f"renewed weights {expect_range('priority: weights', weights[:EPISODES])}")
    if made.choose is not None:
        _check_picks(made.choose, made.candidates, trial)
        lines.append(f"{NUMBER} of {made.candidates * NUMBER} transitions chosen")
    return f"priority as it should be: {'; '.join(lines)}"


def _check_picks(choose: ChooseFn, candidates: int, trial: Trial) -> None:
    """Checks the indices from `choose` for the candidates of several batches."""
    ring, context = trial.ring, trial.context

    def pick(key: PRNGKey) -> jax.Array:
        sample_key, goal_key, choose_key = jax.random.split(key, 3)
        sample = replay.sample(ring, sample_key, candidates * NUMBER)
        batch = relabel(sample, samplers.future, context, goal_key).batch
        indices = choose(choose_key, sample, batch, NUMBER, context)
        return check.array("priority: indices [B] of choose", indices, (NUMBER,), jnp.integer)

    keys = jax.random.split(jax.random.key(3), BATCHES)
    program = compiled("priority: choose", pick, keys[0])
    picked = np.stack([program(key) for key in keys])
    outside = picked[(picked < 0) | (picked >= candidates * NUMBER)]
    expect(not outside.size, f"priority: choose gives indices of {candidates * NUMBER} candidates; one is {outside[:1]}")
    same = (picked == picked[:, :1]).all()
    expect(not same, f"priority: choose must give different transitions; all {NUMBER} are one, in each of {BATCHES} batches")
    first = (picked == candidates * np.arange(NUMBER)).all()
    expect(not first, "priority: choose keeps the first candidate of every place; it must choose")


def check_generator(
    generator: str | Generator | GenerateFn, env: Env | Trial, hparams: HParams | None = None, learner: Learner | None = None
) -> str:
    """Checks the goals of random resets, with an empty ring and with random episodes in it.

    They must be floats [N, G], equal for equal keys, and finite for some reset once there are episodes. Needs `with_goal`.
    """
    made, trial = attempt("generator", generators.make, generator), trial_of(env, hparams, learner)
    attempt("generator", check_with_goal, trial.env)
    if made.uses_values and trial.learner is not None:
        attempt("generator", learners.check_values, trial.learner)
    context, first = trial.context, jax.jit(jax.vmap(trial.env.reset))(jax.random.split(jax.random.key(1), EPISODES))

    def ask(obs: GoalObs, ring: ReplayState) -> jax.Array:
        goals = made(jax.random.key(2), obs, ring, context)
        return check.array("generator: goals [N, G]", goals, obs["desired_goal"].shape)

    program = compiled("generator", ask, first.obs, trial.ring)
    program(first.obs, trial.empty_ring)
    goals, own = np.asarray(program(first.obs, trial.ring)), np.asarray(first.obs["desired_goal"])
    finite = np.isfinite(goals).all(axis=-1)
    expect(finite.any(), "generator: no goal is finite, so every episode would be played for the reset's own")
    set_goals: Any = jax.vmap(trial.env.with_goal)  # type: ignore[attr-defined]
    attempt("env: with_goal", jax.jit(set_goals), first, jnp.asarray(np.where(finite[:, None], goals, own)))
    other = np.mean(finite & (goals != own).any(axis=-1))
    return f"generator as it should be: {other:.0%} of the goals are not those of the reset"
