"""Plays a policy in an environment in real time: play, pause, move goal and object, count successes. Draws nothing."""

import collections
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import context
from mjx_dher.contract import env_spec, step_seconds
from mjx_dher.tools.render import check_drawable, goal_marks

HOLD = 0.6  # s, display time of the end of an episode
SHOWN = 10.0  # s, range of the curves
MOST_SECONDS = 0.4  # delay to catch up with if the machine is too slow; the rest is dropped

Act = Callable[[Mapping[str, np.ndarray]], np.ndarray]  # observation of one state -> action [A]
Value = Callable[[Mapping[str, np.ndarray], np.ndarray], float]  # observation, action [A] -> expected return
Bounds = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]  # lowest and highest x, y and z


class Game(NamedTuple):
    """An environment and its compiled functions of one state."""

    env: Any
    reset: Callable[[Any], Any]  # seed [] -> state
    step: Callable[[Any, Any], Any]  # state, action [A] -> state
    move_goal: Callable[[Any, Any], Any] | None  # state, position [3] -> state; None if it cannot be moved
    move_object: Callable[[Any, Any], Any] | None  # the same
    turn_goal: Callable[[Any, Any], Any] | None = None  # state, orientation [4] -> state; None if it cannot be turned
    ends_at_goal: bool = False  # whether an episode ends where its goal is reached

    @property
    def dt(self) -> float:
        """Seconds per step in real time."""
        return step_seconds(self.env)

    def steps(self, seconds: float) -> int:
        """Number of steps in `seconds` of real time, at least 1."""
        return max(1, round(seconds / self.dt))


def make_game(env: Any) -> Game:
    """Compiles an environment's functions. A goal can be moved if it has `with_goal`, and an object if it has `with_object`.
    Raises ValueError if the environment cannot be drawn.
    """
    check_drawable(env)
    goal = jax.eval_shape(env.reset, jax.random.key(0)).obs["desired_goal"].shape
    is_placed = hasattr(env, "object_position") or goal in ((3,), (7,))
    has_object = is_placed and getattr(env, "has_object", True)  # built-in tasks have the methods also without an object
    has_position = bounds(env, "goal") is not None if hasattr(env, "goal_bounds") else goal == (3,)

    def move_goal(state: Any, position: Any) -> Any:  # a pose keeps its orientation
        return env.with_goal(state, jnp.concatenate([position, state.obs["desired_goal"][3:]]))

    turned: Any = getattr(getattr(env, "goal", None), "turned", None)

    def turn_goal(state: Any, orientation: Any) -> Any:
        return env.with_goal(state, turned(state.obs["desired_goal"], orientation))

    game = Game(
        env=env,
        reset=jax.jit(lambda seed: env.reset(jax.random.key(seed))),
        step=jax.jit(env.step),
        move_goal=jax.jit(move_goal) if hasattr(env, "with_goal") and has_position else None,
        move_object=jax.jit(env.with_object) if hasattr(env, "with_object") and has_object else None,
        turn_goal=jax.jit(turn_goal) if hasattr(env, "with_goal") and turned is not None else None,
        ends_at_goal=env_spec(env).ends_at_goal,
    )
    state = game.reset(np.uint32(0))
    game.step(state, np.zeros(env.action_size, np.float32))
    for move in (game.move_goal, game.move_object):
        if move is not None:
            move(state, np.zeros(3, np.float32))
    if game.turn_goal is not None:
        game.turn_goal(state, np.array([1.0, 0.0, 0.0, 0.0], np.float32))
    return game


def bounds(env: Any, dragged: str) -> Bounds | None:
    """Range in which a "goal" or an "object" may be placed by hand, the range of resets, or None if unknown."""
    box = getattr(env, f"{dragged}_bounds", None)
    return None if box is None else tuple((float(low), float(high)) for low, high in np.transpose(box))  # type: ignore[return-value]


@dataclasses.dataclass
class Tally:
    """Numbers of attempts and of successes."""

    attempts: int = 0
    reached: int = 0

    def add(self, reached: bool) -> None:
        """Counts an attempt."""
        self.attempts += 1
        self.reached += reached

    def __str__(self) -> str:
        return f"{self.reached} of {self.attempts}" + (f" ({self.reached / self.attempts:.0%})" if self.attempts else "")


