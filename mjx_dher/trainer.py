"""The training loop as pure functions `init` and `epoch`, which compile and vmap.

epoch = scan over cycles, then an evaluation
cycle = roll out -> add to the ring, with priorities -> update the normalizers -> learn
learn = scan over draws of many batches: update, and move the targets every `target_period` updates
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher import check, evaluate, learners, priorities, replay, samplers, validation
from mjx_dher import config as config_lib
from mjx_dher import context as context_lib
from mjx_dher.config import Config, HParams
from mjx_dher.context import Context
from mjx_dher.contract import check_with_goal, spec_and_template
from mjx_dher.learners import Learner
from mjx_dher.lookup import check_function
from mjx_dher.parallel import split
from mjx_dher.parallel.split import AxisName
from mjx_dher.priorities import Priority, PriorityFn
from mjx_dher.relabel import add_pool, draw_batches, relabel
from mjx_dher.replay import ReplayState
from mjx_dher.rollout import rollout
from mjx_dher.samplers import LogWeightsFn, Sampler
from mjx_dher.types import Array, Batch, Env, EnvSpec, Episode, GoalObs, Metrics, PRNGKey, PyTree

# Most transitions per draw, but at least one target period. Larger draws do not fit into a CPU's cache.
MAX_TRANSITIONS_PER_DRAW = 16_384
# Folded into a cycle's key for goals, renewed rows and added episodes; no indices of `jax.random.split`.
GENERATE, RENEW, ADD = 0x476F616C, 0x52656E65, 0x44656D6F
_AUGMENT = 0x41756767  # folded into the key of a draw


# generator(key, obs with leading [N], ring, context) -> goals [N, G] to play for; `contrib.generators.Generator` is one
GoalsFn = Callable[[PRNGKey, GoalObs, ReplayState, Context], Array]


@struct.dataclass
class TrainState:
    """Complete state of a run. The next epoch depends on nothing else."""

    learner: PyTree  # of the learner
    replay: ReplayState
    hparams: HParams
    key: PRNGKey
    env_steps: Array  # [] int32, per device


class Train(NamedTuple):
    """Functions and properties of a training loop, from `make_train`."""

    init: Callable[[PRNGKey, HParams], TrainState]
    epoch: Callable[[TrainState], tuple[TrainState, Metrics]]
    add: Callable[[TrainState, Episode], TrainState]  # adds N demonstrations to the ring and the normalizers
    # (state, key, number N) -> outcomes [N] of the deterministic policy on this device
    evaluate: Callable[[TrainState, PRNGKey, int], evaluate.Outcome]
    spec: EnvSpec
    learner: Learner
    replay_bytes: int  # size of one run's ring on a device
    axis_name: AxisName = None


@dataclasses.dataclass(frozen=True)
class Loop:
    """Components of a training loop. Static."""

    env: Env
    spec: EnvSpec
    config: Config
    sampler: Sampler
    priority: Priority
    generator: GoalsFn | None
    learner: Learner
    template: Episode  # shapes and dtypes of an episode
    axis_name: AxisName
    augment: Callable[..., Batch] | None  # (batch, key=key) -> batch

    @property
    def num_episodes(self) -> int:
        """Episodes E that the ring holds."""
        return config_lib.episodes_capacity(self.config, self.spec.episode_length)

    @property
    def uses_values(self) -> bool:
        return self.priority.uses_values or getattr(self.generator, "uses_values", False)

    @property
    def updates_per_round(self) -> int:
        """Updates until both targets and actor have moved."""
        return max(self.config.target_period, learners.policy_delay(self.learner))

    @property
    def rounds_per_draw(self) -> int:
        """Rounds whose batches are drawn together: as many as MAX_TRANSITIONS_PER_DRAW allows, at least one."""
        rounds = self.config.updates_per_cycle // self.updates_per_round
        most = max(1, MAX_TRANSITIONS_PER_DRAW // (self.updates_per_round * self.config.batch_size))
        return next(divisor for divisor in range(min(rounds, most), 0, -1) if rounds % divisor == 0)


def make_train(
    env: Env,
    config: Config,
    *,
    sampler: Sampler | LogWeightsFn | None = None,
    priority: Priority | PriorityFn | None = None,
    generator: GoalsFn | None = None,
    learner: Learner | str | None = None,
    axis_name: AxisName = None,
) -> Train:
    """Makes the training loop of an environment: pure functions to compile, and to vmap over seeds and HParams.

    `init(key, hparams)` makes a TrainState. `epoch(train_state)` plays and learns for `cycles_per_epoch` cycles, evaluates,
    and returns the next TrainState and scalar metrics, which docs/logs.md lists.

    Args:
      config: sizes, per device if several devices share the run.
      sampler: sampler of hindsight goals, or a function like `Sampler.log_weights`. Default: `future`.
      priority: priority, for `hparams.priority_fraction` of each batch. Default: `eventful`.
      generator: generator of the goals of training episodes. Default: the reset's goals.
      learner: a learner made from the same `config`, or the name of a built-in one. Default: `ddpg`.
      axis_name: axis of the devices that share the run. They call `init` and `epoch` inside `jax.shard_map` over it with the
        same key, and average gradients and metrics. Each has its own environments, ring and batches.

    Raises:
      ValueError: invalid argument. `init` raises it for invalid numbers that are not traced, and `epoch`, while it is traced,
        for arrays of the wrong shape.
    """
    spec, template = spec_and_template(env)
    if not isinstance(config, Config):
        raise ValueError(f"config must be a Config; got {config!r}")
    validation.validate(config, HParams(), spec.episode_length)
    if learner is None or isinstance(learner, str):
        learner = learners.make("ddpg" if learner is None else learner, config, spec)
    learners.check_methods(learner, learner)
    loop = Loop(
        env=env,
        spec=spec,
        config=config,
        sampler=samplers.make("future" if sampler is None else sampler),
        priority=priorities.whole(priorities.make("eventful" if priority is None else priority)),
        generator=generator,
        learner=learner if axis_name is None else learners.over_axis(learner, axis_name),
        template=template,
        axis_name=axis_name,
        augment=_augment(config, env),
    )
    if problem := validation.delay_problem(config, learners.policy_delay(loop.learner)):
        raise ValueError(problem)
    if generator is not None:
        check_function("generator", generator, ("key", "obs", "ring", "context"))
        check_with_goal(env)
    if loop.uses_values:
        learners.check_values(loop.learner)
    init, epoch, add = functools.partial(_init, loop), functools.partial(_epoch, loop), functools.partial(_add_episodes, loop)
    nbytes = replay.nbytes(loop.template, loop.num_episodes)
    return Train(init, epoch, add, functools.partial(_evaluate, loop), spec, loop.learner, nbytes, axis_name)


def _augment(config: Config, env: Env) -> Callable[..., Batch] | None:
    if config.augmentation == "none":
        return None
    from mjx_dher import mirror  # only runs with mirror images need it

    return functools.partial(mirror.half, mirror=mirror.of_env(env))


def _init(loop: Loop, key: PRNGKey, hparams: HParams) -> TrainState:
    validation.validate(loop.config, hparams, loop.spec.episode_length)  # traced numbers are not checked
    key, learner_key = jax.random.split(key)
    return TrainState(
        learner=loop.learner.init(learner_key),
        replay=replay.init(loop.template, loop.num_episodes, loop.spec.ends),
        hparams=as_arrays(hparams),
        key=key,
        env_steps=jnp.zeros((), jnp.int32),
    )


def _add_episodes(loop: Loop, state: TrainState, episodes: Episode) -> TrainState:
    """Adds an equal number of the episodes on each device."""
    rows = split.own_rows(episodes.action.shape[0], loop.axis_name)
    episodes = jax.tree.map(lambda x: jnp.asarray(x)[rows], episodes.filled())
    context = _context(loop, state.learner, state.hparams, jnp.zeros(()))
    ring = replay.add(state.replay, episodes, priorities.weights(loop.priority, episodes, context))
    key = split.own_key(jax.random.fold_in(state.key, ADD), loop.axis_name)
    learner, _ = _update_normalizers(loop, state.learner, episodes, jnp.ones(len(rows), bool), context, key)
    if loop.config.renewals:  # a cycle may then renew its own episodes alone
        context = _context(loop, learner, state.hparams, jnp.zeros(()))
        ring = priorities.renew(loop.priority, ring, context, _rows_to_renew(loop, state, ring, len(rows)))
    return dataclasses.replace(state, learner=learner, replay=ring)


def _epoch(loop: Loop, state: TrainState) -> tuple[TrainState, Metrics]:
    state, cycles = jax.lax.scan(lambda state, _: _cycle(loop, state), state, length=loop.config.cycles_per_epoch)
    key, eval_key = jax.random.split(state.key)
    discarded = split.total(jnp.sum(cycles.pop("discarded_episodes"), dtype=jnp.int32), loop.axis_name)
    outcome = _evaluate(loop, state, eval_key, loop.config.eval_episodes)
    trained, tested = split.total((jnp.sum(cycles.pop("train_return_mean"), axis=0), evaluate.returns(outcome)), loop.axis_name)
    means = split.mean(jax.tree.map(lambda x: replay.mean(x, len(x)), cycles), loop.axis_name)
    evaluated = split.mean((evaluate.summary(outcome), evaluate.faults(outcome)), loop.axis_name)
    returns = {"return_mean": tested[0] / tested[1], "train_return_mean": trained[0] / trained[1]}  # NaN without valid episodes
    faults = {name: jnp.maximum(means[name], share) for name, share in evaluated[1].items()} | {"discarded_episodes": discarded}
    own = loop.learner.summary(state.learner)
    learners.check_metrics("summary", own, means)
    return dataclasses.replace(state, key=key), evaluated[0] | means | returns | own | faults


def _cycle(loop: Loop, state: TrainState) -> tuple[TrainState, Metrics]:
    """Rolls out, adds to the ring, updates the normalizers and learns."""
    env, config, hparams = loop.env, loop.config, state.hparams
    key, *keys = jax.random.split(state.key, 5)
    rollout_key, noise_key, normalizer_key, learn_key = (split.own_key(own, loop.axis_name) for own in keys)

    def policy(noise: Any, obs: GoalObs) -> Array:
        return loop.learner.explore(state.learner, obs, noise, hparams)

    noise = loop.learner.noise(noise_key, env.episode_length, config.num_envs, hparams)
    learners.check_noise(noise, env.episode_length, config.num_envs)
    steps = config.num_envs * env.episode_length  # if no episode ends early
    updates = state.env_steps // steps * config.updates_per_cycle
    before = _context(loop, state.learner, hparams, updates)
    goals = _goals(loop, state, before)
    episodes, outcome = rollout(env, policy, rollout_key, config.num_envs, noise, goals, loop.spec)
    weights = priorities.weights(loop.priority, episodes, before)
    ring = replay.add(state.replay, episodes, weights, outcome.valid)
    learner, relabelled = _update_normalizers(loop, state.learner, episodes, outcome.valid, before, normalizer_key)
    context = _context(loop, learner, anneal(hparams, before.progress), updates)
    ring = priorities.renew(loop.priority, ring, context, _rows_to_renew(loop, state, ring, config.num_envs))
    learned, losses = _learn(loop, learner, ring, context, learn_key)
    # While the ring is empty, nothing is learned.
    can_learn = split.all_true(replay.can_sample(ring), loop.axis_name)
    learner = jax.tree.map(lambda new, old: jnp.where(can_learn, new, old), learned, learner)
    metrics = {
        "train_success_rate": jnp.mean(outcome.success),
        "train_return_mean": evaluate.returns(outcome),  # sum and number
        "discarded_episodes": jnp.sum(~outcome.valid, dtype=jnp.int32),
        "priority_mean": priorities.mean(loop.priority, ring, weights, outcome.valid, context),
        **({"train_length_mean": jnp.mean(outcome.length, dtype=jnp.float32)} if loop.spec.ends else {}),
        **evaluate.faults(outcome),
        **relabelled,
        **losses,
    }
    return TrainState(learner=learner, replay=ring, hparams=hparams, key=key, env_steps=state.env_steps + steps), metrics


def _context(loop: Loop, learner: PyTree, hparams: HParams, updates: Array) -> Context:
    progress = jnp.asarray(updates / config_lib.num_updates(loop.config, loop.spec.episode_length), jnp.float32)
    values = learners.values_of(loop.learner, learner, hparams) if loop.uses_values else None
    return context_lib.of_env(loop.env, hparams, progress=progress, updates=updates, values=values)


def _rows_to_renew(loop: Loop, state: TrainState, ring: ReplayState, new: int) -> Array | None:
    """Rows whose priorities to renew after `new` episodes were added, or None for all."""
    number = loop.config.renewals * new
    if loop.priority.renew is None or not loop.priority.by_part or not 0 < number < replay.capacity(ring):
        return None
    key = split.own_key(jax.random.fold_in(state.key, RENEW), loop.axis_name)
    return replay.newest_and_others(ring, key, new, number - new)


def _goals(loop: Loop, state: TrainState, context: Context) -> Callable[[GoalObs], Array] | None:
    """Function from a rollout's initial observations to its goals. Goals that are not finite are replaced by the reset's."""
    generator = loop.generator
    if generator is None:
        return None
    key = split.own_key(jax.random.fold_in(state.key, GENERATE), loop.axis_name)

    def goals_of(obs: GoalObs) -> Array:
        own = obs["desired_goal"]
        # A start that is not finite, of an episode to discard, must not spoil the goals of the others.
        seen = jax.tree.map(lambda x: jnp.nan_to_num(x, posinf=0.0, neginf=0.0), obs)
        goals = check.array("generator: goals [N, G]", generator(key, seen, state.replay, context), own.shape)
        return jnp.where(jnp.all(jnp.isfinite(goals), axis=-1, keepdims=True), goals.astype(own.dtype), own)

    return goals_of


def _update_normalizers(
    loop: Loop, learner: PyTree, episodes: Episode, valid: Array, context: Context, key: PRNGKey
) -> tuple[PyTree, Metrics]:
    """Updates the normalizers with relabelled goals, so that the statistics match training batches."""
    num_new, num_steps = episodes.action.shape[:2]
    fresh = replay.add(replay.init(loop.template, num_new, loop.spec.ends), episodes, valid=valid)
    sample_key, relabel_key = jax.random.split(key)
    sample = replay.sample(fresh, sample_key, num_new * num_steps)
    sample = add_pool(fresh, sample, loop.sampler, relabel_key)
    batch, no_goal_share = relabel(sample, loop.sampler, context, relabel_key)
    if loop.spec.ends:  # not what follows the end
        valid = valid[:, None] & (jnp.arange(num_steps + 1) <= episodes.length[:, None])
    updated = loop.learner.update_normalizers(learner, episodes.observation, batch.desired_goal, context.hparams, valid)
    check.kept("learner.update_normalizers", learner, updated)
    return updated, {**_relabel_metrics(context, sample.desired_goal, batch.desired_goal), "no_goal_share": no_goal_share}


def _relabel_metrics(context: Context, goal: Array, hindsight: Array) -> Metrics:
    """Fraction of goals [B, G] that were replaced, and their mean distance to the hindsight goals."""
    replaced = jnp.any(hindsight != goal, axis=-1).astype(jnp.float32)
    distance = jnp.sum(context.goal_distance(hindsight, goal)) / jnp.maximum(jnp.sum(replaced), 1.0)
    return {"relabelled_share": jnp.mean(replaced), "relabel_distance": distance}


def _learn(loop: Loop, learner: PyTree, ring: ReplayState, context: Context, key: PRNGKey) -> tuple[PyTree, Metrics]:
    """Makes a cycle's updates. Because the ring does not change, many batches are drawn together.

    On a GPU, drawing one batch takes twice as long as learning from it, and drawing 40 takes hardly longer.
    """
    config, weights = loop.config, replay.cumulative(ring)
    shape = (loop.rounds_per_draw, loop.updates_per_round, config.batch_size)
    update = functools.partial(learners.update_round, loop.learner, config.target_period, context.hparams)

    def draw_and_update(learner: PyTree, key: PRNGKey) -> tuple[PyTree, Metrics]:
        batches = draw_batches(ring, key, shape, loop.sampler, context, weights, config.n_step, loop.priority)
        if loop.augment is not None:
            batches = loop.augment(batches, key=jax.random.fold_in(key, _AUGMENT))
        return jax.lax.scan(update, learner, batches)

    keys = jax.random.split(key, config.updates_per_cycle // (loop.updates_per_round * loop.rounds_per_draw))
    learner, losses = jax.lax.scan(draw_and_update, learner, keys)
    return learner, jax.tree.map(jnp.mean, losses)


def _evaluate(loop: Loop, state: TrainState, key: PRNGKey, num_episodes: int) -> evaluate.Outcome:
    def act(obs: GoalObs) -> Array:
        return loop.learner.act(state.learner, obs, state.hparams)

    return evaluate.evaluate(loop.env, act, split.own_key(key, loop.axis_name), num_episodes, loop.spec)


def anneal(hparams: HParams, progress: Array | float) -> HParams:
    """Numbers after a fraction `progress` of the run's updates: learning rates fall linearly to `lr_end`."""
    left: Any = 1.0 - (1.0 - hparams.lr_end) * jnp.minimum(progress, 1.0)
    return hparams._replace(actor_lr=hparams.actor_lr * left, critic_lr=hparams.critic_lr * left)


def as_arrays(hparams: HParams) -> HParams:
    """Converts the numbers to float32 arrays."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), hparams)


def is_finite(learner: PyTree) -> Array:
    """Whether all floats of a learner's state are finite, bool []. Otherwise the run has diverged for good."""
    floats = [leaf for leaf in jax.tree.leaves(learner) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.asarray([jnp.all(jnp.isfinite(leaf)) for leaf in floats], bool))
