"""Rows of constraints of a substep: welds, connected bodies, joint limits, contacts.

A row asks for J qacc = aref, where aref = -k imp (r - margin) - b J qvel (- J' qvel for equalities). Its weight is D = imp /
((1 - imp) times its inverse inertia): https://mujoco.readthedocs.io/en/3.17.0/computation/index.html.
"""

from mjx_dher.envs.engines.fused.contacts import tangent, tangent_of
from mjx_dher.envs.engines.fused.dynamics import dot, times
from mjx_dher.envs.engines.fused.model import Bodies, Contacts, Dofs, Memory, Softness, World
from mjx_dher.envs.engines.fused.threads import give_up, sync
from mjx_dher.system.warp_setup import wp

_TINY = wp.constant(1e-15)  # MuJoCo's smallest number


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    struct Once { static __device__ __noinline__ float power(float x, float y) { return powf(x, y); } };
    return Once::power(x, exponent);
#else
    return powf(x, exponent);
#endif
""")
def _to_the(x: float, exponent: float) -> float:
    """x to the power of `exponent`. Its code is not inlined, because a GPU waits for instructions beyond its cache."""


@wp.func
def _impedance(soft: Softness, depth: float) -> float:
    """Impedance, between 0 and 1, of a constraint at this depth."""
    least = soft[2]
    most = soft[3]
    width = soft[4]
    middle = soft[5]
    power = soft[6]
    if least == most or width <= _TINY:
        return 0.5 * (least + most)
    x = wp.min(wp.abs(depth) / width, 1.0)
    y = x
    if power == 2.0:
        y = wp.where(x <= middle, x * x / middle, 1.0 - (1.0 - x) * (1.0 - x) / (1.0 - middle))
    elif power > 1.0:
        if x <= middle:
            y = _to_the(x, power) / _to_the(middle, power - 1.0)
        else:
            y = 1.0 - _to_the(1.0 - x, power) / _to_the(1.0 - middle, power - 1.0)
    return least + y * (most - least)


@wp.func
def asked(soft: Softness, residual: float, depth: float, inverse_inertia: float, velocity: float) -> wp.vec2:
    """Weight and reference acceleration of a row."""
    imp = _impedance(soft, depth)
    weight = 1.0 / wp.max(inverse_inertia * (1.0 - imp) / imp, _TINY)
    return wp.vec2(weight, -soft[0] * imp * residual - soft[1] * velocity)


@wp.func
def _ask(memory: Memory, row: int, soft: Softness, residual: float, depth: float, inverse_inertia: float, velocity: float):
    """Sets a row's weight and reference acceleration."""
    asks = asked(soft, residual, depth, inverse_inertia, velocity)
    memory.weight[row] = asks[0]
    memory.residual[row] = asks[1]


@wp.func
def _at(motion: wp.spatial_vector, arm: wp.vec3) -> wp.vec3:
    """Velocity of a moving frame at an offset from its origin."""
    return wp.spatial_bottom(motion) + wp.cross(wp.spatial_top(motion), arm)


@wp.func
def weld(world: World, bodies: Bodies, dofs: Dofs, memory: Memory, thread: int, threads: int):
    """Sets six rows of each weld: the target's position less the body's, and the rotation between them."""
    nv = dofs.number
    for w in range(world.welds):
        body, target, row = world.weld_body[w], world.weld_target[w], 6 * w
        arm = memory.pos[body] - memory.pos[bodies.root[body]]
        q = memory.quat[body]
        inverse = wp.vec4(q[0], -q[1], -q[2], -q[3])
        goal = memory.quat[target]
        moved_by = bodies.moved_by[body]
        for i in range(thread, nv, threads):
            along, about = wp.vec3(0.0), wp.vec3(0.0)
            if (moved_by >> i) & 1 == 1:
                motion = memory.motion[i]
                along = -_at(motion, arm)
                axis = wp.spatial_top(motion)
                turn = times(times(inverse, wp.vec4(0.0, axis[0], axis[1], axis[2])), goal)
                about = -0.5 * wp.vec3(turn[1], turn[2], turn[3])
            for k in range(3):
                memory.jacobian[(row + k) * nv + i] = along[k]
                memory.jacobian[(row + 3 + k) * nv + i] = about[k]
        for k in range(thread, 3, threads):
            place = memory.pos[target] - memory.pos[body]
            between = times(inverse, goal)
            turn_left = wp.vec3(between[1], between[2], between[3])
            depth = wp.sqrt(wp.length_sq(place) + wp.length_sq(turn_left))
            bias = memory.bias[body]
            omega, alpha = wp.spatial_top(memory.velocity[body]), wp.spatial_top(bias)
            speed = _at(memory.velocity[body], arm)
            spin = times(times(inverse, wp.vec4(0.0, omega[0], omega[1], omega[2])), goal)
            # With qacc 0: the body's acceleration, and the second derivative of the turn.
            bend = _bend(memory, body, arm)
            twist = wp.vec4(0.25 * wp.dot(omega, omega), 0.5 * alpha[0], 0.5 * alpha[1], 0.5 * alpha[2])
            curl = times(times(inverse, twist), goal)
            _ask(memory, row + k, world.weld_soft[w], place[k], depth, world.weld_weight[w][0], -speed[k])
            memory.residual[row + k] = memory.residual[row + k] + bend[k]
            _ask(memory, row + 3 + k, world.weld_soft[w], turn_left[k], depth, world.weld_weight[w][1], -0.5 * spin[k + 1])
            memory.residual[row + 3 + k] = memory.residual[row + 3 + k] + curl[k + 1]


