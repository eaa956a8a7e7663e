"""Devices of a program: a mesh whose axis `lanes` shares out runs side by side, and whose axis `data` shares out each of them.

Runs side by side exchange nothing. The parts of one run have equal shares of its environments, its ring and its batches; their
learners are alike, because they average gradients (`split`).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
from jax.sharding import NamedSharding, PartitionSpec

from mjx_dher.config import check_devices
from mjx_dher.parallel.split import AxisName

LANES, DATA = "lanes", "data"


@dataclasses.dataclass(frozen=True)
class Layout:
    """Devices of a program and how it lies on them; the default device where there are none."""

    devices: tuple[Any, ...] = ()
    lanes: int = 1  # devices that share out runs side by side
    parts: int = 1  # devices that share each of them

    @property
    def axis_name(self) -> AxisName:
        """Axis of the devices that share one run; None if each run has one device."""
        return DATA if self.parts > 1 else None

    @property
    def sharers(self) -> int:
        """Devices of this process that have one memory: all where they are a CPU's."""
        return len(self.own_devices) if self.devices and self.devices[0].platform == "cpu" else 1

    @property
    def own_devices(self) -> list[tuple[int, Any]]:
        """Devices of this process, each with its place along `lanes`."""
        rows = [(number, device) for number, row in enumerate(self.mesh.devices) for device in row]
        return [(number, device) for number, device in rows if device.process_index == jax.process_index()]

    @functools.cached_property
    def mesh(self) -> jax.sharding.Mesh:
        """Mesh of JAX."""
        kinds = (jax.sharding.AxisType.Auto,) * 2
        return jax.make_mesh((self.lanes, self.parts), (LANES, DATA), kinds, devices=self.devices)

    def sharding(self, *axes: str) -> NamedSharding:
        """Returns the sharding of arrays that lead with these axes of the mesh; the other axis has them alike."""
        return NamedSharding(self.mesh, PartitionSpec(*axes))


ONE = Layout()


def find(devices: int | str) -> tuple[Any, ...]:
    """Returns so many of JAX's devices, or "all"; none for one, which is the default device.

    Raises:
      ValueError: neither a number nor "all", more than there are, or only some of those of several processes.
    """
    check_devices(devices)
    present = jax.devices()
    number = len(present) if devices == "all" else int(devices)
    if number > len(present):
        kind = present[0].platform.upper()
        virtual = "; XLA_FLAGS=--xla_force_host_platform_device_count=N makes N of a CPU, to try things out"
        raise ValueError(
            f"devices must lie in [1, {len(present)}], the {kind} devices that JAX has here, or be all; got {devices}"
            f"{virtual if kind == 'CPU' else ''}"
        )
    if jax.process_count() > 1 and devices == 1:  # nobody has said
        number = len(present)
    if jax.process_count() > 1 and number != len(present):
        raise ValueError(f"devices must be all, or {len(present)}, of {jax.process_count()} processes; got {devices}")
    return tuple(present[:number]) if number > 1 else ()


def arrange(devices: Sequence[Any], runs: int) -> Layout:
    """Lays up to `runs` runs side by side on devices: apart as far as they go, the devices left over in parts of each run."""
    if not devices:
        return ONE
    number = len(devices)
    lanes = next(n for n in range(min(runs, number), number + 1) if number % n == 0)
    return Layout(tuple(devices), lanes, number // lanes)


def most_lanes(lanes: int | None, devices: Sequence[Any]) -> int | None:
    """Returns how many runs lie side by side at most: `lanes`; where None, one for each CPU, and elsewhere what memory holds.

    Raises:
      ValueError: `lanes` is a number that the devices do not divide, nor it them.
    """
    number = max(1, len(devices))
    if lanes is None:
        return number if jax.default_backend() == "cpu" else None
    if lanes % number and number % lanes:
        fewer = [str(n) for n in range(1, number) if number % n == 0]
        raise ValueError(f"lanes must be a multiple of {number}, the devices, or {', '.join(fewer)}; got {lanes}")
    return lanes
