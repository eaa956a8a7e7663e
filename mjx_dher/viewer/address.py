"""Address of the viewer's page, and the browser. Loads neither JAX, MuJoCo nor viser."""

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
    """Checks that the viewer can start. Returns its port, or a free one for 0. Raises ValueError if its package is not
    installed, the port is taken, or the host is not an address of this machine.
    """
    require_extra("the viewer", "viser", "view")
    check_number("port", port, "[0, 65535]")
    if not host.strip():
        raise ValueError(f"host must be an address of this machine, such as 127.0.0.1; got {host!r}")
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as trial:
            if os.name == "posix":  # like the server; on other systems two processes could share a port
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
            trial.listen()
            return int(trial.getsockname()[1])
    except (OSError, UnicodeError) as error:
        if isinstance(error, OSError) and error.errno in (errno.EADDRINUSE, errno.EACCES):
            raise in_use(host, port, error.strerror or str(error)) from None
        raise ValueError(f"host must be an address of this machine; got {host!r} ({error})") from None


def in_use(host: str, port: int, reason: str) -> ValueError:
    """Error for an unavailable port."""
    return ValueError(f"port {port} of {host} cannot be used ({reason}); pass another --port, or 0 for any free port")


def is_ip(host: str) -> bool:
    """Whether a host is an IP address, not a name."""
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(host))
    return False


def is_loopback(host: str) -> bool:
    """Whether an address is reachable only from this machine."""
    return host.lower() == "localhost" or (is_ip(host) and ipaddress.ip_address(host).is_loopback)


def is_everywhere(host: str) -> bool:
    """Whether a host means all addresses of this machine."""
    return is_ip(host) and ipaddress.ip_address(host).is_unspecified


def address(host: str, port: int) -> str:
    """URL of the page for a browser on this machine."""
    if is_everywhere(host):
        host = "::1" if ":" in host else "127.0.0.1"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def open_browser(url: str) -> bool:
    """Opens a page in the user's browser. Returns False if there is no graphical one."""
    on_screen = sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    with contextlib.suppress(webbrowser.Error, OSError):
        # Text browsers have this class, and would use the terminal.
        return on_screen and type(webbrowser.get()) is not webbrowser.GenericBrowser and webbrowser.open(url)
    return False
