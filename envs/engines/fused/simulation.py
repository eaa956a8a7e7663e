"""Environments on a device: their memory, and the launch that advances them."""

from typing import Any

import mujoco

from mjx_dher.envs.engines.fused import kernel, setup
from mjx_dher.system.warp_setup import load, wp

# Threads that share an environment, and the most warps of 32 threads that a block has. Measured on an H100 (docs/design.md).
THREADS, WARPS = 16, 8
# Most iterations of Newton's method and of its line search: an environment takes three where contacts change, one otherwise.
ITERATIONS, LS_ITERATIONS = 50, 20


class Simulation:
    """Environments that the fused kernel advances, on Warp's current device.

    Args:
      model: a model for which `unsupported` is empty; its options limit the iterations of Newton's method and its line search.
      num_envs: number of environments.
      substeps: timesteps an environment step.
      rows: constraint rows that fit into memory; more than can occur are not allocated.

    Raises:
      ValueError: the device's shared memory does not suffice.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, substeps: int, rows: int = 10**6):
        bodies, dofs, contacts = setup.bodies_of(model), setup.dofs_of(model), setup.contacts_of(model)
        world = setup.world_of(model, contacts, rows)
        layout = setup.layout_of(model, world, contacts, dofs)
        device = wp.get_device()
        self._threads = 1 if device.is_cpu else THREADS
        warps = 0 if device.is_cpu else most_warps(layout.size, device.max_shared_memory_per_block)
        self._block = max(1, 32 * warps)
        kinds = tuple(sorted({*map(int, contacts.kind.numpy())}))
        self._kernel = kernel.make(layout.size, self._threads, warps, model.nv, kinds)
        memory = wp.zeros((num_envs, layout.size) if device.is_cpu else (1, 1), dtype=float)
        self._kept = (world, bodies, dofs, contacts, layout, memory)
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


def shared_memory() -> int | None:
    """Bytes of shared memory of a block on the first GPU; None without a GPU."""
    return wp.get_device("cuda:0").max_shared_memory_per_block if wp.is_cuda_available() else None


def check_fits(model: mujoco.MjModel, rows: int) -> None:
    """Raises ValueError if the GPU's shared memory does not suffice for an environment with `rows` rows of constraints."""
    if (shared := shared_memory()) is not None:
        contacts, dofs = setup.contacts_of(model), setup.dofs_of(model)
        most_warps(setup.layout_of(model, setup.world_of(model, contacts, rows), contacts, dofs).size, shared)


def most_warps(size: int, shared: int) -> int:
    """Number of warps of a block, if an environment takes `size` floats and a block has `shared` bytes.

    Raises:
      ValueError: not even one warp fits.
    """
    a_warp = 4 * size * (32 // THREADS)
    if a_warp > shared:
        raise ValueError(
            f"the warp engine needs {a_warp:,} bytes of a GPU's shared memory and has {shared:,}; fewer constraints take less"
        )
    return min(WARPS, shared // a_warp)


def most_rows(model: mujoco.MjModel) -> int:
    """The most constraint rows that an environment can have."""
    return int(setup.world_of(model, setup.contacts_of(model), 10**6).rows)
