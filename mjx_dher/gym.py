"""Gymnasium environments of the tasks, for `gymnasium.make` and `gymnasium.make_vec`.

    gymnasium.make("mjx_dher.gym:mjx_dher/FetchPush-v0")
    gymnasium.make("mjx_dher.gym:mjx_dher/Env-v0", name="my_module:MyTask")

Importing this module registers them. JAX and MuJoCo are loaded when an environment is made.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mjx_dher.config import plain
from mjx_dher.lookup import check_name, missing_extra
from mjx_dher.tools.gym_cache import Programs, programs
from mjx_dher.validation import check_count

try:
    import gymnasium
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
    from gymnasium.wrappers import TimeLimit
except ImportError as error:
    raise ImportError(f"{missing_extra('mjx_dher.gym', 'gymnasium 1.1 or newer', 'gym')} ({error})") from error

if TYPE_CHECKING:
    from mjx_dher.envs import State
    from mjx_dher.tools.render import Painter
    from mjx_dher.types import EnvSpec

__all__ = ["ENV_ID", "IDS", "GymEnv", "GymVectorEnv", "episode_seed", "make_custom"]

IDS = {
    "mjx_dher/FetchPush-v0": "push",
    "mjx_dher/FetchPickAndPlace-v0": "pick_and_place",
    "mjx_dher/FetchSlide-v0": "slide",
    "mjx_dher/FetchReach-v0": "reach",
}
ENV_ID = "mjx_dher/Env-v0"  # any environment, by the argument `name`
HORIZON = 50  # steps; the tasks' default episode_length, which cannot be read without loading JAX
PICTURE = 480  # width and height of a picture, pixels

Obs = dict[str, Any]


def episode_seed(np_random: np.random.Generator) -> int:
    """Draws the seed of the next episode, which starts from `jax.random.key(seed)`."""
    return int(np_random.integers(2**31))


class _GoalApi:
    """Goal methods of gymnasium-robotics' environments and the current state, for single and vectorized ones."""

    _compiled: Programs
    _state: Any = None  # with leading [N] if vectorized; None until `reset`, and again after an error

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Rewards float32 [...] of goals [..., G]. Ignores `info`. Raises ValueError if the last axis of the goals is not G, or
        their shapes cannot be broadcast.
        """
        achieved, desired = self._goals(achieved_goal, desired_goal)
        flat = achieved.reshape(-1, achieved.shape[-1]), desired.reshape(-1, desired.shape[-1])
        # Padded to a power of two, because each new number of goals would be compiled again.
        num_goals = len(flat[0])
        padding = ((0, (1 << max(num_goals - 1, 0).bit_length()) - num_goals), (0, 0))
        rewards = np.array(self._compiled.reward(*(np.pad(goals, padding) for goals in flat)), np.float32)
        return rewards[:num_goals].reshape(achieved.shape[:-1])[()]

    def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Whether reaching these goals ends an episode, bool [...]. Always False unless the task ends at its goal.

        Arguments as in `compute_reward`. The `terminated` of `step` also includes failures that end an episode for any goal.
        """
        goals = self._goals(achieved_goal, desired_goal)
        ends = self._compiled.spec.ends_at_goal
        return np.asarray(self._compiled.reached(*goals) if ends else np.zeros(goals[0].shape[:-1], bool))[()]

    def compute_truncated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """False [...], because truncation does not depend on goals. Arguments as in `compute_reward`."""
        return np.zeros(self._goals(achieved_goal, desired_goal)[0].shape[:-1], bool)[()]

    def _goals(self, achieved_goal: Any, desired_goal: Any) -> tuple[np.ndarray, np.ndarray]:
        try:
            achieved, desired = np.asarray(achieved_goal, np.float32), np.asarray(desired_goal, np.float32)
        except TypeError as error:
            raise ValueError(f"goals must be numbers; got {achieved_goal!r} and {desired_goal!r}") from error
        size = self._compiled.spec.goal_size
        for goals in (achieved, desired):
            if goals.shape[-1:] != (size,):
                raise ValueError(f"goals must end in an axis of {size}; got shapes {achieved.shape} and {desired.shape}")
        return cast("tuple[np.ndarray, np.ndarray]", np.broadcast_arrays(achieved, desired))

    def _moved(self, program: Any, *arguments: Any) -> tuple[Obs, np.ndarray, dict[str, np.ndarray]]:
        """Takes the state that a program returns. Copies its observation, reward (float64) and info to writable arrays."""
        self._state = None
        state = program(*arguments)
        obs, reward = _nested(dict(state.obs), np.array), np.array(state.reward, np.float64)
        failed = getattr(state, "failed", np.zeros(np.shape(state.success), bool))
        info = {"is_success": np.array(state.success, np.float64), "failed": np.array(failed)}
        self._state = state
        return obs, reward, info


