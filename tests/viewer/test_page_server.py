"""Addresses of pages."""

from __future__ import annotations

import socket

import pytest

from mjlab.viewer.page_server import check_address, page_url, serve_page


@pytest.mark.parametrize("host", ["300.1.2.3", "203.0.113.7", "2001:db8::7", "", "a b"])
def test_an_address_of_another_machine_is_rejected(host):
    with pytest.raises(ValueError, match="--host") as caught:
        check_address(host, 8080, "--")
    assert repr(host) in str(caught.value)
    assert "127.0.0.1" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_an_invalid_port_is_rejected(port):
    with pytest.raises(ValueError, match=f"--live-port.*{port}"):
        check_address("127.0.0.1", port, "--live-")


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "127.1"])
def test_addresses_of_this_machine_are_taken(host):
    check_address(host, 8080)


def test_a_page_is_served_to_this_machine_only_beside_a_port_that_is_taken():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        server = serve_page(port=port)
        try:
            assert server.get_host() == "127.0.0.1"
            assert server.get_port() > port
            assert page_url(server) == f"http://localhost:{server.get_port()}"
        finally:
            server.stop()
