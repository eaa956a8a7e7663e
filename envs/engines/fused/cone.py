"""Elliptic friction cones: a contact's rows act together, along the normal, both tangents, and about them.

Residuals u = J a - aref are multiplied by friction, the first one by mu = friction / sqrt(impratio), so that all have one
weight W. N is the first one and T the length of the others. A contact costs nothing if N >= mu T, W / 2 |u|^2 if
mu N + T <= 0, and otherwise W / 2 (N - mu T)^2 / (1 + mu^2): https://mujoco.readthedocs.io/en/3.17.0/computation/index.html#friction-cones.
"""

from mjx_dher.envs.engines.fused.constraints import asked
from mjx_dher.envs.engines.fused.dynamics import dot
from mjx_dher.envs.engines.fused.model import Contacts, Dofs, Memory
from mjx_dher.envs.engines.fused.threads import sync
from mjx_dher.system.warp_setup import wp

_MOST = wp.constant(6)  # rows of a contact
_OPEN, _MIDDLE, _STUCK = (wp.constant(piece) for piece in range(3))  # pieces of the cost


@wp.func
def press_cones(dofs: Dofs, contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Sets the weights of contacts, reference accelerations of their rows, and `cone`.

    A contact's first row has the contact's weight. The second row has mu in the weight's place.
    """
    for at in range(thread, _MOST * memory.counts[0], threads):
        c, k = at // _MOST, at % _MOST
        s = memory.touching[c]
        pair = contacts.pair[s]
        dim = contacts.dim[pair]
        if k < dim:
            row = memory.slot[c] + k
            velocity = dot(memory.jacobian, row, memory.qvel, dofs.number)
            depth = memory.distance[s] - contacts.margin[pair]
            mu = contacts.mu[pair]
            asks = asked(contacts.soft[pair], depth, depth, contacts.weight[pair], 0.0)
            if k == 0:
                memory.cone[c] = row + (dim << 16)
                memory.weight[row] = asks[0] / (mu * mu)
                memory.residual[row] = mu * asks[1] - contacts.soft[pair][1] * velocity
            else:
                memory.weight[row] = mu
                memory.residual[row] = -contacts.slip[pair] * velocity
    sync(threads)


@wp.func
def _piece(normal: float, aside: float, mu: float) -> int:
    """The piece of the cost, from N and T."""
    if normal >= mu * aside:
        return _OPEN
    if mu * normal + aside <= 0.0:
        return _STUCK
    return _MIDDLE


@wp.func
def _mu(memory: Memory, row: int, dim: int) -> float:
    if dim == 1:
        return 1.0
    return memory.weight[row + 1]


@wp.func
def _aside(memory: Memory, row: int, dim: int) -> float:
    """Length of a contact's residuals but the first."""
    square = float(0.0)
    for k in range(1, dim):
        square += memory.residual[row + k] * memory.residual[row + k]
    return wp.sqrt(square)


@wp.func
def begin_cones(memory: Memory, nv: int, thread: int, threads: int) -> float:
    """Computes the residuals of the first guess. Returns a thread's part of their uncertain energy."""
    unsure = float(0.0)
    for c in range(thread, memory.counts[0], threads):
        row, dim = memory.cone[c] & 65535, memory.cone[c] >> 16
        size = float(0.0)
        for k in range(dim):
            asks = memory.residual[row + k]
            has = dot(memory.jacobian, row + k, memory.qacc, nv)
            memory.residual[row + k] = has - asks
            size += (wp.abs(has) + wp.abs(asks)) * (wp.abs(has) + wp.abs(asks))
        if _piece(memory.residual[row], _aside(memory, row, dim), _mu(memory, row, dim)) != _OPEN:
            unsure += memory.weight[row] * size
    return unsure


@wp.func
def change_cones(memory: Memory, nv: int, thread: int, threads: int):
    """Computes how residuals change along the search direction."""
    for row in range(memory.counts[1] + thread, memory.counts[2], threads):
        memory.change[row] = dot(memory.jacobian, row, memory.search, nv)
    sync(threads)


@wp.func
def slopes_cones(memory: Memory, at: float, thread: int, threads: int) -> wp.vec2:
    """A thread's part of the cost's derivatives at a step along the search direction."""
    d1, d2 = float(0.0), float(0.0)
    for c in range(thread, memory.counts[0], threads):
        row, dim = memory.cone[c] & 65535, memory.cone[c] >> 16
        mu, weight = _mu(memory, row, dim), memory.weight[row]
        turn = memory.change[row]
        normal = memory.residual[row] + at * turn
        square, mixed, moved = float(0.0), float(0.0), float(0.0)
        for k in range(1, dim):
            change = memory.change[row + k]
            left = memory.residual[row + k] + at * change
            square += left * left
            mixed += left * change
            moved += change * change
        aside = wp.sqrt(square)
        piece = _piece(normal, aside, mu)
        if piece == _STUCK:
            d1 += weight * (normal * turn + mixed)
            d2 += weight * (turn * turn + moved)
        elif piece == _MIDDLE:
            along = mixed / aside
            short = normal - mu * aside
            slope = turn - mu * along
            d1 += weight / (1.0 + mu * mu) * short * slope
            d2 += weight / (1.0 + mu * mu) * (slope * slope - short * mu * (moved - along * along) / aside)
    return wp.vec2(d1, d2)


@wp.func
def take_cones(memory: Memory, far: float, thread: int, threads: int) -> float:
    """Takes a step along the search direction. Returns a thread's number of contacts for which it was not exact."""
    changed = float(0.0)
    for c in range(thread, memory.counts[0], threads):
        row, dim = memory.cone[c] & 65535, memory.cone[c] >> 16
        mu = _mu(memory, row, dim)
        before = _piece(memory.residual[row], _aside(memory, row, dim), mu)
        for k in range(dim):
            memory.residual[row + k] = memory.residual[row + k] + far * memory.change[row + k]
        after = _piece(memory.residual[row], _aside(memory, row, dim), mu)
        if before != after or after == _MIDDLE:
            changed += 1.0
    return changed


@wp.func
def add_cones(memory: Memory, nv: int, stiff: int, thread: int, threads: int):
    """Adds the forces of contacts to `search` and, with `stiff` 1, their stiffness to `factor`."""
    for c in range(memory.counts[0]):
        row, dim = memory.cone[c] & 65535, memory.cone[c] >> 16
        mu, weight = _mu(memory, row, dim), memory.weight[row]
        normal, aside = memory.residual[row], _aside(memory, row, dim)
        piece = _piece(normal, aside, mu)
        if piece != _OPEN:
            short = normal - mu * aside
            scale = weight * wp.where(piece == _MIDDLE, 1.0 / (1.0 + mu * mu), 1.0)
            for i in range(thread, nv, threads):
                x, y = wp.spatial_vector(), wp.spatial_vector()
                along = float(0.0)
                for k in range(dim):
                    x[k] = memory.jacobian[(row + k) * nv + i]
                    if k > 0:
                        along += x[k] * memory.residual[row + k]
                force = x[0] * normal + along
                y = 1.0 * x
                if piece == _MIDDLE:
                    along = along / aside
                    slope = x[0] - mu * along
                    force = short * slope
                    y[0] = slope
                    for k in range(1, dim):
                        t = memory.residual[row + k] / aside
                        y[k] = -mu * slope * t - short * mu / aside * (x[k] - along * t)
                memory.search[i] = memory.search[i] - scale * force
                if stiff == 1:
                    for j in range(i + 1):
                        more = float(0.0)
                        for k in range(dim):
                            more += y[k] * memory.jacobian[(row + k) * nv + j]
                        place = i * (i + 1) // 2 + j
                        memory.factor[place] = memory.factor[place] + scale * more
    sync(threads)
