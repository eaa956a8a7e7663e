"""Contacts of a substep: a thread for each pair of geoms."""

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.cylinder import cylinder_box
from mjx_dher.envs.engines.fused.model import Contacts, Memory
from mjx_dher.envs.engines.fused.threads import sync
from mjx_dher.system import private_api
from mjx_dher.system.warp_setup import wp

_TILT = wp.constant(1e-3)  # rad
_APART = wp.constant(1e-3)  # least distance of two contacts, relative to the smaller shape
FAR = wp.constant(1.0e10)  # m, the distance of a slot without a contact

_shapes = private_api.mujoco_warp_shapes()
_box_box, _plane_cylinder = _shapes.box_box, _shapes.plane_cylinder


@wp.func
def collide_with_planes(contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Computes distance, place and normal of the slots of planes, and marks all others as empty."""
    for p in range(thread, contacts.pairs, threads):
        first = contacts.first[p]
        for i in range(contacts.most[p]):
            memory.distance[first + i] = FAR
        kind = contacts.kind[p]
        if kind == kinds.PLANE_BOX or kind == kinds.PLANE_CYLINDER:
            geom1 = contacts.geom1[p]
            geom2 = contacts.geom2[p]
            mat1 = _mat(contacts, memory, geom1)
            pos1 = _pos(contacts, memory, geom1)
            pos2 = _pos(contacts, memory, geom2)
            margin = contacts.margin[p]
            normal = axis_of(mat1)
            if wp.dot(pos2 - pos1, normal) <= contacts.geom_reach[geom2] + margin:
                mat2 = _mat(contacts, memory, geom2)
                size2 = contacts.geom_size[geom2]
                if kind == kinds.PLANE_BOX:
                    _corners(memory, first, margin, pos1, normal, pos2, mat2, size2)
                else:
                    _rim(memory, first, pos1, normal, pos2, mat2, size2)
    sync(threads)


@wp.func
def collide_boxes(contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Computes distance, place and normal of the slots of two boxes."""
    for p in range(thread, contacts.pairs, threads):
        if contacts.kind[p] == kinds.BOX_BOX:
            geom1, geom2 = contacts.geom1[p], contacts.geom2[p]
            pos1, mat1, size1 = geom_of(contacts, memory, geom1)
            pos2, mat2, size2 = geom_of(contacts, memory, geom2)
            margin = contacts.margin[p]
            if _near(pos1, contacts.geom_reach[geom1] + margin, pos2, mat2, size2) and _near(
                pos2, contacts.geom_reach[geom2] + margin, pos1, mat1, size1
            ):
                first = contacts.first[p]
                number, distances, places, normal = _box_box(pos1, mat1, size1, pos2, mat2, size2, margin)
                for i in range(number):
                    put(memory, first + i, distances[i], places[i], normal)
    sync(threads)


@wp.func
def collide_cylinders(contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Computes distance, place and normal of the slots of a cylinder and a box.

    As in MuJoCo C, the first contact is found with both in place, and up to four more with both slightly tilted about it.
    """
    for round in range(contacts.rounds):  # not twice in the code, which is long
        for at in range(thread, wp.where(round == 0, 1, 4) * contacts.pairs, threads):
            p = wp.where(round == 0, at, at // 4)
            if contacts.kind[p] == kinds.CYLINDER_BOX:
                _meet(contacts, memory, p, round, at % 4)
        sync(threads)
    _thin(contacts, memory, thread, threads)


@wp.func
def _meet(contacts: Contacts, memory: Memory, p: int, round: int, direction: int):
    """Sets a slot of a cylinder and a box: the first, or one with both tilted in a direction."""
    geom1, geom2 = contacts.geom1[p], contacts.geom2[p]
    pos1, mat1, size1 = geom_of(contacts, memory, geom1)
    pos2, mat2, size2 = geom_of(contacts, memory, geom2)
    margin = contacts.margin[p]
    first = contacts.first[p]
    near = bool(True)
    if round == 0:
        near = _near(pos1, contacts.geom_reach[geom1] + margin, pos2, mat2, size2)
    else:
        near = memory.distance[first] < margin
    if near:
        if round > 0:
            centre = memory.place[first]
            normal = memory.normal[first]
            axis = tangent(normal)
            if direction >= 2:
                axis = wp.cross(normal, axis)
            half = _TILT * wp.where(direction % 2 == 0, -0.5, 0.5)
            turn = wp.quat_to_matrix(wp.quat(wp.sin(half) * axis, wp.cos(half)))
            back = wp.transpose(turn)
            pos1 = centre + turn * (pos1 - centre)
            mat1 = turn * mat1
            pos2 = centre + back * (pos2 - centre)
            mat2 = back * mat2
        distance, place, normal_of_one = cylinder_box(pos1, mat1, size1, pos2, mat2, size2, margin)
        slot = first
        if round > 0:
            slot = first + 1 + direction
        if round == 0:
            memory.distance[slot] = distance
        elif distance < margin:
            memory.distance[slot] = memory.distance[first]
        if distance < margin:
            memory.place[slot] = place
            memory.normal[slot] = normal_of_one


@wp.func
def _thin(contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Drops contacts of a cylinder and a box that are close to another one."""
    for p in range(thread, contacts.pairs, threads):
        first = contacts.first[p]
        if contacts.kind[p] == kinds.CYLINDER_BOX:
            least = _APART * wp.min(contacts.geom_reach[contacts.geom1[p]], contacts.geom_reach[contacts.geom2[p]])
            for i in range(1, 5):
                for j in range(i):
                    if memory.distance[first + j] < FAR:
                        if wp.length(memory.place[first + i] - memory.place[first + j]) <= least:
                            memory.distance[first + i] = FAR
    sync(threads)


@wp.func
def tangent(normal: wp.vec3) -> wp.vec3:
    """First tangent, as in MuJoCo: near y, or near z if the normal is near y."""
    other = wp.vec3(0.0, 1.0, 0.0)
    if wp.abs(normal[1]) >= 0.5:
        other = wp.vec3(0.0, 0.0, 1.0)
    return wp.normalize(other - wp.dot(other, normal) * normal)


@wp.func
def tangent_of(contacts: Contacts, memory: Memory, pair: int, normal: wp.vec3) -> wp.vec3:
    """First tangent of a contact: of a plane and a capsule, as in MuJoCo C, along the capsule unless it stands."""
    if contacts.kind[pair] == kinds.PLANE_CAPSULE:
        axis = axis_of(_mat(contacts, memory, contacts.geom2[pair]))
        along = axis - wp.dot(axis, normal) * normal
        if wp.length(along) > 1.0e-6:
            return wp.normalize(along)
    return tangent(normal)


@wp.func
def _mat(contacts: Contacts, memory: Memory, geom: int) -> wp.mat33:
    return memory.mat[contacts.geom_body[geom]] * contacts.geom_mat[geom]


@wp.func
def _pos(contacts: Contacts, memory: Memory, geom: int) -> wp.vec3:
    body = contacts.geom_body[geom]
    return memory.pos[body] + memory.mat[body] * contacts.geom_pos[geom]


@wp.func
def geom_of(contacts: Contacts, memory: Memory, geom: int):
    """Position, axes and size of a geom."""
    return _pos(contacts, memory, geom), _mat(contacts, memory, geom), contacts.geom_size[geom]


@wp.func
def axis_of(mat: wp.mat33) -> wp.vec3:
    """Third axis of a geom: a plane's normal, the direction of a capsule or cylinder."""
    return wp.vec3(mat[0, 2], mat[1, 2], mat[2, 2])


@wp.func
def put(memory: Memory, slot: int, distance: float, place: wp.vec3, normal: wp.vec3):
    """Sets a slot."""
    memory.distance[slot] = distance
    memory.place[slot] = place
    memory.normal[slot] = normal


@wp.func
def _corners(
    memory: Memory, first: int, margin: float, plane: wp.vec3, normal: wp.vec3, pos: wp.vec3, mat: wp.mat33, size: wp.vec3
):
    """Sets the slots of a plane and a box: corners of the box's lower half, as in MuJoCo C."""
    corners = int(0)
    for corner in range(8):
        arm = mat * wp.cw_mul(wp.vec3(_side(corner & 1), _side(corner & 2), _side(corner & 4)), size)
        down = wp.dot(arm, normal)
        distance = wp.dot(pos - plane, normal) + down
        if distance < margin and down <= 0.0 and corners < 4:
            put(memory, first + corners, distance, pos + arm - 0.5 * distance * normal, normal)
            corners += 1


@wp.func
def _rim(memory: Memory, first: int, plane: wp.vec3, normal: wp.vec3, pos: wp.vec3, mat: wp.mat33, size: wp.vec3):
    """Sets the slots of a plane and a cylinder."""
    distances, places, out = _plane_cylinder(normal, plane, pos, axis_of(mat), size[0], size[1])
    for i in range(4):
        put(memory, first + i, distances[i], places[i], out)


@wp.func
def _side(bit: int) -> float:
    return wp.where(bit == 0, -1.0, 1.0)


@wp.func
def _near(pos: wp.vec3, reach: float, box_pos: wp.vec3, box_mat: wp.mat33, box_size: wp.vec3) -> bool:
    """Whether a sphere may touch a box."""
    at = wp.transpose(box_mat) * (pos - box_pos)
    return (
        wp.abs(at[0]) <= box_size[0] + reach and wp.abs(at[1]) <= box_size[1] + reach and wp.abs(at[2]) <= box_size[2] + reach
    )
