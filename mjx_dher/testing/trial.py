"""What the trials of parts share: random episodes, and calls whose errors become sentences."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable
from typing import Any

import flax
import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.rollout import rollout
from mjx_dher.types import Env, Episode, check_env_parts

EPISODES = 16
# Folders of code that is not the user's.
_OURS = os.path.dirname(os.path.dirname(__file__)) + os.sep
_INNER = (_OURS, *(os.path.dirname(str(module.__file__)) + os.sep for module in (jax, flax, np)))


class PartError(ValueError):
    """Error of a part of one's own; the message says what is wrong and what is expected."""


def random_episodes(env: Env, seed: int = 0) -> Episode:
    """Plays 16 episodes of uniformly random actions; leaves lead with [16].

    Raises:
      PartError: the environment cannot be played.
    """
    attempt("env", check_env_parts, env)
    key, action_key = jax.random.split(jax.random.key(seed))
    shape = (env.episode_length, EPISODES, env.action_size)
    actions = jax.random.uniform(action_key, shape, jnp.float32, minval=-1.0, maxval=1.0)
    play = jax.jit(lambda: rollout(env, lambda action, obs: action, key, EPISODES, actions)[0])
    return attempt("env, played with random actions,", play)


def attempt(what: str, function: Callable[..., Any], *args: Any) -> Any:
    """Calls `function`; an error of any kind becomes a PartError that tells what was tried, the error, and its place.

    The library's own sentences stay as they are.
    """
    try:
        return function(*args)
    except PartError:
        raise
    except Exception as error:
        if isinstance(error, ValueError) and traceback.extract_tb(error.__traceback__)[-1].filename.startswith(_OURS):
            raise PartError(str(error)) from error
        raise PartError(f"{what} raises {describe(error)}") from error


def describe(error: Exception) -> str:
    """Returns an error's type, the first line of its message, and the last place in it that is neither JAX's nor ours."""
    reason = (str(error).strip().splitlines() or [""])[0]
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_inner(frame.filename)]
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    hint = ""
    if isinstance(error, (jax.errors.TracerBoolConversionError, jax.errors.ConcretizationTypeError)):
        hint = "; JAX traces the function, so its `if` and `float` cannot look at values: use jnp.where"
    return f"{type(error).__name__}: {reason}{hint}{place}"


def _is_inner(filename: str) -> bool:
    return filename.startswith("<") or filename.startswith(_INNER)


def expect_finite(what: str, value: Any) -> None:
    """Raises PartError unless all numbers of a pytree are finite."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        if jnp.issubdtype(leaf.dtype, jnp.inexact) and not bool(jnp.all(jnp.isfinite(leaf))):
            raise PartError(f"{what} must be finite; {jax.tree_util.keystr(path) or 'it'} is not")
