"""Positions, velocities, mass matrix and forces of a substep, from qpos and qvel. The stages have MuJoCo's names.

R. Featherstone, Rigid Body Dynamics Algorithms (2008): composite rigid bodies and recursive Newton-Euler. Both are sums over
the bodies of a subtree: a walk along the tree would leave all threads but one idle.
"""

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.model import Bodies, Dofs, Floats, Memory, World
from mjx_dher.envs.engines.fused.tendons import actuation, pull
from mjx_dher.envs.engines.fused.threads import sync
from mjx_dher.system.warp_setup import wp


@wp.func
def dot(matrix: Floats, row: int, x: Floats, size: int) -> float:
    """Row of a matrix [.., size] times a vector [size]."""
    sum = float(0.0)
    for i in range(size):
        sum += matrix[row * size + i] * x[i]
    return sum


@wp.func
def times(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Product of two quaternions (w, x, y, z)."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def turned(quat: wp.vec4, v: wp.vec3) -> wp.vec3:
    """Vector rotated by a quaternion."""
    axis = wp.vec3(quat[1], quat[2], quat[3])
    twice = 2.0 * wp.cross(axis, v)
    return v + quat[0] * twice + wp.cross(axis, twice)


@wp.func
def about(axis: wp.vec3, angle: float) -> wp.vec4:
    """Quaternion of a rotation about a unit axis."""
    s = wp.sin(0.5 * angle)
    return wp.vec4(wp.cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


@wp.func
def _matrix(q: wp.vec4) -> wp.mat33:
    return wp.matrix_from_cols(
        turned(q, wp.vec3(1.0, 0.0, 0.0)), turned(q, wp.vec3(0.0, 1.0, 0.0)), turned(q, wp.vec3(0.0, 0.0, 1.0))
    )


@wp.func
def kinematics(bodies: Bodies, memory: Memory, inputs: Floats, thread: int, threads: int):
    """Computes the pose of every body: relative to its parent in parallel, then along the tree."""
    for b in range(thread, bodies.number, threads):
        pos = bodies.pos[b]
        quat = bodies.quat[b]
        first = bodies.qpos[b]
        kind = bodies.kind[b]
        if kind == kinds.HINGE:
            bent = times(quat, about(bodies.axis[b], memory.qpos[first] - bodies.rest[b]))
            pos = pos + turned(quat, bodies.anchor[b]) - turned(bent, bodies.anchor[b])
            quat = bent
        elif kind == kinds.SLIDE:
            pos = pos + turned(quat, bodies.axis[b]) * (memory.qpos[first] - bodies.rest[b])
        elif kind == kinds.FREE:
            pos = wp.vec3(memory.qpos[first], memory.qpos[first + 1], memory.qpos[first + 2])
            quat = wp.normalize(
                wp.vec4(memory.qpos[first + 3], memory.qpos[first + 4], memory.qpos[first + 5], memory.qpos[first + 6])
            )
        elif kind == kinds.MOCAP:
            at = 7 * bodies.dof[b]
            pos = wp.vec3(inputs[at], inputs[at + 1], inputs[at + 2])
            quat = wp.normalize(wp.vec4(inputs[at + 3], inputs[at + 4], inputs[at + 5], inputs[at + 6]))
        memory.pos[b] = pos
        memory.quat[b] = quat
    sync(threads)
    # One thread walks along the tree, twice, with as little work as possible; the rest is done in parallel.
    if thread == 0:
        for b in range(1, bodies.number):
            parent = bodies.parent[b]
            if parent > 0:
                memory.quat[b] = times(memory.quat[parent], memory.quat[b])
    sync(threads)
    for b in range(thread, bodies.number, threads):
        parent = bodies.parent[b]
        if parent > 0:
            memory.pos[b] = turned(memory.quat[parent], memory.pos[b])
    sync(threads)
    if thread == 0:
        for b in range(1, bodies.number):
            parent = bodies.parent[b]
            if parent > 0:
                memory.pos[b] = memory.pos[b] + memory.pos[parent]
    for b in range(thread, bodies.number, threads):
        memory.quat[b] = wp.normalize(memory.quat[b])
    sync(threads)


@wp.func
def com_pos(bodies: Bodies, memory: Memory, thread: int, threads: int):
    """Computes inertias, and `motion` of each degree of freedom (MuJoCo's cdof)."""
    for b in range(thread, bodies.number, threads):
        origin = memory.pos[bodies.root[b]]
        at = memory.pos[b] - origin
        mat = _matrix(memory.quat[b])
        memory.mat[b] = mat
        mass = bodies.mass[b]
        com = at + mat * bodies.com[b]
        axes = mat * bodies.principal[b]
        memory.moment[b] = mass * com
        memory.inertia[b] = axes * wp.diag(bodies.inertia[b]) * wp.transpose(axes) + mass * (
            wp.dot(com, com) * wp.identity(n=3, dtype=float) - wp.outer(com, com)
        )
        dof = bodies.dof[b]
        kind = bodies.kind[b]
        none = wp.vec3(0.0)
        if kind == kinds.HINGE:
            axis = mat * bodies.axis[b]
            memory.motion[dof] = wp.spatial_vector(axis, wp.cross(at + mat * bodies.anchor[b], axis))
        elif kind == kinds.SLIDE:
            memory.motion[dof] = wp.spatial_vector(none, mat * bodies.axis[b])
        elif kind == kinds.FREE:
            for i in range(3):
                unit = wp.vec3(wp.where(i == 0, 1.0, 0.0), wp.where(i == 1, 1.0, 0.0), wp.where(i == 2, 1.0, 0.0))
                memory.motion[dof + i] = wp.spatial_vector(none, unit)
                axis = mat * unit
                memory.motion[dof + 3 + i] = wp.spatial_vector(axis, wp.cross(at, axis))
    sync(threads)


@wp.func
def com_vel(bodies: Bodies, memory: Memory, thread: int, threads: int):
    """Computes velocities, and `turning` of each degree of freedom (MuJoCo's cdof_dot)."""
    for b in range(thread, bodies.number, threads):
        velocity = wp.spatial_vector()
        moved_by = bodies.moved_by[b]
        for i in range(memory.qvel.shape[0]):
            if (moved_by >> i) & 1 == 1:
                velocity += memory.motion[i] * memory.qvel[i]
        memory.velocity[b] = velocity
        dof = bodies.dof[b]
        kind = bodies.kind[b]
        if kind == kinds.HINGE or kind == kinds.SLIDE:
            memory.turning[dof] = _crossed(velocity, memory.motion[dof])
        elif kind == kinds.FREE:
            for i in range(3):
                memory.turning[dof + i] = wp.spatial_vector()
                memory.turning[dof + 3 + i] = _crossed(velocity, memory.motion[dof + 3 + i])
    sync(threads)


@wp.func
def _crossed(velocity: wp.spatial_vector, motion: wp.spatial_vector) -> wp.spatial_vector:
    """Rate of change of a motion that is fixed to a frame with this velocity."""
    omega, axis = wp.spatial_top(velocity), wp.spatial_top(motion)
    return wp.spatial_vector(
        wp.cross(omega, axis), wp.cross(omega, wp.spatial_bottom(motion)) + wp.cross(wp.spatial_bottom(velocity), axis)
    )


@wp.func
def _momentum(inertia: wp.mat33, moment: wp.vec3, mass: float, motion: wp.spatial_vector) -> wp.spatial_vector:
    """Inertia times motion: angular, then linear momentum."""
    omega, v = wp.spatial_top(motion), wp.spatial_bottom(motion)
    return wp.spatial_vector(inertia * omega + wp.cross(moment, v), mass * v - wp.cross(moment, omega))


@wp.func
def rne(world: World, bodies: Bodies, dofs: Dofs, memory: Memory, thread: int, threads: int):
    """Computes the force of each body that keeps its velocity against inertia and gravity."""
    for b in range(thread, bodies.number, threads):
        bias = wp.spatial_vector()
        moved_by = bodies.moved_by[b]
        for i in range(dofs.number):
            if (moved_by >> i) & 1 == 1:
                bias += memory.turning[i] * memory.qvel[i]
        memory.bias[b] = bias
        inertia = memory.inertia[b]
        moment = memory.moment[b]
        mass = bodies.mass[b]
        velocity = memory.velocity[b]
        has = _momentum(inertia, moment, mass, velocity)
        omega, v = wp.spatial_top(velocity), wp.spatial_bottom(velocity)
        memory.force[b] = _momentum(
            inertia, moment, mass, wp.spatial_vector(wp.spatial_top(bias), wp.spatial_bottom(bias) - world.gravity)
        ) + wp.spatial_vector(
            wp.cross(omega, wp.spatial_top(has)) + wp.cross(v, wp.spatial_bottom(has)), wp.cross(omega, wp.spatial_bottom(has))
        )
    sync(threads)


@wp.func
def smooth_forces(bodies: Bodies, dofs: Dofs, memory: Memory, inputs: Floats, has_tendons: bool, thread: int, threads: int):
    """Computes `smooth`, all forces except constraint forces, and `momentum` of each degree of freedom."""
    for i in range(thread, dofs.number, threads):
        motion = memory.motion[i]
        body = dofs.body[i]
        momentum, force = wp.spatial_vector(), wp.spatial_vector()
        for b in range(body, bodies.last[body] + 1):
            momentum += _momentum(memory.inertia[b], memory.moment[b], bodies.mass[b], motion)
            force += memory.force[b]
        memory.momentum[i] = momentum
        smooth = _passive(dofs, memory, i)
        smooth -= wp.dot(motion, force)
        drive = float(0.0)
        for a in range(dofs.actuators):
            if dofs.actuator_dof[a] == i:
                control = inputs[dofs.first_control + a]
                drive += actuation(dofs, a, control, memory.qpos[dofs.actuator_qpos[a]], memory.qvel[i])
        if has_tendons:
            forces = pull(dofs, memory, inputs, i)
            smooth += forces[0]
            drive += forces[1]
        memory.smooth[i] = smooth + wp.clamp(drive, dofs.drive[i][0], dofs.drive[i][1])
    sync(threads)


@wp.func
def crb(bodies: Bodies, dofs: Dofs, memory: Memory, thread: int, threads: int):
    """Computes the mass matrix from the momenta (composite rigid bodies)."""
    for at in range(thread, memory.mass.shape[0], threads):
        i = int(0.5 * (wp.sqrt(float(8 * at + 1)) - 1.0))  # row of this number in a lower half
        j = at - i * (i + 1) // 2
        mass = float(0.0)
        if (bodies.moved_by[dofs.body[i]] >> j) & 1 == 1:
            mass = wp.dot(memory.motion[j], memory.momentum[i])
        if i == j:
            mass += dofs.armature[i]
        memory.mass[at] = mass
    sync(threads)


@wp.func
def _passive(dofs: Dofs, memory: Memory, i: int) -> float:
    """Force of the spring and damper of a degree of freedom."""
    return dofs.stiffness[i] * (dofs.rest[i] - memory.qpos[dofs.qpos[i]]) - dofs.damping[i] * memory.qvel[i]


@wp.func
def damping(dofs: Dofs, memory: Memory, inputs: Floats, i: int) -> float:
    """Minus the derivative of forces by the velocity of a degree of freedom, for the integrator."""
    all_of_it = dofs.implicit_damping[i]
    if dofs.implicit == 1:
        for a in range(dofs.actuators):
            if dofs.actuator_dof[a] == i:
                clip = dofs.actuator_clip[a]
                control = inputs[dofs.first_control + a]
                force = actuation(dofs, a, control, memory.qpos[dofs.actuator_qpos[a]], memory.qvel[i])
                if force > clip[2] and force < clip[3]:
                    all_of_it -= dofs.actuator_force[a][2]
    return all_of_it


@wp.func
def integrate(world: World, bodies: Bodies, memory: Memory, thread: int, threads: int):
    """Advances positions by the velocities at the substep's end."""
    h = world.timestep
    for b in range(thread, bodies.number, threads):
        first = bodies.qpos[b]
        dof = bodies.dof[b]
        kind = bodies.kind[b]
        if kind == kinds.HINGE or kind == kinds.SLIDE:
            memory.qpos[first] = memory.qpos[first] + h * memory.qvel[dof]
        elif kind == kinds.FREE:
            for i in range(3):
                memory.qpos[first + i] = memory.qpos[first + i] + h * memory.qvel[dof + i]
            omega = wp.vec3(memory.qvel[dof + 3], memory.qvel[dof + 4], memory.qvel[dof + 5])
            speed = wp.length(omega)
            turn = wp.vec4(1.0, 0.0, 0.0, 0.0)
            if speed > 0.0:
                turn = about(omega / speed, h * speed)
            quat = wp.vec4(memory.qpos[first + 3], memory.qpos[first + 4], memory.qpos[first + 5], memory.qpos[first + 6])
            quat = wp.normalize(times(quat, turn))
            for i in range(4):
                memory.qpos[first + 3 + i] = quat[i]
    sync(threads)
