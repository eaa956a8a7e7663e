"""Accelerations under constraints: Newton's method with an exact line search, and the implicit Euler step.

It minimizes 1/2 (a - a0)' M (a - a0) + 1/2 sum of D min(J a - aref, 0)^2 (without the min for equalities), where M a0 are all
other forces. This is convex and piecewise quadratic, so Newton's step from a point in the right piece ends at the minimum. E.
Todorov, Convex and analytically-invertible dynamics with contacts and constraints (2014). Each environment stops individually.
"""

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.cone import add_cones, begin_cones, change_cones, slopes_cones, take_cones
from mjx_dher.envs.engines.fused.dynamics import damping, dot
from mjx_dher.envs.engines.fused.linear import direction
from mjx_dher.envs.engines.fused.memory import copy
from mjx_dher.envs.engines.fused.model import Bodies, Dofs, Floats, Memory, Sparse, World
from mjx_dher.envs.engines.fused.sparse import add_sparse, begin_sparse, change_sparse, slopes_sparse, take_sparse
from mjx_dher.envs.engines.fused.threads import sync, total
from mjx_dher.system.warp_setup import wp

_SLOPE = wp.constant(1e-4)  # of the cost along the search direction, relative to that at its start, at which a search ends
_ROUNDING = wp.constant(1e-10)  # a step's energy relative to that of the accelerations: what single precision leaves unsure
_UNSURE = wp.constant(6e-14)  # the square of four roundings of single precision
_WHOLE = wp.constant(1e-3)  # how near to 1 a step counts as Newton's own


@wp.func
def _pull(world: World, row: int, residual: float, weight: float) -> float:
    """Weight of a row if it acts, else 0. The first ones, of equalities, always do."""
    return wp.where(row < world.equalities or residual < 0.0, weight, 0.0)


@wp.func
def _times_mass(memory: Memory, row: int, x: Floats, size: int) -> float:
    """Row of the mass matrix, whose lower half is in memory, times a vector [size]."""
    sum = float(0.0)
    at = row * (row + 1) // 2
    for i in range(size):
        sum += memory.mass[at] * x[i]
        at += wp.where(i < row, 1, i + 1)
    return sum


@wp.func
def _slopes(
    world: World,
    sparse: Sparse,
    memory: Memory,
    has_sparse: bool,
    elliptic: bool,
    rows: int,
    at: float,
    slope: float,
    curve: float,
    thread: int,
    threads: int,
) -> wp.vec2:
    """First and second derivative of the cost at a step along the search direction."""
    d1 = float(0.0)
    d2 = float(0.0)
    for row in range(thread, rows, threads):
        change = memory.change[row]
        left = memory.residual[row] + at * change
        pull = _pull(world, row, left, memory.weight[row]) * change
        d1 += pull * left
        d2 += pull * change
    if has_sparse:
        more = slopes_sparse(sparse, memory, at, thread, threads)
        d1 += more[0]
        d2 += more[1]
    if elliptic:
        cones = slopes_cones(memory, at, thread, threads)
        d1 += cones[0]
        d2 += cones[1]
    return wp.vec2(total(d1, threads) + slope + at * curve, total(d2, threads) + curve)


@wp.func
def _how_far(
    world: World,
    sparse: Sparse,
    memory: Memory,
    has_sparse: bool,
    elliptic: bool,
    rows: int,
    slope: float,
    curve: float,
    gain: float,
    attempts: int,
    thread: int,
    threads: int,
) -> float:
    """Returns the step along the search direction that minimizes the cost.

    Args:
      slope, curve: first and second derivative of the cost without constraints, where the step is 0.
      gain: minus the first derivative of the whole cost there.
    """
    low = float(0.0)
    high = float(-1.0)
    step = float(1.0)
    for _ in range(attempts):
        d = _slopes(world, sparse, memory, has_sparse, elliptic, rows, step, slope, curve, thread, threads)
        if wp.abs(d[0]) <= _SLOPE * gain:
            break
        if d[0] < 0.0:
            low = step
        else:
            high = step
        step = step - d[0] / d[1]
        if step <= low or (high >= 0.0 and step >= high):
            step = wp.where(high >= 0.0, 0.5 * (low + high), 2.0 * low + 1.0)
    return step


@wp.func
def _take(
    world: World,
    sparse: Sparse,
    memory: Memory,
    has_sparse: bool,
    elliptic: bool,
    far: float,
    rows: int,
    size: int,
    thread: int,
    threads: int,
) -> float:
    """Takes a step along the search direction. Returns the number of rows that begin or cease to act."""
    changed = float(0.0)
    for i in range(thread, size, threads):
        memory.qacc[i] = memory.qacc[i] + far * memory.search[i]
        memory.inert[i] = memory.inert[i] + far * memory.step[i]
    for row in range(thread, rows, threads):
        before = memory.residual[row]
        after = before + far * memory.change[row]
        memory.residual[row] = after
        if row >= world.equalities and (before < 0.0) != (after < 0.0):
            changed += 1.0
    if has_sparse:
        changed += take_sparse(sparse, memory, far, thread, threads)
    if elliptic:
        changed += take_cones(memory, far, thread, threads)
    changed = total(changed, threads)
    sync(threads)
    return changed


