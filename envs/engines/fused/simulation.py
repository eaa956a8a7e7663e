"""Environments on a device: their memory, and the launch that advances them."""

from typing import Any

import mujoco

from mjx_dher.envs.engines import graph
from mjx_dher.envs.engines.fused import kernel, memory, setup
from mjx_dher.envs.engines.fused.sparse import sparse_of
from mjx_dher.envs.engines.fused.varied import NONE, Begins
from mjx_dher.system.warp_setup import load, wp

# Threads that share an environment of few degrees of freedom, and the most warps of 32 threads in a block: measured on an H100.
THREADS, WARPS = 16, 8
# Most iterations of Newton's method and of its line search: an environment takes three where contacts change, one otherwise.
ITERATIONS, LS_ITERATIONS = 50, 20
_FEW_ROWS = 64  # memory for fewer is not worth an overflow
_STATIC = 2048  # bytes of a block that CUDA and the kernel itself take; 1,024 and 64 were seen


class Simulation:
    """Environments that the fused kernel advances, on Warp's current device.

    Args:
      model: a model for which `unsupported` is empty; its options limit the iterations of Newton's method and its line search.
      substeps: timesteps an environment step.
      rows: constraint rows that fit into memory; more than can occur are not allocated.
      varied: where the inputs have numbers of the model.

    Raises:
      ValueError: the device's shared memory does not suffice.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, substeps: int, rows: int = 10**6, varied: Begins = NONE):
        structs = structs_of(model, rows)
        size = structs[-1].size
        device = wp.get_device()
        self._threads = 1 if device.is_cpu else threads_for(model)
        warps = 0 if device.is_cpu else most_warps(size, device.max_shared_memory_per_block - _STATIC, self._threads)
        self._block = max(1, 32 * warps)
        self._kernel = kernel_of(model, structs, self._threads, warps, varied)
        memory = wp.zeros((num_envs, size) if device.is_cpu else (1, 1), dtype=float)
        self._kept = (*structs, memory)
        self._lost = wp.zeros(1, dtype=int)
        self._substeps, self._num_envs = substeps, num_envs

    def load(self) -> None:
        """Compiles the kernel, or takes it from Warp's cache."""
        load(self._kernel.module, self._block)

    def advance(self, state: tuple[Any, Any, Any], inputs: Any, result: tuple[Any, Any, Any]) -> None:
        """Advances coordinates, velocities and the solver's first guess by one environment step."""
        wp.launch(
            self._kernel,
            dim=(self._num_envs, self._threads),
            inputs=[*self._kept, self._substeps, self._lost, inputs, *state],
            outputs=list(result),
            block_dim=self._block,
        )

    def overflow(self) -> int:
        """Number of contacts since the last call that were left out because their rows did not fit."""
        lost = int(self._lost.numpy()[0])
        if lost:
            self._lost.zero_()
        return lost


def structs_of(model: mujoco.MjModel, rows: int) -> tuple[Any, ...]:
    """The kernel's structs for a model, with room for `rows` rows of constraints."""
    bodies, dofs, sparse = setup.bodies_of(model), setup.dofs_of(model), sparse_of(model)
    contacts = setup.contacts_of(model, rows)
    world = setup.world_of(model, contacts, rows)
    return world, bodies, dofs, contacts, sparse, memory.layout_of(model, world, contacts, dofs, sparse)


def kernel_of(model: mujoco.MjModel, structs: tuple[Any, ...], threads: int, warps: int, varied: Begins = NONE) -> Any:
    """The kernel for a model and the structs from `structs_of`, with `warps` of 32 threads in a block, 0 on a CPU."""
    contacts, sparse = structs[3], structs[4]
    kinds = tuple(sorted({*map(int, contacts.kind.numpy())}))
    edges = int(max([6, *contacts.edges.numpy()]))
    pulls = bool(structs[2].tendons.number)
    traits = kernel.Traits(kinds, edges, contacts.near == 0, sparse.rows > 0, pulls, bool(contacts.elliptic), varied)
    return kernel.make(structs[-1].size if warps else 0, threads, warps, model.nv, traits)


def shared_memory() -> int | None:
    """Bytes of shared memory of a block on the first GPU; None without a GPU."""
    return wp.get_device("cuda:0").max_shared_memory_per_block - _STATIC if wp.is_cuda_available() else None


def threads_for(model: mujoco.MjModel) -> int:
    """Threads that share an environment: a warp if half of one would have two rows of the mass matrix each."""
    return THREADS if model.nv <= THREADS else 2 * THREADS


def check_fits(model: mujoco.MjModel, rows: int) -> None:
    """Raises ValueError if the GPU's shared memory does not suffice for an environment with `rows` rows of constraints."""
    if (shared := shared_memory()) is not None:
        most_warps(structs_of(model, rows)[-1].size, shared, threads_for(model))


def most_warps(size: int, shared: int, threads: int = THREADS) -> int:
    """Warps of a block with `shared` bytes, if an environment takes `size` floats. Raises ValueError if not even one fits."""
    a_warp = 4 * size * (32 // threads)
    if a_warp > shared:
        raise ValueError(
            f"the warp engine needs {a_warp:,} bytes of a GPU's shared memory and has {shared:,}; fewer constraints take less"
        )
    return min(WARPS, shared // a_warp)


def most_rows(model: mujoco.MjModel) -> int:
    """The most constraint rows that an environment can have, without those that are sparse."""
    return int(setup.world_of(model, setup.contacts_of(model), 10**6).rows)


def rows_for(model: mujoco.MjModel, shared: int | None) -> int:
    """Constraint rows to have memory for: all that can occur, if a block's shared memory suffices for them.

    For large models it must suffice for the most warps. Otherwise there is memory for 1.5 times the rows that random
    controls cause, and for all further rows that fit without reducing the number of environments.
    """
    most, threads = most_rows(model), threads_for(model)
    a_warp = lambda rows: 4 * structs_of(model, rows)[-1].size * (32 // threads)  # noqa: E731
    if shared is None or a_warp(most) * (1 if threads == THREADS else WARPS) <= shared:
        return most
    rows = min(most, max(_FEW_ROWS, setup.other_rows(model) + round(1.5 * graph.probe(model)[2])))
    warps = most_warps(structs_of(model, rows)[-1].size, shared, threads)
    for more in (128, 64, 32, 16, 8, 4, 2, 1):
        if rows + more <= most and a_warp(rows + more) * warps <= shared:
            rows += more
    return rows
