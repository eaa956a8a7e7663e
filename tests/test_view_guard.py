"""Strangers at the viewer's port: no request of another page, no message and no number of calls disturbs who looks."""

import asyncio
import math
import socket
import threading
import time
import urllib.error
import urllib.request

import pytest
from conftest import ROOT, refuses

from mjx_dher import envs
from mjx_dher.policy import bundled
from mjx_dher.viewer import address, server, sources


@pytest.fixture(scope="module")
def hostile():
    """bench/reliability_messages.py, which has the clients."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "bench")
        import reliability_messages

        yield reliability_messages


@pytest.fixture(scope="module")
def viewer():
    """A viewer that plays Reach in a thread; it must end as it is told, with nothing raised."""
    port, ended, errors = address.check("127.0.0.1", 0), threading.Event(), []
    found = [sources.of_run("reach", bundled.FOLDER / "reach"), sources.by_random("reach")]
    with server.Viewer(found, lambda source: envs.make("reach", engine="native"), "127.0.0.1", port, 1) as viewer:

        def run():
            try:
                viewer.run(ended.is_set)
            except BaseException as error:
                errors.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        viewer.port = port
        yield viewer
        ended.set()
        thread.join()
    assert errors == []


def answer(port, path="/", **headers):
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    with urllib.request.urlopen(request, timeout=10) as response:
        return response


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/", {"Host": "evil.example"}, 421),  # a name that a stranger's DNS server points to 127.0.0.1
        ("/", {"Host": "127.0.0.1.evil.example"}, 421),
        ("/", {"Host": "[::1"}, 421),
        ("/%2e%2e/%2e%2e/_viser.py", {}, 404),
        ("/favicon.ico", {}, 404),
    ],
)
def test_requests_that_the_page_does_not_make_are_rejected(viewer, path, headers, status):
    with pytest.raises(urllib.error.HTTPError) as raised:
        answer(viewer.port, path, **headers)
    assert raised.value.code == status


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:9000", "[::1]:9000", "10.1.2.3"])
def test_the_page_is_served_through_a_tunnel_and_not_in_a_frame(viewer, host):
    response = answer(viewer.port, Host=host)
    assert response.status == 200
    assert "frame-ancestors 'none'" in response.headers["Content-Security-Policy"]


OTHERS = [
    {"origin": "http://evil.example"},
    {"origin": "null"},
    {"origin": "http://127.0.0.1:1"},
    {"headers": {"Host": "evil.example"}},
    {"subprotocols": None},
    {"subprotocols": ["viser-v0.0.1"]},
]


@pytest.mark.parametrize("options", OTHERS)
def test_browsers_of_other_pages_are_rejected(viewer, hostile, options):
    from websockets.exceptions import InvalidMessage, InvalidStatus

    async def call():
        async with hostile.browser(viewer.port, **options):
            pass

    with pytest.raises((InvalidStatus, InvalidMessage)):
        asyncio.run(call())


def test_the_page_itself_is_a_browser_that_may_connect(viewer, hostile):
    async def call():
        async with hostile.browser(viewer.port, origin=f"http://127.0.0.1:{viewer.port}"):
            pass

    asyncio.run(call())


def changed(message, **fields):
    return {**message, **fields}


def test_no_message_of_one_browser_disturbs_another(viewer, hostile):
    """Messages of every kind in one connection; then those of the panel are still obeyed, within their bounds."""
    from websockets.exceptions import ConnectionClosed

    camera, drag, encode = hostile.CAMERA, hostile.DRAG, hostile.encode
    bad = [
        *(changed(drag, position=position) for position in ([math.nan, 0, 0], [1e39, 0, 0], [1, 2], [[1, 2, 3]], "xyz", None)),
        *(
            changed(drag, **{field: value})
            for field, value in [("name", "/ball"), ("owner", "0"), ("more", 1), ("wxyz", []), ("wxyz", [0.0] * 4)]
        ),
        *(changed(camera, **{field: [0, 0, 0]}) for field in ("up_direction",)),
        changed(camera, look_at=camera["position"]),
        *(changed(camera, fov=value) for value in (math.inf, 0, -1, 4)),
        *(
            {"type": name}
            for name in ("ShareUrlRequest", "ShareUrlDisconnect", "ReplayDoneMessage", "Message", "NoSuchMessage")
        ),
        {"type": "FileTransferPart", "transfer_uuid": "", "part_index": 0, "content": b"x" * 9000},
    ]
    kinds = [*map(encode, bad), "text", b"", b"\x91" * 10_000, encode(drag)[:-4], b"\x81" + encode("type") + encode([])]

    async def attack():
        async with hostile.Watcher(viewer.port) as watcher:
            assert await watcher.sees_more(60)
            panel = viewer._panel
            ids = {
                name: getattr(panel, f"_{name}")._impl.uuid for name in ("policy", "play", "once", "speed", "renew", "taken")
            }
            async with hostile.browser(viewer.port) as stranger:
                await stranger.send(encode(drag))  # before its camera
                await stranger.send(encode(camera))
                for message in kinds:
                    await stranger.send(message)
                for uuid in (*ids.values(), "nobody"):
                    for field, value in [
                        *(("value", value) for value in (math.nan, 1e9, None, "nobody", [], {"a": 1}, "x" * 9000)),
                        *((field, True) for field in ("removed", "uuid", "__class__", "update_cb", "props")),
                    ]:
                        await stranger.send(encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {field: value}}))
                await stranger.send(encode({"type": "GuiUpdateMessage", "uuid": ids["speed"], "updates": {"value": 4}}))
                await asyncio.sleep(0)
            async with hostile.browser(viewer.port) as stranger:  # which sends too much
                await stranger.send(b"x" * (1 << 20))
            with pytest.raises(ConnectionClosed):
                await send_many(hostile, viewer.port)
            assert await watcher.sees_more()
            await until(lambda: viewer.player.speed == 4.0)
            assert not viewer.player.is_own
            await watcher.socket.send(encode(changed(drag, position=[1.3, 0.7, 0.5])))
            await until(lambda: viewer.player.is_own)
            assert viewer._server._share_tunnel is None
            assert viewer._server.gui._current_file_upload_states == {}

    asyncio.run(attack())


async def send_many(hostile, port):
    async with hostile.browser(port) as stranger:
        for _ in range(50_000):
            await stranger.send(b"")
            await asyncio.sleep(0)


async def until(condition):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        await asyncio.sleep(0.01)


def test_many_connections_leave_room_for_those_that_come(viewer, hostile):
    """More silent connections and more browsers than there is room for."""

    async def attack():
        silent = [socket.create_connection(("127.0.0.1", viewer.port)) for _ in range(100)]
        async with hostile.Watcher(viewer.port) as watcher:
            assert await watcher.sees_more(60)
            mute = [await hostile.browser(viewer.port).__aenter__() for _ in range(20)]
            async with hostile.Watcher(viewer.port) as newcomer:
                assert await newcomer.sees_more()
            assert await watcher.sees_more()
            for browser in mute:
                browser.transport.abort()
        for stranger in silent:
            stranger.close()

    asyncio.run(attack())


@pytest.mark.parametrize("host", ["", " ", "127.0.0.1:8080", "http://127.0.0.1", "127.0.0.256", "::1::"])
def test_a_host_that_is_no_address_is_refused(host):
    with refuses("host", host):
        address.check(host, 0)
