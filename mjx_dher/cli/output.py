"""Standard output that may fail without stopping the command."""

import contextlib
import errno
import io
import os
import re
import signal
import sys
import warnings
from collections.abc import Iterator
from typing import Any

from rich.console import Console
from rich.text import Text

from mjx_dher import lookup

# Characters that control a terminal or reverse its text, except tab and line feed.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Text with escaped control characters, and escaped bytes of file names that are not valid UTF-8."""
    return _CONTROL.sub(lambda match: repr(match[0])[1:-1], lookup.escaped(text))


class PlainConsole(Console):
    """A console that prints text without markup and with escaped control characters."""

    def __init__(self, **options: Any):
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


class Guarded:
    """A text stream that drops text that cannot be written, and keeps the first error."""

    def __init__(self, stream: Any):
        self.error: OSError | None = None
        self._closed = stream is None  # closed before this program started
        self._stream = open(os.devnull, "w", encoding="utf-8") if self._closed else stream  # noqa: SIM115

    def write(self, text: str) -> int:
        self._attempt("write", text)
        return len(text)

    def flush(self) -> None:
        self._attempt("flush")

    def _attempt(self, method: str, *args: Any) -> None:
        if self.error is not None:
            return
        try:
            if self._closed and args:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            getattr(self._stream, method)(*args)
        except OSError as error:
            self.error = error
            # Otherwise the interpreter would report an error when it flushes the rest.
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def open_closed() -> None:
    """Opens closed standard streams on /dev/null.

    Otherwise the next opened file would get the number of a standard stream, and output of C libraries would go into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number


@contextlib.contextmanager
def guarded() -> Iterator[Guarded]:
    """Guards sys.stdout. Characters that it cannot encode are escaped, and control characters in warnings too."""
    open_closed()
    before, form = sys.stdout, warnings.formatwarning
    if isinstance(before, io.TextIOWrapper):
        before.reconfigure(errors="backslashreplace")
    stream = Guarded(before)
    sys.stdout = stream
    warnings.formatwarning = lambda *about, **options: printable(form(*about, **options))
    try:
        yield stream
    finally:
        stream.flush()
        sys.stdout, warnings.formatwarning = before, form


def status(stream: Guarded, ended: int, trains: bool) -> int:
    """Exit status of a command that ended with `ended`. Reports lost output.

    A command that trains has still done its work. For others lost output is an error or, if the reader has gone (`| head`),
    the status of SIGPIPE.
    """
    if stream.error is None:
        return ended
    gone = isinstance(stream.error, BrokenPipeError)
    if not gone or trains:
        lost = "later output is lost" if trains else "the output is incomplete"
        with contextlib.suppress(OSError, ValueError, AttributeError):  # stderr may be gone too
            print(f"error: cannot print ({stream.error.strerror}); {lost}", file=sys.stderr)
    return ended if trains or ended else (128 + signal.SIGPIPE if gone else 2)
