"""The training loop as two pure functions, `init` and `epoch`, that compile and vmap.

epoch = scan over cycles, then an evaluation
cycle = roll out -> add to the ring, with priorities -> update the normalizers -> learn
learn = scan over draws of many batches at once: update, and move the targets every `target_period` updates
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher import config as config_lib
from mjx_dher import evaluate, generators, learners, priorities, replay, samplers, scores
from mjx_dher.config import Config, HParams
from mjx_dher.context import View
from mjx_dher.generators import GenerateFn, Generator
from mjx_dher.learners import Learner
from mjx_dher.parallel.split import ALONE, Split
from mjx_dher.priorities import Priority, PriorityFn
from mjx_dher.relabel import draw_batches, relabel_counted
from mjx_dher.replay import ReplayState
from mjx_dher.rollout import env_sizes, episode_template, rollout
from mjx_dher.samplers import LogWeightsFn, Sampler
from mjx_dher.types import Array, Env, Episode, GoalObs, Metrics, PRNGKey, PyTree, check_env_parts
from mjx_dher.updates import update_round

# Upper bound of the transitions drawn at once, but never less than one target period. Larger draws fall out of a CPU's cache.
MAX_TRANSITIONS_PER_DRAW = 16_384
# Folded into a cycle's key, for its goals and for the rows that are renewed; no indices of `jax.random.split`.
GENERATE, RENEW = 0x476F616C, 0x52656E65


@struct.dataclass
class TrainState:
    """A run in progress, whole: the next epoch depends on nothing else."""

    learner: PyTree  # of the learner
    replay: ReplayState
    hparams: HParams
    key: PRNGKey
    env_steps: Array  # [] int32


class Train(NamedTuple):
    """What `make_train` returns."""

    init: Callable[[PRNGKey, HParams], TrainState]
    epoch: Callable[[TrainState], tuple[TrainState, Metrics]]
    learner: Learner
    replay_bytes: int  # memory of one run's ring on a device
    split: Split = ALONE


@dataclasses.dataclass(frozen=True)
class Loop:
    """Parts of a training loop; static."""

    env: Env
    config: Config
    sampler: Sampler
    priority: Priority
    generator: Generator
    learner: Learner
    template: Episode  # shapes and dtypes of an episode
    split: Split = ALONE
    max_transitions_per_draw: int = MAX_TRANSITIONS_PER_DRAW

    @property
    def num_episodes(self) -> int:
        """Episodes that the ring holds, E: that of a part, of a run in parts."""
        return self.split.share(config_lib.episodes_capacity(self.config, self.env.episode_length))

    @property
    def uses_values(self) -> bool:
        """Need of one of the parts for the learner's values."""
        return self.sampler.score is not None or self.priority.uses_values or self.generator.uses_values

    @property
    def steps_per_cycle(self) -> int:
        """Environment steps of a cycle."""
        return self.config.num_envs * self.env.episode_length

    @property
    def num_updates(self) -> int:
        """Updates of the whole run."""
        return config_lib.num_updates(self.config, self.env.episode_length)

    @property
    def policy_delay(self) -> int:
        """Updates of the critics for one of the actor."""
        return learners.policy_delay(self.learner)

    @property
    def updates_per_round(self) -> int:
        """Updates until both the targets and the actor have moved."""
        return max(self.config.target_period, self.policy_delay)

    @property
    def rounds_per_draw(self) -> int:
        """Rounds whose batches are drawn at once: as many as `max_transitions_per_draw` allows, at least one."""
        rounds = self.config.updates_per_cycle // self.updates_per_round
        batch_size = self.split.share(self.config.batch_size)
        return _largest_divisor(rounds, self.max_transitions_per_draw // (self.updates_per_round * batch_size))


def make_train(
    env: Env,
    config: Config,
    *,
    sampler: Sampler | LogWeightsFn | None = None,
    priority: Priority | PriorityFn | None = None,
    generator: Generator | GenerateFn | None = None,
    learner: Learner | None = None,
    split: Split = ALONE,
) -> Train:
    """Makes the training loop for an environment: pure functions, to be compiled and, over seeds and HParams, vmapped.

    `init(key, hparams)` makes a TrainState. `epoch(train_state)` plays and learns for `cycles_per_epoch` cycles, evaluates,
    and returns the next TrainState with these metrics, each []: success_rate, reset_success_rate and return_mean of the
    evaluation; train_success_rate and train_return_mean of the exploring policy, and the mean of its episodes' priorities,
    priority_mean; of their transitions the relabelled_share and, over these, relabel_distance, the mean Euclidean distance
    from the episode's goal to the hindsight goal; discarded_episodes, whose physics blew up and which were not learned from;
    bad_rewards and bad_success (`evaluate.faults`) and no_goal_share (`relabel.relabel_counted`), which ought to be 0; and what
    the learner reports, for DDPG critic_loss, actor_loss, q_mean, actor_norm and critic_norm.

    Args:
      env: the environment.
      config: sizes.
      sampler: of hindsight goals, or a function like `Sampler.log_weights`; `future` where None.
      priority: of episodes or transitions, for `hparams.priority_fraction` of each batch; `eventful` where None.
      generator: of the goals that training episodes are played for; those of the reset where None.
      learner: DDPG where None, made of `config`.
      split: of a run in parts on several devices, whose `init` and `epoch` are then called inside `jax.shard_map`.

    Raises:
      ValueError: a Config that cannot run, here or at all, an observation that is not one vector, or an argument of another
        kind. `epoch` raises it where a part gives arrays of the wrong shape, as soon as it is traced.
    """
    _check_arguments(env, config, learner)
    config_lib.check_parts(config, env.episode_length, split.number)
    learner = learners.make("ddpg", config, env_sizes(env)) if learner is None else learner
    loop = Loop(
        env=env,
        config=config,
        sampler=samplers.make("future" if sampler is None else sampler),
        priority=priorities.whole(priorities.make("eventful" if priority is None else priority)),
        generator=generators.make("reset" if generator is None else generator),
        learner=learner if split.number == 1 else learners.over_axis(learner, split.axis),
        template=episode_template(env),
        split=split,
    )
    if problem := config_lib.delay_problem(config, loop.policy_delay):
        raise ValueError(problem)
    generators.check_env(loop.generator, env)
    if loop.uses_values:
        learners.check_values(loop.learner)
    return Train(
        init=functools.partial(_init, loop),
        epoch=functools.partial(_epoch, loop),
        learner=loop.learner,
        replay_bytes=replay.nbytes(loop.template, loop.num_episodes),
        split=split,
    )


def _check_arguments(env: Env, config: Config, learner: Learner | None) -> None:
    check_env_parts(env)
    if not isinstance(config, Config):
        raise ValueError(f"config must be a Config; got {config!r}")
    config_lib.validate(config, HParams(), env.episode_length)
    if learner is not None:
        learners.check_methods(learner, learner)


def _init(loop: Loop, key: PRNGKey, hparams: HParams) -> TrainState:
    key, learner_key = jax.random.split(key)
    return TrainState(
        learner=loop.learner.init(learner_key),
        replay=replay.init(loop.template, loop.num_episodes),
        hparams=as_arrays(hparams),
        key=key,
        env_steps=jnp.zeros((), jnp.int32),
    )


def _epoch(loop: Loop, state: TrainState) -> tuple[TrainState, Metrics]:
    state, cycles = jax.lax.scan(lambda state, _: _cycle(loop, state), state, length=loop.config.cycles_per_epoch)
    key, eval_key = jax.random.split(state.key)
    discarded = jnp.sum(cycles.pop("discarded_episodes"))
    outcome = evaluate_state(loop.env, loop.learner, state, eval_key, loop.config.eval_episodes, loop.split)
    means = jax.tree.map(jnp.mean, cycles)
    faults = {name: jnp.maximum(means[name], share) for name, share in evaluate.faults(outcome).items()}
    metrics = evaluate.summary(outcome) | means
    summary = loop.learner.summary(state.learner)
    learners.check_metrics("summary", summary, means)
    metrics |= summary
    return dataclasses.replace(state, key=key), metrics | faults | {"discarded_episodes": discarded}


def _cycle(loop: Loop, state: TrainState) -> tuple[TrainState, Metrics]:
    """Rolls out, adds to the ring, updates the normalizers, learns."""
    env, config, hparams, split = loop.env, loop.config, state.hparams, loop.split
    key, rollout_key, noise_key, normalizer_key, learn_key = jax.random.split(state.key, 5)

    def policy(noise: Any, obs: GoalObs) -> Array:
        return loop.learner.explore(state.learner, obs, noise, hparams)

    noise = loop.learner.noise(noise_key, env.episode_length, config.num_envs, hparams)
    learners.check_noise(noise, env.episode_length, config.num_envs)
    progress = state.env_steps // loop.steps_per_cycle * config.updates_per_cycle / loop.num_updates
    goals = _goals(loop, state, progress)
    first, num_envs = split.keys(rollout_key, config.num_envs), split.share(config.num_envs)
    episodes, outcome = rollout(env, policy, first, num_envs, split.own(noise, axis=1), goals)
    weights = priorities.weights(loop.priority, episodes, env.compute_reward, hparams)
    ring = replay.add(state.replay, episodes, weights, outcome.valid)
    before = _view(loop, state.learner, hparams, progress)
    learner, relabelled = _update_normalizers(loop, state.learner, episodes, outcome.valid, before, split.key(normalizer_key))
    annealed = anneal(hparams, progress)
    view = _view(loop, learner, annealed, progress)
    ring = priorities.renewed(loop.priority, ring, view, _rows_to_renew(loop, state, ring, num_envs))
    learned, losses = _learn(loop, learner, ring, view, split.key(learn_key))
    # As long as the ring, or that of a part, is empty, nothing is learned.
    learner = jax.tree.map(lambda new, old: jnp.where(split.all(replay.can_sample(ring)), new, old), learned, learner)
    outcome = split.gather(outcome)
    metrics = {
        "train_success_rate": jnp.mean(outcome.success),
        "train_return_mean": evaluate.return_mean(outcome),
        "discarded_episodes": jnp.sum(~outcome.valid),
        "priority_mean": split.mean(jnp.mean(weights) if loop.priority.renew is None else replay.mean_priority(ring)),
        **evaluate.faults(outcome),
        **relabelled,
        **losses,
    }
    env_steps = state.env_steps + loop.steps_per_cycle
    return TrainState(learner=learner, replay=ring, hparams=hparams, key=key, env_steps=env_steps), metrics


def _view(loop: Loop, learner: PyTree, hparams: HParams, progress: Array) -> View:
    values = learners.values_of(loop.learner, learner, hparams) if loop.uses_values else None
    return View(loop.env.compute_reward, hparams, progress, values)


def _rows_to_renew(loop: Loop, state: TrainState, ring: ReplayState, num_new: int) -> Array | None:
    """Returns the rows whose priorities are renewed after `num_new` episodes were added; None for all of them."""
    number = loop.config.renewals * num_new
    if loop.priority.renew is None or not loop.priority.by_part or not 0 < number < replay.capacity(ring):
        return None
    key = loop.split.key(jax.random.fold_in(state.key, RENEW))
    return replay.newest_and_others(ring, key, num_new, number - num_new)


def _goals(loop: Loop, state: TrainState, progress: Array) -> Callable[[GoalObs], Array] | None:
    """Returns what gives the goals of a rollout; None where the reset's own are played for."""
    if loop.generator is generators.reset:
        return None
    view = _view(loop, state.learner, state.hparams, progress)
    key = loop.split.key(jax.random.fold_in(state.key, GENERATE))
    return lambda obs: generators.goals_of(loop.generator, key, obs, state.replay, view)


def _update_normalizers(
    loop: Loop, learner: PyTree, episodes: Episode, valid: Array, view: View, key: PRNGKey
) -> tuple[PyTree, Metrics]:
    """Updates the normalizers; goals are relabelled first, so that their statistics match those of training batches."""
    num_new, num_steps = episodes.action.shape[:2]
    fresh = replay.add(replay.init(loop.template, num_new), episodes, valid=valid)
    sample_key, relabel_key = jax.random.split(key)
    sample = replay.sample(fresh, sample_key, num_new * num_steps)
    hparams, score = view.hparams, scores.of_episodes(loop.sampler.score, fresh.episodes, view)
    batch, no_goal_share = relabel_counted(fresh, sample, loop.sampler, view.compute_reward, hparams, relabel_key, score)
    updated = loop.learner.update_normalizers(learner, episodes.observation, batch.desired_goal, hparams, valid)
    learners.check_kept("update_normalizers", learner, updated)
    metrics = _relabel_metrics(sample.desired_goal, batch.desired_goal, loop.split)
    return updated, {**metrics, "no_goal_share": loop.split.mean(no_goal_share)}


def _learn(loop: Loop, learner: PyTree, ring: ReplayState, view: View, key: PRNGKey) -> tuple[PyTree, Metrics]:
    """Makes a cycle's updates. The ring does not change meanwhile, so batches are drawn many at once.

    On a GPU, drawing one batch takes twice as long as learning from it, and drawing 40 hardly longer.
    """
    config, hparams = loop.config, view.hparams
    cumulative = replay.cumulative_priority(ring)
    score = scores.of_episodes(loop.sampler.score, ring.episodes, view)
    shape = (loop.rounds_per_draw, loop.updates_per_round, loop.split.share(config.batch_size))

    def draw_and_update(learner: PyTree, key: PRNGKey) -> tuple[PyTree, Metrics]:
        numbers = hparams, cumulative, config.n_step, score
        batches = draw_batches(ring, key, shape, loop.sampler, view.compute_reward, *numbers, loop.priority, view)
        return jax.lax.scan(functools.partial(update_round, loop.learner, config.target_period, hparams), learner, batches)

    keys = jax.random.split(key, config.updates_per_cycle // (loop.updates_per_round * loop.rounds_per_draw))
    learner, losses = jax.lax.scan(draw_and_update, learner, keys)
    return learner, loop.split.mean(jax.tree.map(jnp.mean, losses))


def _relabel_metrics(goal: Array, hindsight: Array, split: Split = ALONE) -> Metrics:
    """Returns the share of goals [B, G] that were replaced, and the mean distance of those that took their place."""
    distance = jnp.linalg.norm(hindsight - goal, axis=-1)
    replaced = (distance > 0).astype(jnp.float32)
    return {
        "relabelled_share": split.mean(jnp.mean(replaced)),
        "relabel_distance": split.sum(jnp.sum(distance)) / jnp.maximum(split.sum(jnp.sum(replaced)), 1.0),
    }


def _largest_divisor(number: int, limit: int) -> int:
    """Returns the largest divisor of `number` up to `limit`; at least 1."""
    return next(divisor for divisor in range(max(1, min(number, limit)), 0, -1) if number % divisor == 0)


def evaluate_state(
    env: Env, learner: Learner, state: TrainState, key: PRNGKey, num_episodes: int, split: Split = ALONE
) -> evaluate.Outcome:
    """Plays the learner's policy without exploration; returns the outcomes [num_episodes], of all parts."""

    def act(obs: GoalObs) -> Array:
        return learner.act(state.learner, obs, state.hparams)

    if split.number == 1:
        return evaluate.evaluate(env, act, key, num_episodes)
    share = -(-num_episodes // split.number)
    keys = jax.random.split(key, num_episodes)[jnp.arange(split.number * share) % num_episodes]  # some are played twice
    outcomes = split.gather(evaluate.evaluate(env, act, split.own(keys), share))
    return jax.tree.map(lambda x: x[:num_episodes], outcomes)


def anneal(hparams: HParams, progress: Array | float) -> HParams:
    """Returns the numbers after a fraction `progress` of the run's updates: step sizes fall linearly to `lr_end`."""
    left: Any = 1.0 - (1.0 - hparams.lr_end) * jnp.minimum(progress, 1.0)
    return hparams._replace(actor_lr=hparams.actor_lr * left, critic_lr=hparams.critic_lr * left)


def as_arrays(hparams: HParams) -> HParams:
    """Returns the numbers as float32 arrays."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), hparams)


def is_finite(learner: PyTree) -> Array:
    """Returns [] whether all of a learner's numbers are finite: once they are not, no epoch will mend them."""
    floats = [leaf for leaf in jax.tree.leaves(learner) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.asarray([jnp.all(jnp.isfinite(leaf)) for leaf in floats], bool))
