"""Hostile messages to every port that a command opens: of the viewer, of JAX's processes, and of Ray.

    python bench/reliability.py --parts messages [--messages 200] [--seed 0]

Needs the extras `view`, `ray` and `test`. Each program is the real command. After its messages it must still do its work, a
legitimate client of the viewer must still be served, and memory must not have grown.
"""

import asyncio
import contextlib
import math
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import psutil
import viser
import viser._messages
import zstandard
from reliability_pairs import ROOT
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

PROTOCOL = f"viser-v{viser.__version__}"
CAMERA = {"type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [3, 3, 3], "fov": 1, "near": 0.01, "far": 1000}
CAMERA |= {"image_height": 600, "image_width": 800, "look_at": [0, 0, 0], "up_direction": [0, 0, 1]}
DRAG = {"type": "TransformControlsUpdateMessage", "name": "/handle", "wxyz": [1, 0, 0, 0], "position": [1.3, 0.7, 0.5]}
GROWTH_MB = 64
encode = msgspec.msgpack.encode


# Bytes that are sent to any port: (bytes, whether to hold the connection)


def bytes_to_any_port(rng):
    """Messages of port scanners, health checks, browsers and attackers."""
    host = "Host: 127.0.0.1\r\n"
    requests = [
        *(f"GET {path} HTTP/1.1\r\n{host}\r\n" for path in ("/", "/../../etc/passwd", "/%2e%2e/etc/passwd", "/x" * 3000)),
        "GET / HTTP/1.1\r\nHost: evil.example\r\nUpgrade: websocket\r\n\r\n",
        *(f"{method} / HTTP/1.1\r\n{host}Content-Length: 99999999999\r\n\r\nx" for method in ("POST", "OPTIONS", "PUT", "x")),
        f"GET / HTTP/1.1\r\n{host}" + "A: b\r\n" * 5000 + "\r\n",
        "GET / HTTP/1.1\r\nHost: " + "x" * 100_000,
        "GET / HTTP/1.1\r\n",
        "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        *("SSH-2.0-scan\r\n", "*1\r\n$4\r\nPING\r\n", ""),
    ]
    text = rng.choice([request.encode() for request in requests])
    tails = [b"", rng.randbytes(rng.choice([1, 9, 3000])), struct.pack("!I", 2**32 - 1), b"\x16\x03\x01" + rng.randbytes(300)]
    frame = struct.pack("!I", rng.randrange(2**24))[1:] + rng.randbytes(rng.randrange(200))
    http2 = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + frame
    return rng.choice([text + rng.choice(tails), rng.choice(tails), rng.randbytes(1 << 20), http2]), rng.random() < 0.3


def send_bytes(port, rng, held):
    """Sends some bytes to a port. Sometimes keeps the connection in `held`."""
    data, holds = bytes_to_any_port(rng)
    with contextlib.suppress(OSError):
        stranger = socket.create_connection(("127.0.0.1", port), 5)
        stranger.settimeout(0.5)
        held.append(stranger)
        stranger.sendall(data)
        if not holds:
            held.pop().close()


# The viewer


def values(rng):
    """Any value that a message can have."""
    texts = ["", "x" * 10_000, "[/red]\x1b[2J", b"\0" * 100]
    odd: list = [math.nan, math.inf, -1e308, 1e39, 2**63, -1, 0, True, None, *texts, {}, []]
    one = rng.choice(odd)
    return rng.choice([one, [one] * rng.choice([1, 3, 4, 1000]), {"value": one}, {"type": one}])


def message(rng, controls):
    """A message for viser: one of its types with any values, a valid one with a field changed, or an invalid one."""
    types = viser._messages.Message.get_subclasses()
    kind = rng.choice(types)
    fields = {name: values(rng) for name in getattr(kind, "__dataclass_fields__", {})}
    control = rng.choice([*controls, "nobody"])
    attributes = ["value", "removed", "update_cb", "_impl", "uuid", "is_button", "__class__", "min", "props"]
    changed = {**rng.choice([CAMERA, DRAG])}
    changed[rng.choice(list(changed))] = values(rng)
    upload = {"transfer_uuid": "t", "source_component_uuid": control, "filename": "../x", "mime_type": "", "part_count": 10**9}
    return rng.choice(
        [
            encode({"type": kind.__name__, **fields}),
            encode(changed),
            encode({"type": "GuiUpdateMessage", "uuid": control, "updates": {rng.choice(attributes): values(rng)}}),
            encode({"type": "FileTransferStartUpload", **upload, "size_bytes": 2**62}),
            encode({"type": "FileTransferPart", "transfer_uuid": "t", "part_index": 0, "content": b"x" * 10_000}),
            encode({"type": rng.choice(["ShareUrlRequest", "ShareUrlDisconnect"])}),
            encode(CAMERA)[:-3],
            b"\x91" * 200_000,
            b"\x82" + encode("type") + encode("ShareUrlRequest") + encode("type") + encode("ViewerCameraMessage"),
            "text",
            rng.randbytes(2000),
            b"x" * (1 << 20),
        ]
    )


def browser(port, origin=None, **options):
    """A client with the protocol of the viewer's page."""
    headers = options.pop("headers", {})
    own = {"subprotocols": [PROTOCOL], "compression": None, "max_size": None, "open_timeout": 20, "proxy": None}
    return connect(f"ws://127.0.0.1:{port}", additional_headers=headers, origin=origin, **{**own, **options})


async def send_messages(port, rng, controls):
    """An attacker at the viewer's websocket, from another page or with useless messages."""
    refused = [
        {"origin": rng.choice(["http://evil.example", "null", "http://127.0.0.1:1", "file://"])},
        {"headers": {"Host": "evil.example"}},
        {"subprotocols": ["viser-v0.0.1"]},
        {"subprotocols": None},
    ]
    options = rng.choice([*refused, {}, {}, {}, {}, {}, {}])
    with contextlib.suppress(WebSocketException, OSError, EOFError, AttributeError):  # the last: a fault of websockets
        async with browser(port, **options) as stranger:
            if options:
                raise AssertionError(f"the viewer took a browser with {options}")
            if rng.random() < 0.8:
                await stranger.send(encode(CAMERA))
            for _ in range(rng.choice([1, 5, 5, 2000])):
                await stranger.send(message(rng, controls))
            stranger.transport.abort() if rng.random() < 0.5 else await stranger.close()


class Watcher:
    """A legitimate browser that watches all the time."""

    def __init__(self, port):
        self.port, self.received, self.messages = port, 0, []  # the first messages

    async def __aenter__(self):
        self.socket = await browser(self.port).__aenter__()
        await self.socket.send(encode(CAMERA))
        self.task = asyncio.create_task(self.read())
        return self

    async def __aexit__(self, *error):
        self.task.cancel()
        await self.socket.close()

    async def read(self):
        while True:
            message = await self.socket.recv()
            self.received += 1
            self.messages += [message] if self.received < 50 else []

    async def sees_more(self, seconds=20.0):
        """Whether new pictures arrive."""
        before, end = self.received, time.monotonic() + seconds
        while self.received < before + 3 and time.monotonic() < end and not self.task.done():
            await asyncio.sleep(0.05)
        return self.received >= before + 3


def control_ids(messages):
    """Numbers of the panel's controls, from the messages to a browser."""
    found = set()
    for message in messages:
        plain, packed = struct.unpack_from("<QQ", message)
        window = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(message[16 : 16 + packed], plain))
        found |= {one["uuid"] for one in window["messages"] if "uuid" in one}
    return sorted(found)


