"""Ctrl-C, SIGTERM and SIGHUP. No other module handles them.

Python calls a handler in the main thread, between two instructions. This is late while a library compiles, and its exception
can be lost in a library's callback. So the interpreter writes each signal to a pipe, which a thread reads. The thread ends the
process at once, unless a block is `held`, which ends in order.
"""

import atexit
import contextlib
import ctypes
import fcntl
import math
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SECONDS_OF_ONE = 0.5  # repeated signals within this time count once: `timeout`, srun and uv run pass them on
SECONDS_TO_END = 7.0  # after a signal, for code after the held blocks
SECONDS_TO_CLEAN = 1.5
STOPPING = "stopping after this epoch, with a checkpoint; a second signal stops at once"

# The functions behind `signal.signal` work in any thread. They take and return the address of a handler in C.
_GET, _SET = ctypes.pythonapi.PyOS_getsig, ctypes.pythonapi.PyOS_setsig
_GET.restype = _SET.restype = ctypes.c_void_p
_GET.argtypes, _SET.argtypes = [ctypes.c_int], [ctypes.c_int, ctypes.c_void_p]


class Held:
    """A block that checks `asked` and ends in order. It calls `alive` to show that it does not hang."""

    def __init__(self, report: Callable[[str], None], told: str, patience: float):
        self.report, self.told, self.patience = report, told, patience
        self.alive()

    def alive(self) -> None:
        """Gives the block another `patience` seconds."""
        self.heard = time.monotonic()


class _Signals:
    """The process's signals. The lock is for the main thread and the thread that reads the pipe."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.pipe: tuple[int, ...] | None = None
        self.before: dict[int, Any] = {}  # original handlers
        self.ours: int | None = None  # address of Python's handler in C
        self.asked: int | None = None
        self.since = 0.0
        self.blocks = [Held(lambda text: None, "stopped", SECONDS_TO_END)]  # the first stands for code outside held blocks
        self.cleaners: dict[object, Callable[[], object]] = {}

    def listen(self, read: int) -> None:
        """Reads the pipe while the process lives. Takes back a signal that a library, such as Ray, has taken after 0.1 s."""
        signal.pthread_sigmask(signal.SIG_UNBLOCK, NUMBERS)
        while True:
            select.select([read], [], [], 0.1)
            with self.lock:
                self.look()
                for number in self.before:
                    if _GET(number) != self.ours:
                        _SET(number, self.ours)

    def look(self) -> None:
        """Handles the signals that have arrived."""
        with self.lock:
            for number in self.read():
                if self.asked is None:
                    self.asked, self.since = number, time.monotonic()
                    if len(self.blocks) == 1:
                        self.end(number)
                    report = threading.Thread(target=self.blocks[-1].report, args=[STOPPING], daemon=True)
                    report.start()
                    report.join(SECONDS_OF_ONE)  # writing to a full pipe blocks
                elif time.monotonic() - self.since > SECONDS_OF_ONE:
                    self.end(number)
            block = self.blocks[-1]
            if self.asked is not None and time.monotonic() - max(self.since, block.heard) > block.patience:
                self.end(self.asked)

    def read(self) -> list[int]:
        """Numbers of the signals that have arrived since the last call."""
        with contextlib.suppress(BlockingIOError):
            return [number for number in os.read(self.pipe[0], 1024) if number in NUMBERS] if self.pipe else []
        return []

    def end(self, number: int) -> None:
        """Ends the process at once. Open files are closed as by a kill."""
        limit = threading.Timer(SECONDS_TO_CLEAN, os._exit, [128 + number])
        limit.daemon = True
        limit.start()
        with contextlib.suppress(OSError):
            os.write(2, f"{self.blocks[-1].told}\n".encode())
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # other threads continue until the end and may fail
            if os.isatty(1):
                os.write(1, b"\x1b[?25h")  # a progress bar hides the cursor
        for clean in (sys.stdout.flush, *reversed(list(self.cleaners.values())), _kill_children):
            with contextlib.suppress(Exception):
                clean()
        os._exit(128 + number)

    def finish(self) -> None:
        """Ignores signals while the interpreter ends. It would restore their defaults, which replace the exit status."""
        with self.lock:
            self.look()
            numbers = list(self.before)
            self.before.clear()
            for number in numbers:
                signal.signal(number, signal.SIG_IGN)

    def before_fork(self) -> None:
        """Blocks signals until a child has its own handlers."""
        self.mask = signal.pthread_sigmask(signal.SIG_BLOCK, NUMBERS)

    def in_parent(self) -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, self.mask)

    def in_child(self) -> None:
        """Restores the original handlers in a forked child. It has no reading thread, and shares the pipe."""
        if self.before:
            signal.set_wakeup_fd(-1)
            for number, handler in self.before.items():
                signal.signal(number, handler)
        self.in_parent()


def children() -> list[int]:
    """Running child processes. Needs Linux."""
    pids: list[int] = []
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError), open(f"/proc/self/task/{thread}/children", encoding="ascii") as file:
            pids += map(int, file.read().split())
    return pids


def _kill_children() -> None:
    """Kills child processes that libraries have started, except in other sessions, such as a browser."""
    for pid in children():
        if os.getsid(pid) == os.getsid(0):
            os.kill(pid, signal.SIGKILL)


_signals = _Signals()


def take() -> None:
    """Handles the process's signals from now on, if this is the main thread. SIGHUP stays ignored under `nohup`."""
    if threading.current_thread() is not threading.main_thread():
        return
    if _signals.pipe is None:
        ends = os.pipe()
        _signals.pipe = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 3) for end in ends)  # not instead of a closed stdout
        for end, own in zip(ends, _signals.pipe):
            os.close(end)
            os.set_blocking(own, False)
        os.register_at_fork(before=_signals.before_fork, after_in_parent=_signals.in_parent, after_in_child=_signals.in_child)
        atexit.register(_signals.finish)
        threading.Thread(target=_signals.listen, args=[_signals.pipe[0]], name="signals", daemon=True).start()
    signal.set_wakeup_fd(_signals.pipe[1], warn_on_full_buffer=False)
    with _signals.lock:
        for number in NUMBERS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                before = signal.signal(number, _wake)
                _signals.before.setdefault(number, before or signal.SIG_DFL)
        _signals.ours = _GET(signal.SIGINT)


