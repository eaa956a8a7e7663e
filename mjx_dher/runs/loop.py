"""Runs a training loop: compiles it, checks that it fits into memory, and calls it epoch by epoch."""

import concurrent.futures
import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_dher import config as config_lib
from mjx_dher import validation
from mjx_dher.config import Config, HParams
from mjx_dher.contract import check_steps
from mjx_dher.parallel import mesh, processes
from mjx_dher.parallel.mesh import ONE, Layout
from mjx_dher.system import machine
from mjx_dher.trainer import Train, TrainState, as_arrays, is_finite, make_train
from mjx_dher.types import Array, Env, Metrics, PRNGKey

# Updates, summed over parallel runs, from which the compiler's search for the fastest matrix products pays. On one H100 it
# takes half a minute and shortens Push's epochs to 0.83 (docs/design.md).
WORTH_A_SEARCH = 500_000
# Option for the operations that XLA hands over to YNNPACK on a CPU.
_YNN, _PRODUCTS = "xla_cpu_experimental_ynn_fusion_type", "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"


class Start(NamedTuple):
    """Point from which a run, or L parallel runs, start or resume."""

    state: TrainState
    epoch: int = 0  # epochs that have ended
    wall_seconds: float = 0.0


class Progress(NamedTuple):
    """Progress of a run, or of L parallel runs, after an epoch."""

    epoch: int  # from 1
    num_epochs: int
    env_steps: int  # per run
    updates: int  # per run
    wall_seconds: float  # since the first epoch began, without compilation
    epoch_seconds: float
    metrics: dict[str, Any]  # floats, or arrays [L] for parallel runs
    state: TrainState  # valid until the next epoch begins, which reuses its memory
    finite: Any  # [] or [L] bool, whether all of the learner's floats are finite


class Compiled(NamedTuple):
    """A compiled training loop."""

    init: Callable[[PRNGKey, HParams], TrainState]
    epoch: Callable[[TrainState], tuple[TrainState, Metrics, Array]]  # the last as `Progress.finite`
    nbytes: int  # memory of an epoch per device, planned by the compiler; 0 if unknown


def train(
    env: Env,
    config: Config,
    hparams: HParams | None = None,
    seed: int = 0,
    start: Start | None = None,
    devices: int | str = 1,
    **parts: Any,
) -> Iterator[Progress]:
    """Trains one run without a folder, yielding after every epoch.

    `train_runs` adds folders, checkpoints, logs and parallel runs.

    Args:
      start: point to resume from, as returned by `restoring.restore`.
      devices: number of devices that share the run, or "all". Each has an equal part of environments, ring and batches.
      **parts: sampler, priority and learner, as in `make_train`.

    Raises:
      ValueError: invalid Config, HParams or seed, nothing left to train, too little memory, missing devices, or an error of
        `env.check`.
    """
    hparams = HParams() if hparams is None else hparams
    validation.validate(config, hparams, env.episode_length)
    validation.check_seed(config_lib.plain(seed))
    refuse_ended(config, env.episode_length, [] if start is None else [start.epoch])
    layout = mesh.arrange(mesh.find(devices), 1)
    validation.check_plan(config, env.episode_length, layout.shards)
    program = make_train(env, config_lib.of_one_device(config, layout.shards), axis_name=layout.axis_name, **parts)
    key = jax.random.key(seed)
    check_memory(program, config, layout.sharers)
    compiled = compile_program(program, key, hparams, config_lib.num_updates(config, env.episode_length), layout)
    check_program(compiled, config, layout.sharers)
    check_steps(env)
    for progress in run(env, config, compiled, start or Start(compiled.init(key, hparams))):
        yield progress._replace(metrics={name: float(f"{x:.6g}") for name, x in progress.metrics.items()})


def refuse_ended(config: Config, episode_length: int, ended: Sequence[int]) -> None:
    """Raises ValueError if all epochs of `total_steps` had `ended` at each checkpoint, of which the newest may be damaged."""
    if ended and min(ended) >= (num_epochs := config_lib.num_epochs(config, episode_length)):
        raise ValueError(
            f"nothing is left to train: {max(ended)} epochs have ended, and total_steps {config.total_steps} takes {num_epochs}"
        )


