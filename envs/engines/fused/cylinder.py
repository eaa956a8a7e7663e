# mypy: disable-error-code="valid-type"
"""Cylinder against box by Minkowski portal refinement, MuJoCo C's algorithm if `nativeccd` is disabled.

The Minkowski difference of two convex shapes contains the origin if they overlap. A ray from a point inside it (the difference
of the two centres) through the origin leaves it somewhere. The algorithm looks for a triangle of surface points around the
ray, the portal, and pushes it outwards until it lies on the surface. It finds one contact, not several. Source: G. Snethen,
XenoCollide, Game Programming Gems 7 (2008); MuJoCo C takes it from libccd.

All is in double precision, as in C: a puck sinks 0.02 mm into the table. In single, the normals of that overlap are noise.
"""

from mjx_dher.system.warp_setup import wp

_STEPS = wp.constant(50)  # most steps in the search for a portal, and most refinements of it
_TOLERANCE = wp.constant(wp.float64(1e-6))  # m, of the portal's distance from the surface; MuJoCo's default
_ZERO = wp.constant(wp.float64(2.2e-16))  # libccd's zero
_LEAST = wp.constant(wp.float64(1e-15))  # MuJoCo's
_SHIFT = wp.constant(wp.float64(2.2e-15))  # m, from a centre that lies on the other one
_0, _1, _HALF, _QUARTER, _MOSTLY = (wp.constant(wp.float64(x)) for x in (0.0, 1.0, 0.5, 0.25, 0.95))


@wp.struct
class _Shapes:
    """A cylinder and a box."""

    cylinder_pos: wp.vec3d
    cylinder_mat: wp.mat33d
    cylinder_size: wp.vec3d  # radius, half length
    box_pos: wp.vec3d
    box_mat: wp.mat33d
    box_size: wp.vec3d  # half lengths
    grow: wp.float64  # m, how much larger each shape is taken than it is


@wp.struct
class _Portal:
    """Points of the difference (cylinder minus box), and the points of the cylinder that they are made of; 0 is inside."""

    v0: wp.vec3d
    v1: wp.vec3d
    v2: wp.vec3d
    v3: wp.vec3d
    a0: wp.vec3d
    a1: wp.vec3d
    a2: wp.vec3d
    a3: wp.vec3d


@wp.func
def _sign(x: wp.float64) -> wp.float64:
    return wp.where(x > _0, _1, wp.where(x < _0, -_1, _0))


@wp.func
def _of_cylinder(s: _Shapes, direction: wp.vec3d) -> wp.vec3d:
    """The cylinder's furthest point in a direction."""
    local = wp.transpose(s.cylinder_mat) * direction
    across = wp.sqrt(local[0] * local[0] + local[1] * local[1])
    scale = wp.where(across > _LEAST, s.cylinder_size[0] / wp.max(across, _LEAST), _0)
    point = wp.vec3d(local[0] * scale, local[1] * scale, _sign(local[2]) * s.cylinder_size[1])
    return s.cylinder_pos + s.cylinder_mat * (point + s.grow * local)


@wp.func
def _of_box(s: _Shapes, direction: wp.vec3d) -> wp.vec3d:
    """The box's furthest point in a direction."""
    local = wp.transpose(s.box_mat) * direction
    point = wp.vec3d(_sign(local[0]) * s.box_size[0], _sign(local[1]) * s.box_size[1], _sign(local[2]) * s.box_size[2])
    return s.box_pos + s.box_mat * (point + s.grow * local)


@wp.func
def _outwards(p: _Portal) -> wp.vec3d:
    """The portal's normal, which points away from the inside."""
    return wp.normalize(wp.cross(p.v2 - p.v1, p.v3 - p.v1))


@wp.func
def _widen(p: _Portal, v: wp.vec3d, a: wp.vec3d) -> _Portal:
    """Returns the portal with one corner replaced by a point outside it, so that the ray still goes through."""
    side = wp.cross(v, p.v0)
    if wp.dot(p.v1, side) > _0:
        if wp.dot(p.v2, side) > _0:
            p.v1 = v
            p.a1 = a
        else:
            p.v3 = v
            p.a3 = a
    elif wp.dot(p.v3, side) > _0:
        p.v2 = v
        p.a2 = a
    else:
        p.v1 = v
        p.a1 = a
    return p


