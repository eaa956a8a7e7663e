"""Processes that train together, on one machine or several: they find each other, agree, and end when one of them is gone.

Arrays are JAX's matter (`jax.distributed`). What the hosts tell each other goes over a line of their own, one from each process
to the first: whether their settings agree, what the first one decides, parts of a checkpoint. The first process alone writes.
"""

from __future__ import annotations

import dataclasses
import json
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

from mjx_dher.system.line import Line, LineError

WAIT = 30.0  # s for an address to answer, and for the other processes to come
SHUTDOWN = 10  # s that JAX waits for the others at the end

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Team:
    """Processes that train together; one alone where there are no lines."""

    number: int = 0
    size: int = 1
    lines: Sequence[Line] = ()  # of the first process: to all others, in order; else to the first

    @property
    def leads(self) -> bool:
        """Role of the first process, which decides and writes."""
        return self.number == 0

    def share(self, decide: Callable[[], T]) -> T:
        """Returns what `decide` gives in the first process, as JSON has it: all have to call this. Others do not call `decide`.

        Raises:
          ValueError: `decide` has raised it, or an OSError, which the first process raises as it is.
        """
        if self.size == 1:
            return decide()
        if not self.leads:
            content, _ = self.lines[0].receive()
            if "error" in content:
                raise ValueError(content["error"])
            return content["value"]
        try:
            value = decide()
        except (ValueError, OSError) as error:
            for line in self.lines:
                line.send({"error": f"process 0: {error}"})
            raise
        for line in self.lines:
            line.send({"value": value})
        return value

    def any(self, flag: bool) -> bool:
        """Returns whether `flag` is true in any process: all have to call this."""
        if self.size == 1:
            return flag
        if not self.leads:
            self.lines[0].send({"value": flag})
            return self.share(bool)
        flags = [flag, *(line.receive()[0]["value"] for line in self.lines)]
        return self.share(lambda: any(flags))

    def agree(self, field: str, value: int) -> None:
        """Refuses, in all processes, a number that is not the same in each: all have to call this.

        Raises:
          ValueError: names the field, the first process's number and this one's.
        """
        first = self.share(lambda: value)
        if self.any(value != first):
            raise ValueError(
                f"{field}: the first process has {first}, this one {value}, and all must have the same: the memory that is free"
                f" differs; give --{field}"
            )

    def share_arrays(self, arrays: Sequence[np.ndarray] | None) -> list[np.ndarray]:
        """Returns the first process's arrays: all have to call this, the others with None."""
        if self.leads:
            assert arrays is not None
            for line in self.lines:
                line.send({"arrays": [[list(array.shape), str(array.dtype)] for array in arrays]})
                for array in arrays:
                    line.send({}, np.ascontiguousarray(array).tobytes())
            return list(arrays)
        heads = self.lines[0].receive()[0]["arrays"]
        return [np.frombuffer(self.lines[0].receive()[1], dtype).reshape(shape) for shape, dtype in heads]

    def collect(self, tree: Any) -> Any:
        """Returns a tree's arrays as NumPy's in the first process, None in the others: all have to call this. No keys."""
        if self.size == 1:
            return jax.device_get(tree)
        leaves, structure = jax.tree.flatten(tree)
        whole = [self._collect_one(leaf) for leaf in leaves]
        return jax.tree.unflatten(structure, whole) if self.leads else None

    def _collect_one(self, leaf: Any) -> np.ndarray | None:
        if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable or leaf.is_fully_replicated:
            return np.asarray(leaf)
        own = [shard for shard in leaf.addressable_shards if shard.replica_id == 0]
        if not self.leads:
            self.lines[0].send({"shards": [_bounds(shard.index, leaf.shape) for shard in own]})
            for shard in own:
                self.lines[0].send({}, np.ascontiguousarray(shard.data).tobytes())
            return None
        whole = np.empty(leaf.shape, leaf.dtype)
        for shard in own:
            whole[shard.index] = shard.data
        for line in self.lines:
            for bounds in line.receive()[0]["shards"]:
                place = tuple(slice(*ends) for ends in bounds)
                whole[place] = np.frombuffer(line.receive()[1], leaf.dtype).reshape(whole[place].shape)
        return whole

    def fetch(self, tree: Any) -> Any:
        """Returns a tree's arrays as NumPy's in every process: all have to call this. For small ones."""
        if self.size == 1:
            return jax.device_get(tree)
        leaves, structure = jax.tree.flatten(tree)
        whole = self.collect(leaves)
        return jax.tree.unflatten(structure, self.share_arrays(whole))

    def close(self, reason: str = "") -> None:
        """Ends the lines; the other processes end, too, where a `reason` says what went wrong here."""
        for line in self.lines:
            line.close(reason)


ALONE = Team()


def _bounds(index: tuple[slice, ...], shape: tuple[int, ...]) -> list[list[int]]:
    """Returns start and end of a shard along each axis."""
    return [list(ends.indices(size)[:2]) for ends, size in zip(index, shape)]


