"""The panel next to the scene: policy, speed and progress. Each user action is a command; commands run in order."""

import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_dher import lookup
from mjx_dher.system import private_api
from mjx_dher.viewer.player import Player

SPEEDS = (0.1, 4.0)  # slowest and fastest, times real time
DRAGGED = ("goal", "object", "nothing")  # one at a time, because handles coincide at a reached goal
_ONCE = ("Step", "New episode")  # buttons
_SOLID, _DASHED = {"width": 2}, {"width": 1, "dash": (6, 4)}  # uPlot's line styles
_RED, _BLUE, _GREY = "#d62728", "#1f77b4", "#999999"


class Commands:
    """Queue of user commands, from the server's thread to the player's. A later command replaces one of the same kind."""

    def __init__(self) -> None:
        self._lock, self._waiting = threading.Lock(), dict[str, Callable[[], None]]()

    def put(self, kind: str, command: Callable[[], None]) -> None:
        with self._lock:
            self._waiting.pop(kind, None)
            self._waiting[kind] = command

    def run(self) -> bool:
        """Runs the waiting commands in order. Returns True if there were any."""
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for command in waiting.values():
            command()
        return bool(waiting)


class Panel:
    """Buttons, counters and curves in the GUI of a viser server.

    Args:
      controls: receives a test of allowed values for each control.
      labels: names of the policies. The first one plays.
      commands: queue for user commands.
      choose: called with a policy's name.
      player: returns the current player.
      take: called with the dragged part, one of `DRAGGED`.
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
        self._play = gui.add_button("Pause", hint="Stop or resume the clock")
        self._once = gui.add_button_group("Once", _ONCE, hint="One step; a new start and goal")
        self._speed = gui.add_slider("Speed", *SPEEDS, step=0.1, initial_value=1.0, hint="Times real time")
        self._renew = gui.add_checkbox("Next by itself", True, hint="Start a new episode when one has ended")
        self._taken = gui.add_dropdown("Drag", DRAGGED, initial_value=DRAGGED[0], hint="Part that the handle moves")
        self._score = gui.add_markdown("")
        self._distance = _curve(gui, "Distance to the goal, cm", ("distance", _RED), ("reached below", _GREY))
        self._critic = gui.add_markdown("")
        self._value = _curve(gui, "Critic's value", ("value", _BLUE))
        is_bool = lambda value: isinstance(value, bool)  # noqa: E731
        for control, is_value, command in (
            (self._policy, labels.__contains__, choose),
            (self._play, is_bool, self._pause),
            (self._once, _ONCE.__contains__, self._act_once),
            (self._speed, lambda value: isinstance(value, float) and SPEEDS[0] <= value <= SPEEDS[1], self._settle),
            (self._renew, is_bool, lambda value: player().set_renew(value)),
            (self._taken, DRAGGED.__contains__, take),
        ):
            number = private_api.viser_control_id(control)
            controls[number] = is_value
            (control.on_click if control in (self._play, self._once) else control.on_update)(_put(commands, number, command))

    def _pause(self, _: Any) -> None:
        self._player().playing = not self._player().playing

    def _act_once(self, action: str) -> None:
        if action == "Step":
            self._player().playing = False
            self._player().step(by_hand=True)
        else:
            self._player().new_episode()

    def _settle(self, speed: float) -> None:
        self._player().speed = float(speed)

    def adopt(self) -> None:
        """Applies the panel's settings to a new player."""
        self._settle(self._speed.value)
        self._player().set_renew(bool(self._renew.value))
        self._player().playing = self._play.label == "Pause"

    def name(self, label: str, about: str, critic: str, has_value: bool) -> None:
        """Shows the current policy and its origin."""
        if self._policy.value != label:
            self._policy.value = label
        self.say(about)
        self._critic.content, self._value.visible = lookup.escaped(critic), has_value

    def say(self, text: str) -> None:
        """Shows a sentence in place of the policy's origin."""
        self._about.content = lookup.escaped(text)

    def update(self, with_curves: bool) -> None:
        player = self._player()
        _assign(self._play, "label", "Pause" if player.playing else "Play")
        _assign(self._renew, "value", player.renew)
        _assign(self._score, "content", score(player))
        if with_curves:
            _assign(self._distance, "title", "Distance to the goal" + (f", {unit}" if (unit := player.unit[1]) else ""))
            self._distance.data = distance_curve(player)
            if self._value.visible:
                self._value.data = value_curve(player)


def distance_curve(player: Player) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times in s, distances to the goal in the player's unit, and the one at which it is reached, or 0 if there is none."""
    times, distances, _ = (np.array(x) for x in zip(*player.history))
    threshold = getattr(player.game.env, "distance_threshold", 0.0)
    scale, _ = player.unit
    return times, scale * distances, np.full_like(times, scale * threshold)


def value_curve(player: Player) -> tuple[np.ndarray, np.ndarray]:
    """Times in s and the critic's values, for steps with a value, because a chart with NaN has no range."""
    times, _, values = (np.array(x, float) for x in zip(*player.history))
    has_value = np.isfinite(values)
    return times[has_value], values[has_value]


def score(player: Player) -> str:
    """Counters as Markdown."""
    scale, unit = player.unit
    state = "**reached**" if player.success else f"{scale * player.distance:.1f} {unit}".rstrip() + " from the goal"
    lines = [f"Episodes reached: **{player.episodes}**"]
    if player.own.attempts or player.is_own:
        lines.append(f"Your own: **{player.own}**")
    lines.append(f"Step {min(player.clock, player.length)} of {player.length}: {state}")
    if player.note:
        lines.append(player.note)
    return "  \n".join(lines)


def _curve(gui: Any, label: str, *series: tuple[str, str]) -> Any:
    """Adds a chart with a label and a colour per series. Grey series are dashed."""
    lines = [{"label": name, "stroke": colour, **(_DASHED if colour == _GREY else _SOLID)} for name, colour in series]
    return gui.add_uplot(
        tuple(np.zeros(1) for _ in range(1 + len(lines))),
        ({"label": "s"}, *lines),
        title=label,
        scales={"x": {"time": False}},
        legend={"show": False},
        height=130,
    )


def _put(commands: Commands, kind: str, command: Callable[[Any], None]) -> Callable[[Any], Any]:
    """Viser callback that queues a command with the control's value, unless the server has set the control."""

    async def callback(event: Any) -> None:  # a coroutine, because threads could change the order
        if event.client_id is not None:
            commands.put(kind, functools.partial(command, event.target.value))  # the server may set another one meanwhile

    return callback


def _assign(handle: Any, field: str, value: Any) -> None:
    """Sets a field of an element if it differs, because each assignment is sent."""
    if getattr(handle, field) != value:
        setattr(handle, field, value)