@wp.func
def _beyond(p: _Portal, v: wp.vec3d, direction: wp.vec3d) -> wp.float64:
    """Least distance of a point outside the portal, m."""
    d = wp.dot(v, direction)
    return wp.min(d - wp.dot(p.v1, direction), wp.min(d - wp.dot(p.v2, direction), d - wp.dot(p.v3, direction)))


_APART, _FOUND, _TOUCH, _ON_SEGMENT = (wp.constant(i) for i in range(4))  # outcomes of the search for a portal


@wp.func
def _discover(s: _Shapes):
    """Looks for a portal. Returns the outcome (one of the constants above) and the portal."""
    p = _Portal()
    p.a0 = s.cylinder_pos
    p.v0 = s.cylinder_pos - s.box_pos
    if wp.length_sq(p.v0) == _0:
        p.v0 = wp.vec3d(_SHIFT, _0, _0)
    direction = -wp.normalize(p.v0)
    p.a1 = _of_cylinder(s, direction)
    p.v1 = p.a1 - _of_box(s, -direction)
    if wp.dot(p.v1, direction) <= _0:
        return _APART, p
    across = wp.cross(p.v0, p.v1)
    if wp.length_sq(across) < _ZERO * _ZERO * wp.length_sq(p.v0) * wp.length_sq(p.v1):
        if wp.length_sq(p.v1) == _0:
            return _TOUCH, p
        return _ON_SEGMENT, p
    direction = wp.normalize(across)
    p.a2 = _of_cylinder(s, direction)
    p.v2 = p.a2 - _of_box(s, -direction)
    if wp.dot(p.v2, direction) <= _0:
        return _APART, p
    direction = wp.normalize(wp.cross(p.v1 - p.v0, p.v2 - p.v0))
    if wp.dot(direction, p.v0) > _0:  # the normal is to point away from the inside
        v, a = p.v1, p.a1
        p.v1 = p.v2
        p.a1 = p.a2
        p.v2 = v
        p.a2 = a
        direction = -direction
    for _ in range(_STEPS):
        p.a3 = _of_cylinder(s, direction)
        p.v3 = p.a3 - _of_box(s, -direction)
        if wp.dot(p.v3, direction) <= _0:
            return _APART, p
        if wp.dot(wp.cross(p.v1, p.v3), p.v0) < _0:  # the ray passes outside the side of 1 and 3
            p.v2 = p.v3
            p.a2 = p.a3
        elif wp.dot(wp.cross(p.v3, p.v2), p.v0) < _0:
            p.v1 = p.v3
            p.a1 = p.a3
        else:
            return _FOUND, p
        direction = wp.normalize(wp.cross(p.v1 - p.v0, p.v2 - p.v0))
    return _APART, p


@wp.func
def _refine(s: _Shapes, portal: _Portal):
    """Moves a portal outwards until the origin is inside. Returns True if it succeeds, and the portal."""
    p = portal
    for _ in range(_STEPS):
        direction = _outwards(p)
        if wp.dot(direction, p.v1) >= _0:
            return True, p
        a = _of_cylinder(s, direction)
        v = a - _of_box(s, -direction)
        if wp.dot(v, direction) < _0 or _beyond(p, v, direction) <= _TOLERANCE:
            return False, p
        p = _widen(p, v, a)
    return False, p


@wp.func
def _push_out(s: _Shapes, portal: _Portal):
    """Moves a portal outwards until it lies on the surface."""
    p = portal
    for _ in range(_STEPS):
        direction = _outwards(p)
        a = _of_cylinder(s, direction)
        v = a - _of_box(s, -direction)
        if _beyond(p, v, direction) <= _TOLERANCE:
            break
        p = _widen(p, v, a)
    return p


