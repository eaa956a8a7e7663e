"""Functions of a training loop, placed on the devices of a `Layout`. They lower and compile like the ones of `jax.jit`.

For parallel runs, every device runs the single-device program, so results are bit-identical. (A program for several devices
would round differently, because XLA simplifies it in another order.) A run on several devices has one program for the mesh.
"""

import concurrent.futures
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.sharding import NamedSharding, PartitionSpec, SingleDeviceSharding

from mjx_dher.parallel.mesh import DATA, LANES, Layout
from mjx_dher.trainer import TrainState
from mjx_dher.types import Array, PRNGKey

InitFn = Callable[[PRNGKey, Any], TrainState]
EpochFn = Callable[[TrainState], tuple[TrainState, Any, Any]]


def place_init(layout: Layout, init: InitFn, batched: bool) -> Any:
    """Places (key, numbers) -> state. The placed function takes the arrays from `to_host`, for [L] runs if `batched`."""

    def local(key_data: Array, hparams: Any) -> TrainState:
        return init(jax.random.wrap_key_data(key_data), hparams)

    state, lane = _state_specs(batched), _lane(batched)
    return _place(layout, local, (lane, lane), state, of_host=(0, 1))


def place_epoch(layout: Layout, epoch: EpochFn, batched: bool) -> Any:
    """Places state -> (state, metrics, whether it is finite). The placed function donates the state's memory."""
    state, lane = _state_specs(batched), _lane(batched)
    return _place(layout, epoch, (state,), (state, lane, lane), donate=(0,))


def place_evaluate(layout: Layout, evaluate: Callable[[TrainState, PRNGKey], Any], batched: bool) -> Any:
    """Places (state, key) -> outcomes. The placed function takes the key's data."""

    def local(state: TrainState, key_data: Array) -> Any:
        return evaluate(state, jax.random.wrap_key_data(key_data))

    state, lane = _state_specs(batched), _lane(batched)
    return _place(layout, local, (state, lane), lane, of_host=(1,))


def _place(
    layout: Layout,
    local: Callable[..., Any],
    in_specs: tuple[Any, ...],
    out_specs: Any,
    of_host: Sequence[int] = (),
    donate: Sequence[int] = (),
) -> Any:
    """Places a function of one device. Arguments in `of_host` are NumPy arrays that every process has in full."""
    if layout.shards == 1:
        return _PerDevice(layout, [jax.jit(local, donate_argnums=donate)] * len(layout.own_devices))

    def with_counters(*arguments: Any) -> Any:
        return _counters(local(*_counters(arguments, lambda x: x[..., 0])), lambda x: x[..., None])

    spread = jax.shard_map(with_counters, mesh=layout.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)
    ins = tuple(layout.sharding() if number in of_host else _named(layout, own) for number, own in enumerate(in_specs))
    return jax.jit(spread, donate_argnums=donate, in_shardings=ins, out_shardings=_named(layout, out_specs))


class _PerDevice:
    """A function of parallel runs: one JAX stage (jitted, lowered or compiled) per device of this process.

    Arguments and results lead with [L]. Each device has an equal part.
    """

    def __init__(self, layout: Layout, stages: Sequence[Any]):
        self._layout, self._stages = layout, stages
        self._pool = concurrent.futures.ThreadPoolExecutor(len(stages))  # a call waits while it calls back to the host

    def eval_shape(self, *arguments: Any) -> Any:
        return self._stages[0].eval_shape(*arguments)

    def lower(self, *arguments: Any) -> "_PerDevice":

        def shape_on(device: Any, x: Any) -> jax.ShapeDtypeStruct:
            shape = (x.shape[0] // self._layout.lanes, *x.shape[1:])
            return jax.ShapeDtypeStruct(shape, x.dtype, sharding=SingleDeviceSharding(device))

        shapes = [jax.tree.map(functools.partial(shape_on, device), arguments) for _, device in self._layout.own_devices]
        return _PerDevice(self._layout, [stage.lower(*own) for stage, own in zip(self._stages, shapes)])

    def compile(self, compiler_options: Any = None) -> "_PerDevice":
        """Compiles the function for each device. On GPUs, only the first compilation takes time; the others use JAX's cache."""
        return _PerDevice(self._layout, [stage.compile(compiler_options=compiler_options) for stage in self._stages])

    def memory_analysis(self) -> Any:
        return self._stages[0].memory_analysis()

    def __call__(self, *arguments: Any) -> Any:
        """Calls the function on all devices at once. Results stay on their devices."""
        places = [functools.partial(_part_of, self._layout, *place) for place in self._layout.own_devices]
        own = [jax.tree.map(part_of, arguments) for part_of in places]  # all before any call donates memory
        results = list(self._pool.map(lambda stage, part: stage(*part), self._stages, own))
        return jax.tree.map(lambda *parts: _join(self._layout, parts), *results)


def _part_of(layout: Layout, number: int, device: Any, x: Any) -> Any:
    """Lanes of one device of an array that leads with [L]."""
    if isinstance(x, jax.Array):
        return next(shard.data for shard in x.addressable_shards if shard.device == device)
    lanes = len(x) // layout.lanes
    return jax.device_put(x[number * lanes : (number + 1) * lanes], device)


def _join(layout: Layout, parts: Sequence[Any]) -> jax.Array:
    """Array [L, ...] of the devices' lanes, without copying."""
    shape = (parts[0].shape[0] * layout.lanes, *parts[0].shape[1:])
    return jax.make_array_from_single_device_arrays(shape, layout.sharding(LANES), list(parts))


def _lane(batched: bool) -> PartitionSpec:
    return PartitionSpec(*(LANES,) * batched)


def _state_specs(batched: bool) -> TrainState:
    """Layout of a TrainState on the mesh, with [L] runs if `batched`. Each device of a run has its own cursor and size."""
    whole, split = _lane(batched), PartitionSpec(*_lane(batched), DATA)
    return TrainState(learner=whole, replay=split, hparams=whole, key=whole, env_steps=whole)  # type: ignore[arg-type]


def _named(layout: Layout, specs: Any) -> Any:
    is_spec = lambda x: isinstance(x, PartitionSpec)  # noqa: E731
    return jax.tree.map(lambda spec: NamedSharding(layout.mesh, spec), specs, is_leaf=is_spec)


def _counters(tree: Any, change: Callable[[Array], Array]) -> Any:
    """Changes cursor and size of each TrainState. On the mesh they have an additional axis for the devices."""

    def changed(x: Any) -> Any:
        if not isinstance(x, TrainState):
            return x
        ring = dataclasses.replace(x.replay, cursor=change(x.replay.cursor), size=change(x.replay.size))
        return dataclasses.replace(x, replay=ring)

    return jax.tree.map(changed, tree, is_leaf=lambda x: isinstance(x, TrainState))
