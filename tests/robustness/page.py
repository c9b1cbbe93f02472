"""Malformed clients of the page: the page stays up and serves the next client."""

from __future__ import annotations

import contextlib
import random
import re
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import TASK, Command, check_end, free_port, last_error
from .runs import trained
from .trials import Broken, Trial, name_of

WHAT = "malformed HTTP, odd websockets and random bytes to the page of `play`"
TRIALS = 36
LIMIT = 120.0

_HOST = "127.0.0.1"
_START = 40.0


def prepare(folder: Path) -> dict[str, str]:
    """Train a policy."""
    return {"logs": str(trained(folder / "logs", 1).parents[1])}


def run(trial: Trial, prepared: dict[str, str]) -> None:
    """Play a policy with a page, attack the page, and open it like a browser."""
    port = free_port()
    attack = _ATTACKS[trial.number % len(_ATTACKS)]
    trial.trying(name_of(attack))
    flags = ("--log-root", prepared["logs"], "--device", "cpu", "--port", str(port))
    process = Command("play", (TASK, *flags, "--viewer", "viser"))
    process.watch(_START, lambda: _can_connect(port))
    if not _answers(process, port):
        raise Broken("the page is not served before the attack")
    attack(_Target(process, port, trial.rng))
    process.watch(0.5)
    if process.status is not None:
        raise Broken(f"the process ended with status {process.status}")
    if not _answers(process, port):
        raise Broken("the page is not served afterwards")
    with _websocket(process, port) as (connection, status):
        if status != 101 or not _receive(process, connection):
            raise Broken(f"no websocket afterwards: HTTP {status}")
    process.signal(signal.SIGINT)
    ended = process.end(15.0)
    if ended.was_asked or ended.stuck:
        raise Broken("deaf to Ctrl-C")
    if ended.status < 0:
        check_end(ended)
    if "Traceback" in ended.said:
        raise Broken(f"a traceback was shown ({last_error(ended.said)})")


class _Target:
    """Attacked page."""

    def __init__(self, process: Command, port: int, rng: random.Random) -> None:
        self.process, self.port, self.rng = process, port, rng

    def send(self, data: bytes, seconds: float = 1.0) -> bytes:
        """Send bytes on a connection; return the response until it closes or `seconds` pass."""
        with self.connect() as connection, contextlib.suppress(OSError):
            connection.sendall(data)
            return _receive(self.process, connection, seconds)
        return b""

    def connect(self) -> socket.socket:
        """Open a connection."""
        return socket.create_connection((_HOST, self.port), timeout=5.0)

    def websocket(self) -> contextlib.AbstractContextManager[tuple[socket.socket, int]]:
        """Open a websocket, as the page does."""
        return _websocket(self.process, self.port)


def _can_connect(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((_HOST, port), timeout=0.2):
        return True
    return False


def _receive(process: Command, connection: socket.socket, seconds: float = 5.0) -> bytes:
    """Return the first data on a connection, while collecting the command's output."""
    end = time.monotonic() + seconds
    connection.settimeout(0.02)
    while time.monotonic() < end and process.status is None:
        process.watch(0.0)
        with contextlib.suppress(TimeoutError):
            return connection.recv(1 << 16)
    return b""


def _answers(process: Command, port: int) -> bool:
    """Return True if the page is served."""
    end = time.monotonic() + 10.0
    while time.monotonic() < end and process.status is None:
        address = (_HOST, port)
        with contextlib.suppress(OSError), socket.create_connection(address, 2.0) as connection:
            connection.sendall(f"GET / HTTP/1.1\r\nHost: {_HOST}:{port}\r\n\r\n".encode())
            if _receive(process, connection).startswith(b"HTTP/1.1 200"):
                return True
        process.watch(0.1)
    return False


def _handshake(port: int, **headers: str) -> bytes:
    import viser

    lines = {
        "Host": f"{_HOST}:{port}", "Upgrade": "websocket", "Connection": "Upgrade",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}", **headers,
    }  # fmt: skip
    return (
        "GET / HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in lines.items()) + "\r\n"
    ).encode()


@contextlib.contextmanager
def _websocket(process: Command, port: int) -> Any:
    """Open a websocket; yield it and the HTTP status of the answer."""
    with socket.create_connection((_HOST, port), timeout=5.0) as connection:
        connection.sendall(_handshake(port))
        answer = _receive(process, connection, 10.0)
        found = re.match(rb"HTTP/1.1 (\d+)", answer)
        yield connection, int(found[1]) if found else 0


def _frame(opcode: int, payload: bytes, *, length: int | None = None, first: int = 0x80) -> bytes:
    """Return a masked websocket frame, with a declared length that may be wrong."""
    size = len(payload) if length is None else length
    if size < 126:
        head = bytes([first | opcode, 0x80 | size])
    elif size < 1 << 16:
        head = bytes([first | opcode, 0x80 | 126]) + size.to_bytes(2, "big")
    else:
        head = bytes([first | opcode, 0x80 | 127]) + size.to_bytes(8, "big")
    return head + bytes(4) + payload


# Attacks.


