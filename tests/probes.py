"""Environments whose answers are known, a network and a batch that are followed by hand, and another program's lock."""

import contextlib

import flax.linen as nn
import jax
import jax.numpy as jnp
from filelock import FileLock
from flax import struct

from mjx_dher.learners import Learner
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


class Least(Learner):
    """A learner of one array, whose actions are the same everywhere. It is traced in a fraction of DDPG's time."""

    def init(self, key):
        return {"w": jnp.zeros(8)}

    def act(self, state, obs, hparams):
        return jnp.broadcast_to(jnp.tanh(state["w"][:2]), (*obs["observation"].shape[:-1], 2))

    def explore(self, state, obs, noise, hparams):
        return self.act(state, obs, hparams)

    def update(self, state, batch, hparams):
        return {"w": state["w"] + jnp.mean(batch.reward)}, {"q_mean": jnp.mean(batch.reward)}


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


@struct.dataclass
class WalkState(PointState):
    done: Array
    terminal: Array


class Walk(PointMass):
    """A point that moves by exactly its action from the origin. Its episodes end beyond x = 1, and fatally below y = -1.

    Both depend on where it goes, not on its goal; with `ends_at_goal` a goal that is reached ends an episode, too.
    """

    name = "walk"

    def __init__(self, episode_length: int = 12, ends_at_goal: bool = False):
        super().__init__(episode_length)
        one = jax.ShapeDtypeStruct((2,), jnp.float32)
        self.spec = EnvSpec(one, 2, 2, episode_length, ends=True, ends_at_goal=ends_at_goal)

    def reset(self, key) -> WalkState:
        return self._walk(jnp.zeros(2), jax.random.uniform(key, (2,), jnp.float32, minval=-1.0, maxval=1.0))

    def step(self, state: WalkState, action: Array) -> WalkState:
        return self._walk(state.obs["achieved_goal"] + action, state.obs["desired_goal"])

    def with_goal(self, state: WalkState, goal: Array) -> WalkState:
        return self._walk(state.obs["achieved_goal"], goal)

    def _walk(self, position: Array, goal: Array) -> WalkState:
        state = self._state(position, goal)
        return WalkState(state.obs, state.reward, state.success, position[0] > 1.0, position[1] < -1.0)


class Corridor(PointMass):
    """A state that walks 0, 1, 2, ... whatever the action, towards a goal at `goal`, and a trap at 3.

    Rewards are -1, or 0 at the goal. `kind` says what ends an episode: "trap" (terminal, for every goal), "goal" (reaching it)
    or "clock" (the time alone, while the state stays 0).
    """

    def __init__(self, kind: str, goal: float = 9.0, episode_length: int = 5):
        super().__init__(episode_length)
        self.kind, self.goal = kind, goal
        self.observation_size, self.goal_size, self.action_size = 1, 1, 1
        one = jax.ShapeDtypeStruct((1,), jnp.float32)
        self.spec = EnvSpec(one, 1, 1, episode_length, ends=kind != "clock", ends_at_goal=kind == "goal")

    def reset(self, key):
        return self._at(jnp.zeros(1), jnp.full((1,), self.goal) + 0.0 * jax.random.uniform(key, (1,)))

    def step(self, state, action):
        speed = 0.0 if self.kind == "clock" else 1.0
        return self._at(state.obs["achieved_goal"] + speed + 0.0 * action, state.obs["desired_goal"])

    def compute_reward(self, achieved_goal, desired_goal):
        return -(jnp.abs(achieved_goal - desired_goal)[..., 0] > 0.5).astype(jnp.float32)

    def _at(self, place, goal):
        reward = self.compute_reward(place, goal)
        obs = {"observation": place, "achieved_goal": place, "desired_goal": goal}
        if self.kind == "clock":
            return PointState(obs, reward, (reward == 0).astype(jnp.float32))
        trapped = (place[0] > 2.5) & (self.kind == "trap")
        return WalkState(obs, reward, (reward == 0).astype(jnp.float32), trapped, trapped)


def WalkToGoal():
    """A `Walk` that ends at its goal."""
    return Walk(ends_at_goal=True)