@wp.func
def _bend(memory: Memory, body: int, arm: wp.vec3) -> wp.vec3:
    """Acceleration of a point of a body with qacc 0, without gravity; its offset from the tree's origin is `arm`."""
    velocity = memory.velocity[body]
    return _at(memory.bias[body], arm) + wp.cross(wp.spatial_top(velocity), _at(velocity, arm))


@wp.func
def connect(world: World, bodies: Bodies, dofs: Dofs, memory: Memory, thread: int, threads: int):
    """Sets three rows of each pair of connected bodies: the first one's anchor less the second one's."""
    nv = dofs.number
    for c in range(world.connects):
        body1, body2, row = world.connect_body1[c], world.connect_body2[c], world.equalities - 3 * (world.connects - c)
        place1 = memory.pos[body1] + memory.mat[body1] * world.connect_anchor1[c]
        place2 = memory.pos[body2] + memory.mat[body2] * world.connect_anchor2[c]
        moved1, moved2 = bodies.moved_by[body1], bodies.moved_by[body2]
        for i in range(thread, nv, threads):
            origin = memory.pos[bodies.root[dofs.body[i]]]
            along = float((moved1 >> i) & 1) * _at(memory.motion[i], place1 - origin)
            along -= float((moved2 >> i) & 1) * _at(memory.motion[i], place2 - origin)
            for k in range(3):
                memory.jacobian[(row + k) * nv + i] = along[k]
        for k in range(thread, 3, threads):
            apart = place1 - place2
            arm1, arm2 = place1 - memory.pos[bodies.root[body1]], place2 - memory.pos[bodies.root[body2]]
            speed = _at(memory.velocity[body1], arm1) - _at(memory.velocity[body2], arm2)
            bend = _bend(memory, body1, arm1) - _bend(memory, body2, arm2)
            _ask(memory, row + k, world.connect_soft[c], apart[k], wp.length(apart), world.connect_weight[c], speed[k])
            memory.residual[row + k] = memory.residual[row + k] - bend[k]


@wp.func
def number(
    world: World,
    dofs: Dofs,
    contacts: Contacts,
    memory: Memory,
    lost: wp.array(dtype=int),
    elliptic: bool,
    thread: int,
    threads: int,
):
    """Gives a row to each joint at its limit, and a number of rows to each contact within its margin.

    Contacts that do not fit are counted in `lost`.
    """
    for s in range(thread, contacts.slots, threads):
        pair = contacts.pair[s]
        memory.touching[s] = wp.where(memory.distance[s] < contacts.margin[pair], contacts.edges[pair], 0)
    sync(threads)
    if thread == 0:
        rows = int(world.equalities)
        for k in range(dofs.limits):
            memory.limited[k] = -1
            if _past_limit(dofs, memory, k) < 0.0:
                memory.limited[k] = rows
                rows += 1
        if elliptic:
            memory.counts[1] = rows
        touching = int(0)
        for s in range(contacts.slots):
            edges = memory.touching[s]
            if edges > 0 and rows + edges > world.rows:
                give_up(memory, lost)
            elif edges > 0:
                memory.touching[touching] = s
                memory.slot[touching] = rows
                touching += 1
                rows += edges
        memory.counts[0] = touching
        memory.counts[wp.where(elliptic, 2, 1)] = rows
    sync(threads)


