"""Several processes of one JAX program, connected by `jax.distributed`. The first process decides and writes files.

Every process must call each function here at the same point. With one process they do nothing.
"""

import contextlib
import ipaddress
import json
import os
import socket
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np

from mjx_dher.system import signals
from mjx_dher.validation import host_and_port

VARIABLES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
TIMEOUTS = {"initialization_timeout": 60, "heartbeat_timeout_seconds": 30, "shutdown_timeout_seconds": 30}
_PIECE = 1 << 28  # bytes per transfer of `fetch`
_BLOCK = 1024  # bytes; messages are padded to a multiple, because each size is a compiled program

T = TypeVar("T")


def connect() -> None:
    """Connects this process to the others. Call it before JAX initializes its devices.

    JAX detects Slurm, Open MPI and Kubernetes. Otherwise `VARIABLES` name the address of the first process, the number of
    processes and the index of this one. Raises ValueError if no cluster was detected, or a variable is invalid. If other
    processes do not answer, JAX aborts.
    """
    try:
        size, number = (int(os.environ[name]) if name in os.environ else None for name in VARIABLES[1:])
        own: dict[str, Any] = {**TIMEOUTS, "coordinator_bind_address": _bind_address()}
        jax.distributed.initialize(num_processes=size, process_id=number, **own)
        signals.take_back()  # JAX has taken SIGTERM
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"distributed: {error} Start it with srun or mpirun, or set {', '.join(VARIABLES)}") from error


def _bind_address() -> str | None:
    """Address for the coordinator to listen at: the given one if it is an IP address of this machine, else None."""
    if VARIABLES[0] not in os.environ:
        return None
    host, _ = host_and_port(VARIABLES[0], address := os.environ[VARIABLES[0]])
    with contextlib.suppress(OSError, ValueError):
        family = socket.AF_INET6 if ipaddress.ip_address(host).version == 6 else socket.AF_INET
        socket.create_server((host, 0), family=family).close()
        return os.environ.get("JAX_COORDINATOR_BIND_ADDRESS", address)
    return None


def is_alone() -> bool:
    """Whether the program has only one process."""
    return not jax.distributed.is_initialized()


def leads() -> bool:
    """Whether this is the first process, which decides and writes."""
    return is_alone() or jax.process_index() == 0


def broadcast(decide: Callable[[], T]) -> T:
    """Calls `decide` in the first process. Returns its result, converted by JSON, in all processes. Raises ValueError if
    `decide` raised a ValueError or OSError. The first process raises the original error.
    """
    from jax.experimental import multihost_utils

    if is_alone():
        return decide()
    content: dict[str, Any] = {}
    failure: Exception | None = None
    if leads():
        try:
            content["value"] = decide()
        except (ValueError, OSError) as error:
            content["error"], failure = f"process 0: {error}", error
    text = json.dumps(content).encode()
    size = int(multihost_utils.broadcast_one_to_all(np.int32(-(-len(text) // _BLOCK) * _BLOCK)))
    sent = multihost_utils.broadcast_one_to_all(np.frombuffer(text.ljust(size)[:size], np.uint8))
    content = json.loads(sent.tobytes())
    if failure is not None:
        raise failure
    if "error" in content:
        raise ValueError(content["error"])
    return content["value"]


def highest(number: int) -> int:
    """Highest `number` of all processes."""
    from jax.experimental import multihost_utils

    return number if is_alone() else int(multihost_utils.process_allgather(np.array(number)).max())


def any_process(flag: bool) -> bool:
    """Whether `flag` is true in any process."""
    return bool(highest(flag))


def check_equal(described: Mapping[str, Any]) -> None:
    """Raises ValueError in all processes, naming the fields, unless `described` is equal everywhere."""
    if is_alone():
        return
    own = json.loads(json.dumps(dict(described), default=str))
    first = broadcast(lambda: own)
    differing = [name for name in {**first, **own} if first.get(name) != own.get(name)]
    told = [f"{name} is {first.get(name)!r} in process 0 and {own.get(name)!r} here" for name in differing]
    if any_process(bool(told)):
        raise ValueError(f"all processes must have the same settings: {'; '.join(told) or 'another process differs'}")


def fetch(tree: Any) -> Any:
    """Copies a tree's arrays, without keys, from any devices to NumPy arrays."""
    return jax.device_get(tree) if is_alone() else jax.tree.map(_gather, tree)


def collect(tree: Any) -> Any:
    """Copies a tree's arrays, without keys, to NumPy arrays in the first process. Returns None in the others."""
    if is_alone():
        return jax.device_get(tree)
    leaves, structure = jax.tree.flatten(tree)
    whole = [array if leads() else None for array in map(_gather, leaves)]
    return jax.tree.unflatten(structure, whole) if leads() else None


def _gather(leaf: Any) -> np.ndarray:
    from jax.experimental import multihost_utils

    if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable or leaf.is_fully_replicated:
        return np.asarray(leaf)
    rows = max(1, _PIECE // max(1, leaf.nbytes // len(leaf)))
    pieces = [leaf[start : start + rows] for start in range(0, len(leaf), rows)]
    return np.concatenate([multihost_utils.process_allgather(piece, tiled=True) for piece in pieces])
