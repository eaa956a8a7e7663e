"""Functions of a training loop, placed on the devices of a `Layout`; each is lowered and compiled like one of `jax.jit`.

Runs side by side, each whole on one device: every device has a program of its own, that of a single device, so that results are
the same to the bit. (XLA simplifies a program for several devices in another order, and rounds otherwise.) Runs in parts: one
program for the mesh.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec, SingleDeviceSharding

from mjx_dher.parallel.mesh import DATA, LANES, Layout
from mjx_dher.replay import ReplayState
from mjx_dher.trainer import TrainState
from mjx_dher.types import Array, PRNGKey

InitFn = Callable[[PRNGKey, Any], TrainState]
EpochFn = Callable[[TrainState], tuple[TrainState, Any, Any]]


def to_host(key: PRNGKey, hparams: Any = None) -> tuple[np.ndarray, Any]:
    """Returns keys, as their data, and numbers as the functions here take them, the same in every process: NumPy arrays."""
    return np.asarray(jax.random.key_data(key)), jax.tree.map(np.asarray, hparams)


def place_init(layout: Layout, init: InitFn, batched: bool) -> Any:
    """Places (key, numbers) -> state; the function that it returns takes what `to_host` gives, [L] runs where `batched`."""

    def local(key_data: Array, hparams: Any) -> TrainState:
        return init(jax.random.wrap_key_data(key_data), hparams)

    if layout.parts == 1:
        return _Apart(layout, local)
    specs, lane = _state_specs(batched), _lane(batched)
    spread = _spread(layout, lambda *arguments: _apart(local(*arguments)), (lane, lane), specs)
    return jax.jit(spread, in_shardings=layout.sharding(), out_shardings=_named(layout, specs))


def place_epoch(layout: Layout, epoch: EpochFn, batched: bool) -> Any:
    """Places state -> (state, metrics, whether it is finite), which takes over the state's memory."""
    if layout.parts == 1:
        return _Apart(layout, epoch, donate=(0,))

    def local(state: TrainState) -> tuple[TrainState, Any, Any]:
        state, *told = epoch(_together(state))
        return _apart(state), *told

    specs, lane = _state_specs(batched), _lane(batched)
    spread = _spread(layout, local, (specs,), (specs, lane, lane))
    state = _named(layout, specs)
    told = layout.sharding(*lane)
    return jax.jit(spread, donate_argnums=0, in_shardings=(state,), out_shardings=(state, told, told))


def place_evaluate(layout: Layout, evaluate: Callable[[TrainState, PRNGKey], Any], batched: bool) -> Any:
    """Places (state, key) -> outcomes; the function that it returns takes the key's data."""

    def local(state: TrainState, key_data: Array) -> Any:
        return evaluate(state, jax.random.wrap_key_data(key_data))

    if layout.parts == 1:
        return _Apart(layout, local)
    specs, lane = _state_specs(batched), _lane(batched)
    spread = _spread(layout, lambda state, key: local(_together(state), key), (specs, lane), lane)
    ins = (_named(layout, specs), layout.sharding())
    return jax.jit(spread, in_shardings=ins, out_shardings=layout.sharding(*lane))


