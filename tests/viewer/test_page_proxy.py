"""Requests that a page answers, and those that it rejects."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import socket
import threading
import time

import pytest

from mjlab.viewer.page_server import serve_page


@pytest.fixture(scope="module")
def page():
    """Page on a free port of this machine."""
    server = serve_page(port=18400)
    yield server
    server.stop()


def upgrade() -> dict[str, str]:
    import viser

    return {
        "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
    }  # fmt: skip


def request(path: str = "/", **headers: str) -> bytes:
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    return f"GET {path} HTTP/1.1\r\n{lines}\r\n".encode()


def answer(page, data: bytes, size: int = 4096) -> bytes:
    """Return the first bytes of the answer, or all if the connection ends."""
    address = ("127.0.0.1", page.get_port())
    with socket.create_connection(address, timeout=5.0) as connection:
        connection.sendall(data)
        received = b""
        while len(received) < size and (part := connection.recv(size)):
            received += part
            if received.startswith(b"HTTP/1.1 101"):
                break
    return received


def status(page, **headers: str) -> tuple[int, int]:
    """Return the status of a request, and of the same for a websocket."""
    answers = answer(page, request(**headers)), answer(page, request(**headers, **upgrade()))
    return int(answers[0].split()[1]), int(answers[1].split()[1])


@pytest.mark.parametrize("host", [
    "localhost", "LOCALHOST:8080", "127.0.0.1:8080", "[::1]:8080", "192.168.1.2", socket.gethostname(),
])  # fmt: skip
@pytest.mark.parametrize("origin", [None, "http", "https"])
def test_a_page_connects_to_its_own_server(page, host, origin):
    headers = {} if origin is None else {"Origin": f"{origin}://{host}"}
    assert status(page, Host=host, **headers) == (200, 101)


@pytest.mark.parametrize("origin", [
    "https://evil.example", "null", "", "http://localhost", "http://localhost:8081",
    "http://localhost:80800", "http://localhost:8080.evil.example", "http://localhost:8080/",
    "ws://localhost:8080", "http://127.0.0.1:8080", "http://localhost:8080 http://evil.example",
])  # fmt: skip
def test_pages_of_other_origins_are_rejected(page, origin):
    assert status(page, Host="localhost:8080", Origin=origin) == (403, 403)


@pytest.mark.parametrize("host", [
    "evil.example", "localhost.evil.example:8080", "127.0.0.1.evil.example", "x@localhost",
    "localhost:8080@evil.example", "localhost/", "", "[::1", "[evil]:80", "localhost:x", "1.2.3.4.5",
])  # fmt: skip
def test_names_that_resolve_to_this_machine_are_rejected(page, host):
    assert status(page, Host=host, Origin=f"http://{host}") == (403, 403)


def test_a_named_host_is_served(page):
    own = serve_page("localhost", port=18400)
    try:
        assert status(own, Host="localhost:9", Origin="http://localhost:9") == (200, 101)
    finally:
        own.stop()


def test_a_page_of_the_network_is_served_by_its_full_name(page, monkeypatch):
    name = "Robot.Lab.Example"
    monkeypatch.setattr(socket, "getfqdn", lambda: name)
    assert status(page, Host=name) == (403, 403)
    own = serve_page("0.0.0.0", port=18400)
    try:
        assert status(own, Host=f"{name}:8080", Origin=f"http://{name}:8080") == (200, 101)
    finally:
        own.stop()


@pytest.mark.parametrize("error", [OverflowError, UnicodeError, TypeError, MemoryError])
@pytest.mark.parametrize("name", ["start_server", "run"])
def test_errors_of_the_start_reach_the_caller(monkeypatch, error, name):
    def fail(*args, **kwargs):
        for argument in args:
            if asyncio.iscoroutine(argument):
                argument.close()
        raise error("odd")

    with monkeypatch.context() as patch, pytest.raises(error, match="odd"):
        patch.setattr(f"mjlab.viewer.page_proxy.asyncio.{name}", fail)
        serve_page(port=18400)


def test_a_share_address_is_not_handed_out(page, caplog):
    assert page.request_share_url() is None
    assert "ssh" in caplog.text


@pytest.mark.parametrize("twice", ["Host: localhost\r\nHost: evil\r\n", "Origin: null\r\n" * 2, ""])
def test_ambiguous_requests_are_rejected(page, twice):
    host = "" if twice.startswith("Host") or not twice else "Host: localhost\r\n"
    assert b" 403 " in answer(page, f"GET / HTTP/1.1\r\n{host}{twice}\r\n".encode())


def test_a_connection_carries_one_request(page):
    second = request(Host="evil.example", Origin="http://evil.example")
    everything = answer(page, request(Host="localhost") + second, size=10_000_000)
    assert everything.startswith(b"HTTP/1.1 200")
    assert everything.count(b"HTTP/1.1 ") == 1
    length = int(re.search(rb"Content-Length: (\d+)", everything)[1])
    assert len(everything.partition(b"\r\n\r\n")[2]) == length


@pytest.mark.parametrize("query", [
    "websocket=ws://evil.example", "a=b&%77ebsocket=", "playbackPath=http://evil.example/x.viser",
])  # fmt: skip
def test_links_to_another_source_show_the_page_itself(page, query):
    got = answer(page, request(f"/?{query}", Host="localhost"))
    assert got.startswith(b"HTTP/1.1 307")
    assert b"\r\nLocation: ?\r\n" in got


def test_a_rejection_says_the_cure(page):
    assert b"--host" in answer(page, request(Host="evil.example"))
    assert b"http://localhost:1" in answer(
        page, request(Host="localhost:1", Origin="http://localhost:2")
    )


@pytest.fixture
def sticks(page):
    """Positions of a gamepad that the page took."""
    taken: list = []
    page.on_gamepad = taken.append
    yield taken
    page.on_gamepad = None


def test_the_page_of_a_gamepad_shows_the_viewer_in_a_frame(page, sticks):
    got = answer(page, request("/gamepad", Host="localhost"), size=10_000)
    assert got.startswith(b"HTTP/1.1 200")
    assert b"\r\nContent-Type: text/html" in got
    assert b'<iframe src="/"' in got
    assert sticks == []


def test_positions_of_sticks_are_passed_on(page, sticks):
    fetch = {"Host": "localhost", "Sec-Fetch-Site": "same-origin"}
    for query in ("forward=1&left=0&turn=-0.25", "forward=0&left=0&turn=0"):
        assert b" 200 " in answer(page, request(f"/gamepad?{query}", **fetch))
    assert sticks == [(1.0, 0.0, -0.25), (0.0, 0.0, 0.0)]


@pytest.mark.parametrize("query", [
    "forward=2&left=0&turn=0", "forward=nan&left=0&turn=0", "forward=1&left=0", "forward=&left=0&turn=x",
])  # fmt: skip
def test_positions_beyond_the_sticks_are_rejected(page, sticks, query):
    assert b" 400 " in answer(page, request(f"/gamepad?{query}", Host="localhost"))
    assert sticks == []


@pytest.mark.parametrize("site", ["cross-site", "same-site", "none"])
def test_images_of_other_sites_cannot_steer(page, sticks, site):
    headers = {"Host": "localhost", "Sec-Fetch-Site": site}
    assert b" 403 " in answer(page, request("/gamepad?forward=1&left=0&turn=0", **headers))
    assert sticks == []


def test_without_steering_there_is_no_gamepad(page):
    assert b" 404 " in answer(page, request("/gamepad", Host="localhost"))


def test_malformed_clients_are_quiet(page, capfd, caplog):
    for data in (b"", b"\0", os.urandom(3000), b"A" * 200_000, b"GET / HTTP/1.1\r\n", b"\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", page.get_port())) as connection:
            connection.sendall(data)
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_WR)
                connection.recv(100)
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


def test_a_malformed_message_logs_one_line(page, caplog):
    frame = bytes([0x82, 0x80 | 100]) + bytes(4) + b"\xc1" * 100
    with socket.create_connection(("127.0.0.1", page.get_port()), timeout=5.0) as connection:
        connection.sendall(request(Host="localhost", **upgrade()) + frame)
        end = time.monotonic() + 5.0
        while not caplog.records and time.monotonic() < end:
            time.sleep(0.01)
    (record,) = caplog.records
    assert record.exc_info is None
    assert "\n" not in record.getMessage()


def test_viser_listens_to_this_machine_only():
    """Also if the page is served to the network."""
    before = listening()
    page = serve_page("0.0.0.0", port=18400)
    try:
        new = listening() - before
        outer = [address for address in new if address[0] == "0.0.0.0"]
        assert outer == [("0.0.0.0", page.get_port())]
        (inner,) = new - set(outer)
        assert inner[0].startswith("127.")
    finally:
        page.stop()


def test_a_stopped_page_leaves_nothing(capfd, caplog):
    before, threads = listening(), set(threading.enumerate())
    page = serve_page(port=18400)
    port = page.get_port()
    with socket.create_connection(("127.0.0.1", port), timeout=5.0) as connection:
        connection.sendall(request(Host="localhost", **upgrade()))
        assert b" 101 " in connection.recv(100)
        page.stop()
    page.stop()
    assert "Traceback" not in capfd.readouterr().err
    assert not caplog.records
    assert listening() == before
    assert not [thread for thread in set(threading.enumerate()) - threads if thread.is_alive()]
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))


def listening() -> set[tuple[str, int]]:
    """Return the addresses at which this process listens."""
    psutil = pytest.importorskip("psutil")
    found = psutil.Process().net_connections("tcp")
    return {(c.laddr.ip, c.laddr.port) for c in found if c.status == psutil.CONN_LISTEN}
