"""Server of a page behind a proxy that checks who connects."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import ipaddress
import logging
import re
import secrets
import socket
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Future
from typing import Any
from urllib.parse import parse_qs

import rich
import viser
from websockets.http11 import Request, Response
from websockets.server import ServerProtocol

from mjlab.viewer import gamepad

log = logging.getLogger(__name__)

# Seconds for a request to arrive.
_PATIENCE = 10.0
_MAX_PORTS = 1000
# A `Host` header: an IPv6 address in brackets, or a name or IPv4 address; then perhaps a port.
_HOST = re.compile(r"(?:\[([\da-f:.]+)\]|([\w.-]+))(?::\d{1,5})?", re.ASCII)
# Parameters by which a link makes viser's page connect to, or load from, another server.
_OTHER_SOURCES = {"websocket", "playbackPath"}


class PageServer(viser.ViserServer):
    """Viser server to which other web sites in the same browser cannot connect.

    Viser checks neither `Host` nor `Origin` of a request and has no hook for it. Here a proxy
    listens at `host` and `port`, or the next free port, reads the request with which a connection
    begins, and passes the connection on to viser if the request comes from the page itself. Viser
    listens at a random loopback address and port, which web sites cannot guess.
    """

    def __init__(self, host: str, port: int, names: set[str]) -> None:
        """Start serving; browsers may also use the page by these `names`, in lower case."""
        # Viser would print its own address.
        with _quiet_console():
            super().__init__(_random_loopback_address(), 0, verbose=False)
        self._viser_address = super().get_host(), super().get_port()
        self._page_address = host, port
        own = socket.gethostname().lower()
        self._names = {"localhost", own, f"{own}.local", *names}
        self.on_gamepad: Callable[[tuple[float, float, float]], Any] | None = None
        """Called with the position of a gamepad's sticks (forward, left, turn left), each in [-1, 1], in
        the proxy's thread. None: the page has no gamepad."""
        self._has_warned = False
        self._reported: set[str] = set()
        self._connections: set[asyncio.Task | None] = set()
        logging.getLogger("websockets.server").addFilter(_shorten)
        started: Future[int] = Future()
        self._proxy = threading.Thread(target=self._run, args=(started,), daemon=True)
        self._proxy.start()
        try:
            self._page_address = host, started.result()
        except Exception:
            super().stop()
            raise

    def get_host(self) -> str:
        """Return the address of the page."""
        return self._page_address[0]

    def get_port(self) -> int:
        """Return the port of the page."""
        return self._page_address[1]

    def stop(self) -> None:
        """Stop serving the page."""
        # The loop is closed if the server was stopped before.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._stopping.set)
        self._proxy.join(timeout=1.0)
        with _quiet_console():
            super().stop()

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Return None: viser's tunnel passes by the proxy, and does not find viser's address."""
        log.warning("The page cannot be shared by viser's tunnel; use `ssh -L` or --host instead.")
        return None

    def _run(self, started: Future[int]) -> None:
        """Serve until `stop`. The port, or the error of the start, is the result of `started`."""
        try:
            asyncio.run(self._listen(started))
        except Exception as error:
            if started.done():
                raise
            started.set_exception(error)

    async def _listen(self, started: Future[int]) -> None:
        """Serve connections at the wanted port, or the next free one, until `stop`."""
        self._loop, self._stopping = asyncio.get_running_loop(), asyncio.Event()
        self._loop.set_exception_handler(self._report)
        host, port = self._page_address
        last = min(port + _MAX_PORTS, 65535)
        while True:
            try:
                listener = await asyncio.start_server(self._serve, host, port)
                break
            except OSError as error:
                if error.errno != errno.EADDRINUSE or port == last:
                    raise
                port += 1
        started.set_result(port)
        await self._stopping.wait()
        listener.close()

    def _report(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log an error of the loop once; a lack of open files comes with each try to accept."""
        text = f"{context['message']} ({context.get('exception')})"
        if text not in self._reported:
            self._reported.add(text)
            log.warning("Page: %s.", text)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Check the request with which a connection begins, and pass the connection on.

        Viser answers one request per connection, so that none follows unchecked.
        """
        with contextlib.ExitStack() as stack:
            # Ended by the other side, too much before the end of the request, or stopped.
            expected = (OSError, EOFError, asyncio.LimitOverrunError, asyncio.CancelledError)
            stack.enter_context(contextlib.suppress(*expected))
            stack.callback(writer.close)
            # The loop keeps weak references only.
            self._connections.add(task := asyncio.current_task())
            stack.callback(self._connections.discard, task)
            async with asyncio.timeout(_PATIENCE):
                head = await reader.readuntil(b"\r\n\r\n")
            # The parser with which viser reads the request, too.
            parser = ServerProtocol()
            parser.receive_data(head)
            request = next(iter(parser.events_received()), None)
            if not isinstance(request, Request):
                answer = parser.reject(400, "Expected a GET request of HTTP/1.1.\n")
                return writer.write(answer.serialize())
            answer = self._answer(request, parser)
            if answer is not None:
                return writer.write(answer.serialize())
            from_viser, to_viser = await asyncio.open_connection(*self._viser_address)
            stack.callback(to_viser.close)
            to_viser.write(head)
            if "Upgrade" in request.headers:
                await asyncio.gather(_copy(reader, to_viser), _copy(from_viser, writer))
            else:
                await _copy(from_viser, writer)

    def _answer(self, request: Request, parser: ServerProtocol) -> Response | None:
        """Return the answer to a request, or None if viser answers."""
        reason = _reason_to_reject(request, self._names)
        if reason is not None:
            if not self._has_warned:
                log.warning("The page rejected a connection. %s", reason)
            self._has_warned = True
            return parser.reject(403, f"{reason}\n")
        if _OTHER_SOURCES & parse_qs(request.path.partition("?")[2], True).keys():
            answer = parser.reject(307, "")
            answer.headers["Location"] = "?"
            return answer
        path, _, query = request.path.partition("?")
        return self._answer_gamepad(query, request, parser) if path == gamepad.PATH else None

    def _answer_gamepad(self, query: str, request: Request, parser: ServerProtocol) -> Response:
        """Return the page that reads a gamepad, or pass on the position of its sticks."""
        if self.on_gamepad is None:
            return parser.reject(404, "Nothing here can be steered by a gamepad.\n")
        if not query:
            answer = parser.reject(200, gamepad.PAGE)
            del answer.headers["Content-Type"]
            answer.headers["Content-Type"] = "text/html; charset=utf-8"
            return answer
        # An image of another web site is requested without `Origin`, but browsers mark it.
        if request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            return parser.reject(403, "Expected a request of the page itself.\n")
        try:
            self.on_gamepad(gamepad.stick_position(query))
        except ValueError as error:
            return parser.reject(400, f"{error}\n")
        return parser.reject(200, "")


def _shorten(record: logging.LogRecord) -> bool:
    """Reduce the error of a malformed message, logged by viser's websockets, to one line."""
    if record.exc_info and record.msg != "opening handshake failed":
        record.msg = f"The page closed a connection: {ascii(record.exc_info[1])[:200]}"
        record.exc_info = None
    return True


