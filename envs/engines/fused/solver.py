"""The accelerations that constraints allow: Newton's method with an exact line search, and the implicit Euler step.

Minimized is 1/2 (a - a0)' M (a - a0) + 1/2 sum of D min(J a - aref, 0)^2 (the weld's rows without the min), where M a0 are all
other forces: convex and quadratic in pieces, so that Newton's step from a point in the right piece ends at the minimum.
E. Todorov, Convex and analytically-invertible dynamics with contacts and constraints (2014). Each environment stops on its own.
"""

from mjx_dher.envs.engines.fused.lanes import sync, total
from mjx_dher.envs.engines.fused.model import Dofs, Memory, World
from mjx_dher.host.warp_setup import wp

_EQUALITIES = wp.constant(6)  # rows that hold from both sides, the first ones
_SLOPE = wp.constant(1e-4)  # of the cost along the search direction, relative to that at its start, at which a search ends
_ROUNDING = wp.constant(1e-10)  # a step's energy relative to that of the accelerations: what single precision leaves unsure
_WHOLE = wp.constant(1e-3)  # how near to 1 a step counts as Newton's own


@wp.func
def _pull(row: int, residual: float, weight: float) -> float:
    """Returns a row's weight if it acts, else 0."""
    return wp.where(row < _EQUALITIES or residual < 0.0, weight, 0.0)


@wp.func
def _dot(matrix: wp.array(dtype=float), row: int, x: wp.array(dtype=float), size: int) -> float:
    """Returns a row of a matrix [.., size] times a vector [size]."""
    sum = float(0.0)
    for i in range(size):
        sum += matrix[row * size + i] * x[i]
    return sum


@wp.func
def _forces(
    jacobian: wp.array(dtype=float), residual: wp.array(dtype=float), pull: wp.array(dtype=float), rows: int, size: int, i: int
) -> float:
    """Returns the force of all constraints on a degree of freedom."""
    force = float(0.0)
    for row in range(rows):
        force -= jacobian[row * size + i] * pull[row] * residual[row]
    return force


@wp.func
def _factorize(factor: wp.array(dtype=float), pivot: wp.array(dtype=float), size: int, lane: int, lanes: int):
    """Computes L L' = `factor` in its place, and L^-1 times the right-hand side in the row below."""
    for k in range(size):
        for i in range(k + lane, size + 1, lanes):
            left = factor[i * size + k]
            for j in range(k):
                left -= factor[i * size + j] * factor[k * size + j]
            factor[i * size + k] = left
        sync(lanes)
        inverse = 1.0 / wp.sqrt(wp.max(factor[k * size + k], 1.0e-20))
        for i in range(k + 1 + lane, size + 1, lanes):
            factor[i * size + k] = factor[i * size + k] * inverse
        if lane == 0:
            pivot[k] = inverse
        sync(lanes)


@wp.func
def _substitute(
    factor: wp.array(dtype=float), pivot: wp.array(dtype=float), x: wp.array(dtype=float), size: int, lane: int, lanes: int
):
    """Computes x = L'^-1 times the row below the factor."""
    for back in range(size):
        k = size - 1 - back
        xk = factor[size * size + k] * pivot[k]
        for j in range(lane, k, lanes):
            factor[size * size + j] = factor[size * size + j] - factor[k * size + j] * xk
        if lane == 0:
            x[k] = xk
        sync(lanes)


