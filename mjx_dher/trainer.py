"""The training loop as two pure functions, `init` and `epoch`, that compile and vmap."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_dher import config as config_lib
from mjx_dher import evaluate, replay, samplers
from mjx_dher.config import Config, HParams
from mjx_dher.hopper import gradients as hopper
from mjx_dher.host import memory
from mjx_dher.learners import ddpg
from mjx_dher.learners.ddpg import DDPGState, Losses, Networks
from mjx_dher.networks import Actor, Critic
from mjx_dher.relabel import draw_batches, is_eventful, relabel
from mjx_dher.replay import ReplayState
from mjx_dher.rollout import rollout
from mjx_dher.samplers import Sampler
from mjx_dher.types import Array, Batch, Env, Episode, GoalObs, PRNGKey

# Transitions, at most, but for a single batch and those up to a target update. More would not fit a CPU's cache.
DRAWN_AT_ONCE = 16_384


@struct.dataclass
class TrainState:
    """A run in progress, whole: the next epoch depends on nothing else."""

    learner: DDPGState
    replay: ReplayState
    hparams: HParams
    key: PRNGKey
    env_steps: Array  # [] int32


# Scalars of an epoch, by name; see `make_train`.
Metrics = dict[str, Array]


class Train(NamedTuple):
    """What `make_train` returns."""

    init: Callable[[PRNGKey, HParams], TrainState]
    epoch: Callable[[TrainState], tuple[TrainState, Metrics]]
    networks: Networks
    replay_bytes: int  # of one run's ring


def make_train(env: Env, config: Config, sampler: Sampler | None = None) -> Train:
    """The training loop for an environment: pure functions, to be compiled and, over seeds and HParams, vmapped.

    Hindsight goals are chosen by `sampler`, or else by the one that `config` names. `config.env` is not read.

    `init(key, hparams)` makes a TrainState. `epoch(train_state)` plays and learns for `cycles_per_epoch` cycles, evaluates,
    and returns the next TrainState with these metrics, each []: success_rate, reset_success_rate and return_mean of the
    evaluation; train_success_rate and train_return_mean of the exploring policy, and the eventful_share of its episodes;
    of the transitions in them, the relabelled_share and, over these, relabel_distance, the mean Euclidean distance from the
    episode's goal to the hindsight goal; critic_loss, actor_loss and q_mean; actor_norm and critic_norm, the Euclidean norms of
    all parameters at the end; discarded_episodes, of which the physics blew up and which were not learned from.

    Raises:
      ValueError: a Config that cannot run, here or at all, or an observation that is not one vector.
    """
    config_lib.validate(config, HParams(), env.episode_length)
    chosen = samplers.make(config.sampler, config.weight_kernel, config.metric) if sampler is None else sampler
    networks, learning = (_networks(env.action_size, config.hidden_sizes, dtype) for dtype in ("float32", config.learner_dtype))
    template = episode_template(env)
    gradients = _gradients(config, template, env.action_size)
    num_episodes = config_lib.episodes_capacity(config, env.episode_length)
    targets_per_cycle = config.updates_per_cycle // config.target_period
    # Batches are drawn many at once: on a GPU, drawing one takes twice as long as learning from it, and 40 hardly longer.
    targets_at_once = _largest_divisor(targets_per_cycle, DRAWN_AT_ONCE // (config.target_period * config.batch_size))
    num_cycles = config_lib.num_epochs(config, env.episode_length) * config.cycles_per_epoch

    def init(key: PRNGKey, hparams: HParams) -> TrainState:
        key, learner_key = jax.random.split(key)
        return TrainState(
            learner=ddpg.init(
                learner_key,
                networks,
                observation_size=template.observation.shape[-1],
                goal_size=template.desired_goal.shape[-1],
                action_size=env.action_size,
            ),
            replay=replay.init(template, num_episodes),
            hparams=_arrays(hparams),
            key=key,
            env_steps=jnp.zeros((), jnp.int32),
        )

    def see(learner: DDPGState, episodes: Episode, valid: Array, hparams: HParams, key: PRNGKey) -> tuple[DDPGState, Metrics]:
        """Shows the new episodes to the normalizers, with goals distributed as the learner will meet them."""
        num_new, num_steps = episodes.action.shape[:2]
        fresh = replay.add(replay.init(template, num_new), episodes, valid=valid)
        sample_key, relabel_key = jax.random.split(key)
        sample = replay.sample(fresh, sample_key, num_new * num_steps)
        batch = relabel(fresh, sample, chosen, env.compute_reward, hparams, relabel_key)
        learner = ddpg.update_normalizers(learner, episodes.observation, batch.desired_goal, hparams, valid)
        return learner, _moved(sample.desired_goal, batch.desired_goal)

    def learn(learner: DDPGState, ring: ReplayState, hparams: HParams, key: PRNGKey) -> tuple[DDPGState, Losses]:
        counts = replay.count_eventful(ring)
        hparams = anneal(hparams, learner.num_updates / (num_cycles * config.updates_per_cycle))

        def update(learner: DDPGState, batch: Batch) -> tuple[DDPGState, Losses]:
            return ddpg.update(learning, learner, batch, hparams, gradients)

        def update_with_target(learner: DDPGState, batches: Batch) -> tuple[DDPGState, Losses]:
            learner, losses = jax.lax.scan(update, learner, batches)
            return ddpg.update_target(learner, hparams), losses

        def draw_and_update(learner: DDPGState, key: PRNGKey) -> tuple[DDPGState, Losses]:
            shape = (targets_at_once, config.target_period, config.batch_size)
            batches = draw_batches(ring, key, shape, chosen, env.compute_reward, hparams, counts)
            return jax.lax.scan(update_with_target, learner, batches)

        keys = jax.random.split(key, targets_per_cycle // targets_at_once)
        learner, losses = jax.lax.scan(draw_and_update, learner, keys)
        return learner, jax.tree.map(jnp.mean, losses)

    def cycle(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, rollout_key, noise_key, see_key, learn_key = jax.random.split(state.key, 5)
        hparams = state.hparams

        def policy(noise: ddpg.Noise, obs: GoalObs) -> Array:
            return ddpg.explore(noise, ddpg.act(networks, state.learner, obs, hparams))

        noise = ddpg.exploration_noise(noise_key, env.episode_length, config.num_envs, env.action_size, hparams)
        episodes, outcome = rollout(env, policy, rollout_key, config.num_envs, noise)
        eventful = is_eventful(episodes, env.compute_reward)
        ring = replay.add(state.replay, episodes, eventful, outcome.valid)
        learner, seen = see(state.learner, episodes, outcome.valid, hparams, see_key)
        learned, losses = learn(learner, ring, hparams, learn_key)
        # No episode yet: nothing was learned.
        learner = jax.tree.map(lambda new, old: jnp.where(replay.can_sample(ring), new, old), learned, learner)
        metrics = {
            "train_success_rate": jnp.mean(outcome.success),
            "train_return_mean": evaluate.return_mean(outcome),
            "discarded_episodes": jnp.sum(~outcome.valid),
            "eventful_share": jnp.mean(eventful),
            **seen,
            **losses._asdict(),
        }
        state = TrainState(
            learner=learner,
            replay=ring,
            hparams=hparams,
            key=key,
            env_steps=state.env_steps + config.num_envs * env.episode_length,
        )
        return state, metrics

    def epoch(state: TrainState) -> tuple[TrainState, Metrics]:
        state, cycles = jax.lax.scan(cycle, state, length=config.cycles_per_epoch)
        key, eval_key = jax.random.split(state.key)
        discarded = jnp.sum(cycles.pop("discarded_episodes"))
        found = evaluate_state(env, networks, state, eval_key, config.eval_episodes)
        metrics = found | jax.tree.map(jnp.mean, cycles) | _norms(state.learner) | {"discarded_episodes": discarded}
        return dataclasses.replace(state, key=key), metrics

    return Train(init=init, epoch=epoch, networks=networks, replay_bytes=replay.nbytes(template, num_episodes))


def _networks(action_size: int, hidden_sizes: tuple[int, ...], dtype: str) -> Networks:
    """Both networks; those of another dtype have the same parameters."""
    return Networks(actor=Actor(action_size, hidden_sizes, jnp.dtype(dtype)), critic=Critic(hidden_sizes, jnp.dtype(dtype)))


def _gradients(config: Config, template: Episode, action_size: int) -> ddpg.GradientFn:
    """What computes an update's gradients, as `learner_kernels` says.

    Raises:
      ValueError: kernels that cannot compute this run's.
    """
    if config.learner_kernels == "xla":
        return ddpg.compute_gradients
    problem = hopper.unsupported_reason(config, template.observation.shape[-1] + template.desired_goal.shape[-1], action_size)
    if config.learner_kernels == "hopper" and problem is not None:
        raise ValueError(f"learner_kernels hopper needs {problem}")
    return hopper.compute_gradients if problem is None else ddpg.compute_gradients


def _moved(goal: Array, hindsight: Array) -> Metrics:
    """The share of goals [B, G] that were replaced, and how far away, in the mean, those are that took their place."""
    distance = jnp.linalg.norm(hindsight - goal, axis=-1)
    replaced = (distance > 0).astype(jnp.float32)
    return {
        "relabelled_share": jnp.mean(replaced),
        "relabel_distance": jnp.sum(distance) / jnp.maximum(jnp.sum(replaced), 1.0),
    }


def _norms(learner: DDPGState) -> Metrics:
    params = learner.params
    return {"actor_norm": optax.tree.norm(params.actor), "critic_norm": optax.tree.norm(params.critic)}


def evaluate_state(env: Env, networks: Networks, state: TrainState, key: PRNGKey, num_episodes: int) -> Metrics:
    """Plays the learner's policy without exploration: success_rate, reset_success_rate and return_mean, each []."""
    outcome = evaluate.evaluate(env, lambda obs: ddpg.act(networks, state.learner, obs, state.hparams), key, num_episodes)
    return evaluate.summary(outcome)