@wp.func
def _begin(
    world: World,
    sparse: Sparse,
    memory: Memory,
    has_sparse: bool,
    elliptic: bool,
    rows: int,
    nv: int,
    thread: int,
    threads: int,
) -> float:
    """Initializes the solver at the first guess. Returns the energy that single precision leaves uncertain.

    Rounding J a - aref causes it: at the minimum, a step cannot gain more than the sum of D times the squared error.
    """
    for i in range(thread, nv, threads):
        memory.inert[i] = _times_mass(memory, i, memory.qacc, nv)
    unsure = float(0.0)
    for row in range(thread, rows, threads):
        asked = memory.residual[row]
        has = dot(memory.jacobian, row, memory.qacc, nv)
        residual = has - asked
        memory.residual[row] = residual
        size = wp.abs(has) + wp.abs(asked)
        unsure += _pull(world, row, residual, memory.weight[row]) * size * size
    if has_sparse:
        unsure += begin_sparse(sparse, memory, thread, threads)
    if elliptic:
        unsure += begin_cones(memory, nv, thread, threads)
    unsure = total(unsure, threads)
    sync(threads)
    return _UNSURE * unsure


@wp.func
def solve(world: World, sparse: Sparse, memory: Memory, has_sparse: bool, elliptic: bool, nv: int, thread: int, threads: int):
    """Computes `qacc` from its present value. Flags say whether there are rows of `sparse`, and elliptic cones."""
    rows = memory.counts[1]
    unsure = _begin(world, sparse, memory, has_sparse, elliptic, rows, nv, thread, threads)
    for _ in range(world.iterations):
        energy = float(0.0)
        for i in range(thread, nv, threads):
            energy += memory.qacc[i] * memory.inert[i]
            memory.step[i] = memory.smooth[i] - memory.inert[i]
            memory.search[i] = memory.step[i]
        least = wp.max(wp.max(world.tolerance / world.scale, unsure), _ROUNDING * total(energy, threads))
        if has_sparse:
            add_sparse(sparse, memory, nv, 1, thread, threads)
        elif elliptic:
            copy(memory.mass, memory.factor, thread, threads)
        sync(threads)
        if elliptic:
            add_cones(memory, nv, 1, thread, threads)
        gain = direction(
            memory.mass,
            memory.jacobian,
            memory.weight,
            memory.residual,
            memory.factor,
            memory.search,
            nv,
            rows,
            world.equalities,
            1,
            wp.where(has_sparse or elliptic, 1, 0),
            thread,
            threads,
        )  # the cost's decrease if all of it were one piece, twice
        if not (gain > least):  # also if it is NaN
            break
        slope = float(0.0)
        curve = float(0.0)
        for i in range(thread, nv, threads):
            step_i = _times_mass(memory, i, memory.search, nv)
            slope -= memory.search[i] * memory.step[i]
            curve += memory.search[i] * step_i
            memory.step[i] = step_i
        for row in range(thread, rows, threads):
            memory.change[row] = dot(memory.jacobian, row, memory.search, nv)
        if has_sparse:
            change_sparse(sparse, memory, thread, threads)
        if elliptic:
            change_cones(memory, nv, thread, threads)
        slope = total(slope, threads)
        curve = total(curve, threads)
        far = _how_far(
            world, sparse, memory, has_sparse, elliptic, rows, slope, curve, gain, world.ls_iterations, thread, threads
        )
        changed = _take(world, sparse, memory, has_sparse, elliptic, far, rows, nv, thread, threads)
        if changed == 0.0 and wp.abs(far - 1.0) < _WHOLE:
            break
        if far * far * gain <= least:  # rounding lets the search go no further
            break


@wp.func
def accelerate(
    world: World,
    bodies: Bodies,
    dofs: Dofs,
    sparse: Sparse,
    memory: Memory,
    inputs: Floats,
    has_sparse: bool,
    elliptic: bool,
    nv: int,
    thread: int,
    threads: int,
):
    """Advances velocities by all forces, implicitly in damping."""
    sync(threads)
    for i in range(thread, nv, threads):
        diagonal = i * (i + 3) // 2
        memory.mass[diagonal] = memory.mass[diagonal] + world.timestep * damping(dofs, memory, inputs, i)
        memory.search[i] = memory.smooth[i]
    if has_sparse:
        add_sparse(sparse, memory, nv, 0, thread, threads)
    sync(threads)
    if elliptic:
        add_cones(memory, nv, 0, thread, threads)
    direction(
        memory.mass,
        memory.jacobian,
        memory.weight,
        memory.residual,
        memory.factor,
        memory.search,
        nv,
        memory.counts[1],
        world.equalities,
        0,
        0,
        thread,
        threads,
    )
    if dofs.implicit == 1:
        sync(threads)
        _gyrate(world, bodies, memory, nv, thread, threads)
        sync(threads)
    for i in range(thread, nv, threads):
        memory.qvel[i] = memory.qvel[i] + world.timestep * memory.search[i]
    sync(threads)


@wp.func
def _gyrate(world: World, bodies: Bodies, memory: Memory, nv: int, thread: int, threads: int):
    """Makes accelerations of free bodies that stand alone implicit in gyroscopic forces, as MuJoCo's implicitfast does."""
    for b in range(thread, bodies.number, threads):
        if bodies.kind[b] == kinds.FREE and bodies.last[b] == b:
            dof = bodies.dof[b] + 3
            omega, alpha, mass = wp.vec3(), wp.vec3(), wp.mat33()
            for i in range(3):
                omega[i] = memory.qvel[dof + i]
                alpha[i] = memory.search[dof + i]
                for j in range(3):
                    later, sooner = dof + wp.max(i, j), dof + wp.min(i, j)
                    mass[i, j] = memory.mass[later * (later + 1) // 2 + sooner]
            axes = bodies.principal[b]
            inertia = axes * wp.diag(bodies.inertia[b]) * wp.transpose(axes)
            change = wp.skew(omega) * inertia - wp.skew(inertia * omega)
            alpha = wp.inverse(mass + world.timestep * change) * (mass * alpha)
            for i in range(3):
                memory.search[dof + i] = alpha[i]
