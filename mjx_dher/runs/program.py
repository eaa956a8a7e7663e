"""A compiled program for parallel runs: lanes of one `vmap`, or one run without a lane axis."""

import collections
import concurrent.futures
import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import config as config_lib
from mjx_dher import evaluate as evaluate_lib
from mjx_dher import learners, priorities, samplers, trainer, validation
from mjx_dher import spec as spec_lib
from mjx_dher.config import HParams
from mjx_dher.contract import STEP_SECONDS, check_steps, env_spec, step_seconds
from mjx_dher.learners import Learner
from mjx_dher.parallel import mesh, processes, split
from mjx_dher.parallel.mesh import ONE, Layout
from mjx_dher.rollout import Outcome
from mjx_dher.runs import loop
from mjx_dher.runs.folder import run_folder
from mjx_dher.runs.loop import Compiled
from mjx_dher.spec import RunSpec
from mjx_dher.system import machine
from mjx_dher.trainer import Train, TrainState
from mjx_dher.types import Env, EnvSpec, PRNGKey

# HParams, and the indices of a lane's sampler, priority and generator (`context.one_of`).
Lane = collections.namedtuple("Lane", (*HParams._fields, "choice", "priority_choice", "generator_choice"))  # type: ignore[misc]
EvaluateFn = Callable[[TrainState, Any], Outcome]


class Choices(NamedTuple):
    """Components in which the lanes of a program differ, each once, in the order of the runs."""

    samplers: list[tuple[str, str, str, str]]  # arguments of samplers.make
    priorities: list[str]
    generators: list[str]

    def of(self, spec: RunSpec) -> tuple[int, int, int]:
        """Indices of a run's sampler, priority and generator."""
        sampler, priority, generator = _parts(spec)
        return self.samplers.index(sampler), self.priorities.index(priority), self.generators.index(generator)


def _parts(spec: RunSpec) -> tuple[tuple[str, str, str, str], str, str]:
    return spec.sampler_choice, spec.priority, spec.generator


def choices_of(specs: Sequence[RunSpec]) -> Choices:
    """Components used by the runs of a program."""
    return Choices(*(list(dict.fromkeys(values)) for values in zip(*map(_parts, specs))))


class Program(NamedTuple):
    """A compiled program for parallel runs."""

    lanes: int
    layout: Layout
    choices: Choices
    learner: Learner
    spec: EnvSpec
    compiled: Compiled
    evaluate: concurrent.futures.Future[EvaluateFn]  # final evaluation of each lane


def make_loop(env: Env, spec: RunSpec, choices: Choices, layout: Layout = ONE) -> Train:
    """Training loop of runs that share a program, with their components."""
    validation.check_plan(spec.config, env.episode_length, layout.shards)
    config = config_lib.of_one_device(spec.config, layout.shards)
    if any(of[2].startswith("resting_point") for of in choices.samplers) and round(step_seconds(env), 9) != STEP_SECONDS:
        raise ValueError(f"metric resting_point needs a task with a dt of {STEP_SECONDS} s; got {step_seconds(env):g} s")
    generator = None
    if set(choices.generators) != {"reset"}:
        from mjx_dher.contrib import generators

        generator = generators.join([generators.make(name) for name in choices.generators])
    train = trainer.make_train(
        env,
        config,
        sampler=samplers.join([samplers.make(*choice) for choice in choices.samplers]),
        priority=priorities.join([priorities.make(name) for name in choices.priorities]),
        generator=generator,
        learner=learners.make(spec.learner, config, env_spec(env), spec.networks),
        axis_name=layout.axis_name,
    )
    if spec.demonstrations is None:
        return train
    from mjx_dher.demonstrations import read_demonstrations

    capacity = config_lib.episodes_capacity(spec.config, env.episode_length)
    episodes = read_demonstrations(spec.demonstrations, env, capacity)
    return train._replace(init=lambda key, hparams: train.add(train.init(key, hparams), episodes))