def take_back() -> None:
    """Handles the signals again, if this module does, after a library that may have taken them."""
    if _signals.before:
        take()


def _wake(number: int, frame: object) -> None:
    """Python writes to the pipe only for signals that have a handler."""


@contextlib.contextmanager
def taken() -> Iterator[None]:
    """Handles the signals during the block, unless `take` has been called, and restores the original handlers."""
    if _signals.before or threading.current_thread() is not threading.main_thread():
        yield
        return
    pipe = signal.set_wakeup_fd(-1)
    take()
    try:
        yield
    finally:
        with _signals.lock:
            signal.set_wakeup_fd(pipe)
            for number, handler in _signals.before.items():
                signal.signal(number, handler)
            _signals.before.clear()
            _signals.read()
            _signals.asked = None


def asked() -> int | None:
    """Signal that requests a stop, or None."""
    _signals.look()
    return _signals.asked


def forget() -> None:
    """Clears a request to stop, because all work is done."""
    _signals.asked = None


def are_asked() -> bool:
    """Whether a signal requests a stop."""
    return asked() is not None


@contextlib.contextmanager
def held(report: Callable[[str], None], place: object, patience: float = math.inf) -> Iterator[Held]:
    """Lets the block end in order after a first signal. It must check `asked`. A second signal ends the process at once.

    `report` is called with a line when a signal arrives. The block saves its work in `place`. Unless it calls `alive`, the
    process ends `patience` seconds after the signal.
    """
    block = Held(report, f"stopped at once; saved work is in {place}", patience)
    take_back()
    with _signals.lock:
        _signals.blocks.append(block)
    try:
        yield block
    finally:
        with _signals.lock:
            _signals.look()  # signals that arrived in the block
            _signals.blocks.remove(block)
            _signals.blocks[-1].alive()


@contextlib.contextmanager
def cleaning(clean: Callable[[], object]) -> Iterator[None]:
    """Calls `clean` at the end of the block, even if a signal ends the process within it."""
    key = object()
    _signals.cleaners[key] = clean
    try:
        yield
    finally:
        clean()
        _signals.cleaners.pop(key)
