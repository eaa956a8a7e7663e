"""Environments whose answers are known, a network and a batch that are followed by hand, and another program's lock."""

from __future__ import annotations

import contextlib

import flax.linen as nn
import jax
import jax.numpy as jnp
from filelock import FileLock
from flax import struct

from mjx_dher.types import Array, Batch, EnvSpec
from point_mass import PointMass, PointState


def spec_of(observation: int, goal: int, action: int, **fields) -> EnvSpec:
    """Spec of an environment with observations, goals and actions of these sizes."""
    fields = {"episode_length": 1, **fields}
    return EnvSpec(jax.ShapeDtypeStruct((observation,), jnp.float32), goal, action, **fields)


@contextlib.contextmanager
def held(folder):
    """Has the lock of a folder as another program would."""
    with FileLock(folder / ".lock", timeout=0):
        yield


class Clock(PointMass):
    """A point that moves by exactly its action from the origin: achieved goals are sums of actions."""

    name = "clock"

    def reset(self, key) -> PointState:
        return self._state(jnp.zeros(2), jax.random.uniform(key, (2,)))

    def step(self, state: PointState, action: Array) -> PointState:
        return self._state(state.obs["achieved_goal"] + action, state.obs["desired_goal"])


@struct.dataclass
class ExplodingState(PointState):
    step: Array
    failed: Array


class Explodes(PointMass):
    """PointMass of which the episodes that start beyond `edge` break at their third step.

    `value` then stands in their observations for one step; None: they say `failed` and show nothing.
    """

    EDGE = 0.2

    def __init__(self, value: float | None, edge: float = EDGE):
        super().__init__()
        self.value, self.edge = value, edge

    def reset(self, key) -> ExplodingState:
        state = super().reset(key)
        breaks = state.obs["achieved_goal"][0] > self.edge
        # Counts up from 0 in an episode that will break, from 100 in any other.
        return ExplodingState(state.obs, state.reward, state.success, jnp.where(breaks, 0, 100), jnp.zeros((), bool))

    def with_goal(self, state: ExplodingState, goal: Array) -> ExplodingState:
        first = super().with_goal(state, goal)
        return ExplodingState(first.obs, first.reward, first.success, state.step, state.failed)

    def step(self, state: ExplodingState, action: Array) -> ExplodingState:
        following = super().step(state, action)
        step, obs = state.step + 1, following.obs
        if self.value is None:
            failed = state.failed | (step == 3)
        else:
            failed = state.failed
            obs = obs | {"observation": jnp.where(step == 3, self.value, obs["observation"])}
        return ExplodingState(obs, following.reward, following.success, step, failed)


class LinearActor(nn.Module):
    """tanh(w * observation): one number in, one out."""

    @nn.compact
    def __call__(self, observation, goal):
        return jnp.tanh(self.param("w", nn.initializers.constant(1.0), ()) * observation)


BATCH = Batch(
    observation=jnp.array([[1.0], [0.0]]),
    next_observation=jnp.array([[0.0], [2.0]]),
    desired_goal=jnp.array([[-1.0], [-4.0]]),
    action=jnp.array([[1.0], [-1.0]]),
    reward=jnp.array([-1.0, 0.0]),
    discount=jnp.array([0.5, 0.5]),
    row=jnp.arange(2),
)