def _malformed_http(target: _Target) -> None:
    for _ in range(10):
        method = target.rng.choice((b"GET", b"POST", b"", b"\xff\xfe", b"G" * 70_000, b"GET\x00"))
        path = target.rng.choice((b"/", b"", b"/" * 9000, b"/%00", b"/%ff%fe", b"/\xc3\x28", b"*"))
        version = target.rng.choice((b"HTTP/1.1", b"HTTP/9", b"", b"HTTP/1.1 HTTP/1.1"))
        headers = target.rng.choice((
            b"", b"Host\r\n", b": x\r\n", b"A: " + b"x" * 100_000 + b"\r\n", b"A: b\r\n" * 5000,
            b"Content-Length: -1\r\n", b"Content-Length: 99999999999999\r\n", b"\x00: \x00\r\n",
            b"Transfer-Encoding: chunked\r\n", b"Host: a\r\nHost: b\r\n",
        ))  # fmt: skip
        target.send(method + b" " + path + b" " + version + b"\r\n" + headers + b"\r\n", 0.3)


def _random_bytes(target: _Target) -> None:
    for _ in range(15):
        target.send(target.rng.randbytes(target.rng.choice((1, 100, 100_000))), 0.1)


def _paths_outside(target: _Target) -> None:
    ups = (b"..", b"%2e%2e", b"..%2f..", b"....//", b"%252e%252e", b"..\\..")
    for up in ups:
        for prefix in (b"/", b"/assets/", b"//"):
            path = prefix + b"/".join([up] * 12) + b"/etc/passwd"
            answer = target.send(b"GET " + path + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", 0.5)
            if b"root:" in answer:
                raise Broken(f"GET {path.decode()} shows a file of the machine")


def _random_messages(target: _Target) -> None:
    for _ in range(5):
        with target.websocket() as (connection, _), contextlib.suppress(OSError):
            for _ in range(10):
                size = target.rng.choice((0, 1, 30, 3000, 100_000))
                connection.sendall(_frame(target.rng.choice((1, 2)), target.rng.randbytes(size)))
            _receive(target.process, connection, 0.3)


def _odd_messages(target: _Target) -> None:
    import msgspec

    types = ("GuiUpdateMessage", "ViewerCameraMessage", "ScenePointerMessage", "GuiCloseModal",
             "TransformControlsUpdateMessage", "FileTransferPart", "RunJavascriptMessage", "x")  # fmt: skip
    with target.websocket() as (connection, _), contextlib.suppress(OSError):
        for _ in range(40):
            value = target.rng.choice((None, -1, 1e308, float("nan"), "x" * 1000, [[]], {"a": {}}))
            names = (
                "uuid",
                "updates",
                "wxyz",
                "position",
                "fov",
                "source_component_uuid",
                "content",
            )
            message = {"type": target.rng.choice(types)} | dict.fromkeys(
                target.rng.sample(names, 4), value
            )
            sent = (
                message
                if target.rng.random() < 0.3
                else {"messages": [message], "timestampSec": 0.0}
            )
            connection.sendall(_frame(2, msgspec.msgpack.encode(sent)))
        _receive(target.process, connection, 0.3)


def _nested_message(target: _Target) -> None:
    for opening in (b"\x91", b"\x81\xa1a"):
        with target.websocket() as (connection, _), contextlib.suppress(OSError):
            connection.sendall(_frame(2, opening * 200_000))
            _receive(target.process, connection, 0.5)


def _giant_frames(target: _Target) -> None:
    for claimed in (60 << 20, 1 << 40, (1 << 63) - 1):
        with target.websocket() as (connection, _), contextlib.suppress(OSError):
            connection.sendall(_frame(2, b"", length=claimed))
            for _ in range(8):
                connection.sendall(bytes(1 << 20))
                target.process.watch(0.02)


def _many_fragments(target: _Target) -> None:
    with target.websocket() as (connection, _), contextlib.suppress(OSError):
        connection.sendall(_frame(2, b"x", first=0))
        for _ in range(2000):
            connection.sendall(_frame(0, b"x", first=0))
        target.process.watch(0.3)


def _wrong_frames(target: _Target) -> None:
    for data in (
        b"\x82\x05hello", _frame(15, b"x"), _frame(9, b"x" * 200), _frame(8, b"\x00"),
        _frame(1, b"\xff\xfe"), b"\xf2" + _frame(2, b"x")[1:], _frame(0, b"x"),
    ):  # fmt: skip
        with target.websocket() as (connection, _), contextlib.suppress(OSError):
            connection.sendall(data)
            _receive(target.process, connection, 0.3)


def _many_connections(target: _Target) -> None:
    with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
        for _ in range(150):
            connection = stack.enter_context(target.connect())
            # Half of them send a request and never read the response.
            if target.rng.random() < 0.5:
                connection.sendall(_handshake(target.port))
        target.process.watch(2.0)


def _reset_connections(target: _Target) -> None:
    for _ in range(40):
        with target.connect() as connection, contextlib.suppress(OSError):
            connection.sendall(_handshake(target.port)[: target.rng.randrange(1, 200)])
            linger = (1).to_bytes(4, "little") + (0).to_bytes(4, "little")
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)


_ATTACKS: tuple[Callable[[_Target], None], ...] = (
    _malformed_http, _random_bytes, _random_messages, _giant_frames, _paths_outside, _odd_messages,
    _nested_message, _many_fragments, _wrong_frames, _many_connections, _reset_connections,
)  # fmt: skip