async def attack_viewer(port, number, seed):
    """Sends hostile messages to a viewer. Returns a line each time its browser stopped receiving."""
    rng, held, faults = random.Random(seed), list[socket.socket](), []
    async with Watcher(port) as watcher:
        if not await watcher.sees_more(60):
            return ["a browser sees nothing"]
        controls = control_ids(watcher.messages)
        for count in range(number):
            if rng.random() < 0.4:
                await asyncio.to_thread(send_bytes, port, rng, held)
            else:
                await send_messages(port, rng, controls)
            if count % 10 == 0 and not await watcher.sees_more():
                faults.append(f"after message {count} a browser saw nothing more")
        held += [await asyncio.to_thread(socket.create_connection, ("127.0.0.1", port), 5) for _ in range(300)]
        if not await watcher.sees_more():
            faults.append("beside 300 silent connections a browser saw nothing more")
        async with Watcher(port) as newcomer:
            if not await newcomer.sees_more():
                faults.append("beside 300 silent connections a new browser saw nothing")
    for stranger in held:
        stranger.close()
    return faults


# Programs


def family(process):
    """A program's processes."""
    first = psutil.Process(process.pid)
    return [first, *first.children(recursive=True)]


def memory_mb(process):
    return sum(one.memory_info().rss for one in family(process)) >> 20