class GymEnv(_GoalApi, gymnasium.Env[Obs, np.ndarray]):
    """A single environment. `gymnasium.make` wraps it in a `TimeLimit` of `max_episode_steps`.

    Observations are float32. Actions outside [-1, 1] are clipped. A copy or pickle opens its own renderer.

    Args:
      name: a task from `envs.list_envs()`, or module:attribute.
      render_mode: None or "rgb_array".
      **options: arguments of `envs.make`, such as `engine` or `reward_type`.

    Raises:
      ValueError: as in `envs.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 - gymnasium's

    def __init__(self, name: str, render_mode: str | None = None, **options: Any):
        if render_mode is not None:
            check_name("render_mode", render_mode, ("rgb_array",))
        self._compiled = programs(name, options)
        self.metadata = {**self.metadata, "render_fps": self._compiled.fps}
        self.render_mode = render_mode
        self.observation_space, self.action_space = _spaces(self._compiled.spec)
        self._painter: Painter | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_painter": None}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Starts an episode. Returns its first observation and info, with `is_success` as in `step`. Raises ValueError if
        `options` is not empty, or `GoalEnv.check` found a fault in earlier episodes.
        """
        (seed,) = _check_reset(options, seed, 1)
        super().reset(seed=seed)
        self._compiled.check()
        obs, _, info = self._moved(self._compiled.reset, episode_seed(self.np_random))
        return obs, {key: value.item() for key, value in info.items()}

    def step(self, action: np.ndarray) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Applies an action [A]. Returns observation, reward, `terminated`, `truncated` and info.

        `terminated` means that no future follows. `truncated` means that the task ends the episode for another reason. Info
        has `is_success` (1.0 or 0.0) and `failed`. `failed` is True from the step at which the simulation diverged until the
        episode ends; do not learn from these steps.

        Raises:
          ValueError: `action` does not have shape [A], or is not finite.
          gymnasium.error.ResetNeeded: `reset` has not been called, or a step has failed since, other than for its action.
        """
        obs, reward, info = self._moved(self._compiled.step, self._state, _checked(action, self.action_space, self._state))
        terminated, truncated = (bool(flag) for flag in self._compiled.ended(self._state))
        return obs, reward.item(), terminated, truncated, {key: value.item() for key, value in info.items()}

    def render(self) -> np.ndarray:
        """Picture [480, 480, 3] uint8 of the state, with the goal as a red ball. The first call opens a renderer.

        Raises:
          ValueError: the environment was made without render_mode="rgb_array", or cannot be drawn on this machine.
          gymnasium.error.ResetNeeded: `reset` has not been called, or a step has failed since.
        """
        if self.render_mode is None:
            raise ValueError('render_mode must be "rgb_array" to draw the environment; got None')
        if self._state is None:
            raise gymnasium.error.ResetNeeded("reset must be called before render")
        if self._painter is None:
            from mjx_dher.tools import render

            env: Any = self._compiled.env  # Any: a GoalEnv need not have a model
            render.check_drawable(env)
            self._painter = render.Painter(env, PICTURE, PICTURE)
        return self._painter.draw(np.asarray(self._state.physics.qpos), np.asarray(self._state.obs["desired_goal"]))

    def close(self) -> None:
        """Closes the renderer. Call it before the program ends if the environment was drawn."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None


def make_custom(name: str, render_mode: str | None = None, episode_length: int | None = None, **options: Any) -> TimeLimit:
    """Makes a `GymEnv` that is truncated after `episode_length` steps, by default its own: the entry point of `ENV_ID`. In
    `gymnasium.make`, `max_episode_steps` can only make episodes shorter than that.
    """
    env = GymEnv(name, render_mode, **options)
    length = plain(env._compiled.spec.episode_length if episode_length is None else episode_length)
    check_count("episode_length", length)
    return TimeLimit(env, length)


