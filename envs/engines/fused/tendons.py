"""Springs and dampers of fixed tendons, and actuators on them."""

from mjx_dher.envs.engines.fused.model import Bodies, Dofs, Floats, Memory, World
from mjx_dher.system.warp_setup import wp


@wp.func
def actuation(dofs: Dofs, a: int, control: float, length: float, velocity: float) -> float:
    """Force of an actuator on its joint or tendon."""
    clip = dofs.actuator_clip[a]
    factors = dofs.actuator_force[a]
    force = factors[0] + factors[1] * length + factors[2] * velocity + factors[3] * wp.clamp(control, clip[0], clip[1])
    return wp.clamp(force, clip[2], clip[3])


@wp.func
def tension(dofs: Dofs, memory: Memory, inputs: Floats, t: int) -> wp.vec3:
    """Force of a tendon's spring and damper, force of its actuators, and minus their derivative by the tendon's velocity."""
    tendons = dofs.tendons
    length, velocity = float(0.0), float(0.0)
    for term in range(tendons.begin[t], tendons.begin[t + 1]):
        length += tendons.coef[term] * memory.qpos[tendons.qpos[term]]
        velocity += tendons.coef[term] * memory.qvel[tendons.dof[term]]
    drive, slope = float(0.0), 1.0 * tendons.damping[t]
    for a in range(dofs.actuators):
        if tendons.actuator_tendon[a] == t:
            force = actuation(dofs, a, inputs[dofs.first_control + a], length, velocity)
            drive += force
            if force > dofs.actuator_clip[a][2] and force < dofs.actuator_clip[a][3]:
                slope -= dofs.actuator_force[a][2]
    rest = wp.clamp(length, tendons.spring[t][0], tendons.spring[t][1])
    passive = tendons.stiffness[t] * (rest - length) - tendons.damping[t] * velocity
    return wp.vec3(passive, wp.clamp(drive, tendons.drive[t][0], tendons.drive[t][1]), slope)


@wp.func
def pull(dofs: Dofs, memory: Memory, inputs: Floats, i: int) -> wp.vec2:
    """Forces of tendons on a degree of freedom: of springs and dampers, and of actuators."""
    tendons = dofs.tendons
    forces = wp.vec2()
    for term in range(tendons.terms):
        if tendons.dof[term] == i:
            of_tendon = tension(dofs, memory, inputs, tendons.tendon[term])
            forces += tendons.coef[term] * wp.vec2(of_tendon[0], of_tendon[1])
    return forces


@wp.func
def soften(world: World, bodies: Bodies, dofs: Dofs, memory: Memory, inputs: Floats, thread: int, threads: int):
    """Makes velocities implicit in the forces of tendons, as implicitfast does: adds to the mass matrix.

    As in MuJoCo C, one joint of a tendon is implicit in another's velocity only if one of them moves the other.
    """
    tendons = dofs.tendons
    for i in range(thread, dofs.implicit * dofs.number, threads):
        for term in range(tendons.terms):
            if tendons.dof[term] == i:
                t = tendons.tendon[term]
                slope = world.timestep * tendons.coef[term] * tension(dofs, memory, inputs, t)[2]
                for other in range(tendons.begin[t], tendons.begin[t + 1]):
                    j = tendons.dof[other]
                    if (bodies.moved_by[dofs.body[i]] >> j) & 1 == 1 and j <= i:
                        at = i * (i + 1) // 2 + j
                        memory.mass[at] = memory.mass[at] + slope * tendons.coef[other]
