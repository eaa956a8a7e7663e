"""Contacts of ellipsoids with planes, spheres, capsules and boxes.

A sphere is a point with a radius, a capsule a segment with a radius, and a box a box with radius 0. The contact is at the
point, on the segment or in the box, that is deepest in the ellipsoid, or nearest to it. The signed distance from a convex
shape is a convex function, so Newton's method, kept within the segment or box, finds that point. MuJoCo C runs its general
convex solver (GJK and EPA) here, which finds the same contact up to a depth of about a third of the shortest half axis.
Source: D. Bertsekas, Projected Newton methods for optimization problems with simple constraints (1982).
"""

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.contacts import axis_of, geom_of, put
from mjx_dher.envs.engines.fused.model import Contacts, Memory
from mjx_dher.envs.engines.fused.threads import sync
from mjx_dher.system import private_api
from mjx_dher.system.warp_setup import wp

_plane_ellipsoid = private_api.mujoco_warp_shapes().plane_ellipsoid
_STEPS, _HALVINGS = wp.constant(60), wp.constant(12)  # most steps of Newton's method, and halvings of a step
_FLAT = wp.constant(1.0e-5)  # slope at which the search ends
_ROUNDING = wp.constant(3.0e-7)  # a decrease that single precision leaves unsure, relative to the longest axis
_INSIDE = wp.constant(0.999)  # how far towards the middle of the ellipsoid distances are exact


