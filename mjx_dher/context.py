"""`Context`: inputs of relabelling, priorities and goal generators in addition to the data.

It holds the task's goal functions, the run's numbers and progress, and the learner's values. The trainer makes one per cycle,
with the current learner.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_dher.config import HParams
from mjx_dher.contract import STEP_SECONDS, step_seconds
from mjx_dher.types import Array, Batch, DistanceFn, PyTree, ReachedFn, RewardFn

_ERRORS_AT_ONCE = 2048  # on a CPU, whose cache they fit: two thirds of the time of all at once


def euclidean(achieved: Array, desired: Array) -> Array:
    """Euclidean distance [...] between goals [..., G]: the default `goal_distance`."""
    # Coordinate by coordinate: XLA on a CPU takes three times as long for a sum over an axis of 3.
    squares = jnp.square(achieved - desired)
    return jnp.sqrt(sum(squares[..., i] for i in range(squares.shape[-1])))


class Values(NamedTuple):
    """Current policy and value function of a learner that defines `value` (`learners.Learner`)."""

    act: Callable[[PyTree, Array], Array]  # observation [..., D], goal [..., G] -> action [..., A] of the deterministic policy
    value: Callable[[PyTree, Array, Array], Array]  # observation, goal, action [..., A] -> estimated return [...]

    def of_state(self, observation: PyTree, goal: Array) -> Array:
        """Estimated return [...] of following the policy from `observation` [..., D] to `goal` [..., G]."""
        return self.value(observation, goal, self.act(observation, goal))


class Context(NamedTuple):
    """Inputs of a method in addition to the data. `of_env` takes the fields from an environment.

    By hand, `relabel` needs only the first two. Returns of several steps, priorities and generators also need `reward_range`:
    by default they take a reward of 0 for a goal that is reached.
    """

    compute_reward: RewardFn
    hparams: HParams
    reward_range: tuple[float, float] = (-1.0, 0.0)
    ends_at_goal: bool = False  # whether reaching the goal ends an episode
    reached_fn: ReachedFn | None = None  # the environment's `reached`
    goal_distance: DistanceFn = euclidean
    dt: float = STEP_SECONDS  # seconds per step
    progress: Array | float = 0.0  # [] fraction of the run's updates made so far
    values: Values | None = None  # None unless the method has `uses_values`
    updates: Array | float = 0.0  # [] number of the run's updates made so far

    def reached(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Whether goals [..., G] are reached, bool [...]: by the environment's `reached`, or by a reward at its maximum."""
        if self.reached_fn is not None:
            return self.reached_fn(achieved_goal, desired_goal)
        return self.compute_reward(achieved_goal, desired_goal) >= self.reward_range[1]

    def bounds(self) -> tuple[Array | float, Array | float]:
        """Lowest and highest return [] (`return_bounds`)."""
        return return_bounds(self.reward_range, self.hparams.gamma)

    def learner_values(self) -> Values:
        """`values`. Raises ValueError if there are none."""
        if self.values is None:
            raise ValueError(
                "values is missing: this method asks for a learner's values, so it needs uses_values=True in a run, and a"
                " Context with values outside one (learners.values_of)"
            )
        return self.values

    def td_error(self, batch: Batch) -> Array:
        """One-step errors r + discount V(s', g) - Q(s, a, g) of a batch, shape [B]."""
        if batch.reward.size > _ERRORS_AT_ONCE and jax.default_backend() == "cpu":
            return jax.lax.map(self.td_error, batch, batch_size=_ERRORS_AT_ONCE)
        values = self.learner_values()
        following = values.of_state(batch.next_observation, batch.desired_goal)
        target = jnp.clip(batch.reward + batch.discount * following, *self.bounds())
        return target - values.value(batch.observation, batch.desired_goal, batch.action)


def of_env(env: Any, hparams: HParams, **fields: Any) -> Context:
    """Context with an environment's goal functions. `fields` are other fields of `Context`."""
    spec = getattr(env, "spec", None)
    if spec is not None:
        fields = {"reward_range": spec.reward_range, "ends_at_goal": spec.ends_at_goal, **fields}
    distance = getattr(env, "goal_distance", euclidean)
    fields = {"dt": step_seconds(env), "reached_fn": getattr(env, "reached", None), "goal_distance": distance, **fields}
    return Context(env.compute_reward, hparams, **fields)


def reached_fn(env: Any) -> ReachedFn:
    """Function that tests whether an environment's goals are reached (`Context.reached`)."""
    return of_env(env, HParams()).reached


def return_bounds(reward_range: tuple[float, float], gamma: Array | float) -> tuple[Array | float, Array | float]:
    """Lowest and highest discounted return [] of rewards in `reward_range`, for episodes of any length.

    The bounds include 0, because a return that ends early counts as if rewards of 0 followed.
    """
    low, high = (min(reward_range[0], 0.0), max(reward_range[1], 0.0))
    tail = jnp.maximum(1.0 - jnp.asarray(gamma), jnp.finfo(jnp.float32).tiny)  # 0 / 0 at gamma = 1 would be NaN
    return low / tail, high / tail


def pick(results: Sequence[Any], number: Array) -> Array:
    """Selects the result with the traced index `number` [], for lanes of one program that use different components."""
    kept = jnp.asarray(results[0])
    for index, result in enumerate(results[1:], 1):
        kept = jnp.where(number == index, result, kept)
    return kept


def one_of(functions: Sequence[Callable[..., Any]], index: str) -> Callable[..., Array]:
    """Joins functions of one signature into one whose result the traced number `hparams.<index>` selects.

    All functions are computed, so each lane gets exactly the result of its function. One argument must be an `HParams` with
    the field `index`, or a `Context` with such `hparams`.
    """

    def chosen(*args: Any, **more: Any) -> Array:
        numbers = (getattr(arg, "hparams", arg) for arg in args)
        number = next(getattr(hparams, index) for hparams in numbers if hasattr(hparams, index))
        return pick([function(*args, **more) for function in functions], number)

    return functions[0] if len(functions) == 1 else chosen