def _largest_divisor(number: int, limit: int) -> int:
    """The largest divisor of `number` up to `limit`; at least 1."""
    return next(divisor for divisor in range(max(1, min(number, limit)), 0, -1) if number % divisor == 0)


def anneal(hparams: HParams, progress: Array | float) -> HParams:
    """The numbers once a share `progress` of the run's updates is done: step sizes fall linearly to `lr_end` of themselves."""
    left: Any = 1.0 - (1.0 - hparams.lr_end) * jnp.minimum(progress, 1.0)
    return hparams._replace(actor_lr=hparams.actor_lr * left, critic_lr=hparams.critic_lr * left)


def state_template(program: Train) -> TrainState:
    """The shapes and types of a run's TrainState, for `checkpoint.restore`."""
    return jax.eval_shape(program.init, jax.random.key(0), _arrays(HParams()))


@jax.jit
def is_finite(learner: DDPGState) -> Array:
    """[] whether all of the learner's numbers are: once they are not, no epoch will mend them."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(learner)]))


def episode_template(env: Env) -> Episode:
    """The shapes and types of one episode of `env`, without running it.

    Raises:
      ValueError: the observation is not a single vector.
    """
    obs = jax.eval_shape(env.reset, jax.random.key(0)).obs
    observation = obs["observation"]
    if not (hasattr(observation, "shape") and len(observation.shape) == 1):
        raise ValueError(f"the learner takes observations of one vector [D]; this environment gives {observation}")

    def repeat(x: Any, times: int) -> Any:
        return jax.ShapeDtypeStruct((times, *x.shape), x.dtype)

    num_steps = env.episode_length
    return Episode(
        observation=repeat(observation, num_steps + 1),
        achieved_goal=repeat(obs["achieved_goal"], num_steps + 1),
        desired_goal=obs["desired_goal"],
        action=repeat(jax.ShapeDtypeStruct((env.action_size,), jnp.float32), num_steps),
    )


class Start(NamedTuple):
    """Where a run, or L side by side, goes on from."""

    state: TrainState
    epoch: int = 0  # epochs that have ended
    wall_seconds: float = 0.0


class Progress(NamedTuple):
    """Where a run is after an epoch, or L runs side by side."""

    epoch: int  # from 1
    num_epochs: int
    env_steps: int  # of each run
    updates: int  # of each run
    wall_seconds: float  # since the first epoch began: compilation is not counted
    epoch_seconds: float
    metrics: dict[str, Any]  # a float each; of runs side by side an array [L] each
    state: TrainState  # valid until the next epoch begins, which takes over its memory


def train(
    env: Env,
    config: Config,
    hparams: HParams | None = None,
    seed: int = 0,
    on_compile: Callable[[float | None], None] = lambda seconds: None,
    start: Start | None = None,
) -> Iterator[Progress]:
    """Trains, yielding after every epoch. Stop by not asking for more.

    The device works in a thread of its own, so that the caller's signal handlers run while an epoch is under way.

    Args:
      env: the environment; `config.env` is not read.
      config: shapes and choices.
      hparams: numbers; the defaults where None.
      seed: of everything random.
      on_compile: called with None when compilation begins and with its seconds when it has ended.
      start: what to go on from, as `checkpoint.restore` gives it; a new run where None.

    Raises:
      ValueError: a Config or HParams that cannot run, a replay ring larger than the memory that is free, or what
        `env.check` raises, where the environment has one, before the first epoch or after any.
    """
    hparams = HParams() if hparams is None else hparams
    config_lib.validate(config, hparams, env.episode_length)
    program = make_train(env, config)
    check_memory(program.replay_bytes, config)
    on_compile(None)
    started = time.perf_counter()
    key = jax.random.key(seed)
    compiled = compile_program(program, key, hparams)
    check_steps(env)
    on_compile(time.perf_counter() - started)
    for progress in run(env, config, compiled, start or Start(compiled.init(key, hparams))):
        yield progress._replace(metrics={name: to_float(value) for name, value in progress.metrics.items()})


def to_float(value: Any) -> float:
    """A float32 to the digits that it has: 95 of 100 are 0.95, which float(float32) is not."""
    return float(f"{value:.6g}")


class Compiled(NamedTuple):
    """A training loop, compiled."""

    init: Callable[[PRNGKey, HParams], TrainState]
    epoch: Callable[[TrainState], tuple[TrainState, Metrics]]
    nbytes: int  # memory that an epoch takes, all told, as the compiler planned it; 0 where it does not tell


def compile_program(program: Train, key: PRNGKey, hparams: HParams) -> Compiled:
    """Compiles `program` for one run, or for L side by side where `key` and `hparams` lead with [L].

    Their values do not matter.
    """
    init, epoch = (jax.vmap(program.init), jax.vmap(program.epoch)) if key.ndim else (program.init, program.epoch)
    hparams = _arrays(hparams)
    state = jax.eval_shape(init, key, hparams)
    lowered_init = jax.jit(init).lower(key, hparams)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        compiling = pool.submit(compile_lowered, lowered_init)
        lowered = jax.jit(epoch, donate_argnums=0).lower(state)
        compiled = compile_lowered(lowered)
        compiled_init = compiling.result()
    sizes = compiled.memory_analysis()
    nbytes = 0
    if sizes is not None:
        nbytes = (
            sizes.argument_size_in_bytes + sizes.output_size_in_bytes - sizes.alias_size_in_bytes + sizes.temp_size_in_bytes
        )
    memory.release()
    return Compiled(init=lambda key, hparams: compiled_init(key, _arrays(hparams)), epoch=compiled, nbytes=nbytes)


def compile_lowered(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compiles what `jax.jit(...).lower` gave, on a GPU without a pass that can take half the time and gains a learner nothing.

    It makes Triton kernels of what looks like a softmax, as a norm does, and from then on the compiler weighs, with many
    tilings each, what else could go into them.
    """
    options: dict[str, str | bool] = {}
    if jax.default_backend() == "gpu":
        options["xla_disable_hlo_passes"] = "triton-softmax-rewriter"
    return lowered.compile(compiler_options=options)


