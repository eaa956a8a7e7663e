"""Contacts of spheres and capsules. MuJoCo Warp's functions, which follow MuJoCo C, compute all except those with cylinders.

The contact with a cylinder is where the signed distance from it is least on the capsule's segment: a convex function, whose
slope is followed by bisection. If a part is flat, for example on parallel axes, the contact is in its middle. A capsule that
lies on an end of the cylinder has a contact where it enters the end's circle, and one where it leaves, as in MuJoCo C. C takes
a polygon for the circle, so its two contacts are up to a twentieth of the radius further inside.
"""

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.contacts import axis_of, geom_of, put
from mjx_dher.envs.engines.fused.model import Contacts, Memory
from mjx_dher.envs.engines.fused.threads import sync
from mjx_dher.system import private_api
from mjx_dher.system.warp_setup import wp

_shapes = private_api.mujoco_warp_shapes()
_plane_sphere, _sphere_sphere, _sphere_capsule = _shapes.plane_sphere, _shapes.sphere_sphere, _shapes.sphere_capsule
_sphere_box, _capsule_capsule, _capsule_box = _shapes.sphere_box, _shapes.capsule_capsule, _shapes.capsule_box
_HALVINGS = wp.constant(22)
_FLAT = wp.constant(1.0e-6)  # slope that counts as none
_LYING = wp.constant(0.0887)  # sine of the angle up to which a capsule lies on an end, measured in MuJoCo C


@wp.func
def collide_round(contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Computes distance, place and normal of the slots of spheres and capsules."""
    for p in range(thread, contacts.pairs, threads):
        kind = contacts.kind[p]
        if kind >= kinds.PLANE_SPHERE and kind <= kinds.CAPSULE_BOX:
            geom1, geom2 = contacts.geom1[p], contacts.geom2[p]
            pos1, mat1, size1 = geom_of(contacts, memory, geom1)
            pos2, mat2, size2 = geom_of(contacts, memory, geom2)
            margin = contacts.margin[p]
            apart = wp.length(pos2 - pos1) - contacts.geom_reach[geom1] - contacts.geom_reach[geom2]
            if kind == kinds.PLANE_SPHERE or kind == kinds.PLANE_CAPSULE:
                apart = wp.dot(pos2 - pos1, axis_of(mat1)) - contacts.geom_reach[geom2]
            if apart <= margin:
                _meet(memory, kind, contacts.first[p], margin, pos1, mat1, size1, pos2, mat2, size2)
    sync(threads)


@wp.func
def _meet(
    memory: Memory,
    kind: int,
    first: int,
    margin: float,
    pos1: wp.vec3,
    mat1: wp.mat33,
    size1: wp.vec3,
    pos2: wp.vec3,
    mat2: wp.mat33,
    size2: wp.vec3,
):
    """Sets the slots of a pair of geoms."""
    axis1, axis2 = axis_of(mat1), axis_of(mat2)
    if kind == kinds.PLANE_SPHERE:
        distance, place = _plane_sphere(axis1, pos1, pos2, size2[0])
        put(memory, first, distance, place, axis1)
    elif kind == kinds.PLANE_CAPSULE:
        for i in range(2):
            end = pos2 + wp.where(i == 0, size2[1], -size2[1]) * axis2
            distance, place = _plane_sphere(axis1, pos1, end, size2[0])
            put(memory, first + i, distance, place, axis1)
    elif kind == kinds.SPHERE_SPHERE:
        distance, place, normal = _sphere_sphere(pos1, size1[0], pos2, size2[0])
        put(memory, first, distance, place, normal)
    elif kind == kinds.SPHERE_CAPSULE:
        distance, place, normal = _sphere_capsule(pos1, size1[0], pos2, axis2, size2[0], size2[1])
        put(memory, first, distance, place, normal)
    elif kind == kinds.SPHERE_BOX:
        distance, place, normal = _sphere_box(pos1, size1[0], pos2, mat2, size2)
        put(memory, first, distance, place, normal)
    elif kind == kinds.CAPSULE_CAPSULE:
        distances, places, normals = _capsule_capsule(pos1, axis1, size1[0], size1[1], pos2, axis2, size2[0], size2[1], margin)
        for i in range(2):
            put(memory, first + i, distances[i], places[i], normals[i])
    elif kind == kinds.CAPSULE_BOX:
        distances, places, normals = _capsule_box(pos1, axis1, size1[0], size1[1], pos2, mat2, size2)
        for i in range(2):
            put(memory, first + i, distances[i], places[i], normals[i])


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
                axis = back * axis_of(mat1)
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