def _reason_to_reject(request: Request, names: set[str]) -> str | None:
    """Return the reason why a request does not come from the page itself.

    `Host` is another if a web site's name was made to resolve to this machine (DNS rebinding),
    `Origin` if a page of a web site sends the request. Programs send no `Origin`.
    """
    hosts = [host.lower() for host in request.headers.get_all("Host")]
    origins = [origin.lower() for origin in request.headers.get_all("Origin")]
    found = _HOST.fullmatch(hosts[0]) if len(hosts) == 1 else None
    name = found and (found[1] or found[2])
    if name is None or not (name in names or _is_ip_address(name)):
        return (
            f"Host: expected localhost, an IP address or the page's name, got {_shown(hosts)}; "
            "use one of these, or start the page with --host NAME."
        )
    if origins not in ([], [f"http://{hosts[0]}"], [f"https://{hosts[0]}"]):
        return f"Origin: expected http://{hosts[0]}, got {_shown(origins)}; open that address."
    return None


def _shown(values: list[str]) -> str:
    return ascii(", ".join(values)[:100])


def _is_ip_address(name: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    """Copy a stream up to its end, then close the target."""
    with contextlib.suppress(OSError):
        while data := await source.read(1 << 18):
            target.write(data)
            await target.drain()
    target.close()


@contextlib.contextmanager
def _quiet_console() -> Generator[None]:
    """Leave out what viser prints within the block."""
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = quiet


def _random_loopback_address() -> str:
    """Return a random address of 127.0.0.0/8, or 127.0.0.1 where the system has no other."""
    address = (
        f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(256)}.{secrets.randbelow(254) + 1}"
    )
    with contextlib.suppress(OSError), socket.socket() as probe:
        probe.bind((address, 0))
        return address
    return "127.0.0.1"
