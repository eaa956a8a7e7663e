"""Contacts of spheres and capsules, with MuJoCo Warp's functions for them, which follow MuJoCo C."""

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.contacts import geom_of, put
from mjx_dher.envs.engines.fused.model import Contacts, Memory
from mjx_dher.envs.engines.fused.threads import sync
from mjx_dher.system import private_api
from mjx_dher.system.warp_setup import wp

_shapes = private_api.mujoco_warp_shapes()
_plane_sphere, _sphere_sphere, _sphere_capsule = _shapes.plane_sphere, _shapes.sphere_sphere, _shapes.sphere_capsule
_sphere_box, _capsule_capsule, _capsule_box = _shapes.sphere_box, _shapes.capsule_capsule, _shapes.capsule_box


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
                apart = wp.dot(pos2 - pos1, _axis(mat1)) - contacts.geom_reach[geom2]
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
    axis1, axis2 = _axis(mat1), _axis(mat2)
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
def _axis(mat: wp.mat33) -> wp.vec3:
    """Third axis of a geom: a plane's normal, a capsule's direction."""
    return wp.vec3(mat[0, 2], mat[1, 2], mat[2, 2])
