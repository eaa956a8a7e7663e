"""The viewer's server: a page in the browser that shows a player's scene and takes user commands. Needs viser."""

import contextlib
import io
import time
from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np

from mjx_dher.system import private_api
from mjx_dher.tools.render import GOAL_RADIUS, GOAL_RGBA
from mjx_dher.viewer import address
from mjx_dher.viewer.panel import DRAGGED, Commands, Panel
from mjx_dher.viewer.player import Game, Player, bounds, make_game
from mjx_dher.viewer.scene import Poses, add, front, to_bytes
from mjx_dher.viewer.sources import Cast, Source

_REACHED = (60, 180, 75)  # colour of a reached goal
_SECONDS_PER_LOOK = 1.0  # between checks for a newer policy
_SECONDS_PER_CURVE = 0.25
_BACK = 1.3  # distance of the page's camera relative to the model's


class Viewer:
    """A page with a scene and a panel, and its player. Use it in a `with` block, and call `run`.

    The first of the sources plays. `port` is from `address.check`. Raises ValueError if the first policy cannot be played, its
    environment cannot be drawn, or the port is taken.
    """

    def __init__(self, sources: Sequence[Source], make_env: Callable[[Source], Any], host: str, port: int, seed: int):
        self._sources = {source.label: source for source in sources}
        self._make_env, self._seed = make_env, seed
        self._games: dict[tuple[Any, ...], Game] = {}
        self._commands = Commands()
        self._taken, self._held = DRAGGED[0], False  # part with the handle, and whether a user holds it
        self._handle: Any = None
        self._cast, self.player = self._prepare(sources[0])
        self._server, controls = _start(host, port)
        self.address = address.address(host, self._server.get_port())
        self._panel = Panel(
            self._server.gui, controls, list(self._sources), self._commands, self.choose, lambda: self.player, self.take
        )
        self._draw_scene()
        self._aim()
        self._name()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints that it stops
            self._server.stop()

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> None:
        """Plays in real time while a browser is connected, until `should_stop` returns True."""
        looked = drawn = before = time.monotonic()
        while not should_stop():
            started = time.monotonic()
            commanded = self._commands.run()
            watched = bool(self._server.get_clients())
            moved = self.player.advance(started - before) if watched else 0
            before = started
            if started - looked > _SECONDS_PER_LOOK:
                looked = started
                if self._cast.refresh():
                    self.player.replace(self._cast.act, self._cast.value)
                    self._name()
            if moved or commanded:
                curves = started - drawn > _SECONDS_PER_CURVE
                drawn = started if curves else drawn
                with self._server.atomic():
                    self.show(curves)
            time.sleep(max(0.002, self.player.game.dt / max(1.0, self.player.speed) / 2 - (time.monotonic() - started)))

    def choose(self, label: str) -> None:
        """Plays the policy of this name. If it cannot be played, the panel reports it and the previous one continues."""
        source = self._sources[label]
        if source.place not in self._games:
            self._panel.say(f"compiling `{source.env}` ...")
        try:
            cast, player = self._prepare(source)
        except Exception as error:  # custom code may raise any error
            self._name()
            self._panel.say(f"{label} cannot be played: {error}")
            return
        other_scene = source.place != self._cast.source.place
        self._cast, self.player = cast, player
        self._panel.adopt()
        if other_scene:
            self._draw_scene()
            self._aim()
        self._name()
        self.show(True)

    def _prepare(self, source: Source) -> tuple[Cast, Player]:
        if source.place not in self._games:
            self._games[source.place] = make_game(self._make_env(source))
        game = self._games[source.place]
        cast = Cast(source, game.env)
        return cast, Player(game, cast.act, cast.value, self._seed)

    def _name(self) -> None:
        self._panel.name(self._cast.source.label, self._cast.about(), self._cast.critic, self._cast.value is not None)

    def show(self, curves: bool) -> None:
        positions, orientations = self._poses.at(self.player.qpos)
        for body, node in self._nodes.items():
            if body:  # the world does not move
                node.position, node.wxyz = positions[body], orientations[body]
        marks = self.player.marks
        if self._handle is not None and not self._held:
            self._handle.position, self._handle.wxyz = self._place_of(self._taken, marks)
        colour = _REACHED if self.player.success else to_bytes(GOAL_RGBA)
        balls = iter(self._balls)
        for body, *place in marks:
            mark: Any = next(balls) if body < 0 else self._ghosts.get(body)
            if mark is not None:  # else a body without visible geoms
                mark.position, mark.wxyz = place
            if body < 0 and mark.color != colour:
                mark.color = colour
        self._panel.update(curves)

    def _place_of(self, dragged: str, marks: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
        """Position [3] and orientation [4] of a dragged part. A goal that is only an orientation is at its ghost."""
        game, ghosts = self.player.game, [place for body, *place in marks if body >= 0]
        pos, quat = self.player.object_position if dragged == "object" else self.player.obs["desired_goal"][:3], np.eye(4)[0]
        if dragged == "goal" and game.turn_goal is not None and ghosts:
            quat = ghosts[0][1]
            pos = pos if game.move_goal else ghosts[0][0]
        return pos, quat

    def take(self, dragged: str) -> None:
        """Attaches the handle to one of `DRAGGED`."""
        self._taken = dragged
        self._draw_scene()

    def _draw_scene(self) -> None:
        scene, env = self._server.scene, self.player.game.env
        for name in ("/bodies", "/ghosts", "/handle", "/balls"):
            with contextlib.suppress(KeyError, ValueError):
                scene.remove_by_name(name)
        self._held = False
        self._poses, self._nodes = Poses(env.model), add(scene, env.model)
        bodies = [body for body, _, _ in self.player.marks]
        self._ghosts = add(scene, env.model, bodies)
        self._handle = self._add_handle(self._taken) if any(self._moves(self._taken)) else None
        look: dict[str, Any] = {"opacity": GOAL_RGBA[3], "cast_shadow": False, "receive_shadow": False}
        self._balls = [
            scene.add_icosphere(f"/balls/{i}", GOAL_RADIUS, to_bytes(GOAL_RGBA), subdivisions=3, **look)
            for i in range(sum(body < 0 for body in bodies))
        ]
        self.show(True)

    def _moves(self, dragged: str) -> tuple[bool, bool]:
        """Whether a part can be moved, and whether it can be turned."""
        game = self.player.game
        moves = {"goal": (game.move_goal, game.turn_goal), "object": (game.move_object, None)}
        return tuple(move is not None for move in moves.get(dragged, (None, None)))  # type: ignore[return-value]

    def _add_handle(self, dragged: str) -> Any:
        moves, turns = self._moves(dragged)
        limits = bounds(self.player.game.env, dragged) or ((0.0, 1.0),) * 3
        handle = self._server.scene.add_transform_controls(
            "/handle",
            scale=0.14,
            line_width=4.0,
            disable_axes=not moves,
            disable_sliders=not moves,
            disable_rotations=not turns,
            # Viser's limits apply to the dragged distance, so the player limits the position instead.
            active_axes=tuple(turns or high - low > 1e-9 for low, high in limits),
        )

        async def on_update(event: Any) -> None:  # a coroutine, because threads could change the order
            place, phase = (np.array(event.target.position), np.array(event.target.wxyz)), event.phase
            self._commands.put("move" if phase == "update" else "hold", lambda: self._drag(dragged, place, phase))

        handle.on_update(on_update)
        return handle

    def _drag(self, dragged: str, place: tuple[np.ndarray, np.ndarray], phase: str) -> None:
        """Follows the handle to a pose, if it still belongs to the part. `phase` is start, update or end."""
        if self._handle is None or dragged != self._taken:
            return
        if phase != "update":  # which a client can send without a start
            self._held = phase == "start"
            return
        (moves, turns), before = self._moves(dragged), self._place_of(dragged, self.player.marks)
        if turns and abs(before[1] @ place[1]) < 1.0 - 1e-9:  # of unit quaternions
            self.player.turn_goal(place[1])
        if moves and not np.allclose(before[0], place[0], rtol=0.0, atol=1e-6):
            {"goal": self.player.move_goal, "object": self.player.move_object}[dragged](place[0])

    def _aim(self) -> None:
        """Moves the cameras to the model's camera "front", if it exists."""
        model = self.player.game.env.model
        if (camera := front(model, self.player.qpos)) is None:
            return
        (position, forward, angle), center = camera, np.array(model.stat.center)
        look_at = position + forward * float(np.dot(center - position, forward))
        position = look_at + _BACK * (position - look_at)  # the panel takes a third of the page
        for camera in (self._server.initial_camera, *(client.camera for client in self._server.get_clients().values())):
            camera.position, camera.look_at = position, look_at
            camera.fov = angle


def _start(host: str, port: int) -> tuple[Any, dict[str, Callable[[Any], bool]]]:
    """Starts viser's server. Returns it, and a dict for the panel's controls. Raises ValueError if the port was taken since."""
    import viser

    from mjx_dher.viewer.guard import Guard

    guard = Guard(host)
    with contextlib.redirect_stdout(io.StringIO()):  # the caller prints the address
        with private_api.viser_served_with(guard.options):
            server = viser.ViserServer(host=host, port=port, label="mjx-dher", verbose=False)
        if server.get_port() != port:  # viser takes the next free port
            server.stop()
            raise address.in_use(host, port, "another process has taken it")
        if not guard.is_used:
            server.stop()
            raise ValueError(f"the viewer cannot check requests with viser {viser.__version__}; install viser 1.1.1")
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    server.scene.configure_environment_map("studio", environment_intensity=0.22)  # light from all sides
    return server, guard.controls
