"""Ctrl-C and SIGTERM during training."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

from rich.console import Console


class Stop:
    """Context in which the first signal requests a stop, and the second ends the process at once.

    A compiled epoch cannot be interrupted, so training checks `asked` after each epoch.

    Args:
      console: to print to.
      folder: of the run, for the messages.
    """

    def __init__(self, console: Console, folder: Path):
        self.asked: int | None = None  # the signal
        self._console, self._folder = console, folder

    def __enter__(self) -> Stop:
        self._handlers: dict[int, Any] = {}
        if threading.current_thread() is not threading.main_thread():  # where Python takes no handlers
            return self
        self._handlers = {number: signal.signal(number, self._on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _on_signal(self, signum: int, frame: Any) -> None:
        if self.asked is not None:
            self._console.show_cursor(True)
            self._console.print(f"stopped at once; what was saved is in {self._folder}", soft_wrap=True)
            sys.stdout.flush()
            os._exit(128 + signum)
        self.asked = signum
        self._console.print("stopping when this epoch has ended, with a checkpoint; again stops at once, with what is saved")