def run(env: Env, config: Config, compiled: Compiled, start: Start) -> Iterator[Progress]:
    """Runs what `compile_program` has made, yielding after every epoch; metrics stay arrays. See `train`.

    Raises:
      ValueError: what `env.check` raises, where the environment has one, after an epoch.
    """
    num_epochs = config_lib.num_epochs(config, env.episode_length)
    state = jax.block_until_ready(start.state)
    previous = time.perf_counter()
    started = previous - start.wall_seconds
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        for number in range(start.epoch + 1, num_epochs + 1):
            running = pool.submit(lambda state: jax.block_until_ready(compiled.epoch(state)), state)
            while not running.done():
                concurrent.futures.wait([running], timeout=0.1)
            state, metrics = running.result()
            check_steps(env)
            now = time.perf_counter()
            yield Progress(
                epoch=number,
                num_epochs=num_epochs,
                env_steps=number * config_lib.steps_per_epoch(config, env.episode_length),
                updates=number * config.cycles_per_epoch * config.updates_per_cycle,
                wall_seconds=now - started,
                epoch_seconds=now - previous,
                metrics=jax.device_get(metrics),
                state=state,
            )
            previous = time.perf_counter()


def _arrays(hparams: HParams) -> HParams:
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), hparams)


def check_steps(env: Env) -> None:
    """Calls `env.check()`, where the environment has one: whether its steps so far were whole."""
    if (check := getattr(env, "check", None)) is not None:
        check()


def check_memory(replay_bytes: int, config: Config) -> None:
    """Refuses a replay ring that cannot fit.

    Raises:
      ValueError: says what the ring needs, what is free and which replay_size would fit.
    """
    available = memory.available_bytes()
    if available is not None and replay_bytes > available:
        fitting = int(config.replay_size * available / replay_bytes)
        raise ValueError(
            f"replay_size {config.replay_size} needs {memory.format_bytes(replay_bytes)}, but only"
            f" {memory.format_bytes(available)} of memory is free; at most {fitting} transitions fit"
        )
