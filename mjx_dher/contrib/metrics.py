"""Metrics between achieved and desired goals that use more than positions, for closest, epsilon_closest and weighted.

    metric(achieved [T+1, G], desired [G]) -> [T+1]

Velocities are differences of successive achieved goals, in m per step. The first is 0.
"""

import functools

import jax.numpy as jnp

from mjx_dher.contract import STEP_SECONDS
from mjx_dher.priorities import GRAVITY, displacements
from mjx_dher.samplers import position
from mjx_dher.types import Array

_SPEED_STEPS = 5.0  # weight of the velocity, in steps


def velocity(achieved: Array, desired: Array) -> Array:
    """Distances [T+1] in position and velocity to rest at the desired goal [G].

    They are sqrt(|p_i - g|^2 + |5 v_i|^2) with displacements per step v_i, so an object that flies past a goal is not near.
    """
    distance = position(achieved, desired)
    moving = position(_SPEED_STEPS * displacements(achieved), jnp.zeros_like(desired))
    return jnp.sqrt(jnp.square(distance) + jnp.square(moving))


def _resting(achieved: Array, desired: Array, friction: float) -> Array:
    """Distances [T+1] between the points where the object would come to rest and the desired goal [G].

    An object that slides at v m/s against friction alone stops after v^2 / (2 friction g), at p_i + v_i |v_i| / (2 friction
    g). A height among its coordinates is kept. Steps take 0.04 s; `runs.program` rejects other tasks.
    """
    velocities = displacements(achieved) / STEP_SECONDS
    if achieved.shape[-1] > 2:
        velocities = velocities.at[..., 2:].set(0.0)
    speed = position(velocities, jnp.zeros_like(desired))
    return position(achieved + velocities * speed[:, None] / (2.0 * friction * GRAVITY), desired)


resting_point = functools.partial(_resting, friction=0.1)  # Slide's puck on its table
resting_point_rough = functools.partial(_resting, friction=1.0)  # the cube of Push and PickAndPlace
