"""A line between two processes: messages of JSON and bytes, and a watch that ends this process when the other one is gone."""

from __future__ import annotations

import ctypes
import json
import os
import queue
import signal
import socket
import struct
import sys
import threading
import time
from typing import Any

BEAT = 5.0  # s between signs of life
GRACE = 3.0  # s for this process to end in order where the other one has told why it ends
SILENCE = 30.0  # s without any, after which the other process counts as gone
GOES_ON = "; this one ends, too, and the same command goes on from the last checkpoint\n"
GONE = 75  # exit status of a process whose team is gone: worth another try (EX_TEMPFAIL)
MOST = 1 << 20  # bytes of a message's JSON
PIECE = 1 << 22  # bytes that are sent in a call
_HEAD = struct.Struct("!IQ")  # sizes of JSON and bytes


@ctypes.CFUNCTYPE(None, ctypes.c_int)
def _on_abort(number: int) -> None:
    """Leaves it to a line to end this process, which JAX aborts when the first one is gone; ends it where none does."""
    time.sleep(GRACE)
    os.write(2, f"error: process 0 is gone (JAX has lost it){GOES_ON}".encode())
    os._exit(GONE)


class LineError(OSError):
    """A line that cannot be made."""


class Line:
    """One end. Until `watch`, the one who waits for a message learns that the other is gone; from then on, the process ends."""

    def __init__(self, connection: socket.socket, greeting: dict[str, Any]):
        self.greeting = greeting  # of the other end, which has called
        self.others: list[Line] = []  # of this process, to be told where the other end is gone
        self._socket = connection
        self._sending = threading.Lock()
        self._messages: queue.Queue[tuple[dict[str, Any], bytes]] = queue.Queue()
        self._watched = self._closed = False

    @classmethod
    def called(cls, host: str, port: int, greeting: dict[str, Any]) -> Line:
        """Calls a process that listens. Raises OSError where none does."""
        connection = socket.create_connection((host, port), timeout=SILENCE)
        line = cls(connection, {"number": 0})
        line.send(greeting)
        return line

    @classmethod
    def taken(cls, listening: socket.socket) -> Line | None:
        """Takes a call; None where it is none of ours. Raises TimeoutError where nobody calls."""
        connection, _ = listening.accept()
        connection.settimeout(SILENCE)
        line = cls(connection, {})
        try:
            line.greeting = line._read()[0]
        except (OSError, ValueError, EOFError):
            connection.close()
            return None
        return line if "described" in line.greeting else None

    def send(self, content: dict[str, Any], data: bytes = b"") -> None:
        """Sends a message."""
        text = json.dumps(content).encode()
        try:
            with self._sending:
                self._socket.sendall(_HEAD.pack(len(text), len(data)) + text)
                for start in range(0, len(data), PIECE):  # the socket's time limit is for each call
                    self._socket.sendall(memoryview(data)[start : start + PIECE])
        except OSError as error:
            self._lost(error)

    def receive(self) -> tuple[dict[str, Any], bytes]:
        """Returns the next message, as long as it may take."""
        if self._watched:
            return self._messages.get()
        try:
            return self._read()
        except (OSError, ValueError, EOFError) as error:
            raise LineError(f"process {self.greeting.get('number')} is gone before all were ready ({error})") from error

    def watch(self) -> None:
        """Begins to listen, and to give signs of life, in threads."""
        self._watched = True
        if (
            os.name == "posix" and self.greeting.get("number") == 0
        ):  # a handler of C: one of Python would have to wait for the thread that aborts
            ctypes.CDLL(None).signal(signal.SIGABRT, _on_abort)
        self._socket.settimeout(SILENCE)
        threading.Thread(target=self._listen, daemon=True).start()
        threading.Thread(target=self._beat, daemon=True).start()

    def close(self, reason: str = "") -> None:
        """Tells the other end that this process ends: in order, or because of `reason`."""
        self._closed = True
        self.send({"bye": reason})

    def _listen(self) -> None:
        try:
            while True:
                content, data = self._read()
                if "bye" in content:
                    if content["bye"]:
                        time.sleep(GRACE)  # this one may end by itself, for the same reason
                        self._lost(f"has ended: {content['bye']}")
                    return
                if "beat" not in content:
                    self._messages.put((content, data))
        except (OSError, ValueError, EOFError) as error:
            self._lost(error)

    def _beat(self) -> None:
        while not self._closed:
            self.send({"beat": 1})
            time.sleep(BEAT)

    def _read(self) -> tuple[dict[str, Any], bytes]:
        size, more = _HEAD.unpack(self._exactly(_HEAD.size))
        if size > MOST:
            raise ValueError("no message of ours")
        content = json.loads(self._exactly(size))
        if not isinstance(content, dict):
            raise ValueError("no message of ours")
        return content, self._exactly(more)

    def _exactly(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            if not (part := self._socket.recv(min(size - len(data), 1 << 20))):
                raise EOFError("the line is closed")
            data += part
        return bytes(data)

    def _lost(self, what: Exception | str) -> None:
        if self._watched and not self._closed:
            told = what if isinstance(what, str) else f"is gone ({what or type(what).__name__})"
            self._closed = True
            for other in self.others:
                other.close(f"process {self.greeting.get('number')} {told}")
            self._end(told)

    def _end(self, what: str) -> None:
        """Ends this process at once: it may be waiting for the other one in an operation of both, which nothing interrupts."""
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError):
                continue
        os.write(2, f"error: process {self.greeting.get('number')} {what}{GOES_ON}".encode())
        os._exit(GONE)