def run(env: Env, config: Config, compiled: Compiled, start: Start) -> Iterator[Progress]:
    """Runs a compiled program, yielding after every epoch. Metrics stay arrays.

    The device works in its own thread, so signal handlers can run during an epoch. Raises ValueError for an error of
    `env.check` after an epoch.
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
            state, *told = running.result()
            check_steps(env)
            metrics, finite = processes.fetch(told)
            now = time.perf_counter()
            yield Progress(
                *_counts(env, config, number),
                wall_seconds=now - started,
                epoch_seconds=now - previous,
                metrics=metrics,
                state=state,
                finite=np.asarray(finite),
            )
            previous = time.perf_counter()


def resumed(env: Env, config: Config, start: Start) -> Progress:
    """Progress of a run at its start or checkpoint, without metrics."""
    return Progress(*_counts(env, config, start.epoch), start.wall_seconds, 0.0, {}, start.state, np.asarray(True))


def _counts(env: Env, config: Config, epoch: int) -> tuple[int, int, int, int]:
    """The first four fields of `Progress`."""
    steps = epoch * config_lib.steps_per_epoch(config, env.episode_length)
    updates = epoch * config.cycles_per_epoch * config.updates_per_cycle
    return epoch, config_lib.num_epochs(config, env.episode_length), steps, updates


def compile_program(program: Train, key: PRNGKey, hparams: HParams, updates: int = 0, layout: Layout = ONE) -> Compiled:
    """Compiles `program` for one run, or for L parallel runs if `key` and `hparams` lead with [L]. Their values do not matter.
    If each run makes many `updates`, the compiler searches longer.
    """

    def epoch_and_check(state: TrainState) -> tuple[TrainState, Metrics, Array]:
        state, metrics = program.epoch(state)
        return state, metrics, is_finite(state.learner)

    search = updates * (key.shape[0] if key.ndim else 1) // layout.lanes >= WORTH_A_SEARCH
    init, epoch = (jax.vmap(program.init), jax.vmap(epoch_and_check)) if key.ndim else (program.init, epoch_and_check)
    arguments: tuple[Any, Any] = key, as_arrays(hparams)
    if layout.devices:
        from mjx_dher.parallel import sharded

        init, epoch = sharded.place_init(layout, init, bool(key.ndim)), sharded.place_epoch(layout, epoch, bool(key.ndim))
        arguments = mesh.to_host(*arguments)
        state = init.eval_shape(*arguments)
    else:
        state = jax.eval_shape(init, *arguments)
        init, epoch = jax.jit(init), jax.jit(epoch, donate_argnums=0)
    lowered_init = init.lower(*arguments)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        compiling = pool.submit(compile_lowered, lowered_init)
        lowered = epoch.lower(state)
        compiled = compile_lowered(lowered, search)
        compiled_init = compiling.result()
    nbytes, sizes = 0, compiled.memory_analysis()
    if sizes is not None:
        held = sizes.argument_size_in_bytes + sizes.output_size_in_bytes - sizes.alias_size_in_bytes
        nbytes = held + sizes.temp_size_in_bytes
    machine.release()

    def start(key: PRNGKey, hparams: HParams) -> TrainState:
        return compiled_init(*(mesh.to_host(key, as_arrays(hparams)) if layout.devices else (key, as_arrays(hparams))))

    return Compiled(init=start, epoch=compiled, nbytes=nbytes)


def compile_lowered(lowered: jax.stages.Lowered, search: bool = False, plain: bool = False) -> jax.stages.Compiled:
    """Compiles a lowered function without passes that take long and gain little.

    Args:
      lowered: result of `jax.jit(...).lower`.
      search: whether to search for the fastest matrix products on a GPU, by timing Triton's with many tilings.
      plain: whether to skip optimizations on a CPU, for programs whose time is spent in physics.

    On a GPU, one pass turns anything like a softmax, such as a norm, into Triton kernels and then weighs many fusions, from
    which a learner gains nothing. On a CPU, XLA hands small sums to a library (YNNPACK), whose calls take longer than the
    sums: layer normalization made updates two to three times slower. Only matrix products are handed over here.
    """
    options: dict[str, Any] = {}
    if jax.default_backend() == "cpu":
        if plain:
            options |= {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
        if _YNN not in os.environ.get("XLA_FLAGS", ""):
            options[_YNN] = _PRODUCTS
    if jax.default_backend() == "gpu":
        options["xla_disable_hlo_passes"] = "triton-softmax-rewriter"
        if "xla_gpu_enable_triton_gemm" not in os.environ.get("XLA_FLAGS", ""):
            options["xla_gpu_enable_triton_gemm"] = search
    try:
        return lowered.compile(compiler_options=options)
    except jax.errors.JaxRuntimeError as error:
        if _YNN not in options or _YNN not in str(error):
            raise
    del options[_YNN]  # this version of the compiler lacks the option, which is experimental
    return lowered.compile(compiler_options=options)


def state_template(program: Train) -> TrainState:
    """Shapes and dtypes of a run's TrainState, for `restoring.restore`."""
    return jax.eval_shape(program.init, jax.random.key(0), as_arrays(HParams()))


def check_memory(program: Train, config: Config, sharers: int = 1) -> None:
    """Raises ValueError, before compilation, if ring or networks do not fit into the memory that `sharers` devices share.

    The message has the needed and the free memory and, for the ring, a replay_size that fits.
    """
    available = machine.available_bytes()
    if available is None:
        return
    free = f"but only {machine.format_bytes(available)} of memory is free"
    ring = sharers * program.replay_bytes
    if ring > available:
        fitting = int(config.replay_size * available / ring)
        needed = machine.format_bytes(ring)
        raise ValueError(f"replay_size {config.replay_size} needs {needed}, {free}; at most {fitting} transitions fit")
    shapes = jax.tree.leaves(jax.eval_shape(program.learner.init, jax.random.key(0)))
    nbytes = sharers * sum(leaf.size * leaf.dtype.itemsize for leaf in shapes)
    if nbytes > available:
        raise ValueError(f"hidden_sizes {config.hidden_sizes}: the learner needs {machine.format_bytes(nbytes)}, {free}")


def check_program(compiled: Compiled, config: Config, sharers: int = 1) -> None:
    """Raises ValueError if a compiled program does not fit into the memory that `sharers` devices share.

    The message has the needed and the free memory and the settings that decide it.
    """
    available = machine.available_bytes()
    nbytes = sharers * compiled.nbytes
    if available is not None and nbytes > available:
        settings = ("num_envs", "batch_size", "hidden_sizes", "replay_size", "eval_episodes")
        raise ValueError(
            f"an epoch needs {machine.format_bytes(nbytes)}, but only {machine.format_bytes(available)} of memory"
            f" is free; it depends on {', '.join(f'{name} {getattr(config, name)}' for name in settings)}"
        )