@dataclasses.dataclass(frozen=True)
class _Apart:
    """A function of runs side by side, whose arguments and results all lead with [L], on devices that share these out."""

    layout: Layout
    function: Callable[..., Any]
    donate: tuple[int, ...] = ()

    def eval_shape(self, *arguments: Any) -> Any:
        """Returns the shapes of the results."""
        return jax.eval_shape(self.function, *arguments)

    def lower(self, *arguments: Any) -> _ApartLowered:
        """Lowers it for each device of this process."""

        def shape_on(device: Any, x: Any) -> jax.ShapeDtypeStruct:
            shape = (x.shape[0] // self.layout.lanes, *x.shape[1:])
            return jax.ShapeDtypeStruct(shape, x.dtype, sharding=SingleDeviceSharding(device))

        jitted = jax.jit(self.function, donate_argnums=self.donate)
        lowered = [
            jitted.lower(*jax.tree.map(functools.partial(shape_on, device), arguments)) for _, device in self.layout.own_devices
        ]
        return _ApartLowered(self.layout, lowered)


@dataclasses.dataclass(frozen=True)
class _ApartLowered:
    layout: Layout
    lowered: Sequence[jax.stages.Lowered]

    def compile(self, compiler_options: Any = None) -> _ApartCompiled:
        """Compiles it for each device; where JAX keeps programs, a GPU's second device finds that of the first."""
        return _ApartCompiled(self.layout, [each.compile(compiler_options=compiler_options) for each in self.lowered])


class _ApartCompiled:
    def __init__(self, layout: Layout, compiled: Sequence[jax.stages.Compiled]):
        self._layout, self._compiled = layout, compiled
        self._pool = concurrent.futures.ThreadPoolExecutor(len(compiled))  # a call waits while it calls back to the host

    def memory_analysis(self) -> Any:
        """Returns the compiler's figures for one device."""
        return self._compiled[0].memory_analysis()

    def __call__(self, *arguments: Any) -> Any:
        """Calls it on all devices at once; results lie where they were computed."""
        places = [functools.partial(_part_of, self._layout, *place) for place in self._layout.own_devices]
        own = [jax.tree.map(part_of, arguments) for part_of in places]  # all of them before a call takes over its memory
        running = [self._pool.submit(compiled, *part) for compiled, part in zip(self._compiled, own)]
        results = [each.result() for each in running]
        return jax.tree.map(lambda *parts: _join(self._layout, parts), *results)


def _part_of(layout: Layout, number: int, device: Any, x: Any) -> Any:
    """Returns the lanes of one device of an array that leads with [L]."""
    if isinstance(x, jax.Array):
        return next(shard.data for shard in x.addressable_shards if shard.device == device)
    lanes = len(x) // layout.lanes
    return jax.device_put(x[number * lanes : (number + 1) * lanes], device)


def _join(layout: Layout, parts: Sequence[Any]) -> jax.Array:
    """Returns the array [L, ...] whose lanes lie on the devices as they are."""
    shape = (parts[0].shape[0] * layout.lanes, *parts[0].shape[1:])
    return jax.make_array_from_single_device_arrays(shape, layout.sharding(LANES), list(parts))


def _spread(layout: Layout, local: Callable[..., Any], in_specs: Any, out_specs: Any) -> Any:
    return jax.shard_map(local, mesh=layout.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def _lane(batched: bool) -> PartitionSpec:
    return PartitionSpec(*(LANES,) * batched)


def _state_specs(batched: bool) -> TrainState:
    """Returns how a TrainState lies on the mesh, [L] runs where `batched`. Each part of a run has a cursor and a size."""
    whole, parted = _lane(batched), PartitionSpec(*_lane(batched), DATA)
    ring: Any = ReplayState(episodes=parted, priority=parted, cursor=parted, size=parted)  # type: ignore[arg-type]
    return TrainState(learner=whole, replay=ring, hparams=whole, key=whole, env_steps=whole)  # type: ignore[arg-type]


def _named(layout: Layout, specs: Any) -> Any:
    is_spec = lambda x: isinstance(x, PartitionSpec)  # noqa: E731
    return jax.tree.map(lambda spec: NamedSharding(layout.mesh, spec), specs, is_leaf=is_spec)


def _counters(state: TrainState, change: Callable[[Array], Array]) -> TrainState:
    ring = dataclasses.replace(state.replay, cursor=change(state.replay.cursor), size=change(state.replay.size))
    return dataclasses.replace(state, replay=ring)


def _apart(state: TrainState) -> TrainState:
    """Returns a part's state whose counters have an axis, along which the mesh lays those of the parts side by side."""
    return _counters(state, lambda x: x[..., None])


def _together(state: TrainState) -> TrainState:
    """Returns a part's state as `trainer` knows it."""
    return _counters(state, lambda x: x[..., 0])
