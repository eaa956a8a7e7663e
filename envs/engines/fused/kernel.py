"""The kernel: all substeps of an environment step, for every environment."""

import functools
from typing import Any, NamedTuple

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.cone import press_cones
from mjx_dher.envs.engines.fused.constraints import connect, limit, number, press, touch, weld
from mjx_dher.envs.engines.fused.contacts import collide_boxes, collide_cylinders, collide_with_planes
from mjx_dher.envs.engines.fused.dynamics import com_pos, com_vel, crb, integrate, kinematics, rne, smooth_forces
from mjx_dher.envs.engines.fused.ellipsoid import collide_ellipsoids
from mjx_dher.envs.engines.fused.memory import carve, copy
from mjx_dher.envs.engines.fused.model import Bodies, Contacts, Dofs, Floats, Floats2d, Ints, Layout, Memory, Sparse, World
from mjx_dher.envs.engines.fused.near import keep, memory_of, near_pairs
from mjx_dher.envs.engines.fused.round import collide_cylinders_with_round, collide_round
from mjx_dher.envs.engines.fused.solver import accelerate, solve
from mjx_dher.envs.engines.fused.sparse import ask_sparse
from mjx_dher.envs.engines.fused.tendons import soften
from mjx_dher.envs.engines.fused.threads import gather, sync
from mjx_dher.envs.engines.fused.varied import NONE, Begins, owning
from mjx_dher.system.warp_setup import wp


@wp.func
def _begin(memory: Memory, qpos: Floats, qvel: Floats, guess: Floats, thread: int, threads: int):
    """Copies an environment's state into its memory."""
    copy(qpos, memory.qpos, thread, threads)
    copy(qvel, memory.qvel, thread, threads)
    copy(guess, memory.qacc, thread, threads)
    sync(threads)


@wp.func
def _end(memory: Memory, qpos: Floats, qvel: Floats, guess: Floats, thread: int, threads: int):
    """Copies an environment's state out of its memory. If `give_up` was called, all coordinates become NaN."""
    copy(memory.qpos, qpos, thread, threads)
    if wp.isnan(memory.qvel[0]):
        for i in range(thread, qpos.shape[0], threads):
            qpos[i] = wp.nan
    copy(memory.qvel, qvel, thread, threads)
    copy(memory.qacc, guess, thread, threads)


@wp.func
def _forces(
    world: World,
    bodies: Bodies,
    dofs: Dofs,
    memory: Memory,
    given: Floats,
    has_tendons: bool,
    warps: int,
    thread: int,
    threads: int,
):
    """Computes positions, velocities, the mass matrix and all forces except constraint forces."""
    gather(warps)
    kinematics(bodies, memory, given, thread, threads)
    gather(warps)
    com_pos(bodies, memory, thread, threads)
    gather(warps)
    com_vel(bodies, memory, thread, threads)
    gather(warps)
    rne(world, bodies, dofs, memory, thread, threads)
    gather(warps)
    smooth_forces(bodies, dofs, memory, given, has_tendons, thread, threads)
    gather(warps)
    crb(bodies, dofs, memory, thread, threads)


class Traits(NamedTuple):
    """Properties of a model that the kernel's code depends on."""

    kinds: tuple[int, ...]  # kinds of geom pairs; code for other kinds is left out
    edges: int  # most rows of a contact
    few: bool  # whether there is memory for the contacts of all pairs at once; else near pairs are searched for
    has_sparse: bool  # whether there are rows of `Sparse`
    has_tendons: bool  # whether there are `Tendons`
    elliptic: bool  # whether friction cones are elliptic
    varied: Begins = NONE  # of numbers that differ between environments


def _ending(traits: Traits, nv: int, warps: int) -> Any:
    """Returns the function that advances velocities and places."""
    has_sparse, has_tendons, elliptic = traits.has_sparse, traits.has_tendons, traits.elliptic

    @wp.func
    def end(world: World, bodies: Bodies, dofs: Dofs, sparse: Sparse, memory: Memory, given: Floats, thread: int, threads: int):
        if wp.static(has_sparse):
            gather(wp.static(warps))
            ask_sparse(sparse, memory, thread, threads)
        gather(wp.static(warps))
        solve(world, sparse, memory, wp.static(has_sparse), wp.static(elliptic), wp.static(nv), thread, threads)
        gather(wp.static(warps))
        if wp.static(has_tendons):
            soften(world, bodies, dofs, memory, given, thread, threads)
        accelerate(
            world,
            bodies,
            dofs,
            sparse,
            memory,
            given,
            wp.static(has_sparse),
            wp.static(elliptic),
            wp.static(nv),
            thread,
            threads,
        )
        gather(wp.static(warps))
        integrate(world, bodies, memory, thread, threads)

    return end