@wp.func
def _past_limit(dofs: Dofs, memory: Memory, k: int) -> float:
    """Distance of a joint from its nearer limit, less the margin."""
    at = memory.qpos[dofs.qpos[dofs.limit_dof[k]]]
    return wp.min(at - dofs.limit_range[k][0], dofs.limit_range[k][1] - at) - dofs.limit_margin[k]


@wp.func
def limit(dofs: Dofs, contacts: Contacts, memory: Memory, thread: int, threads: int):
    """Sets the rows of joints at their limits."""
    for k in range(thread, dofs.limits, threads):
        row = memory.limited[k]
        if row >= 0:
            dof = dofs.limit_dof[k]
            at = memory.qpos[dofs.qpos[dof]]
            side = wp.where(at - dofs.limit_range[k][0] < dofs.limit_range[k][1] - at, 1.0, -1.0)
            for i in range(dofs.number):
                memory.jacobian[row * dofs.number + i] = wp.where(i == dof, side, 0.0)
            past = _past_limit(dofs, memory, k)
            _ask(memory, row, dofs.limit_soft[k], past, past, dofs.limit_weight[k], side * memory.qvel[dof])


@wp.func
def touch(
    bodies: Bodies,
    dofs: Dofs,
    contacts: Contacts,
    memory: Memory,
    elliptic: bool,
    capsules: bool,
    rolling: bool,
    thread: int,
    threads: int,
):
    """Sets the rows of contacts: the edges of friction pyramids, normal plus and minus friction times tangent.

    Args:
      elliptic: whether rows have elliptic cones instead: mu times the normal, and friction times tangent.
      capsules: whether there may be some on planes.
      rolling: whether there may be rolling friction.
    """
    nv = dofs.number
    for c in range(memory.counts[0]):
        s = memory.touching[c]
        row = memory.slot[c]
        pair = contacts.pair[s]
        dim = contacts.dim[pair]
        normal = memory.normal[s]
        friction = contacts.friction[pair]
        first = tangent(normal)
        if capsules:
            first = tangent_of(contacts, memory, pair, normal)
        second = wp.cross(normal, first)
        roll1, roll2 = wp.vec3(), wp.vec3()
        if rolling:
            roll1 = contacts.rolling[pair][0] * first
            roll2 = contacts.rolling[pair][1] * second
        second = friction[1] * second
        first = friction[0] * first
        turning = friction[2] * normal
        moves2 = bodies.moved_by[contacts.geom_body[contacts.geom2[pair]]]
        moves1 = bodies.moved_by[contacts.geom_body[contacts.geom1[pair]]]
        for i in range(thread, nv, threads):
            sign = float((moves2 >> i) & 1) - float((moves1 >> i) & 1)
            motion = sign * memory.motion[i]
            velocity = _at(motion, memory.place[s] - memory.pos[bodies.root[dofs.body[i]]])
            along = wp.dot(velocity, normal)
            if elliptic:
                along *= contacts.mu[pair]
            if elliptic or dim == 1:
                memory.jacobian[row * nv + i] = along
            for k in range(dim - 1):
                aside = wp.dot(wp.spatial_top(motion), turning)
                if k < 2:
                    aside = wp.dot(velocity, wp.where(k == 0, first, second))
                elif rolling and k > 2:
                    aside = wp.dot(wp.spatial_top(motion), wp.where(k == 3, roll1, roll2))
                if elliptic:
                    memory.jacobian[(row + k + 1) * nv + i] = aside
                else:
                    memory.jacobian[(row + 2 * k) * nv + i] = along + aside
                    memory.jacobian[(row + 2 * k + 1) * nv + i] = along - aside
    sync(threads)


@wp.func
def press(dofs: Dofs, contacts: Contacts, memory: Memory, most: int, thread: int, threads: int):
    """Sets weights and reference accelerations of the contacts' rows, at most `most` rows per contact."""
    for at in range(thread, most * memory.counts[0], threads):
        s = memory.touching[at // most]
        pair = contacts.pair[s]
        row = memory.slot[at // most] + at % most
        if at % most < contacts.edges[pair]:
            depth = memory.distance[s] - contacts.margin[pair]
            velocity = dot(memory.jacobian, row, memory.qvel, dofs.number)
            _ask(memory, row, contacts.soft[pair], depth, depth, contacts.weight[pair], velocity)
    sync(threads)
