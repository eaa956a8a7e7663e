"""Guard of the viewer's port: checks connections, requests and messages before viser gets them. Needs viser.

Any web page can make a browser call this port, and so can any program on the machine. So requests must come from the viewer's
page, and messages must come from its panel and handle, with allowed values.
"""

import asyncio
import contextlib
import http
import logging
import math
import socket
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import msgspec
import viser
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from mjx_dher.viewer import address

CLIENTS = 16  # most browsers
WAITING = 64  # most connections that are not browsers yet
MESSAGE_BYTES = 1 << 14  # the page's messages have less than 300
BYTES_PER_SECOND, BURST_BYTES = 100_000, 500_000  # per client
MESSAGE_COST = 500  # bytes added to a message's own; the page sends up to 100 messages per second
UNSENT_BYTES = 16 << 20  # for a client that sends and does not read
SECONDS_TO_READ = 20.0  # for a client that does not read
HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}

_Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]  # excludes NaN
_Pixels = Annotated[int, msgspec.Meta(ge=0, le=100_000)]
_Vector = tuple[_Number, _Number, _Number]
_Quaternion = tuple[_Number, _Number, _Number, _Number]


class _Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """Message of a browser, with the fields of viser's message of this name."""


class _Camera(_Message, tag="ViewerCameraMessage"):
    wxyz: _Quaternion
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Pixels
    image_width: _Pixels
    look_at: _Vector
    up_direction: _Vector


class _DragStart(_Message, tag="TransformControlsDragStartMessage"):
    name: Literal["/handle"]
    owner: Literal[""] = ""


class _DragEnd(_DragStart, tag="TransformControlsDragEndMessage"):
    pass


class _Drag(_DragStart, tag="TransformControlsUpdateMessage", kw_only=True):
    wxyz: _Quaternion
    position: _Vector


class _Updates(msgspec.Struct, forbid_unknown_fields=True):
    value: bool | float | str


class _Control(_Message, tag="GuiUpdateMessage"):
    uuid: str
    updates: _Updates


_decode = msgspec.msgpack.Decoder(_Camera | _Drag | _DragStart | _DragEnd | _Control).decode


class Guard:
    """Rules of a port, and its open connections. `host` is the user's address."""

    def __init__(self, host: str):
        self.controls: dict[str, Callable[[Any], bool]] = {}  # tests of values, by id of a panel's control
        self.is_used = False
        self._names = {"localhost", host.lower()}
        if not address.is_loopback(host):
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
        self.waiting: dict[Connection, None] = {}  # in order of connection
        self.clients: dict[Connection, None] = {}

    def options(self, own: Mapping[str, Any]) -> dict[str, Any]:
        """Options for `websockets.asyncio.server.serve`, based on viser's."""
        self.is_used = True
        log = logging.Logger("viewer")  # errors of strangers are not shown to the user
        log.addHandler(logging.NullHandler())
        return {
            **own,
            "process_request": lambda connection, request: self._answer(connection, request, own["process_request"]),
            "create_connection": lambda *args, **options: Connection(self, *args, **options),
            "subprotocols": [f"viser-v{viser.__version__}"],
            "select_subprotocol": None,
            "max_size": MESSAGE_BYTES,
            "close_timeout": 1.0,
            "logger": log,
        }

    def _answer(self, connection: "Connection", request: Request, page: Callable[..., Response | None]) -> Response | None:
        """Answers a request. Returns None if the browser may connect."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return connection.respond(http.HTTPStatus.MISDIRECTED_REQUEST, "no such host here\n")
        if request.headers.get_all("Upgrade"):
            if len(origins) > 1 or any(origin.lower().partition("://")[2] != hosts[0].lower() for origin in origins):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "only the viewer's own page can connect\n")
            if not self._admit(connection):
                return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many browsers look\n")
            return None
        if request.path.partition("?")[0] not in ("/", "/index.html"):
            return connection.respond(http.HTTPStatus.NOT_FOUND, "not found\n")
        response = page(connection, request)
        if response is not None:
            response.headers.update(HEADERS)
        return response

    def _is_own(self, host: str) -> bool:
        """Whether a request's Host cannot come from a foreign DNS name that points here."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return name in self._names or address.is_ip(name)

    def _admit(self, connection: "Connection") -> bool:
        """Admits a browser. If there are too many, it replaces one that has not sent its camera."""
        if len(self.clients) >= CLIENTS:
            silent = next((client for client in self.clients if not client.has_camera), None)
            if silent is None:
                return False
            silent.drop()
        self.waiting.pop(connection, None)
        self.clients[connection] = None
        return True


class Connection(ServerConnection):
    """Connection that passes on only valid messages, and that ends if its peer sends too much or reads too little."""

    def __init__(self, guard: Guard, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.has_camera = False
        self._guard, self._credit, self._received = guard, float(BURST_BYTES), self.loop.time()

    def drop(self) -> None:
        self._guard.waiting.pop(self, None)
        self._guard.clients.pop(self, None)
        self.transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._guard.waiting[self] = None
        if len(self._guard.waiting) > WAITING:
            next(iter(self._guard.waiting)).drop()

    def connection_lost(self, exc: Exception | None) -> None:
        self.drop()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        now = self.loop.time()
        self._credit = min(BURST_BYTES, self._credit + (now - self._received) * BYTES_PER_SECOND) - len(data)
        self._received = now
        if self._credit < 0 or self.transport.get_write_buffer_size() > UNSENT_BYTES:
            self.drop()
        else:
            super().data_received(data)

    async def drain(self) -> None:
        async with asyncio.timeout(SECONDS_TO_READ):
            await super().drain()

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            raw = await super().recv(decode)
            self._credit -= MESSAGE_COST
            with contextlib.suppress(msgspec.MsgspecError, TypeError):  # TypeError: a frame of text
                message = _decode(raw)  # type: ignore[arg-type]
                if self._is_allowed(message):
                    return msgspec.msgpack.encode(message)  # not `raw`, which viser could read differently

    def _is_allowed(self, message: _Message) -> bool:
        """Whether viser may get a message. The camera must come first, because viser has no client without one."""
        if isinstance(message, _Camera):
            view = math.dist(message.position, message.look_at)
            is_posed = min(view, math.hypot(*message.up_direction), math.hypot(*message.wxyz)) > 1e-3
            allowed = is_posed and 0 < message.fov < math.pi and 0 < message.near < message.far
            self.has_camera |= allowed
            return allowed
        if isinstance(message, _Control):
            is_value = self._guard.controls.get(message.uuid, lambda value: False)
            return self.has_camera and is_value(message.updates.value)
        if isinstance(message, _Drag) and math.hypot(*message.wxyz) < 1e-3:
            return False
        return self.has_camera
