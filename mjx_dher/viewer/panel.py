"""The panel beside the scene: what to play, how fast, how it goes. Each press of a user's is a command, in order."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_dher.system import private_api
from mjx_dher.viewer.player import Player

SPEEDS = (0.1, 4.0)  # slowest and fastest, times real time
DRAGGED = ("goal", "object", "nothing")  # one at a time: at a goal that is reached, their handles would lie in one place
_ONCE = ("Step", "New episode")  # buttons
_SOLID, _DASHED = {"width": 2}, {"width": 1, "dash": (6, 4)}  # as uPlot has lines
_RED, _BLUE, _GREY = "#d62728", "#1f77b4", "#999999"


class Commands:
    """Commands of users, from the thread of the server to the one that plays. A later one replaces one of the same kind."""

    def __init__(self) -> None:
        self._lock, self._waiting = threading.Lock(), dict[str, Callable[[], None]]()

    def put(self, kind: str, command: Callable[[], None]) -> None:
        """Adds a command; returns at once."""
        with self._lock:
            self._waiting.pop(kind, None)
            self._waiting[kind] = command

    def run(self) -> bool:
        """Runs the commands that wait, in order; returns whether there were any."""
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for command in waiting.values():
            command()
        return bool(waiting)


class Panel:
    """Buttons, counters and curves.

    Args:
      gui: of a server of viser's.
      controls: receives, for each control, whether it may have a value.
      labels: names of the policies; the first is at play.
      commands: to put the user's into.
      choose: called with a policy's name.
      player: returns the player as it is then.
      take: called with what is to be dragged: one of `DRAGGED`.
    """

    def __init__(
        self,
        gui: Any,
        controls: dict[str, Callable[[Any], bool]],
        labels: Sequence[str],
        commands: Commands,
        choose: Callable[[str], None],
        player: Callable[[], Player],
        take: Callable[[str], None],
    ):
        self._player = player
        self._policy = gui.add_dropdown("Policy", tuple(labels), initial_value=labels[0])
        self._about = gui.add_markdown("")
        self._play = gui.add_button("Pause", hint="Stop the clock, or let it go on")
        self._once = gui.add_button_group("Once", _ONCE, hint="A step of 40 ms; another start and goal")
        self._speed = gui.add_slider("Speed", *SPEEDS, step=0.1, initial_value=1.0, hint="Times real time")
        self._renew = gui.add_checkbox("Next by itself", True, hint="Whether another episode begins when one has ended")
        self._taken = gui.add_dropdown("Drag", DRAGGED, initial_value=DRAGGED[0], hint="Where the handle is that moves it")
        self._score = gui.add_markdown("")
        self._distance = _curve(gui, "Distance to the goal, cm", ("distance", _RED), ("reached below", _GREY))
        self._critic = gui.add_markdown("")
        self._value = _curve(gui, "Critic's value", ("value", _BLUE))
        is_bool = lambda value: isinstance(value, bool)  # noqa: E731
        for control, is_value, command in (
            (self._policy, labels.__contains__, lambda: choose(self._policy.value)),
            (self._play, is_bool, self._pause),
            (self._once, _ONCE.__contains__, self._act_once),
            (self._speed, lambda value: isinstance(value, float) and SPEEDS[0] <= value <= SPEEDS[1], self._settle),
            (self._renew, is_bool, self._settle),
            (self._taken, DRAGGED.__contains__, lambda: take(self._taken.value)),
        ):
            number = private_api.viser_control_id(control)
            controls[number] = is_value
            (control.on_click if control in (self._play, self._once) else control.on_update)(_put(commands, number, command))

    def _pause(self) -> None:
        self._player().playing = not self._player().playing

    def _act_once(self) -> None:
        if self._once.value == "Step":
            self._player().playing = False
            self._player().step()
        else:
            self._player().new_episode()
            self._player().renew = True

    def _settle(self) -> None:
        self._player().speed, self._player().renew = float(self._speed.value), bool(self._renew.value)

    def adopt(self) -> None:
        """Hands what is set here to a player that has taken another's place."""
        self._settle()
        self._player().playing = self._play.label == "Pause"

    def name(self, label: str, about: str, critic: str, has_value: bool) -> None:
        """Shows which policy is at play, and where it comes from."""
        if self._policy.value != label:
            self._policy.value = label
        self._about.content, self._critic.content, self._value.visible = about, critic, has_value

    def say(self, text: str) -> None:
        """Shows a sentence in place of where the policy comes from."""
        self._about.content = text

    def update(self, with_curves: bool) -> None:
        """Shows how it goes."""
        player = self._player()
        _assign(self._play, "label", "Pause" if player.playing else "Play")
        _assign(self._renew, "value", player.renew)
        _assign(self._score, "content", score(player))
        if with_curves:
            self._distance.data = distance_curve(player)
            if self._value.visible:
                self._value.data = value_curve(player)


def distance_curve(player: Player) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns times, s, distances to the goal, cm, and the distance below which it is reached (0 where the task has none)."""
    times, distances, _ = (np.array(x) for x in zip(*player.history))
    threshold = getattr(player.game.env, "distance_threshold", 0.0)
    return times, 100 * distances, np.full_like(times, 100 * threshold)


def value_curve(player: Player) -> tuple[np.ndarray, np.ndarray]:
    """Returns times, s, and the critic's values, for those steps that have one: a chart with NaN in it has no range."""
    times, _, values = (np.array(x, float) for x in zip(*player.history))
    has_value = np.isfinite(values)
    return times[has_value], values[has_value]


def score(player: Player) -> str:
    """Returns the counters as Markdown."""
    state = "**reached**" if player.success else f"{100 * player.distance:.1f} cm from the goal"
    lines = [f"Episodes reached: **{player.episodes}**"]
    if player.own.attempts or player.is_own:
        lines.append(f"Your own: **{player.own}**")
    lines.append(f"Step {min(player.clock, player.length)} of {player.length}: {state}")
    if player.note:
        lines.append(player.note)
    return "  \n".join(lines)


def _curve(gui: Any, label: str, *series: tuple[str, str]) -> Any:
    """Adds a chart with series of a label and a colour each; a grey one is dashed."""
    lines = [{"label": name, "stroke": colour, **(_DASHED if colour == _GREY else _SOLID)} for name, colour in series]
    return gui.add_uplot(
        tuple(np.zeros(1) for _ in range(1 + len(lines))),
        ({"label": "s"}, *lines),
        title=label,
        scales={"x": {"time": False}},
        legend={"show": False},
        height=130,
    )


def _put(commands: Commands, kind: str, command: Callable[[], None]) -> Callable[[Any], Any]:
    """Returns a callback of viser's that puts a command, unless the server itself has set the control."""

    async def callback(event: Any) -> None:  # a coroutine: what a thread ran could come out of order
        if event.client_id is not None:
            commands.put(kind, command)

    return callback


def _assign(handle: Any, field: str, value: Any) -> None:
    """Sets a field of an element where it differs: each time it is set, it is sent."""
    if getattr(handle, field) != value:
        setattr(handle, field, value)
