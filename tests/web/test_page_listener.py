"""Connections to a page, by real sockets: those that send nothing, or half a request, end and keep nobody out."""

import contextlib
import socket
import ssl
import time
import urllib.request

import pytest

from tests.support.waiting import deadline, wait
from tests.web.test_page_server import CountingWorld
from vinesim.client.page import page_access
from vinesim.web import page_listener
from vinesim.web.page_server import PageServer

HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-A: "
ATTACK = 1004
"""Number of connections of an attacker: nearly all that a process with 1,024 files can have."""


@pytest.fixture(params=["http", "https"])
def reached(request, tmp_path, monkeypatch):
    """A page's server, and a function that makes a connection to it from an address."""
    options = {}
    trusting = None
    if request.param == "https":
        monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))
        monkeypatch.setattr(page_access, "own_address", lambda: "127.0.0.1")
        access = page_access.network_access()
        trusting = ssl.create_default_context(cafile=tmp_path / "page-certificate" / "ca.pem")
        options = {"tls": access.tls, "token": access.token}
    with PageServer(CountingWorld(), **options) as server:

        def connect(source="127.0.0.1", sent=HALF):
            plain = socket.create_connection(("127.0.0.1", server.port), deadline(10.0), (source, 0))
            if trusting is None:
                plain.sendall(sent)
                return plain
            secured = trusting.wrap_socket(plain, server_hostname="127.0.0.1")
            secured.sendall(sent)
            return secured

        def load(path="scene"):
            with urllib.request.urlopen(server.address + path, timeout=deadline(10.0), context=trusting) as answer:
                return answer.read()

        yield server, connect, load


def is_open(connection):
    """Whether the other end has not closed a connection on which nothing was sent to this end."""
    connection.settimeout(0.0)
    try:
        return connection.recv(1) != b""
    except (BlockingIOError, ssl.SSLWantReadError):
        return True
    except OSError:
        return False


@pytest.mark.parametrize("sent", [HALF, b""], ids=["half a request", "nothing"])
def test_connections_that_send_no_request_lock_out_nobody(reached, sent):
    """1,004 of them from one address, the same as that of the browser; at most 128 are kept."""
    _, connect, load = reached
    with contextlib.ExitStack() as stack:
        attack = []
        for _ in range(ATTACK):
            with contextlib.suppress(OSError):
                attack.append(stack.enter_context(connect(sent=sent)))
            if len(attack) == ATTACK // 2:
                assert load() == b"scene"
        assert load() == b"scene"
        assert load("main.js")
        wait(
            lambda: sum(map(is_open, attack)) <= page_listener.MAX_STRANGERS_OF_ADDRESS,
            "no more than the limit are kept",
        )
        assert sum(map(is_open, attack)) > 1, "others may connect, too"


def test_many_addresses_share_the_places_of_strangers_evenly(reached, monkeypatch):
    monkeypatch.setattr(page_listener, "REQUEST_TIMEOUT", 600.0)  # on a slow machine the attack may take longer
    _, connect, load = reached
    with contextlib.ExitStack() as stack:
        quiet = [stack.enter_context(connect("127.0.0.99")) for _ in range(10)]
        attack = []
        for number in range(4):
            for _ in range(page_listener.MAX_STRANGERS_OF_ADDRESS):
                with contextlib.suppress(OSError):
                    attack.append(stack.enter_context(connect(f"127.0.0.{2 + number}")))
        assert load() == b"scene"
        wait(
            lambda: sum(map(is_open, [*quiet, *attack])) <= page_listener.MAX_STRANGERS,
            "no more than the limit are kept",
        )
        assert all(map(is_open, quiet)), "the loudest addresses make room"


@pytest.mark.parametrize("sent", [HALF, b"", b"trickle"], ids=["half a request", "nothing", "a letter at a time"])
def test_a_request_must_come_in_time(reached, sent, monkeypatch):
    """Also if a few bytes come now and then."""
    monkeypatch.setattr(page_listener, "REQUEST_TIMEOUT", 0.5)
    _, connect, load = reached
    with connect(sent=HALF if sent == b"trickle" else sent) as connection:
        start = time.monotonic()

        def is_closed():
            if sent == b"trickle":
                with contextlib.suppress(OSError):
                    connection.settimeout(1.0)
                    connection.sendall(b"a")
            return not is_open(connection)

        wait(is_closed, "the connection is closed")
        assert time.monotonic() - start > 0.4, "not before its time"
    assert load() == b"scene"


def test_a_connection_without_a_next_request_is_closed_and_one_with_a_socket_is_not(reached, monkeypatch):
    monkeypatch.setattr(page_listener, "IDLE_TIMEOUT", 1.0)
    monkeypatch.setattr(page_listener, "REQUEST_TIMEOUT", 1.0)
    server, connect, _ = reached
    path = "/" + server.address.split("/", 3)[3]
    head = f"GET {path}%s HTTP/1.1\r\nHost: 127.0.0.1\r\n%s\r\n"
    upgrade = (
        "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    )
    with (
        connect(sent=(head % ("state", upgrade)).encode()) as page,
        connect(sent=(head % ("rigid", "")).encode()) as idle,
    ):
        for connection, status in ((page, b"101"), (idle, b"200")):
            assert connection.recv(4096).split()[1] == status
        half = time.monotonic()
        idle.sendall(HALF)

        def is_closed():
            with contextlib.suppress(BlockingIOError, ssl.SSLWantReadError):
                idle.settimeout(0.0)
                try:
                    return idle.recv(4096) == b""
                except ConnectionError:
                    return True
            return False

        wait(is_closed, "the connection without a whole next request is closed")
        assert time.monotonic() - half > 0.8
        assert server.has_viewers, "a page is connected as long as it wants"
        assert is_open(page)