def connect(address: str, size: int, number: int, described: Mapping[str, Any], wait: float = WAIT) -> Team:
    """Joins this process to the others, and starts JAX in all of them as one.

    Args:
      address: HOST:PORT of the first process.
      size: processes, 2 or more.
      number: of this one, from 0.
      described: what all have to agree in, by name, as JSON has it: the version, the settings.
      wait: seconds for the others to come, or to answer.

    Raises:
      ValueError: nobody answers, somebody does not come, or others are described otherwise; it names the field.
    """
    host, _, port = address.rpartition(":")
    own = {"size": size, "number": number, "described": json.loads(json.dumps(dict(described))), "host": socket.gethostname()}
    try:
        gather = _gather(int(port), own, wait) if number == 0 else [_answer(host, int(port), own, wait)]
    except LineError as error:
        raise ValueError(str(error)) from error
    team = Team(number, size, gather)
    placed = team.share(lambda: _places(host, [own["host"], *(line.greeting["host"] for line in gather)]))
    _start_jax(placed["address"], team, placed["ranks"][number])
    for line in team.lines:
        line.others = [other for other in team.lines if other is not line]
        line.watch()
    return team


def _gather(port: int, own: dict[str, Any], wait: float) -> list[Line]:
    """Takes the calls of all other processes; refuses, for all of them, one that is not described as this one is."""
    size = own["size"]
    lines: dict[int, Line] = {}
    try:
        listening = socket.create_server(("", port), backlog=size)
    except OSError as error:
        raise LineError(f"coordinator: process 0 cannot listen at port {port} ({error.strerror}); name another one") from error
    with listening:
        deadline = time.monotonic() + wait
        while len(lines) < size - 1:
            listening.settimeout(max(0.01, deadline - time.monotonic()))
            try:
                line = Line.taken(listening)
            except TimeoutError:
                missing = ", ".join(str(n) for n in range(1, size) if n not in lines)
                problem = f"num_processes is {size}, and of these processes {missing} did not come within {wait:g} s"
            else:
                problem = "" if line is None else _problem(line.greeting, own, lines)
                if line is not None:
                    lines[line.greeting.get("number", size)] = line
            if problem:
                for line in lines.values():
                    line.send({"error": problem})
                raise LineError(problem)
    return [lines[number] for number in sorted(lines)]


def _problem(other: dict[str, Any], own: dict[str, Any], taken: Mapping[int, Line]) -> str:
    """Returns what is wrong with a process that calls the first one, for its user."""
    number, size = other.get("number"), own["size"]
    if other.get("size") != size:
        return f"num_processes must be the same in all: it is {size} in process 0, and {other.get('size')} in process {number}"
    if not isinstance(number, int) or not 1 <= number < size or number in taken:
        return f"process_id must be a different one of 0 to {size - 1} in each process; {number} is there twice, or is none"
    before, now = own["described"], other.get("described", {})
    differing = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    told = "; ".join(
        f"{name} is {before.get(name)!r} in process 0, and {now.get(name)!r} in process {number}" for name in differing
    )
    return f"all processes must be started alike: {told}" if told else ""


def _answer(host: str, port: int, own: dict[str, Any], wait: float) -> Line:
    """Calls the first process, which may be started a little later."""
    deadline = time.monotonic() + wait
    while True:
        try:
            return Line.called(host, port, own)
        except socket.gaierror as error:
            raise LineError(f"coordinator: there is no host {host!r} ({error.strerror})") from error
        except OSError as error:
            if time.monotonic() > deadline:
                raise LineError(
                    f"coordinator: nobody answers at {host}:{port} ({error.strerror or error}), for {wait:g} s; it must be"
                    " the address of process 0, which must be running"
                ) from error
        time.sleep(0.2)


def _places(host: str, hosts: Sequence[str]) -> dict[str, Any]:
    """Returns the address for JAX's own service, and each process's number on its host, -1 where it is there alone."""
    with socket.socket() as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    ranks = [hosts[:n].count(name) if hosts.count(name) > 1 else -1 for n, name in enumerate(hosts)]
    return {"address": f"{host}:{port}", "ranks": ranks}


def _start_jax(address: str, team: Team, rank: int) -> None:
    """Starts JAX as one of several processes. Those on one host take a GPU each."""
    if hasattr(jax.config, "jax_cpu_collectives_implementation"):
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            address,
            team.size,
            team.number,
            local_device_ids=_own_gpus(rank),
            cluster_detection_method="deactivate",
            initialization_timeout=2 * int(WAIT),
            shutdown_timeout_seconds=SHUTDOWN,
        )
    except RuntimeError as error:
        raise ValueError(f"coordinator: JAX cannot join its processes at {address} ({str(error).splitlines()[0]})") from error


def _own_gpus(rank: int) -> list[int] | None:
    """Returns the GPU that a process takes which is not alone on its host; None for all that it sees."""
    import os

    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    return None if rank < 0 or (visible and "," not in visible) else [rank]