def _collision(present: tuple[int, ...], few: bool, warps: int) -> Any:
    """Returns the function that finds contacts, for kinds of geom pairs. See `make`."""
    boxes, cylinders = kinds.BOX_BOX in present, kinds.CYLINDER_BOX in present
    round_ones = any(kinds.PLANE_SPHERE <= kind < kinds.PLANE_ELLIPSOID for kind in present)
    ellipsoids = any(kinds.PLANE_ELLIPSOID <= kind <= kinds.ELLIPSOID_BOX for kind in present)
    round_cylinders = kinds.SPHERE_CYLINDER in present or kinds.CAPSULE_CYLINDER in present

    @wp.func
    def collide(
        contacts: Contacts, memory: Memory, layout: Layout, spare: Floats, lost: Ints, thread: int, threads: int
    ) -> Contacts:
        """Finds contacts, and returns `contacts` with their pairs."""
        near, scratch = contacts, memory
        if wp.static(not few):
            gather(wp.static(warps))
            near = near_pairs(contacts, memory, layout, spare, lost, thread, threads)
            scratch = memory_of(contacts, memory, layout, spare, threads)
        gather(wp.static(warps))
        collide_with_planes(near, scratch, thread, threads)
        if wp.static(boxes):
            gather(wp.static(warps))
            collide_boxes(near, scratch, thread, threads)
        if wp.static(cylinders):
            gather(wp.static(warps))
            collide_cylinders(near, scratch, thread, threads)
        if wp.static(round_ones):
            gather(wp.static(warps))
            collide_round(near, scratch, thread, threads)
        if wp.static(ellipsoids):
            gather(wp.static(warps))
            collide_ellipsoids(near, scratch, thread, threads)
        if wp.static(round_cylinders):
            gather(wp.static(warps))
            collide_cylinders_with_round(near, scratch, thread, threads)
        held = contacts
        if wp.static(not few):
            gather(wp.static(warps))
            held = keep(contacts, near, scratch, memory, layout, spare, lost, thread, threads)
        return held

    return collide


def _constraining(traits: Traits, warps: int) -> Any:
    """Returns the function that finds contacts and computes the rows of constraints. See `make`."""
    capsules, collide = kinds.PLANE_CAPSULE in traits.kinds, _collision(traits.kinds, traits.few, warps)
    elliptic, edges, rolling = traits.elliptic, traits.edges, traits.elliptic or traits.edges > 6

    @wp.func
    def constrain(
        world: World,
        bodies: Bodies,
        dofs: Dofs,
        contacts: Contacts,
        memory: Memory,
        layout: Layout,
        spare: Floats,
        lost: Ints,
        thread: int,
        threads: int,
    ):
        held = collide(contacts, memory, layout, spare, lost, thread, threads)
        gather(wp.static(warps))
        number(world, dofs, held, memory, lost, wp.static(elliptic), thread, threads)
        gather(wp.static(warps))
        weld(world, bodies, dofs, memory, thread, threads)
        connect(world, bodies, dofs, memory, thread, threads)
        gather(wp.static(warps))
        limit(dofs, held, memory, thread, threads)
        gather(wp.static(warps))
        touch(bodies, dofs, held, memory, wp.static(elliptic), wp.static(capsules), wp.static(rolling), thread, threads)
        gather(wp.static(warps))
        if wp.static(elliptic):
            press_cones(dofs, held, memory, thread, threads)
        else:
            press(dofs, held, memory, wp.static(edges), thread, threads)

    return constrain


@functools.cache
def make(floats: int, threads_per_env: int, warps: int, nv: int, traits: Traits) -> Any:
    """Returns the kernel for `nv` degrees of freedom.

    Args:
      floats: memory of an environment; unused on a CPU.
      threads_per_env, warps: threads that share an environment; and warps of 32 threads in a block, 0 on a CPU.
    """
    shared = warps * (32 // threads_per_env) * floats
    own_bodies, own_dofs, own_contacts = owning(traits.varied)
    constrain, end = _constraining(traits, warps), _ending(traits, nv, warps)

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def advance(
        world: World,
        bodies: Bodies,
        dofs: Dofs,
        contacts: Contacts,
        sparse: Sparse,
        layout: Layout,
        spare: Floats2d,
        substeps: int,
        lost: Ints,
        inputs: Floats2d,
        old_qpos: Floats2d,
        old_qvel: Floats2d,
        old_guess: Floats2d,
        qpos: Floats2d,
        qvel: Floats2d,
        guess: Floats2d,
    ):
        """Advances coordinates, velocities and the solver's first guess by `substeps` timesteps.

        `spare` [num_envs, size] is the memory on a CPU; `inputs` [num_envs, 7 nmocap + nu]; `lost` counts lost contacts.
        """
        env, thread = wp.tid()  # type: ignore[misc]
        threads = wp.static(threads_per_env)  # so that the compiler knows them
        if wp.static(shared > 0):
            _ = wp.tile_empty(shape=shared, dtype=float, storage="shared")  # what `carve` takes
        own = spare[env % spare.shape[0]]
        memory = carve(layout, own, threads)
        if wp.static(traits.varied != NONE):
            bodies = own_bodies(bodies, inputs[env])
            dofs = own_dofs(dofs, inputs[env])
            contacts = own_contacts(contacts, inputs[env])
        _begin(memory, old_qpos[env], old_qvel[env], old_guess[env], thread, threads)
        for _substep in range(substeps):
            _forces(world, bodies, dofs, memory, inputs[env], wp.static(traits.has_tendons), wp.static(warps), thread, threads)
            constrain(world, bodies, dofs, contacts, memory, layout, own, lost, thread, threads)
            end(world, bodies, dofs, sparse, memory, inputs[env], thread, threads)
        _end(memory, qpos[env], qvel[env], guess[env], thread, threads)

    return advance