@wp.func
def _hessian(
    mass: wp.array(dtype=float),
    jacobian: wp.array(dtype=float),
    pull: wp.array(dtype=float),
    factor: wp.array(dtype=float),
    rows: int,
    size: int,
    lane: int,
    lanes: int,
):
    """Computes the mass matrix and what acting rows add, in the lower triangle of `factor`."""
    for at in range(lane, size * (size + 1) // 2, lanes):
        i = int((wp.sqrt(8.0 * float(at) + 1.0) - 1.0) * 0.5)  # row of the triangle's entry
        j = at - i * (i + 1) // 2
        sum = mass[i * size + j]
        for row in range(rows):
            if pull[row] != 0.0:
                sum += pull[row] * jacobian[row * size + i] * jacobian[row * size + j]
        factor[i * size + j] = sum


@wp.func
def _slopes(memory: Memory, rows: int, at: float, slope: float, curve: float, lane: int, lanes: int) -> wp.vec2:
    """Returns the first and second derivative of the cost, so far along the search direction."""
    d1 = float(0.0)
    d2 = float(0.0)
    for row in range(lane, rows, lanes):
        change = memory.change[row]
        left = memory.residual[row] + at * change
        pull = _pull(row, left, memory.weight[row]) * change
        d1 += pull * left
        d2 += pull * change
    return wp.vec2(total(d1, lanes) + slope + at * curve, total(d2, lanes) + curve)


@wp.func
def _how_far(memory: Memory, rows: int, slope: float, curve: float, attempts: int, lane: int, lanes: int) -> float:
    """Returns the step along the search direction that minimizes the cost.

    Args:
      slope, curve: first and second derivative of the cost without constraints, where the step is 0.
    """
    least = _SLOPE * wp.abs(_slopes(memory, rows, 0.0, slope, curve, lane, lanes)[0])
    low = float(0.0)
    high = float(-1.0)
    step = float(1.0)
    for _ in range(attempts):
        d = _slopes(memory, rows, step, slope, curve, lane, lanes)
        if wp.abs(d[0]) <= least:
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
def _take(memory: Memory, far: float, rows: int, size: int, lane: int, lanes: int) -> float:
    """Goes so far along the search direction; returns how many rows begin or cease to act."""
    changed = float(0.0)
    for i in range(lane, size, lanes):
        memory.qacc[i] = memory.qacc[i] + far * memory.search[i]
        memory.inert[i] = memory.inert[i] + far * memory.step[i]
    for row in range(lane, rows, lanes):
        before = memory.pull[row]
        memory.residual[row] = memory.residual[row] + far * memory.change[row]
        memory.pull[row] = _pull(row, memory.residual[row], memory.weight[row])
        if before != memory.pull[row]:
            changed += 1.0
    changed = total(changed, lanes)
    sync(lanes)
    return changed


@wp.func
def _begin(memory: Memory, rows: int, nv: int, lane: int, lanes: int):
    """Computes what the solver keeps up to date, at the first guess."""
    for i in range(lane, nv, lanes):
        memory.inert[i] = _dot(memory.mass, i, memory.qacc, nv)
    for row in range(lane, rows, lanes):
        memory.residual[row] = _dot(memory.jacobian, row, memory.qacc, nv) - memory.aref[row]
        memory.pull[row] = _pull(row, memory.residual[row], memory.weight[row])
    sync(lanes)


@wp.func
def solve(world: World, dofs: Dofs, memory: Memory, lane: int, lanes: int):
    """Computes `qacc`, from what it holds on."""
    nv = dofs.number
    rows = memory.counts[1]
    _begin(memory, rows, nv, lane, lanes)
    for _ in range(world.iterations):
        for i in range(lane, nv, lanes):
            memory.factor[nv * nv + i] = (
                memory.smooth[i] + _forces(memory.jacobian, memory.residual, memory.pull, rows, nv, i) - memory.inert[i]
            )
        _hessian(memory.mass, memory.jacobian, memory.pull, memory.factor, rows, nv, lane, lanes)
        sync(lanes)
        _factorize(memory.factor, memory.pivot, nv, lane, lanes)
        gain = float(0.0)  # the cost's decrease if all of it were one piece, twice: |L^-1 gradient|^2
        for i in range(nv):
            gain += memory.factor[nv * nv + i] * memory.factor[nv * nv + i]
        energy = float(0.0)
        for i in range(lane, nv, lanes):
            energy += memory.qacc[i] * memory.inert[i]
        least = wp.max(world.tolerance / world.scale, _ROUNDING * total(energy, lanes))
        if not (gain > least):  # also if it is NaN
            break
        sync(lanes)
        _substitute(memory.factor, memory.pivot, memory.search, nv, lane, lanes)
        slope = float(0.0)
        curve = float(0.0)
        for i in range(lane, nv, lanes):
            step_i = _dot(memory.mass, i, memory.search, nv)
            memory.step[i] = step_i
            slope += memory.search[i] * (memory.inert[i] - memory.smooth[i])
            curve += memory.search[i] * step_i
        for row in range(lane, rows, lanes):
            memory.change[row] = _dot(memory.jacobian, row, memory.search, nv)
        slope = total(slope, lanes)
        curve = total(curve, lanes)
        far = _how_far(memory, rows, slope, curve, world.ls_iterations, lane, lanes)
        changed = _take(memory, far, rows, nv, lane, lanes)
        if changed == 0.0 and wp.abs(far - 1.0) < _WHOLE:
            break


@wp.func
def accelerate(world: World, dofs: Dofs, memory: Memory, lane: int, lanes: int):
    """Advances velocities by all forces, implicitly in damping."""
    nv = dofs.number
    rows = memory.counts[1]
    factor = memory.factor
    search = memory.search
    sync(lanes)
    for i in range(lane, nv, lanes):
        forces = _forces(memory.jacobian, memory.residual, memory.pull, rows, nv, i)
        factor[nv * nv + i] = memory.smooth[i] + forces
    for at in range(lane, nv * nv, lanes):
        i = at // nv
        factor[at] = memory.mass[at] + wp.where(i == at % nv, world.timestep * dofs.damping[i], 0.0)
    sync(lanes)
    _factorize(factor, memory.pivot, nv, lane, lanes)
    _substitute(factor, memory.pivot, search, nv, lane, lanes)
    for i in range(lane, nv, lanes):
        memory.qvel[i] = memory.qvel[i] + world.timestep * search[i]
    sync(lanes)
