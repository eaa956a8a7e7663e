"""An environment's functions for Gymnasium, compiled once for all equal instances."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_dher import envs, import_paths
from mjx_dher.lookup import is_import_path

if TYPE_CHECKING:
    from mjx_dher.envs import GoalEnv, State
    from mjx_dher.types import EnvSpec


@dataclasses.dataclass(frozen=True)
class Programs:
    """An environment and its functions, each compiled at its first call."""

    name: str
    options: tuple[tuple[str, Any], ...]
    env: GoalEnv
    spec: EnvSpec
    fps: float  # steps per second
    reset: Callable[[Any], State]  # seed [] -> state
    step: Callable[[State, np.ndarray], State]  # state, action [A] -> state
    reset_all: Callable[[Any], State]  # seeds [N] -> states [N, ...]
    step_all: Callable[[State, np.ndarray], State]  # states, actions [N, A] -> states
    restart: Callable[[State, Any, Any], State]  # states, seeds [N], mask of states to reset [N] -> states
    ended: Callable[[State], tuple[Any, Any]]  # state or states [N] -> terminated, truncated; bool [] or [N]
    reward: Callable[[np.ndarray, np.ndarray], Any]  # achieved [M, G], desired [M, G] -> [M]
    reached: Callable[[Any, Any], Any]  # achieved [..., G], desired [..., G] -> bool [...]

    def check(self) -> None:
        """Raises ValueError if the environment found a fault in earlier steps."""
        if callable(check := getattr(self.env, "check", None)):
            check()

    def __reduce__(self) -> Any:
        """Copies and pickles make or share the functions again, because compiled functions cannot be copied."""
        return programs, (self.name, dict(self.options))


def programs(name: str, options: dict[str, Any]) -> Programs:
    """Functions shared by all instances of an environment. Arguments are as in `envs.make`. Raises ValueError as `envs.make`
    does, or if an option has another name in Gymnasium.
    """
    if "episode_length" in options:
        raise ValueError("episode_length is called max_episode_steps in gymnasium.make and gymnasium.make_vec")
    from mjx_dher.envs.engines import resolve_engine

    for key, value in options.items():
        if not isinstance(value, Hashable):
            raise ValueError(f"option {key} must be a single value; got {value!r}")
    if "engine" in options or not is_import_path(name):  # auto shares the programs of its engine
        options = {**options, "engine": resolve_engine(options.get("engine", "auto"))}
    made_by = import_paths.load("env", name) if is_import_path(name) else None  # another one after a reload
    given = tuple(sorted(options.items()))
    return _compile(name, given, (made_by, *(type(value) for _, value in given)))


@functools.lru_cache(maxsize=16)  # a living environment keeps its own
def _compile(name: str, options: tuple[tuple[str, Any], ...], differs: Hashable) -> Programs:
    """Programs of an environment. `differs` tells equal arguments apart, such as 1 and True."""
    del differs
    import jax

    from mjx_dher import context, rollout
    from mjx_dher.contract import env_spec, step_seconds

    env = envs.make(name, **dict(options))
    spec = env_spec(env)

    def reset(seed):
        return env.reset(jax.random.key(seed))

    def restart(states, seeds, which):
        return rollout.where_each(which, jax.vmap(reset)(seeds), states)

    return Programs(
        name=name,
        options=options,
        env=env,
        spec=spec,
        fps=1.0 / step_seconds(env),
        reset=jax.jit(reset),
        step=jax.jit(env.step),
        reset_all=jax.jit(jax.vmap(reset)),
        step_all=jax.jit(jax.vmap(env.step)),
        restart=jax.jit(restart),
        ended=jax.jit(functools.partial(rollout.ended, env, spec)),
        reward=jax.jit(env.compute_reward),
        reached=context.reached_fn(env),
    )
