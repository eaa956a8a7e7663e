"""Shared parts of the checks: random episodes, and calls whose errors become one line."""

import dataclasses
import functools
import os
import traceback
from collections.abc import Callable
from typing import Any

import flax
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mjx_dher import learners, replay, trainer
from mjx_dher.config import Config, HParams
from mjx_dher.context import Context, of_env
from mjx_dher.contract import check_env_parts, env_spec
from mjx_dher.learners import Learner
from mjx_dher.replay import ReplayState
from mjx_dher.rollout import rollout
from mjx_dher.types import Env, Episode, is_key

EPISODES = 16  # random episodes
TOLERANCE = 1e-3
# Folders of code that does not belong to the user.
_OURS = os.path.dirname(os.path.dirname(__file__)) + os.sep
_INNER = ("<", _OURS, *(os.path.dirname(str(module.__file__)) + os.sep for module in (jax, flax, np)))


class ComponentError(ValueError):
    """A custom component violates its contract. The message has the violation and the expectation."""


def expect(condition: Any, message: str) -> None:
    """Raises ComponentError with `message` unless the condition holds."""
    if not condition:
        raise ComponentError(message)


def expect_finite(what: str, value: Any) -> None:
    """Raises ComponentError unless all numbers of a pytree are finite."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        if jnp.issubdtype(leaf.dtype, jnp.inexact):
            name = jax.tree_util.keystr(path) or "it"
            expect(np.isfinite(np.asarray(leaf)).all(), f"{what} must be finite; {name} is not")


def expect_range(what: str, values: NDArray) -> str:
    """Raises ComponentError unless numbers are finite and not negative. Returns their range as text."""
    expect_finite(what, values)
    expect(values.min() >= 0, f"{what} must not be negative; the least is {values.min():.3g}")
    return f"from {values.min():.3g} to {values.max():.3g}"


def compiled(what: str, function: Callable[..., Any], *args: Any, tolerance: float = TOLERANCE) -> Callable[..., Any]:
    """Compiles a pure function of arrays for arguments like `args`. Raises ComponentError if the function raises an error, or a
    second trace or call gives another result for `args`.
    """
    traces = [attempt(what, jax.jit(functools.partial(function)).lower, *args) for _ in range(2)]  # two objects, two traces
    program = attempt(what, traces[0].compile)
    # The traces are compared as programs, because most are equal, and compiling takes longest.
    other = program if traces[0].as_text() == traces[1].as_text() else attempt(what, traces[1].compile)
    first, second = (attempt(what, again, *args) for again in (program, other))
    expect_same(f"{what}, called twice with the same arguments,", first, second, tolerance)
    return lambda *args: attempt(what, program, *args)


def run(what: str, function: Callable[..., Any], *args: Any) -> Any:
    """Result of a compiled pure function of arrays. Raises ComponentError like `compiled`."""
    return compiled(what, function, *args)(*args)


def expect_same(what: str, result: Any, expected: Any, tolerance: float = TOLERANCE) -> None:
    """Raises ComponentError unless two pytrees of arrays are equal, up to `tolerance` times the larger of 1 and the value."""
    for (path, actual), value in zip(jax.tree_util.tree_leaves_with_path(result), jax.tree.leaves(expected)):
        if is_key(value):
            continue
        a, b = (np.asarray(x, np.float64) for x in (actual, value))
        if not np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True):
            name = jax.tree_util.keystr(path, simple=True, separator=": ")
            difference = f"{name or 'it'} differs by {np.nanmax(np.abs(a - b)):.3g}"
            raise ComponentError(f"{what} must give the same result; {difference}")


@dataclasses.dataclass(frozen=True)
class Trial:
    """Test data for components: random episodes of an environment, in the middle of a run of an untrained learner."""

    env: Env
    hparams: HParams = HParams()  # noqa: RUF009 - a tuple
    learner: Learner | None = None  # source of values; None: `ddpg`

    @functools.cached_property
    def episodes(self) -> Episode:
        """16 episodes; leaves lead with [16]."""
        return random_episodes(self.env)

    @functools.cached_property
    def context(self) -> Context:
        made = self.learner or learners.make("ddpg", Config(hidden_sizes=(16,)), env_spec(self.env))
        numbers = trainer.as_arrays(self.hparams)
        values = learners.values_of(made, jax.jit(made.init)(jax.random.key(0)), numbers) if hasattr(made, "value") else None
        return of_env(self.env, numbers, progress=jnp.float32(0.5), values=values)

    @functools.cached_property
    def empty_ring(self) -> ReplayState:
        """Empty ring with room for twice as many episodes."""
        return replay.init(jax.tree.map(lambda x: x[0], self.episodes), 2 * EPISODES, env_spec(self.env).ends)

    @functools.cached_property
    def ring(self) -> ReplayState:
        """Ring with the episodes, half of whose rows are empty."""
        return jax.jit(replay.add)(self.empty_ring, self.episodes)


def trial_of(env: Env | Trial, hparams: HParams | None, learner: Learner | None) -> Trial:
    """Trial in an environment, or `env` itself if it is a trial."""
    return env if isinstance(env, Trial) else Trial(env, hparams or HParams(), learner)


def random_episodes(env: Env, seed: int = 0) -> Episode:
    """Plays 16 episodes of uniformly random actions; leaves lead with [16]. Raises ComponentError if it fails."""
    attempt("env", check_env_parts, env)
    key, action_key = jax.random.split(jax.random.key(seed))
    shape = (env.episode_length, EPISODES, env.action_size)
    actions = jax.random.uniform(action_key, shape, jnp.float32, minval=-1.0, maxval=1.0)
    play = jax.jit(lambda: rollout(env, lambda action, obs: action, key, EPISODES, actions)[0])
    return attempt("env, played with random actions,", play)


def attempt(what: str, function: Callable[..., Any], *args: Any) -> Any:
    """Calls `function`. An error becomes a ComponentError with `what`, the error and its place.

    The library's ValueErrors keep their message.
    """
    try:
        return function(*args)
    except ComponentError:
        raise
    except (Exception, SystemExit) as error:
        if isinstance(error, ValueError) and traceback.extract_tb(error.__traceback__)[-1].filename.startswith(_OURS):
            raise ComponentError(str(error)) from error
        raise ComponentError(f"{what} raises {_describe(error)}") from error


def _describe(error: BaseException) -> str:
    """An error's type, the first line of its message, and its last place outside JAX and this library."""
    reason = (str(error).strip().splitlines() or [""])[0]
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(_INNER)]
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    hint = ""
    if isinstance(error, (jax.errors.TracerBoolConversionError, jax.errors.ConcretizationTypeError)):
        hint = "; JAX traces the function, so its `if` and `float` cannot look at values: use jnp.where"
    return f"{type(error).__name__}: {reason}{hint}{place}"
