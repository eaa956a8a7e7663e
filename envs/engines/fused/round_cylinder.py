"""Contacts of spheres and capsules with cylinders.

The contact is where the signed distance from the cylinder is least on the capsule's segment: a convex function, whose slope is
followed by bisection. Where it is flat, for example on parallel axes, the contact is in the middle. A capsule that lies on an
end of the cylinder has a contact where it enters the end's circle, and one where it leaves, as in MuJoCo C. C takes a polygon
for the circle, so its two contacts are up to a twentieth of the radius further inside.
"""

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.contacts import geom_of, put
from mjx_dher.envs.engines.fused.model import Contacts, Memory
from mjx_dher.envs.engines.fused.threads import sync
from mjx_dher.system.warp_setup import wp

_HALVINGS = wp.constant(22)
_FLAT = wp.constant(1.0e-6)  # slope that counts as none
_LYING = wp.constant(0.0887)  # sine of the angle up to which a capsule lies on an end, measured in MuJoCo C


@wp.func
def collide_cylinders_with_round(contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Computes distance, place and normal of the slots of spheres and capsules with cylinders."""
    for i in range(thread, contacts.pairs, threads):
        kind = contacts.kind[i]
        if kind == kinds.SPHERE_CYLINDER or kind == kinds.CAPSULE_CYLINDER:
            geom1, geom2 = contacts.geom1[i], contacts.geom2[i]
            pos1, mat1, size1 = geom_of(contacts, memory, geom1)
            pos2, mat2, size2 = geom_of(contacts, memory, geom2)
            reach = contacts.geom_reach[geom1] + contacts.geom_reach[geom2] + contacts.margin[i]
            if wp.length(pos2 - pos1) <= reach:
                back = wp.transpose(mat2)
                middle = back * (pos1 - pos2)
                axis = back * wp.vec3(mat1[0, 2], mat1[1, 2], mat1[2, 2])
                at = float(0.0)
                if kind == kinds.CAPSULE_CYLINDER:
                    low = _end(middle, axis, -size1[1], size1[1], -_FLAT, size2)
                    at = 0.5 * (low + _end(middle, axis, -size1[1], size1[1], _FLAT, size2))
                point = middle + at * axis
                away = _away(point, size2)
                normal = wp.vec3(away[0], away[1], away[2])
                first, radius = contacts.first[i], size1[0]
                _put(memory, first, point, normal, away[3], radius, pos2, mat2)
                along = axis[0] * axis[0] + axis[1] * axis[1]
                middling = axis[0] * middle[0] + axis[1] * middle[1]
                inside = middling * middling - along * (middle[0] * middle[0] + middle[1] * middle[1] - size2[0] * size2[0])
                if kind == kinds.CAPSULE_CYLINDER and wp.abs(axis[2]) < _LYING and wp.abs(normal[2]) == 1.0 and inside > 0.0:
                    for end in range(2):
                        at = (wp.where(end == 0, -1.0, 1.0) * wp.sqrt(inside) - middling) / along
                        point = middle + wp.clamp(at, -size1[1], size1[1]) * axis
                        _put(memory, first + end, point, normal, point[2] * normal[2] - size2[1], radius, pos2, mat2)
    sync(threads)


@wp.func
def _put(memory: Memory, slot: int, point: wp.vec3, normal: wp.vec3, away: float, radius: float, pos: wp.vec3, mat: wp.mat33):
    """Sets a slot, from the axis's point, the normal and their distance in the cylinder's frame."""
    put(memory, slot, away - radius, pos + mat * (point - 0.5 * (away + radius) * normal), -(mat * normal))


@wp.func
def _end(middle: wp.vec3, axis: wp.vec3, low: float, high: float, slope: float, size: wp.vec3) -> float:
    """The place on a segment up to which the distance's slope is below `slope`."""
    left, right = float(low), float(high)
    for _ in range(_HALVINGS):
        at = 0.5 * (left + right)
        away = _away(middle + at * axis, size)
        if axis[0] * away[0] + axis[1] * away[1] + axis[2] * away[2] < slope:
            left = at
        else:
            right = at
    return 0.5 * (left + right)


@wp.func
def _away(point: wp.vec3, size: wp.vec3) -> wp.vec4:
    """Direction from a cylinder to a point, in the cylinder's frame, and the distance: negative inside."""
    across = wp.sqrt(point[0] * point[0] + point[1] * point[1])
    outwards = wp.vec3(1.0, 0.0, 0.0)
    if across > 1.0e-12:
        outwards = wp.vec3(point[0] / across, point[1] / across, 0.0)
    along = wp.vec3(0.0, 0.0, wp.where(point[2] < 0.0, -1.0, 1.0))
    beside, above = across - size[0], wp.abs(point[2]) - size[1]
    distance = wp.max(beside, above)
    normal = wp.where(beside > above, outwards, along)
    if beside > 0.0 and above > 0.0:
        distance = wp.sqrt(beside * beside + above * above)
        normal = (beside * outwards + above * along) / distance
    return wp.vec4(normal[0], normal[1], normal[2], distance)
