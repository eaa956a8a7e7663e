"""Devices of a program: a mesh with the axis `lanes` for parallel runs and the axis `data` for the shards of a run.

Parallel runs exchange nothing. The shards of a run have equal parts of its environments, replay ring and batches. They average
gradients (`split`), so their learners stay equal.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from mjx_dher.parallel.split import AxisName
from mjx_dher.types import PRNGKey
from mjx_dher.validation import check_count, check_devices

LANES, DATA = "lanes", "data"


@dataclasses.dataclass(frozen=True)
class Layout:
    """Layout of a program on devices. Without devices it runs on the default device."""

    devices: tuple[Any, ...] = ()
    lanes: int = 1  # number of groups of devices, for parallel runs
    shards: int = 1  # devices that share one run

    @property
    def axis_name(self) -> AxisName:
        """Axis of the devices that share one run, or None if each run has one device."""
        return DATA if self.shards > 1 else None

    @property
    def sharers(self) -> int:
        """Number of this process's devices that share one memory: all devices of a CPU, or one GPU."""
        return len(self.own_devices) if self.devices and self.devices[0].platform == "cpu" else 1

    @property
    def own_devices(self) -> list[tuple[int, Any]]:
        """Devices of this process, each with its index along `lanes`."""
        rows = [(number, device) for number, row in enumerate(self.mesh.devices) for device in row]
        return [(number, device) for number, device in rows if device.process_index == jax.process_index()]

    @functools.cached_property
    def mesh(self) -> jax.sharding.Mesh:
        kinds = (jax.sharding.AxisType.Auto,) * 2
        return jax.make_mesh((self.lanes, self.shards), (LANES, DATA), kinds, devices=self.devices)

    def sharding(self, *axes: str) -> NamedSharding:
        """Sharding of arrays that lead with these mesh axes and are replicated along the other one."""
        return NamedSharding(self.mesh, PartitionSpec(*axes))


ONE = Layout()


def find(devices: int | str) -> tuple[Any, ...]:
    """The first `devices` JAX devices, or "all". Empty for one, which means the default device. Raises ValueError if it is
    neither a number nor "all", exceeds the available devices, or selects only some devices of several processes.
    """
    check_devices(devices)
    present = jax.devices()
    number = len(present) if devices == "all" else int(devices)
    if number > len(present):
        kind = present[0].platform.upper()
        virtual = "; for tests, XLA_FLAGS=--xla_force_host_platform_device_count=N splits a CPU into N devices"
        raise ValueError(
            f"devices must lie in [1, {len(present)}], the number of {kind} devices, or be all; got {devices}"
            f"{virtual if kind == 'CPU' else ''}"
        )
    if jax.process_count() > 1 and devices == 1:  # the default
        number = len(present)
    if jax.process_count() > 1 and number != len(present):
        raise ValueError(f"devices must be all, or {len(present)}, with {jax.process_count()} processes; got {devices}")
    return tuple(present[:number]) if number > 1 else ()


def arrange(devices: Sequence[Any], runs: int) -> Layout:
    """Arranges up to `runs` parallel runs on devices. If there are more devices than runs, several share each run."""
    if not devices:
        return ONE
    number = len(devices)
    lanes = next(n for n in range(min(runs, number), number + 1) if number % n == 0)
    return Layout(tuple(devices), lanes, number // lanes)


def most_lanes(lanes: int | None, devices: Sequence[Any]) -> int | None:
    """Most parallel runs: `lanes`, or by default one per CPU device, and on GPUs as many as fit into memory (None). Raises
    ValueError if `lanes` is neither a multiple nor a divisor of the number of devices.
    """
    number = max(1, len(devices))
    if lanes is None:
        return number if jax.default_backend() == "cpu" else None
    check_count("lanes", lanes)
    if lanes % number and number % lanes:
        fewer = [str(n) for n in range(1, number) if number % n == 0]
        raise ValueError(f"lanes must be a multiple of {number}, the devices, or {', '.join(fewer)}; got {lanes}")
    return lanes


def to_host(key: PRNGKey, hparams: Any = None) -> tuple[np.ndarray, Any]:
    """Converts keys to their data, and numbers to NumPy arrays, which must be equal in every process."""
    return np.asarray(jax.random.key_data(key)), jax.tree.map(np.asarray, hparams)
