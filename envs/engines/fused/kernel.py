"""The kernel: all substeps of an environment step, for every environment."""

import functools
from typing import Any

from mjx_dher.envs.engines.fused.constraints import limit, number, press, touch, weld
from mjx_dher.envs.engines.fused.contacts import collide_boxes, collide_cylinders, collide_with_planes
from mjx_dher.envs.engines.fused.dynamics import integrate, move, place, push, strain, turn, weigh
from mjx_dher.envs.engines.fused.memory import carve, copy
from mjx_dher.envs.engines.fused.model import BOX_BOX, CYLINDER_BOX, Bodies, Contacts, Dofs, Layout, Memory, World
from mjx_dher.envs.engines.fused.solver import accelerate, solve
from mjx_dher.envs.engines.fused.threads import gather, sync
from mjx_dher.system.warp_setup import wp


@wp.func
def _begin(
    memory: Memory,
    qpos: wp.array(dtype=float),  # type: ignore[valid-type]
    qvel: wp.array(dtype=float),  # type: ignore[valid-type]
    guess: wp.array(dtype=float),  # type: ignore[valid-type]
    lane: int,
    lanes: int,
):
    """Takes an environment's state into its memory."""
    copy(qpos, memory.qpos, lane, lanes)
    copy(qvel, memory.qvel, lane, lanes)
    copy(guess, memory.qacc, lane, lanes)
    sync(lanes)


@wp.func
def _forces(
    world: World,
    bodies: Bodies,
    dofs: Dofs,
    memory: Memory,
    given: wp.array(dtype=float),  # type: ignore[valid-type]
    warps: int,
    lane: int,
    lanes: int,
):
    """Computes places, velocities, the mass matrix and all forces but those of constraints."""
    gather(warps)
    place(bodies, memory, given, lane, lanes)
    gather(warps)
    move(bodies, memory, lane, lanes)
    gather(warps)
    turn(bodies, memory, lane, lanes)
    gather(warps)
    strain(world, bodies, dofs, memory, lane, lanes)
    gather(warps)
    push(bodies, dofs, memory, given, lane, lanes)
    gather(warps)
    weigh(bodies, dofs, memory, lane, lanes)


@wp.func
def _constraints(
    world: World,
    bodies: Bodies,
    dofs: Dofs,
    contacts: Contacts,
    memory: Memory,
    lost: wp.array(dtype=int),  # type: ignore[valid-type]
    warps: int,
    lane: int,
    lanes: int,
):
    """Computes the rows of constraints."""
    gather(warps)
    number(world, dofs, contacts, memory, lost, lane, lanes)
    gather(warps)
    weld(world, bodies, dofs, memory, lane, lanes)
    gather(warps)
    limit(dofs, contacts, memory, lane, lanes)
    gather(warps)
    touch(bodies, dofs, contacts, memory, lane, lanes)
    gather(warps)
    press(dofs, contacts, memory, lane, lanes)


@wp.func
def _go_on(world: World, bodies: Bodies, dofs: Dofs, memory: Memory, nv: int, warps: int, lane: int, lanes: int):
    """Advances velocities and places."""
    gather(warps)
    solve(world, memory, nv, lane, lanes)
    gather(warps)
    accelerate(world, dofs, memory, nv, lane, lanes)
    gather(warps)
    integrate(world, bodies, memory, lane, lanes)


@functools.cache
def make(floats: int, lanes_of_one: int, warps: int, nv: int, kinds: tuple[int, ...]) -> Any:
    """Returns the kernel for `nv` degrees of freedom.

    Args:
      floats: memory of an environment.
      lanes_of_one: threads that share an environment.
      warps: of 32 threads in a block; 0 on a CPU.
      kinds: of pairs of geoms that there are; the code for others is left out.
    """
    shared = warps * (32 // lanes_of_one) * floats

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def advance(
        world: World,
        bodies: Bodies,
        dofs: Dofs,
        contacts: Contacts,
        layout: Layout,
        spare: wp.array2d(dtype=float),  # type: ignore[valid-type]
        substeps: int,
        lost: wp.array(dtype=int),  # type: ignore[valid-type]
        inputs: wp.array2d(dtype=float),  # type: ignore[valid-type]
        old_qpos: wp.array2d(dtype=float),  # type: ignore[valid-type]
        old_qvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
        old_guess: wp.array2d(dtype=float),  # type: ignore[valid-type]
        qpos: wp.array2d(dtype=float),  # type: ignore[valid-type]
        qvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
        guess: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ):
        """Computes coordinates, velocities and the solver's first guess `substeps` timesteps later.

        `spare` [num_envs, size of `layout`] is the memory on a CPU; `inputs` [num_envs, 7 + nu] has the mocap body's pose and
        the controls. `lost` [1] counts contacts that there is no room for.
        """
        env, lane = wp.tid()  # type: ignore[misc]
        lanes = wp.static(lanes_of_one)  # so that the compiler knows them
        if wp.static(shared > 0):
            _ = wp.tile_empty(shape=shared, dtype=float, storage="shared")  # what `carve` takes
        memory = carve(layout, spare[env % spare.shape[0]], lanes)
        _begin(memory, old_qpos[env], old_qvel[env], old_guess[env], lane, lanes)
        given = inputs[env]
        for _substep in range(substeps):
            _forces(world, bodies, dofs, memory, given, wp.static(warps), lane, lanes)
            gather(wp.static(warps))
            collide_with_planes(contacts, memory, lane, lanes)
            if wp.static(BOX_BOX in kinds):
                gather(wp.static(warps))
                collide_boxes(contacts, memory, lane, lanes)
            if wp.static(CYLINDER_BOX in kinds):
                gather(wp.static(warps))
                collide_cylinders(contacts, memory, lane, lanes)
            _constraints(world, bodies, dofs, contacts, memory, lost, wp.static(warps), lane, lanes)
            _go_on(world, bodies, dofs, memory, wp.static(nv), wp.static(warps), lane, lanes)
        copy(memory.qpos, qpos[env], lane, lanes)
        copy(memory.qvel, qvel[env], lane, lanes)
        copy(memory.qacc, guess[env], lane, lanes)

    return advance
