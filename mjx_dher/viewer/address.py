"""Where the viewer's page is served, and who opens it. Loads neither JAX, MuJoCo nor viser."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import socket
import sys
import webbrowser

from mjx_dher.lookup import require_extra
from mjx_dher.validation import check_number


def check(host: str, port: int) -> int:
    """Returns the port to serve the page at, once it is known that the viewer can begin; for 0 one that is free.

    Raises:
      ValueError: its package is not installed, the port is taken, or the host is no address of this machine.
    """
    require_extra("the viewer", "viser", "view")
    check_number("port", port, "[0, 65535]")
    if not host.strip():
        raise ValueError(f"host must be an address of this machine, such as 127.0.0.1; got {host!r}")
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as trial:
            if os.name == "posix":  # as the server itself does; elsewhere this would let two have one port
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
            trial.listen()
            return int(trial.getsockname()[1])
    except (OSError, UnicodeError) as error:
        if isinstance(error, OSError) and error.errno in (errno.EADDRINUSE, errno.EACCES):
            raise in_use(host, port, error.strerror or str(error)) from None
        raise ValueError(f"host {host!r} is no address of this machine ({error})") from None


def in_use(host: str, port: int, reason: str) -> ValueError:
    """Returns the error for a port that cannot be had."""
    return ValueError(f"port {port} of {host} cannot be used ({reason}); name another with --port, or 0 for any that is free")


def is_ip(host: str) -> bool:
    """Whether a host is an IP address, not a name."""
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(host))
    return False


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine alone."""
    return host == "localhost" or (is_ip(host) and ipaddress.ip_address(host).is_loopback)


def is_everywhere(host: str) -> bool:
    """Whether a host means all addresses of this machine."""
    return is_ip(host) and ipaddress.ip_address(host).is_unspecified


def address(host: str, port: int) -> str:
    """Returns the page's address for a browser on this machine."""
    if is_everywhere(host):
        host = "::1" if ":" in host else "127.0.0.1"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def open_browser(url: str) -> bool:
    """Opens a page in the user's browser; returns False where there is none that has a screen."""
    on_screen = sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    with contextlib.suppress(webbrowser.Error, OSError):
        # Browsers in a terminal are of this class itself, and would take the terminal.
        return on_screen and type(webbrowser.get()) is not webbrowser.GenericBrowser and webbrowser.open(url)
    return False
