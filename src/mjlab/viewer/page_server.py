"""Viser page servers: address checks, start-up and URL."""

from __future__ import annotations

import logging
import os
import socket
import sys
import webbrowser
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080

_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_ALL_INTERFACES = ("0.0.0.0", "::")


def check_address(host: str, port: int, prefix: str = "") -> None:
    """Raise `ValueError` unless this machine can listen on `host` and `port` is a valid port.

    On an invalid address viser would wait forever. A port in use passes: viser takes the next free
    one. `prefix` precedes the names of the two flags in the message, e.g. `--`.
    """
    if not 1 <= port <= 65535:
        raise ValueError(f"{prefix}port: expected a port in [1, 65535], got {port}.")
    # Skip the DNS lookup of numeric addresses: it can take long.
    numeric = socket.AI_NUMERICHOST if host.replace(".", "").isdigit() else 0
    try:
        addresses = socket.getaddrinfo(
            host, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE | numeric
        )
        for family, kind, protocol, _, address in addresses:
            with socket.socket(family, kind, protocol) as probe:
                probe.bind(address)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(
            f"{prefix}host: expected an address of this machine, got {host!r} ({reason}); use "
            "127.0.0.1 for this machine only, or 0.0.0.0 for the whole network."
        ) from error


def serve_page(host: str = DEFAULT_HOST, port: int = DEFAULT_PORT) -> viser.ViserServer:
    """Return the server of an empty page, at `port` or the next free one.

    Raises:
        ValueError: see `check_address`.
    """
    from mjlab.viewer.page_proxy import PageServer

    check_address(host, port)
    names = {host.lower()}
    if host.lower() not in _LOOPBACK and not host.startswith("127."):
        log.warning(
            "The page is served on %s: anyone who can reach this machine can control it.", host
        )
        # On some networks this lookup is slow.
        names.add(socket.getfqdn().lower())
    return PageServer(host, port, names)


def page_url(server: viser.ViserServer) -> str:
    """Return the URL of the page for a browser on this machine."""
    host = server.get_host()
    if host in (*_LOOPBACK, *_ALL_INTERFACES):
        host = "localhost"
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def open_browser(url: str) -> None:
    """Open `url` in the browser of this machine, if it has a display.

    Without a display, Linux would open a text browser in the terminal. Over SSH, the browser would
    open on the remote machine, or slowly by X forwarding.
    """
    has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    has_display = has_display or sys.platform in ("darwin", "win32")
    if has_display and not os.environ.get("SSH_CONNECTION"):
        webbrowser.open(url)