def check_runs(
    env: Env, specs: Sequence[RunSpec], lanes: int | None = None, devices: int | str = 1, sweep: bool = False
) -> Train:
    """Training loop of runs that share a program. Raises ValueError, before compilation, if they cannot be trained."""
    for spec in specs:
        spec_lib.validate(spec, env.episode_length)
    placed_on = mesh.find(devices)
    return _plan(env, specs, mesh.most_lanes(lanes, placed_on), placed_on, sweep)[0]


def _plan(
    env: Env, specs: Sequence[RunSpec], max_lanes: int | None, devices: Sequence[Any], sweep: bool
) -> tuple[Train, Layout, int]:
    """Training loop of runs, its layout, and the most lanes per device. Raises ValueError like `compile_runs`."""
    most = min(len(specs), max_lanes or len(specs))
    layout = mesh.arrange(devices, (max_lanes or len(devices)) if sweep else most)
    train = make_loop(env, specs[0], choices_of(specs), layout)
    loop.check_memory(train, specs[0].config, layout.sharers)
    return train, layout, math.ceil(most / layout.lanes)


def compile_runs(
    env: Env,
    specs: Sequence[RunSpec],
    max_lanes: int | None,
    final_episodes: int,
    report: Callable[[str], None],
    devices: Sequence[Any] = (),
    sweep: bool = False,
    together: int = 1,
) -> Program:
    """Compiles for as many lanes as allowed and as fit into memory, by the compiler's estimate (`equal_lanes`).

    In a `sweep`, whether devices share a run depends on `max_lanes` alone, because fewer runs are left at its next start.
    The final evaluation may still be compiling in a thread while the runs are trained. Raises ValueError for too little memory
    for one run, or sizes that the devices do not divide.
    """
    spec, choices = specs[0], choices_of(specs)
    train, layout, lanes = _plan(env, specs, max_lanes, devices, sweep)  # lanes per device, like the bytes
    available = machine.available_bytes()
    if available is not None:  # the rings must fit before anything is compiled
        available //= layout.sharers
        lanes = max(1, min(lanes, int(available / train.replay_bytes)))
    while True:
        lanes = equal_lanes(len(specs), lanes, layout.lanes, together)
        keys, hparams = stack(specs, choices, lanes * layout.lanes)
        report(f"{spec.env}: compiling for {_title(env, specs, train, lanes * layout.lanes, layout)} ...")
        started = time.perf_counter()
        compiled = loop.compile_program(train, keys, hparams, config_lib.num_updates(spec.config, env.episode_length), layout)
        check_steps(env)
        seconds, needed = time.perf_counter() - started, machine.format_bytes(compiled.nbytes)
        report(f"{spec.env}: compiled in {seconds:.1f} s; {needed} of memory")
        if available is None or compiled.nbytes <= available or lanes == 1:
            loop.check_program(compiled, spec.config, layout.sharers)
            beside = available is not None and compiled.nbytes <= available / 2
            evaluate = _compile_evaluation(train, keys, hparams, final_episodes, beside, layout)
            return Program(lanes * layout.lanes, layout, choices, train.learner, train.spec, compiled, evaluate)
        lanes = min(lanes - 1, max(1, int(0.95 * lanes * available / compiled.nbytes)))


def equal_lanes(runs: int, most: int, groups: int, together: int) -> int:
    """Lanes of each of `groups` devices, at most `most`, with which chunks of the runs have equal sizes. If `together` runs,
    which share a checkpoint, need more, as many as they need.
    """
    chunks = math.ceil(runs / (most * groups))
    return min(most, math.ceil(max(runs / chunks, together) / groups))


