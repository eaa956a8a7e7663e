"""An environment's functions for gymnasium, compiled once for all instances that are alike."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_dher import envs

if TYPE_CHECKING:
    from mjx_dher.envs import GoalEnv, State


@dataclasses.dataclass(frozen=True)
class Programs:
    """An environment and its functions, each compiled at its first call."""

    name: str
    options: tuple[tuple[str, Any], ...]
    env: GoalEnv
    reset: Callable[[Any], State]  # seed [] -> state
    step: Callable[[State, np.ndarray], State]  # state, action [A] -> state
    reset_all: Callable[[Any], State]  # seeds [N] -> states [N, ...]
    step_all: Callable[[State, np.ndarray], State]  # states, actions [N, A] -> states
    reward: Callable[[np.ndarray, np.ndarray], Any]  # achieved [M, G], desired [M, G] -> [M]

    def __reduce__(self) -> Any:
        """Returns how a copy, or a pickle, is made: compiled functions cannot be copied, but made again, or shared."""
        return _compile, (self.name, self.options)


def programs(name: str, options: dict[str, Any]) -> Programs:
    """Returns the functions that all instances of an environment share; arguments as for `envs.make`.

    Raises:
      ValueError: as for `envs.make`, or an option has another name in gymnasium.
    """
    if "episode_length" in options:
        raise ValueError("episode_length is called max_episode_steps in gymnasium.make and gymnasium.make_vec")
    from mjx_dher.envs.engines import resolve_engine

    for key, value in options.items():
        if not isinstance(value, Hashable):
            raise ValueError(f"option {key} must be a single value; got {value!r}")
    engine = resolve_engine(options.get("engine", "auto"))  # so that auto shares the programs of the engine it stands for
    return _compile(name, tuple(sorted({**options, "engine": engine}.items())))


@functools.cache
def _compile(name: str, options: tuple[tuple[str, Any], ...]) -> Programs:
    import jax

    env = envs.make(name, **dict(options))

    def reset(seed):
        return env.reset(jax.random.key(seed))

    return Programs(
        name=name,
        options=options,
        env=env,
        reset=jax.jit(reset),
        step=jax.jit(env.step),
        reset_all=jax.jit(jax.vmap(reset)),
        step_all=jax.jit(jax.vmap(env.step)),
        reward=jax.jit(env.compute_reward),
    )