class Player:
    """A policy that plays in an environment. The first episode has the seed `seed`, and others follow.

    An attempt has as many steps as an episode. It begins with a reset, or when goal or object are moved. It counts once, as a
    success if the goal is reached at its last step, as in an evaluation. If `renew` is set, the next episode begins then.
    Moving something unsets `renew` up to the next episode, so that a user can continue.
    """

    def __init__(self, game: Game, act: Act, value: Value | None = None, seed: int = 1):
        self.game, self.act, self.value = game, act, value
        self.playing, self.renew, self.speed = True, True, 1.0
        self.episodes, self.own = Tally(), Tally()  # attempts after a reset, and after a hand
        self.note = ""
        # Of the last steps: time, s; distance to the goal, m; the critic's value, or NaN.
        self.history: collections.deque[tuple[float, float, float]] = collections.deque(maxlen=game.steps(SHOWN))
        self._seed, self._steps, self._owed, self._renews = seed, 0, 0.0, False
        self.new_episode()

    def new_episode(self) -> None:
        """Begins the next episode."""
        self._state = self.game.reset(np.uint32(self._seed % 2**32))
        self._seed += 1
        self.clock, self._held, self._counts, self.is_own, self.note = 0, 0, True, False, ""
        self.set_renew(self.renew or self._renews)
        self._look()

    def set_renew(self, renew: bool) -> None:
        """Sets whether the next episode begins by itself."""
        self.renew, self._renews = renew, False

    def advance(self, seconds: float) -> int:
        """Plays for `seconds` of real time, times the speed. Returns the number of steps."""
        if not self.playing:
            return 0
        self._owed += seconds * self.speed / self.game.dt
        steps, most = int(self._owed + 1e-6), self.game.steps(MOST_SECONDS)
        self._owed = self._owed - steps if steps <= most else 0.0
        for _ in range(min(steps, most)):
            self.step()
        return min(steps, most)

    def step(self, by_hand: bool = False) -> None:
        """Makes one step of the environment, or holds the end of an episode for one step, except `by_hand`."""
        if self._held:
            self._held = 0 if by_hand else self._held - 1
            if not self._held:
                self.new_episode()
            return
        self._state = self.game.step(self._state, self.act(self.obs))
        self.clock += 1
        self._steps += 1
        self._look()
        failed = self._flag("failed")
        ended = self._flag("done") or self._flag("terminal") or (self.game.ends_at_goal and self.success)
        if failed or ended or self.clock >= self.length:
            if self._counts:
                (self.own if self.is_own else self.episodes).add(self.success)
            self._counts = False
            self._held = self.game.steps(HOLD) if failed or ended or self.renew else 0
        if failed:
            self.note = "The simulation diverged; a new episode begins."

    def move_goal(self, position: np.ndarray) -> None:
        """Moves the goal to a position [3] in m, or as near as allowed, and begins a user's attempt."""
        self._move(self.game.move_goal, "goal", position)

    def turn_goal(self, orientation: np.ndarray) -> None:
        """Gives the goal's body an orientation [4] (w, x, y, z) of any length but 0; see `move_goal`."""
        orientation = np.asarray(orientation, np.float32)
        with np.errstate(all="ignore"):
            length = np.linalg.norm(orientation.astype(float))
            self._move(self.game.turn_goal, "goal", orientation / length, (4,))

    def move_object(self, position: np.ndarray) -> None:
        """Moves the object to a position [3] in m, or as near as allowed; see `move_goal`."""
        self._move(self.game.move_object, "object", position)

    def _move(
        self, move: Callable[[Any, Any], Any] | None, dragged: str, position: np.ndarray, shape: tuple[int] = (3,)
    ) -> None:
        position = np.asarray(position, np.float32)
        if move is None or position.shape != shape or not np.all(np.isfinite(position)):
            raise ValueError(f"the {dragged} cannot be moved to {position}")
        box = bounds(self.game.env, dragged)
        if box is not None and shape == (3,):
            position = np.clip(position, *np.transpose(box)).astype(np.float32)
        if self._flag("failed"):  # only a reset helps
            self.new_episode()
        self._state = move(self._state, position)
        self._renews, self.renew = self._renews or self.renew, False
        self.clock, self._held, self._counts, self.is_own = 0, 0, True, True
        self._look()

    def replace(self, act: Act, value: Value | None) -> None:
        """Continues with another policy, and resets the counters. The present attempt, which is of both, does not count."""
        self.act, self.value = act, value
        self.episodes, self.own, self._counts = Tally(), Tally(), False
        self._look()

    @property
    def length(self) -> int:
        """Steps of an attempt."""
        return int(self.game.env.episode_length)

    @property
    def success(self) -> bool:
        """Whether the goal is reached."""
        return bool(np.asarray(self._state.success) > 0.5)

    @property
    def distance(self) -> float:
        """Distance to the goal, in the goal's `unit`."""
        distance = getattr(self.game.env, "goal_distance", context.euclidean)
        return float(distance(self.obs["achieved_goal"], self.obs["desired_goal"]))

    @property
    def unit(self) -> tuple[float, str]:
        """Factor and unit in which distances are shown: cm, degrees, or the goal's own number."""
        return {"m": (100.0, "cm"), "rad": (180.0 / np.pi, "°")}.get(
            getattr(getattr(self.game.env, "goal", None), "unit", "m"), (1.0, "")
        )

    @property
    def object_position(self) -> np.ndarray:
        """Position [3] of the object, in m. It is the achieved goal's if the environment has no `object_position`."""
        position = getattr(self.game.env, "object_position", None)
        return np.asarray(self.obs["achieved_goal"][:3] if position is None else position(self._state))

    @property
    def qpos(self) -> np.ndarray:
        """Configuration [nq] in the layout of the environment's model."""
        return np.asarray(self._state.physics.qpos, np.float64)

    @property
    def marks(self) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Marks of the goal (`render.goal_marks`)."""
        return goal_marks(self.game.env, self.qpos, self.obs["desired_goal"])

    def _flag(self, name: str) -> bool:
        return bool(np.any(getattr(self._state, name, False)))

    def _look(self) -> None:
        """Records the observation, distance and value of the state."""
        self.obs = jax.tree.map(np.asarray, dict(self._state.obs))
        value = float("nan")
        if self.value is not None and not self._flag("failed"):  # a failed state's observation need not be finite
            value = self.value(self.obs, self.act(self.obs))
        now = self._steps * self.game.dt
        if self.history and self.history[-1][0] == now:  # moved or restarted since the last step
            self.history.pop()
        self.history.append((now, self.distance, value))