@wp.func
def collide_ellipsoids(contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Computes distance, place and normal of the slots of ellipsoids."""
    for i in range(thread, contacts.pairs, threads):
        kind = contacts.kind[i]
        if kind >= kinds.PLANE_ELLIPSOID and kind <= kinds.ELLIPSOID_BOX:
            geom1, geom2 = contacts.geom1[i], contacts.geom2[i]
            pos1, mat1, size1 = geom_of(contacts, memory, geom1)
            pos2, mat2, size2 = geom_of(contacts, memory, geom2)
            margin = contacts.margin[i]
            slot = contacts.first[i]
            if kind == kinds.PLANE_ELLIPSOID:
                distance, place, normal = _plane_ellipsoid(axis_of(mat1), pos1, pos2, mat2, size2)
                put(memory, slot, distance, place, normal)
            elif wp.length(pos2 - pos1) <= contacts.geom_reach[geom1] + contacts.geom_reach[geom2] + margin:
                if kind == kinds.ELLIPSOID_BOX:
                    distance, place, normal = _shape(pos1, mat1, size1, pos2, mat2, size2, 0.0)
                else:
                    half = wp.vec3(0.0, 0.0, wp.where(kind == kinds.CAPSULE_ELLIPSOID, size1[1], 0.0))
                    distance, place, normal = _shape(pos2, mat2, size2, pos1, mat1, half, size1[0])
                    normal = -normal
                put(memory, slot, distance, place, normal)
    sync(threads)


@wp.func
def _shape(pos: wp.vec3, mat: wp.mat33, axes: wp.vec3, box_pos: wp.vec3, box_mat: wp.mat33, half: wp.vec3, radius: float):
    """Returns distance, place and normal, from the ellipsoid to the other, of the contact of an ellipsoid and a rounded box."""
    turn = wp.transpose(mat) * box_mat
    middle = wp.transpose(mat) * (box_pos - pos)
    at = _within(-(wp.transpose(turn) * middle), half)
    longest = wp.max(axes)
    for _ in range(_STEPS):
        point = middle + turn * at
        normal, bend = _curved(point, axes)
        slope = wp.transpose(turn) * normal
        bend = wp.transpose(turn) * bend * turn
        steep = float(0.0)
        for k in range(3):
            stuck = (at[k] <= -half[k] and slope[k] > 0.0) or (at[k] >= half[k] and slope[k] < 0.0) or half[k] == 0.0
            if stuck:
                slope[k] = 0.0
                for j in range(3):
                    bend[k, j] = 0.0
                    bend[j, k] = 0.0
            bend[k, k] += wp.where(stuck, 1.0, 1.0e-4) / longest
            steep = wp.max(steep, wp.abs(slope[k]))
        if steep < _FLAT:
            break
        step = -(wp.inverse(bend) * slope)
        step *= wp.min(1.0, 2.0 * longest / wp.max(wp.length(step), 1.0e-12))
        depth = _depth(point, axes)
        moved = at
        for _halving in range(_HALVINGS):
            moved = _within(at + step, half)
            less = -wp.dot(slope, moved - at)
            if wp.abs(less) < _ROUNDING * longest or _depth(middle + turn * moved, axes) <= depth - 1.0e-4 * less:
                break
            step *= 0.5
        if wp.length(moved - at) < 1.0e-7 * longest:
            break
        at = moved
    point = middle + turn * at
    normal = _outwards(point, axes)
    distance = _away(point, normal, axes)
    place = pos + mat * (point - 0.5 * (distance + radius) * normal)
    return distance - radius, place, mat * normal


@wp.func
def _within(at: wp.vec3, half: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.clamp(at[0], -half[0], half[0]), wp.clamp(at[1], -half[1], half[1]), wp.clamp(at[2], -half[2], half[2]))


@wp.func
def _shift(point: wp.vec3, axes: wp.vec3) -> float:
    """Returns t, for which the surface's nearest point q has q_i = a_i^2 / (a_i^2 + t) p_i: negative inside.

    Newton's method on 1 - 1 / |x|, where x is q divided by the axes: it is concave, so no step from below goes too far.
    """
    shortest = wp.min(axes)
    t = -_INSIDE * shortest * shortest
    for k in range(3):
        t = wp.max(t, axes[k] * (wp.abs(point[k]) - axes[k]))
    for _ in range(_STEPS):
        square = float(0.0)
        slope = float(0.0)
        for k in range(3):
            inverse = 1.0 / (axes[k] * axes[k] + t)
            x = axes[k] * point[k] * inverse
            square += x * x
            slope += x * x * inverse
        more = wp.sqrt(square) - 1.0
        if not (more > 1.0e-6):
            break
        t += square / slope * more
    return t


@wp.func
def _outwards(point: wp.vec3, axes: wp.vec3) -> wp.vec3:
    """The surface's normal at the point that is nearest to `point`."""
    t = _shift(point, axes)
    square = wp.cw_mul(axes, axes)
    v = wp.cw_div(point, square + wp.vec3(t))
    size = wp.length(v)
    if size > 1.0e-12:
        return v / size
    least = wp.min(axes)  # in the middle: along the shortest axis
    return wp.normalize(wp.vec3(float(axes[0] == least), float(axes[1] == least), float(axes[2] == least)))


@wp.func
def _away(point: wp.vec3, normal: wp.vec3, axes: wp.vec3) -> float:
    """Distance of a point from the ellipsoid's tangent plane with this normal."""
    return wp.dot(normal, point) - wp.length(wp.cw_mul(axes, normal))


@wp.func
def _depth(point: wp.vec3, axes: wp.vec3) -> float:
    """Distance of a point from the ellipsoid, negative inside."""
    return _away(point, _outwards(point, axes), axes)


@wp.func
def _curved(point: wp.vec3, axes: wp.vec3):
    """First and second derivatives of the distance from the ellipsoid."""
    t = _shift(point, axes)
    normal = _outwards(point, axes)
    inverse = wp.cw_div(wp.vec3(1.0), wp.cw_mul(axes, axes) + wp.vec3(t))
    v = wp.cw_mul(point, inverse)
    size = wp.max(wp.length(v), 1.0e-4 / wp.max(axes))
    change = wp.cw_mul(inverse, v)
    along = v - t * change
    bend = wp.diag(inverse) - wp.outer(change, along) / wp.max(wp.dot(along, v), 1.0e-4 * size * size)
    return normal, (bend - wp.outer(normal, wp.transpose(bend) * normal)) / size
