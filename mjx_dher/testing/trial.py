"""What the checks share: random episodes, and calls whose errors become one line."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable
from typing import Any

import flax
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher.contract import check_env_parts
from mjx_dher.rollout import rollout
from mjx_dher.types import Env, Episode

EPISODES = 16
TOLERANCE = 1e-3
# Folders of code that is not the user's.
_OURS = os.path.dirname(os.path.dirname(__file__)) + os.sep
_INNER = (_OURS, *(os.path.dirname(str(module.__file__)) + os.sep for module in (jax, flax, np)))


class ComponentError(ValueError):
    """Error of a custom component: what is wrong, and what is expected."""


def expect(condition: Any, message: str) -> None:
    """Raises ComponentError with `message` unless the condition holds."""
    if not condition:
        raise ComponentError(message)


def expect_finite(what: str, value: Any) -> None:
    """Raises ComponentError unless all numbers of a pytree are finite."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        if jnp.issubdtype(leaf.dtype, jnp.inexact):
            name = jax.tree_util.keystr(path) or "it"
            expect(jnp.all(jnp.isfinite(leaf)), f"{what} must be finite; {name} is not")


def expect_range(what: str, values: NDArray) -> str:
    """Raises ComponentError unless numbers are finite and not negative; returns their range as text."""
    expect_finite(what, values)
    expect(values.min() >= 0, f"{what} must not be negative; the least is {values.min():.3g}")
    return f"from {values.min():.3g} to {values.max():.3g}"


def random_episodes(env: Env, seed: int = 0) -> Episode:
    """Plays 16 episodes of uniformly random actions; leaves lead with [16]. Raises ComponentError if it cannot."""
    attempt("env", check_env_parts, env)
    key, action_key = jax.random.split(jax.random.key(seed))
    shape = (env.episode_length, EPISODES, env.action_size)
    actions = jax.random.uniform(action_key, shape, jnp.float32, minval=-1.0, maxval=1.0)
    play = jax.jit(lambda: rollout(env, lambda action, obs: action, key, EPISODES, actions)[0])
    return attempt("env, played with random actions,", play)


def attempt(what: str, function: Callable[..., Any], *args: Any) -> Any:
    """Calls `function`; an error of any kind becomes a ComponentError with what was tried, the error and its place.

    The library's own ValueErrors keep their message.
    """
    try:
        return function(*args)
    except ComponentError:
        raise
    except Exception as error:
        if isinstance(error, ValueError) and traceback.extract_tb(error.__traceback__)[-1].filename.startswith(_OURS):
            raise ComponentError(str(error)) from error
        raise ComponentError(f"{what} raises {_describe(error)}") from error


def _describe(error: Exception) -> str:
    """An error's type, the first line of its message, and the last place in it that is neither JAX's nor this library's."""
    reason = (str(error).strip().splitlines() or [""])[0]
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_inner(frame.filename)]
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    hint = ""
    if isinstance(error, (jax.errors.TracerBoolConversionError, jax.errors.ConcretizationTypeError)):
        hint = "; JAX traces the function, so its `if` and `float` cannot look at values: use jnp.where"
    return f"{type(error).__name__}: {reason}{hint}{place}"


def _is_inner(filename: str) -> bool:
    return filename.startswith("<") or filename.startswith(_INNER)