@wp.func
def _nearest(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Returns the point of a triangle that is nearest to the origin."""
    ab, ac = b - a, c - a
    d1, d2 = -wp.dot(ab, a), -wp.dot(ac, a)
    if d1 <= _0 and d2 <= _0:
        return a
    d3, d4 = -wp.dot(ab, b), -wp.dot(ac, b)
    if d3 >= _0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= _0 and d1 >= _0 and d3 <= _0:
        return a + (d1 / (d1 - d3)) * ab
    d5, d6 = -wp.dot(ab, c), -wp.dot(ac, c)
    if d6 >= _0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= _0 and d2 >= _0 and d6 <= _0:
        return a + (d2 / (d2 - d6)) * ac
    va = d3 * d6 - d5 * d4
    if va <= _0 and d4 >= d3 and d5 >= d6:
        return b + ((d4 - d3) / ((d4 - d3) + (d5 - d6))) * (c - b)
    return a + (vb / (va + vb + vc)) * ab + (vc / (va + vb + vc)) * ac


@wp.func
def _where(s: _Shapes, p: _Portal) -> wp.vec3d:
    """Returns the point of contact: the origin's weights in the tetrahedron of the inside and the portal, on the cylinder."""
    w0 = wp.dot(wp.cross(p.v1, p.v2), p.v3)
    w1 = wp.dot(wp.cross(p.v3, p.v2), p.v0)
    w2 = wp.dot(wp.cross(p.v0, p.v1), p.v3)
    w3 = wp.dot(wp.cross(p.v2, p.v1), p.v0)
    total = w0 + w1 + w2 + w3
    if total <= _0:
        direction = _outwards(p)
        w0 = _0
        w1 = wp.dot(wp.cross(p.v2, p.v3), direction)
        w2 = wp.dot(wp.cross(p.v3, p.v1), direction)
        w3 = wp.dot(wp.cross(p.v1, p.v2), direction)
        total = w1 + w2 + w3
    on_cylinder = (w0 * p.a0 + w1 * p.a1 + w2 * p.a2 + w3 * p.a3) / total
    difference = (w0 * p.v0 + w1 * p.v1 + w2 * p.v2 + w3 * p.v3) / total
    return on_cylinder - _HALF * difference


@wp.func
def _round(s: _Shapes, pos: wp.vec3d, normal: wp.vec3d) -> wp.vec3d:
    """Returns the normal, radial where the point of contact is on the cylinder's round side, as MuJoCo C corrects it."""
    local = wp.transpose(s.cylinder_mat) * (pos - s.cylinder_pos)
    radius, half = s.cylinder_size[0], s.cylinder_size[1]
    across = wp.sqrt(local[0] * local[0] + local[1] * local[1])
    if wp.abs(local[2]) > _MOSTLY * half or wp.abs(half - wp.abs(local[2])) < _QUARTER * wp.abs(radius - across):
        return normal
    return s.cylinder_mat * wp.normalize(wp.vec3d(local[0], local[1], _0))


@wp.func
def cylinder_box(
    cylinder_pos: wp.vec3,
    cylinder_mat: wp.mat33,
    cylinder_size: wp.vec3,
    box_pos: wp.vec3,
    box_mat: wp.mat33,
    box_size: wp.vec3,
    margin: float,
):
    """Finds the contact of a cylinder and a box.

    Returns:
      Distance (m, negative where they overlap; more than `margin` if there is no contact), position in the world, and normal
      from the cylinder to the box.
    """
    s = _Shapes()
    s.cylinder_pos = wp.vec3d()
    s.cylinder_mat = wp.mat33d(cylinder_mat)
    s.cylinder_size = wp.vec3d(cylinder_size)
    s.box_pos = wp.vec3d(box_pos - cylinder_pos)
    s.box_mat = wp.mat33d(box_mat)
    s.box_size = wp.vec3d(box_size)
    s.grow = _HALF * wp.float64(margin)
    status, p = _discover(s)
    far = margin + 1.0
    nowhere = wp.vec3(0.0)
    if status == _APART or status == _TOUCH:
        return far, nowhere, nowhere
    if status == _ON_SEGMENT:
        away = p.v1
        pos = p.a1 - _HALF * p.v1
    else:
        inside, p = _refine(s, p)
        if not inside:
            return far, nowhere, nowhere
        p = _push_out(s, p)
        away = _nearest(p.v1, p.v2, p.v3)
        pos = _where(s, p)
    depth = wp.length(away)
    if depth < _ZERO:
        return far, nowhere, nowhere
    return margin - float(depth), cylinder_pos + wp.vec3(pos), wp.vec3(_round(s, pos, away / depth))
