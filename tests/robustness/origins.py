"""Requests of web sites to a page: only those of the page itself are answered."""

from __future__ import annotations

import contextlib
import importlib
import random
import re
import signal
import socket
import time
from pathlib import Path
from typing import Any

from .commands import TASK, Command, check_end, free_port
from .trials import Broken, Trial

WHAT = "combinations of Host, Origin, method, path and second requests to the pages of commands"
TRIALS = 40
LIMIT = 60.0

_REQUESTS = 40
_EVIL = "evil.example"
_MODEL = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
_HOSTS = {"127.0.0.1": "127.0.0.1", "localhost": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::1": "::1"}
"""Values of `--host` and the addresses to connect to."""


def preload() -> None:
    """Import what pages need."""
    for name in (
        "mjlab.scripts.view",
        "mjlab.scripts.visualize_terrain",
        "mjlab.viewer.page_proxy",
    ):
        importlib.import_module(name)
    importlib.import_module("mjlab.viewer.viser.viewer")


def prepare(folder: Path) -> None:
    """Return nothing: trials share no data."""


def run(trial: Trial, prepared: Any) -> None:
    """Serve a page and send requests."""
    rng = trial.rng
    Path("model.xml").write_text(_MODEL)
    name, flags = rng.choice([
        ("view", ("model.xml", "--open-browser", "False")),
        ("play", (TASK, "--agent", "zero", "--viewer", "viser", "--device", "cpu")),
        ("visualize-terrain", ("--num-levels", "1", "--robot", "none")),
    ])  # fmt: skip
    host, port = rng.choice(list(_HOSTS)), free_port()
    trial.trying(f"{name} --host {host}")
    process = Command(name, (*flags, "--host", host, "--port", str(port)))
    address = (_HOSTS[host], port)
    if not process.watch(30.0, lambda: _status(address, _Request(rng, good=True)) in (200, 101)):
        raise Broken("the page is not served")
    for _ in range(_REQUESTS):
        request = _Request(rng, good=rng.random() < 0.4)
        status = _status(address, request)
        process.watch(0.0)
        if (status == request.expected) != request.is_good:
            raise Broken(f"status {status} of {request.data!r}")
    if _status(address, _Request(rng, good=True)) not in (200, 101):
        raise Broken("the page is not served afterwards")
    process.signal(signal.SIGINT)
    ended = process.end(15.0)
    check_end(ended)
    if ended.was_asked or ended.said.count("rejected a connection") > 1:
        raise Broken(f"deaf to Ctrl-C, or not one line: {ended.said[-500:]!r}")


class _Request:
    """Random request, and the status that the page's own browser would get."""

    def __init__(self, rng: random.Random, good: bool) -> None:
        port = rng.choice(("", ":80", f":{rng.randrange(1, 65536)}"))
        own = [
            f"{name}{port}" for name in ("localhost", "LOCALHOST", "127.0.0.1", "[::1]", "10.1.2.3")
        ]
        other = [
            f"{_EVIL}{port}", f"localhost.{_EVIL}{port}", f"127.0.0.1.{_EVIL}", f"localhost@{_EVIL}",
            f"{_EVIL}#localhost", f"{_EVIL}/localhost", "", "[::1", f"[{_EVIL}]{port}", "localhost:",
            "local host", "::1", f"localhost{port}, {_EVIL}", f"{rng.randbytes(4).hex()}x{port}",
        ]  # fmt: skip
        host = rng.choice(own)
        scheme = rng.choice(("http", "https"))
        origins = [[], [], [f"{scheme}://{host}"], [f"{scheme.upper()}://{host}"]]
        foreign = [
            [f"{scheme}://{_EVIL}"], ["null"], [""], [f"{scheme}://{host}1"], [f"{scheme}://1{host}"],
            [f"{scheme}://{host}/"], [f"{scheme}://{host}.{_EVIL}"], [f"ws://{host}"], ["file://"], [host],
            [f"{scheme}://{host} {scheme}://{_EVIL}"], [f"{scheme}://{host}@{_EVIL}"],
            [f"{scheme}://{host}", f"{scheme}://{_EVIL}"], [f"{scheme}://{_EVIL}", f"{scheme}://{host}"],
        ]  # fmt: skip
        self.is_good = good
        hosts, origin, method = [host], rng.choice(origins), "GET"
        fault = (
            None if good else rng.choice(("host", "hosts", "no host", "origin", "origin", "method"))
        )
        if fault == "host":
            hosts = [rng.choice(other)]
            origin = rng.choice(([], [f"{scheme}://{hosts[0]}"]))
        elif fault == "hosts":
            hosts = rng.choice(([host, _EVIL], [_EVIL, host], [host, host]))
        elif fault == "no host":
            hosts = []
        elif fault == "origin":
            origin = rng.choice(foreign)
        elif fault == "method":
            method = rng.choice(("POST", "HEAD", "OPTIONS", "get", "CONNECT", "GET\t"))
        lines = [*(("Host", value) for value in hosts), *(("Origin", value) for value in origin)]
        lines += [("X-Forwarded-Host", "localhost"), ("Referer", "http://localhost/")][
            : rng.randrange(3)
        ]
        self.expected = rng.choice((200, 101))
        if self.expected == 101:
            lines += _upgrade()
        rng.shuffle(lines)
        space = rng.choice(("", " ", " \t"))
        text = "".join(
            f"{rng.choice((name, name.lower(), name.upper()))}:{space}{value}{space}\r\n"
            for name, value in lines
        )
        path = rng.choice(("/", "/?a=1", "//", "/index.html"))
        self.data = f"{method} {path} HTTP/1.1\r\n{text}\r\n".encode()
        self.pieces = rng.choice((1, 1, 2, 5))
        # A page answers one request of a connection.
        if self.expected == 200 and rng.random() < 0.3:
            self.data += f"GET / HTTP/1.1\r\nHost: {_EVIL}\r\n\r\n".encode()
            self.pieces = 1


def _upgrade() -> list[tuple[str, str]]:
    import viser

    return [
        ("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Sec-WebSocket-Version", "13"),
        ("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ=="),
        ("Sec-WebSocket-Protocol", f"viser-v{viser.__version__}"),
    ]  # fmt: skip


def _status(address: tuple[str, int], request: _Request) -> int:
    """Return the status of the answer; 0 without one, -1 of two."""
    received = b""
    with contextlib.suppress(OSError), socket.create_connection(address, 5.0) as connection:
        size = -(-len(request.data) // request.pieces)
        for start in range(0, len(request.data), size):
            connection.sendall(request.data[start : start + size])
            time.sleep(0.002 * (request.pieces > 1))
        while not received.startswith(b"HTTP/1.1 101") and (part := connection.recv(1 << 20)):
            received += part
    if received.count(b"HTTP/1.1 ") > 1:
        return -1
    found = re.match(rb"HTTP/1.1 (\d+)", received)
    return int(found[1]) if found else 0