def _title(env: Env, specs: Sequence[RunSpec], train: Train, lanes: int, layout: Layout) -> str:
    apart = f"{layout.lanes} groups" if layout.lanes > 1 else ""
    parts = f"{layout.shards} for each run" if layout.shards > 1 else ""
    number = f"{len(layout.devices)} devices ({', '.join(filter(None, (apart, parts)))}) of " if layout.devices else ""
    together = f"{lanes} parallel runs of {len(specs)}" if lanes > 1 else f"one run at a time of {len(specs)}"
    note = getattr(getattr(env, "engine", None), "note", "")  # how the engine runs this model
    physics = run_folder.engine_name(env) + (f" ({note})" if note else "")
    return (
        f"{'one run' if len(specs) == 1 else together}; physics {physics}, learner on"
        f" {number}{jax.devices()[0].device_kind}, replay ring {machine.format_bytes(train.replay_bytes)}"
    )


def _compile_evaluation(
    train: Train, keys: PRNGKey, hparams: Any, final_episodes: int, beside: bool, layout: Layout = ONE
) -> concurrent.futures.Future[EvaluateFn]:
    """Compiles the final evaluation. With `beside`, a thread does so during training, which takes memory."""
    episodes = math.ceil(min(final_episodes, evaluate_lib.CHUNK) / layout.shards)

    def evaluate(state: TrainState, key: PRNGKey) -> Outcome:
        return split.gather(train.evaluate(state, key, episodes), train.axis_name)

    init, evaluate_all = (jax.vmap(train.init), jax.vmap(evaluate)) if keys.ndim else (train.init, evaluate)
    arguments: tuple[Any, Any] = keys, hparams
    if layout.devices:
        from mjx_dher.parallel import sharded

        batched = bool(keys.ndim)
        init, evaluate_all = sharded.place_init(layout, init, batched), sharded.place_evaluate(layout, evaluate_all, batched)
        arguments = mesh.to_host(keys, hparams)
        state = init.eval_shape(*arguments)
    else:
        state, evaluate_all = jax.eval_shape(init, keys, hparams), jax.jit(evaluate_all)
    lowered = evaluate_all.lower(state, arguments[0])
    pool = concurrent.futures.ThreadPoolExecutor(1)
    compiling = pool.submit(loop.compile_lowered, lowered, plain=True)
    pool.shutdown(wait=not beside)
    return cast("concurrent.futures.Future[EvaluateFn]", compiling)


def stack(specs: Sequence[RunSpec], choices: Choices, lanes: int) -> tuple[PRNGKey, Any]:
    """Keys and numbers of `lanes` runs, [lanes] each, or [] for one. Missing runs repeat the last one."""
    padded = [specs[min(i, len(specs) - 1)] for i in range(lanes)]
    numbers: list[Any] = [spec.hparams for spec in padded]
    if any(len(own) > 1 for own in choices):
        numbers = [Lane._make((*spec.hparams, *choices.of(spec))) for spec in padded]
    if lanes == 1:
        return jax.random.key(padded[0].seed), trainer.as_arrays(numbers[0])
    keys = jnp.stack([jax.random.key(spec.seed) for spec in padded])
    return keys, jax.tree.map(lambda *x: jnp.array(x, jnp.float32), *numbers)


def lane_of(tree: Any, lane: int, lanes: int) -> Any:
    """One run's slice of a pytree of `lanes` runs. A single lane has no axis."""
    return tree if lanes == 1 else jax.tree.map(lambda x: x[lane], tree)


def evaluate(env: Env, program: Program, state: TrainState, keys: PRNGKey, episodes: int) -> Outcome:
    """Outcomes [lanes, episodes] of the final evaluation of each lane, as NumPy arrays.

    Chunk i of a run's episodes, from 1, has the key `fold_in(key, i)`.
    """

    def key_of(number: int) -> Any:
        fold_in = functools.partial(jax.random.fold_in, data=number)
        own = jax.vmap(fold_in)(keys) if keys.ndim else fold_in(keys)
        return mesh.to_host(own)[0] if program.layout.devices else own

    chunks = map(key_of, range(1, 1 + math.ceil(episodes / evaluate_lib.CHUNK)))
    outcome = evaluate_lib.in_chunks(functools.partial(program.evaluate.result(), state), chunks, episodes, processes.fetch)
    check_steps(env)
    return jax.tree.map(np.atleast_2d, outcome)
