"""Wrappers for any environment: observation noise, action delay, action filter and frame stack. They compose.

A wrapper is an environment. It has the members of the wrapped environment, and its states have the fields of the inner states.
With the same key, both start the same episode.
"""

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mjx_dher.contract import check_env_parts, env_spec
from mjx_dher.types import Array, EnvSpec, GoalObs, MirrorFn, PRNGKey, PyTree
from mjx_dher.validation import check_number

__all__ = ["ActionDelay", "ActionFilter", "FrameStack", "ObservationNoise", "Wrapper", "WrapperState"]

_KEY = 0x57524150  # folded into the innermost wrapper's key; the next wrapper uses the next number


@struct.dataclass
class WrapperState:
    """State of a wrapped environment. Other fields, such as `reward` and `physics`, come from `inner`."""

    inner: PyTree  # state of the inner environment
    obs: GoalObs
    memory: PyTree  # state of the wrapper

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "inner":  # while a copy is made, `inner` is missing
            raise AttributeError(name)
        return getattr(self.inner, name)


class Wrapper:
    """Base class: passes actions and observations on unchanged. Goals, rewards and success come from the inner environment."""

    keeps_mirror = False  # whether the inner environment's `mirror` holds for this class. Subclasses do not inherit it.

    def __init__(self, env: Any):
        check_env_parts(env)
        self.env = env
        self._number: int = env._number + 1 if isinstance(env, Wrapper) else _KEY
        self._rest = np.broadcast_to(np.asarray(getattr(env, "rest_action", 0.0), np.float32), (env.action_size,))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        if name in ("init_state", "first_state"):  # they have no key for the wrapper's memory
            raise AttributeError(f"a wrapped environment has no {name}: use reset(key)")
        if name == "mirror":
            from mjx_dher import mirror

            if not vars(type(self)).get("keeps_mirror"):
                raise AttributeError(f"the inner mirror may contradict {type(self).__name__}, unless it sets keeps_mirror")
            return mirror.own(self.env)
        if name == "robot_interface" and type(self).__module__ != __name__:
            return {"own": [type(self).__name__]}
        own = getattr(self.env, name)  # with_goal and with_object only if the environment has them
        return {"with_goal": self._with_goal, "with_object": self._with_object}.get(name, own)

    def begin(self, key: PRNGKey, observation: PyTree, rest: Array) -> tuple[PyTree, PyTree]:
        """Memory and observation after a reset with `observation`. The action `rest` [A] holds the first state."""
        return (), observation

    def act(self, memory: PyTree, action: Array) -> tuple[PyTree, Array]:
        """Memory, and the action [A] to apply in place of `action`."""
        return memory, action

    def see(self, memory: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
        """Memory, and the observation in place of `observation`."""
        return memory, observation

    def see_moved(self, memory: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
        """`see` after the object was set elsewhere."""
        return self.see(memory, observation)

    def reset(self, key: PRNGKey) -> WrapperState:
        """Initial state. `key` draws the same start as without the wrapper."""
        inner = self.env.reset(key)
        rest_of = getattr(self.env, "rest_of", None)
        rest = jnp.asarray(self._rest) if rest_of is None else rest_of(inner.physics)
        memory, observation = self.begin(jax.random.fold_in(key, self._number), inner.obs["observation"], rest)
        return WrapperState(inner, _observed(inner, observation), memory)

    def step(self, state: WrapperState, action: Array) -> WrapperState:
        """State after one step with an action [A], which is clipped to [-1, 1], except NaN and infinity."""
        action = jnp.asarray(action, jnp.float32)
        if action.shape != (self.env.action_size,):
            raise ValueError(f"action must be [{self.env.action_size}]; got shape {list(action.shape)}")
        memory, action = self.act(state.memory, jnp.where(jnp.isfinite(action), jnp.clip(action, -1.0, 1.0), action))
        return self._seen(self.env.step(state.inner, action), memory)

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards [...] of goals [..., G] in the inner environment."""
        return self.env.compute_reward(achieved_goal, desired_goal)

    def _seen(self, inner: Any, memory: PyTree) -> WrapperState:
        memory, observation = self.see(memory, inner.obs["observation"])
        return WrapperState(inner, _observed(inner, observation), memory)

    def _with_goal(self, state: WrapperState, goal: Array) -> WrapperState:
        inner = self.env.with_goal(state.inner, goal)
        return WrapperState(inner, _observed(inner, state.obs["observation"]), state.memory)

    def _with_object(self, state: WrapperState, position: Array) -> WrapperState:
        inner = self.env.with_object(state.inner, position)
        memory, observation = self.see_moved(state.memory, inner.obs["observation"])
        return WrapperState(inner, _observed(inner, observation), memory)


def _observed(inner: Any, observation: PyTree) -> GoalObs:
    """Goals of an inner state with another observation."""
    obs: Any = {**inner.obs, "observation": observation}
    return obs


class ObservationNoise(Wrapper):
    """Adds normal noise to the observation at each step. Achieved goals and rewards have no noise.

    Args:
      obs_noise: standard deviation in [0, 1000], a number, or [D] for a vector observation.
    """

    keeps_mirror = True

    def __init__(self, env: Any, obs_noise: Any):
        super().__init__(env)
        for value in np.ravel(obs_noise).tolist():
            check_number("obs_noise", value, "[0, 1000]", float)
        self._std = np.asarray(obs_noise, np.float32)
        spec = env_spec(env)
        if self._std.ndim and self._std.shape != (spec.observation_size,):
            raise ValueError(f"obs_noise must be a number or [{spec.observation_size}]; got shape {list(self._std.shape)}")
        if not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(spec.observation)):
            raise ValueError(f"obs_noise needs float observations; got {spec.observation}")

    def begin(self, key: PRNGKey, observation: PyTree, rest: Array) -> tuple[PyTree, PyTree]:
        return self.see(key, observation)

    def see(self, memory: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
        following, key = jax.random.split(memory)
        leaves, structure = jax.tree.flatten(observation)
        keys = jax.random.split(key, len(leaves))
        drawn = [x + self._std * jax.random.normal(own, x.shape, x.dtype) for own, x in zip(keys, leaves)]
        return following, jax.tree.unflatten(structure, drawn)


class ActionDelay(Wrapper):
    """Applies actions some steps late. Before the first one arrives, it applies the action that holds the first state.
    An environment says it by `rest_of(physics)` or `rest_action`; otherwise it is 0.

    Args:
      action_delay: steps, at most 1000, or (low, high) or "low-high" to draw a number at each reset.
    """

    keeps_mirror = True

    def __init__(self, env: Any, action_delay: int | tuple[int, int] | str):
        super().__init__(env)
        between = re.fullmatch(r"(\d{1,4})-(\d{1,4})", action_delay) if isinstance(action_delay, str) else None
        given: Any = tuple(map(int, between.groups())) if between else action_delay
        self._least, self._most = given if isinstance(given, tuple) and len(given) == 2 else (given, given)
        check_number("action_delay", self._least, "[0, 1000]")
        check_number("action_delay", self._most, f"[{self._least}, 1000]")

    def begin(self, key: PRNGKey, observation: PyTree, rest: Array) -> tuple[PyTree, PyTree]:
        steps = jax.random.randint(key, (), self._least, self._most + 1, jnp.int32)
        return (steps, jnp.tile(rest, (self._most, 1))), observation

    def act(self, memory: PyTree, action: Array) -> tuple[PyTree, Array]:
        steps, earlier = memory  # earlier actions, latest first
        actions = jnp.concatenate([action[None], earlier])
        return (steps, actions[: self._most]), actions[steps]


class ActionFilter(Wrapper):
    """Applies y_t = c y_(t-1) + (1 - c) a_t in place of the action a_t. Initially y is as in `ActionDelay`.

    Args:
      action_filter: c in [0, 1). 0 filters nothing.
    """

    keeps_mirror = True

    def __init__(self, env: Any, action_filter: float):
        super().__init__(env)
        check_number("action_filter", action_filter, "[0, 1)", float)
        self._kept = float(action_filter)

    def begin(self, key: PRNGKey, observation: PyTree, rest: Array) -> tuple[PyTree, PyTree]:
        return rest, observation

    def act(self, memory: PyTree, action: Array) -> tuple[PyTree, Array]:
        filtered = self._kept * memory + (1.0 - self._kept) * action
        return filtered, filtered


class FrameStack(Wrapper):
    """Observes the last n observations, joined along their last axis, latest first. A reset repeats the first one.

    Args:
      frame_stack: n in [1, 100].
    """

    keeps_mirror = True

    def __init__(self, env: Any, frame_stack: int):
        super().__init__(env)
        check_number("frame_stack", frame_stack, "[1, 100]")
        self._frames = frame_stack
        if not all(leaf.shape for leaf in jax.tree.leaves(env_spec(env).observation)):
            raise ValueError(f"frame_stack needs vector observations; got {env_spec(env).observation}")

    @property
    def observation_size(self) -> int:
        """Size of n observations."""
        return self._frames * self.env.observation_size

    @property
    def mirror(self) -> MirrorFn:
        """The inner environment's `mirror`, applied to each frame. Raises AttributeError if it has none."""
        inner = self.__getattr__("mirror")  # refused for a subclass without keeps_mirror

        def of_frames(observation: PyTree, goal: Array, action: Array) -> tuple[PyTree, Array, Array]:
            leaves, structure = jax.tree.flatten(observation)
            frames = zip(*(jnp.split(leaf, self._frames, axis=-1) for leaf in leaves))
            images = [inner(jax.tree.unflatten(structure, frame), goal, action) for frame in frames]
            return self._join(tuple(image[0] for image in images)), *images[0][1:]

        return of_frames

    @property
    def spec(self) -> EnvSpec:
        """Contract of the inner environment, with larger observations."""
        joined = jax.eval_shape(self._join, (self.env.spec.observation,) * self._frames)
        return dataclasses.replace(self.env.spec, observation=joined)

    def begin(self, key: PRNGKey, observation: PyTree, rest: Array) -> tuple[PyTree, PyTree]:
        return self.see_moved((), observation)

    def see(self, memory: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
        frames = (observation, *memory[:-1])
        return frames, self._join(frames)

    def see_moved(self, memory: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
        return self.see((observation,) * self._frames, observation)

    @staticmethod
    def _join(frames: tuple[PyTree, ...]) -> PyTree:
        return jax.tree.map(lambda *each: jnp.concatenate(each, axis=-1), *frames)