def ports_of(processes):
    """Ports at which programs listen."""
    places = [one for process in processes for child in family(process) for one in child.net_connections()]
    return sorted({one.laddr.port for one in places if one.status == psutil.CONN_LISTEN})


@contextlib.contextmanager
def started(folder, name, *command, **variables):
    """A command with its output in a file. Stopped as Ctrl-C does."""
    with (folder / f"{name}.log").open("w") as log:
        argv = [sys.executable, "-u", "train.py", *map(str, command)]
        process = subprocess.Popen(argv, cwd=ROOT, stdout=log, stderr=log, env={**os.environ, **variables})
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()


def until(condition, process, seconds=600.0):
    end = time.monotonic() + seconds
    while not condition():
        if process.poll() is not None or time.monotonic() > end:
            raise RuntimeError(f"{process.args} has not begun")
        time.sleep(0.2)


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def view(folder, number, seed):
    """Hostile messages to `view`."""
    port = free_port()
    with started(folder, "view", "view", "push", "reach", "--no-open", "--port", port) as process:
        until(lambda: f":{port}" in (folder / "view.log").read_text(), process)
        quiet, before = (folder / "view.log").read_text(), memory_mb(process)
        faults = asyncio.run(attack_viewer(port, number, seed))
        grown = memory_mb(process) - before
        noise = (folder / "view.log").read_text()[len(quiet) :]
        faults += [f"memory grew by {grown} MB"] if grown > GROWTH_MB else []
        return 1, faults + ([f"it printed {noise[:300]!r}"] if noise else [])


def attack_ports(folder, name, processes, number, seed):
    """Sends bytes to every port of training programs, which must continue. Returns the number of ports, and faults."""
    rng, held, faults = random.Random(seed), list[socket.socket](), []
    ports, lines = ports_of(processes), epochs(folder)
    for port in ports:
        for _ in range(number):
            send_bytes(port, rng, held)
            if any(process.poll() is not None for process in processes):
                return len(ports), [f"{name} ended at port {port} with {[process.poll() for process in processes]}"]
            if len(held) > 100:
                held.pop(0).close()
    end = time.monotonic() + 60
    while epochs(folder) <= lines and time.monotonic() < end:
        time.sleep(0.2)
    if epochs(folder) <= lines:
        faults.append(f"{name} made no epoch in a minute")
    return len(ports), faults


def epochs(folder):
    """Lines of all curves in a folder."""
    return sum(path.read_text().count("\n") for path in folder.rglob("metrics.csv"))


SMALL = """
    --env docs.examples.point_mass:PointMass --preset cpu --num-envs 16 --cycles-per-epoch 2 --batch-size 64 --hidden-sizes 8
    --updates-per-cycle 4 --target-period 2 --replay-size 4000 --final-episodes 50 --eval-episodes 50 --total-steps 40000000
""".split()  # noqa: SIM905


def distributed(folder, number, seed):
    """Hostile bytes to the ports of `train --distributed`, two processes."""
    address = f"127.0.0.1:{free_port()}"
    common = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2", "JAX_PLATFORMS": "cpu"}
    command = [*SMALL, "--out", folder / "run", "--distributed", "--devices", 2]
    with (
        started(folder, "first", *command, **common, JAX_PROCESS_ID="0") as first,
        started(folder, "second", *command, **common, JAX_PROCESS_ID="1") as second,
    ):
        until(lambda: epochs(folder) > 3, first)
        return attack_ports(folder, "distributed", [first, second], number, seed)


def ray(folder, number, seed):
    """Hostile bytes to the ports of `sweep --ray local`."""
    command = ["sweep", *SMALL, "--seeds", 1, "--out", folder / "sweep", "--ray", "local", "--ray-cpus", 1]
    with started(folder, "ray", *command, JAX_PLATFORMS="cpu") as process:
        until(lambda: epochs(folder) > 3, process)
        return attack_ports(folder, "ray", [process], number, seed)


PROGRAMS = {"view": view, "distributed": distributed, "ray": ray}


def messages(folder, number, seed):
    """Attacks each program. Returns the number of ports, and a line per fault."""
    tried, wrong = 0, []
    for name, attack in PROGRAMS.items():
        Path(folder, name).mkdir(parents=True)
        ports, faults = attack(Path(folder, name), number, seed)
        print(
            f"{name}: {number} messages to each of {ports} ports: {'; '.join(faults) or 'nothing ended or blocked'}", flush=True
        )
        tried += ports
        wrong += [f"{name}: {fault}" for fault in faults]
    return tried, wrong