class GymVectorEnv(_GoalApi, gymnasium.vector.VectorEnv[Obs, np.ndarray, np.ndarray]):
    """A vectorized environment: N copies of one environment in one compiled program.

    The step after an episode's last one resets that copy and ignores its action (`AutoresetMode.NEXT_STEP`). Copy i equals a
    single environment with seed + i, up to rounding.

    Args:
      name: a task from `envs.list_envs()`, or module:attribute.
      num_envs: number of copies N.
      max_episode_steps: episode length. Default: the environment's `episode_length`.
      render_mode: must be None; vectorized environments are not drawn.
      **options: arguments of `envs.make`, such as `engine` or `reward_type`.

    Raises:
      ValueError: as in `envs.make`, a number is less than 1, or `render_mode` is not None.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - gymnasium's
    _np_random: Any  # [N] generators; `np_random` and `np_random_seed` return both, as in `SyncVectorEnv`
    _np_random_seed: Any  # [N]

    def __init__(
        self, name: str, num_envs: int = 1, max_episode_steps: int | None = None, render_mode: str | None = None, **options: Any
    ):
        check_count("num_envs", num_envs)
        if render_mode is not None:
            raise ValueError(f"render_mode must be None for a vectorized environment; got {render_mode!r}")
        self._compiled = programs(name, options)
        self.num_envs = num_envs
        self.max_episode_steps = plain(self._compiled.env.episode_length if max_episode_steps is None else max_episode_steps)
        check_count("max_episode_steps", self.max_episode_steps)
        self.single_observation_space, self.single_action_space = _spaces(self._compiled.spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._np_random, self._np_random_seed = zip(*(seeding.np_random() for _ in range(num_envs)))
        self._steps, self._ended = np.zeros(num_envs, int), np.zeros(num_envs, bool)  # steps of each episode

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Starts N episodes. Returns their first observations, and the infos of `GymEnv` as arrays [N], each with a mask.

        Args:
          seed: one seed per copy, or one number: copy i then uses seed + i. None continues the random streams.
          options: must be None or empty.

        Raises:
          ValueError: there are not N seeds, `options` is not empty, or `GoalEnv.check` found a fault.
        """
        streams = zip(_check_reset(options, seed, self.num_envs), zip(self._np_random, self._np_random_seed))
        self._compiled.check()
        self._np_random, self._np_random_seed = zip(*(old if one is None else seeding.np_random(one) for one, old in streams))
        return self._moved(self._restart)[::2]

    def step(self, actions: np.ndarray) -> tuple[Obs, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Applies actions [N, A]. Returns arrays with leading [N]; `GymEnv.step` describes them.

        Raises:
          ValueError: `actions` does not have shape [N, A] or is not finite, or `GoalEnv.check` found a fault.
          gymnasium.error.ResetNeeded: `reset` has not been called, or a step has failed since, other than for its action.
        """
        actions = _checked(actions, self.action_space, self._state)
        restarted = self._ended
        obs, rewards, infos = self._moved(self._advance, self._state, actions)
        rewards = np.where(restarted, 0.0, rewards)
        terminated, done = (np.asarray(flag) & ~restarted for flag in self._compiled.ended(self._state))
        truncated = done | (self._steps == self.max_episode_steps)  # like a `TimeLimit`, even if it is terminated, too
        self._ended = terminated | truncated
        return obs, rewards, terminated, truncated, infos

    def _seeds(self, which: np.ndarray) -> np.ndarray:
        """Seeds [N] int32. Only the copies in the mask `which` [N] draw new ones."""
        drawn = (episode_seed(random) if one else 0 for random, one in zip(self._np_random, which))
        return np.fromiter(drawn, np.int32, self.num_envs)

    def _advance(self, states: "State", actions: np.ndarray) -> "State":
        if self._ended.any():
            self._compiled.check()
        if self._ended.all():
            return self._restart()
        states = self._compiled.step_all(states, actions)
        self._steps += 1
        if self._ended.any():
            states = self._compiled.restart(states, self._seeds(self._ended), self._ended)
            self._steps[self._ended] = 0
        return states

    def _restart(self) -> "State":
        self._steps, self._ended = np.zeros(self.num_envs, int), np.zeros(self.num_envs, bool)
        return self._compiled.reset_all(self._seeds(np.ones(self.num_envs, bool)))

    def _moved(self, program: Any, *arguments: Any) -> tuple[Obs, np.ndarray, dict[str, Any]]:
        obs, rewards, infos = super()._moved(program, *arguments)
        return obs, rewards, infos | {f"_{key}": np.ones(self.num_envs, bool) for key in infos}


def _spaces(spec: "EnvSpec") -> tuple[Any, Any]:
    """Observation space, in which floats are unbounded, and action space."""
    goal = gymnasium.spaces.Box(-np.inf, np.inf, (spec.goal_size,), np.float32)
    spaces: dict[str, Any] = {"observation": _space(spec.observation), "achieved_goal": goal, "desired_goal": goal}
    return gymnasium.spaces.Dict(spaces), gymnasium.spaces.Box(-1.0, 1.0, (spec.action_size,), np.float32)


def _space(observation: Any) -> Any:
    """Space of an observation: a Box for an array, a Dict or Tuple for a tree."""

    def box(leaf: Any) -> Any:
        dtype, kind = leaf.dtype, leaf.dtype.kind
        low, high = (-np.inf, np.inf) if kind == "f" else (0, 1) if kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        return gymnasium.spaces.Box(low, high, leaf.shape, dtype)

    return _nested(observation, box, gymnasium.spaces.Dict, gymnasium.spaces.Tuple)


def _nested(tree: Any, leaf: Callable[[Any], Any], mapping: Any = dict, sequence: Any = tuple) -> Any:
    """Converts a tree: arrays by `leaf`, dictionaries and the fields of dataclasses by `mapping`, tuples by `sequence`."""
    if dataclasses.is_dataclass(tree):
        tree = {f.name: getattr(tree, f.name) for f in dataclasses.fields(tree) if f.metadata.get("pytree_node", True)}
    if isinstance(tree, Mapping):
        return mapping({key: _nested(one, leaf, mapping, sequence) for key, one in tree.items()})
    return sequence([_nested(one, leaf, mapping, sequence) for one in tree]) if isinstance(tree, (tuple, list)) else leaf(tree)


def _checked(actions: Any, space: Any, state: Any) -> np.ndarray:
    """Converts `actions` to float32. Raises an error without a `state` or if they do not fit `space`, bounds aside."""
    if state is None:
        raise gymnasium.error.ResetNeeded("reset must be called before step")
    actions = np.asarray(actions, np.float32)
    if actions.shape != space.shape:
        raise ValueError(f"action must have shape {space.shape}; got {actions.shape}")
    if not np.all(np.isfinite(actions)):
        raise ValueError(f"action must be finite; got {actions}")
    return np.clip(actions, -1.0, 1.0)


def _check_reset(options: dict[str, Any] | None, seed: Any, count: int) -> list[int | None]:
    """A seed for each of `count` environments, or None to continue its random stream."""
    if options:
        raise ValueError(f"reset takes no options; got {options!r}")
    seeds = list(seed) if np.iterable(seed) else [seed]
    for one in seeds:
        if one is not None and (isinstance(one, bool) or not isinstance(one, (int, np.integer)) or one < 0):
            raise ValueError(f"a seed must be an integer of at least 0, or None; got {one!r}")
    if not np.iterable(seed):
        seeds = [None if seed is None else int(seed) + i for i in range(count)]
    if len(seeds) != count:
        raise ValueError(f"seed must be one number or one for each of {count} environments; got {len(seeds)}")
    return [None if one is None else int(one) for one in seeds]  # gymnasium rejects NumPy integers


_VECTOR: dict[str, Any] = {"vector_entry_point": "mjx_dher.gym:GymVectorEnv"}
for _id, _name in IDS.items():
    gymnasium.register(_id, "mjx_dher.gym:GymEnv", max_episode_steps=HORIZON, kwargs={"name": _name}, **_VECTOR)
make_custom.metadata = GymEnv.metadata  # type: ignore[attr-defined] # gymnasium.make wraps its pictures in windows and lists
gymnasium.register(ENV_ID, "mjx_dher.gym:make_custom", **_VECTOR)
