"""A policy on a robot: measurements to targets, with the task's own observation and controls."""

import json
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.contract import robot_interface
from mjx_dher.envs.engines import Controls, Physics
from mjx_dher.envs.simulated import SimulatedTask
from mjx_dher.envs.wrappers import ActionDelay, ActionFilter, FrameStack, ObservationNoise, Wrapper
from mjx_dher.types import Array, PyTree

_BY_HAND = "pass an env without it, and a policy that does the same"


class RobotLoop:
    """Maps a robot's measurements to the inputs of its servos and motors, one call per step of `env.dt` s.

    Stacked frames and the action filter work as in training. Noise and delay of the environment are left out, because the robot
    has its own. The constructor compiles all, for the CPU.

    Args:
      env: a `MujocoTask` or Fetch task, or wrappers around one, made as in training.
      policy: maps {"observation": [D], "desired_goal": [G]} to an action [A], such as `mjx_dher.load_policy(path)`.

    Raises:
      ValueError: it is no such environment, it has an own wrapper, `advance`, `step`, `observed` or `observe_goal`, or the
        policy was trained with another period, controls or observation.
    """

    def __init__(self, env: Any, policy: Callable[[Mapping[str, Any]], np.ndarray]):
        self._wrappers: list[Wrapper] = []
        task = env
        while isinstance(task, Wrapper):
            if isinstance(task, ActionFilter | FrameStack):
                self._wrappers.insert(0, task)  # the innermost first
            elif not isinstance(task, ActionDelay | ObservationNoise):
                raise ValueError(f"a loop does not know what {type(task).__name__} does; {_BY_HAND}")
            task = task.env
        if not isinstance(task, SimulatedTask):
            raise ValueError(f"env must be a task from an MJCF, or wrappers around one; got {type(task).__name__}")
        if unknown := {"advance", "step", "observed", "observe_goal"} & set(task._own):
            raise ValueError(f"a loop does not know what {type(task).__name__}.{min(unknown)} does; {_BY_HAND}")
        self.task, self.policy = task, policy
        trained, own = getattr(policy, "interface", None) or {}, json.loads(json.dumps(robot_interface(env)))
        if "own" in trained and trained["own"] != own.get("own", []):  # policies of older versions lack it
            raise ValueError(f"env has its own {own.get('own', [])}, and the policy was trained with own {trained['own']}")
        described = trained.keys() & own.keys()  # env leaves out what its own methods may contradict
        for name in ("dt", "controls", "layout", "joints", "sensors"):
            if name in described and not _agree(trained[name], own[name]):
                raise ValueError(f"env has {name} {own[name]}, and the policy was trained with {trained[name]}")
        goals = [{name: each.get("goal", {}).get(name) for name in ("kind", "of")} for each in (trained, own)]
        if "goal" in described and goals[0] != goals[1]:
            raise ValueError(f"env has the goal {goals[1]}, and the policy was trained with {goals[0]}")
        model, sensors = task.model, task._rest.sensors
        self._sizes = {"qpos": model.nq, "qvel": model.nv, "goal": task.goal_size}
        self._sizes["sensors"] = 0 if sensors is None else len(sensors)
        self._senses = sensors is not None
        self._see, self._act = jax.jit(self._observe), jax.jit(self._control)
        zeros = {name: np.zeros(size, np.float32) for name, size in self._sizes.items()}
        self.start()
        for _ in range(2):  # the first step of an episode and the others are two programs
            self(**{**zeros, "qpos": model.qpos0})
        self.start()

    def start(self) -> None:
        """Begins an episode: forgets the frames and the filtered action."""
        self._memory: list[PyTree] | None = None

    def __call__(self, qpos: Any, qvel: Any, goal: Any, sensors: Any = None) -> Controls:
        """Inputs for the next step.

        Args:
          qpos: positions [nq] of all joints of the model in its order, rad or m; a free body has x, y, z, and w, x, y, z.
          qvel: velocities [nv], rad/s or m/s.
          goal: desired goal [G].
          sensors: sensor data [nsensordata], if the task observes sensors. The arm tasks with a cube observe one number.

        Returns:
          `ctrl` [nu] for the actuators and `mocap` [nmocap, 7], in NumPy.

        Raises:
          ValueError: a measurement or the policy's action has another size, or is not finite. Frames and filter are then as
            before the call.
        """
        measured = {"qpos": qpos, "qvel": qvel} | ({"sensors": sensors} if self._senses else {})
        arrays = {name: _checked(name, value, self._sizes[name]) for name, value in measured.items()}
        desired = _checked("goal", goal, self._sizes["goal"])
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            memory, physics, observation = self._see(self._memory, arrays)
            _check_finite("the observation is", observation, qpos)
            action = self.policy({"observation": np.asarray(observation), "desired_goal": desired})
            action = _checked("action of the policy", action, self.task.action_size)
            memory, controls = self._act(memory, physics, action)
        controls = jax.tree.map(np.asarray, controls)
        _check_finite("the controls are", controls, qpos)
        self._memory = memory  # only now, so that the call can be repeated after an error
        return controls

    def _observe(self, memory: list[PyTree] | None, measured: dict[str, Array]) -> tuple[list[PyTree], Physics, PyTree]:
        """Memory of the wrappers, physics, and observation."""
        model = self.task.model
        rest = {"warmstart": jnp.zeros(model.nv), "act": jnp.zeros(model.na)}
        physics = Physics(**rest, **measured)
        observation = self.task.observe(physics).astype(jnp.float32)
        following, of_task = [], getattr(self.task, "rest_of", None)
        rest_action = jnp.zeros(self.task.action_size) if of_task is None else of_task(physics, measured=True)
        for i, wrapper in enumerate(self._wrappers):
            if memory is None:
                own, observation = wrapper.begin(jax.random.key(0), observation, rest_action)
            else:
                own, observation = wrapper.see(memory[i], observation)
            following.append(own)
        return following, physics, observation

    def _control(self, memory: list[PyTree], physics: Physics, action: Array) -> tuple[list[PyTree], Controls]:
        """Memory of the wrappers, and inputs of the engine."""
        action = jnp.clip(action, -1.0, 1.0)
        following: list[PyTree] = []
        for i, wrapper in reversed(list(enumerate(self._wrappers))):
            own, action = wrapper.act(memory[i], action)
            following.insert(0, own)
        return following, self.task.controls(physics, action)


def _checked(name: str, value: Any, size: int) -> np.ndarray:
    """The value as float32 [size]. Raises ValueError if it has another size or is not finite."""
    array = np.asarray(value, np.float32)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be {size} finite numbers; got {value}")
    return array


def _check_finite(what: str, values: PyTree, qpos: Any) -> None:
    """Raises ValueError if one of the `values` is not finite."""
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(values)):
        raise ValueError(f"{what} not finite; qpos must have quaternions of length 1; got {qpos}")


def _agree(trained: Any, own: Any) -> bool:
    """Whether two JSON descriptions agree in all entries that both have. Policies of older versions have fewer."""
    if isinstance(trained, dict) and isinstance(own, dict):
        return all(_agree(trained[name], own[name]) for name in trained.keys() & own.keys())
    if isinstance(trained, list) and isinstance(own, list):
        return len(trained) == len(own) and all(map(_agree, trained, own))
    return bool(trained == own)
