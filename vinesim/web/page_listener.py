"""The listener of the page: it accepts connections, limits them, and passes them on to an aiohttp server.

Anyone who reaches the port can connect, and only requests with the page's secret are served. So a connection counts as
a stranger's until it has sent such a request. Strangers' connections are limited in number, in all and for each
address; when a limit is reached, the one that has waited longest is closed. So connections that send nothing, or half a
request, make room for those of people with the secret, also if both come from one address. A connection that waits for
its next request is closed after a time, too.

With https, plain http on the same port is answered with a sentence, instead of dropping the connection.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import dataclasses
import errno
import logging
import os
import socket
import ssl
from collections.abc import Iterator

from aiohttp import web

log = logging.getLogger(__name__)

REQUEST_TIMEOUT = 10.0
"""[s] Time in which a connection must send its first whole request, with https after a handshake that takes at most as
long."""
IDLE_TIMEOUT = 60.0
"""[s] Time after which a connection without a request is closed."""
RESPONSE_TIMEOUT = 300.0
"""[s] Time in which a browser must have received a response: 30 MB at 1 Mbit/s."""
MAX_STRANGERS = 256
"""Largest number of connections that have not sent a request with the page's secret."""
MAX_STRANGERS_OF_ADDRESS = 128
"""Largest number of such connections from one address."""
MAX_CONNECTIONS = 512
"""Largest number of all connections; a page has up to eight."""
_SHARE_OF_FILES = 0.5
"""Largest share [1] of the files that this process may open that :data:`MAX_CONNECTIONS` may use."""
_HANDSHAKE = b"\x16"
"""First byte of every TLS connection (RFC 8446, section 5.1)."""
_ANSWER_TIMEOUT = 2.0
"""[s] Time in which a plain request to an https page must be read and answered."""
_PERIOD = 0.5
"""[s] Time between two checks for connections that are over time."""
_POLL = 0.05
"""[s] Period of polling for the first byte, in event loops that cannot wait for it."""


@dataclasses.dataclass(eq=False)
class _Connection:
    """One connection from its acceptance to its end."""

    address: str
    """Address of the other machine."""
    since: float
    """Time of the event loop at which the connection was accepted, or at which its last request ended [s]."""
    socket: socket.socket | None
    """The socket, until it is passed on to the event loop with :attr:`protocol`."""
    opening: asyncio.Task[None] | None = None
    """Task that passes the connection on to aiohttp; None after that."""
    protocol: web.RequestHandler | None = None
    """The aiohttp side of the connection; None before the connection is passed on."""
    is_known: bool = False
    """Whether a request had the page's secret."""
    requests: int = 0
    """Number of requests that are being served."""

    @property
    def transport(self) -> asyncio.Transport | None:
        return None if self.protocol is None else self.protocol.transport

    @property
    def is_over(self) -> bool:
        return self.opening is None and self.transport is None

    def close(self) -> None:
        """Close the connection at once."""
        if (transport := self.transport) is not None:
            transport.abort()
        if self.opening is not None:
            self.opening.cancel()

    def opened(self) -> None:
        """The task of :attr:`opening` has ended: close the socket if it has not been passed on."""
        self.opening = None
        if self.socket is not None:
            self.socket.close()
            self.socket = None

    def limit(self) -> float:
        """Returns the time after :attr:`since` at which the connection must be closed [s]."""
        if self.requests:
            return float("inf")
        if (transport := self.transport) is not None and transport.get_write_buffer_size():
            return RESPONSE_TIMEOUT
        return IDLE_TIMEOUT if self.is_known else REQUEST_TIMEOUT


class PageListener:
    """Accepts connections for an aiohttp server, by http or https, within the limits of this module."""

    def __init__(self, server: web.Server, tls: ssl.SSLContext | None, sentence: str) -> None:
        """``tls``: serve by https; None: by http. ``sentence``: the answer to plain http on an https port."""
        self._server = server
        self._tls = tls
        self._sentence = sentence
        self._listener: socket.socket | None = None
        self._tasks: tuple[asyncio.Task[None], ...] = ()
        self._connections: set[_Connection] = set()
        self._by_protocol: dict[object, _Connection] = {}
        self._most = _room()
        self._was_full = False

    def listen(self, host: str, port: int) -> int:
        """Start listening. Returns the port. Raises OSError if it is taken."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family, backlog=MAX_CONNECTIONS)
        self._listener.setblocking(False)
        self._tasks = asyncio.ensure_future(self._accept(self._listener)), asyncio.ensure_future(self._watch())
        return int(self._listener.getsockname()[1])

    async def close(self) -> None:
        """Stop accepting connections, and close those that have not been passed on to aiohttp."""
        tasks = [*self._tasks, *(one.opening for one in self._connections if one.opening is not None)]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._listener is not None:
            self._listener.close()

    @contextlib.contextmanager
    def serving(self, request: web.BaseRequest) -> Iterator[None]:
        """The request is served in this context; meanwhile its connection has no time limit. Raises ConnectionError if
        the connection has ended."""
        if (connection := self._by_protocol.get(request.protocol)) is None:
            raise ConnectionResetError
        connection.requests += 1
        try:
            yield
        finally:
            connection.requests -= 1
            connection.since = asyncio.get_running_loop().time()

    def know(self, request: web.BaseRequest) -> None:
        """Count the connection of a request no longer as a stranger's: the request had the secret of the page."""
        if (connection := self._by_protocol.get(request.protocol)) is not None:
            connection.is_known = True

    async def _accept(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, address = await loop.sock_accept(listener)
            except OSError as failure:  # the peer has closed the connection already, or too many files are open
                if failure.errno in (errno.EMFILE, errno.ENFILE):
                    log.warning("a page cannot connect: %s", os.strerror(failure.errno))
                await asyncio.sleep(0.1)
                continue
            if self._make_room(str(address[0])):
                one = _Connection(str(address[0]), loop.time(), connection)
                one.opening = asyncio.ensure_future(self._open(one))
                one.opening.add_done_callback(lambda _, one=one: one.opened())
                self._connections.add(one)
            else:
                connection.close()
            await asyncio.sleep(0)  # accepting takes no time if connections wait already: let others be served, too

    def _make_room(self, address: str) -> bool:
        """Close the strangers' connections that a new one from ``address`` replaces. Returns whether there is room for
        it."""
        self._forget()
        strangers = [one for one in self._connections if not one.is_known]
        of_address = [one for one in strangers if one.address == address]
        most = min(MAX_STRANGERS, self._most // 2)
        if len(of_address) >= min(MAX_STRANGERS_OF_ADDRESS, most):
            replaced = of_address
        elif len(strangers) >= most or (strangers and len(self._connections) >= self._most):
            counts = collections.Counter(one.address for one in strangers)
            loudest = max(counts, key=lambda each: counts[each])
            replaced = [one for one in strangers if one.address == loudest]
        else:
            return len(self._connections) < self._most
        oldest = min(replaced, key=lambda one: one.since)
        if not self._was_full:
            self._was_full = True
            log.warning(
                "%d connections to the page, most from %s, sent no request with its secret: the oldest are closed "
                "(said once)",
                len(strangers),
                oldest.address,
            )
        oldest.close()
        self._connections.discard(oldest)
        return True

    def _forget(self) -> None:
        """Remove the connections that have ended."""
        for one in [one for one in self._connections if one.is_over]:
            self._connections.discard(one)
        self._by_protocol = {key: one for key, one in self._by_protocol.items() if not one.is_over}

    async def _watch(self) -> None:
        """Close connections that are over time."""
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(_PERIOD)
            self._forget()
            now = loop.time()
            for one in self._connections:
                if one.opening is None and now > one.since + one.limit():
                    one.close()

    async def _open(self, one: _Connection) -> None:
        """Serve one connection until it is passed on or answered."""
        loop = asyncio.get_running_loop()
        connection = one.socket
        assert connection is not None
        with contextlib.suppress(OSError, TimeoutError):  # no first byte, or no valid handshake
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._tls is not None and await asyncio.wait_for(_peek(connection), REQUEST_TIMEOUT) != _HANDSHAKE:
                await asyncio.wait_for(self._answer(connection), _ANSWER_TIMEOUT)
                return
            one.protocol = protocol = self._server()
            one.socket = None
            self._by_protocol[protocol] = one
            limit = None if self._tls is None else REQUEST_TIMEOUT
            await loop.connect_accepted_socket(lambda: protocol, connection, ssl=self._tls, ssl_handshake_timeout=limit)
            one.since = loop.time()

    async def _answer(self, connection: socket.socket) -> None:
        """Answer a plain request. It must be read first, or closing the connection would discard the answer."""
        loop = asyncio.get_running_loop()
        body = f"{self._sentence}\n".encode()
        await loop.sock_recv(connection, 1 << 16)
        head = (
            "HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain; charset=utf-8\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        )
        await loop.sock_sendall(connection, head.encode() + body)
        connection.shutdown(socket.SHUT_WR)
        with contextlib.suppress(OSError):
            await loop.sock_recv(connection, 1 << 16)


def _room() -> int:
    """Returns the largest number of connections: a part of the files that this process may open."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return MAX_CONNECTIONS
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MAX_CONNECTIONS if most == resource.RLIM_INFINITY else min(MAX_CONNECTIONS, int(_SHARE_OF_FILES * most))


async def _peek(connection: socket.socket) -> bytes:
    """Wait for the first byte without consuming it. Returns an empty string if the peer has closed."""
    loop = asyncio.get_running_loop()
    while True:
        with contextlib.suppress(BlockingIOError):
            return connection.recv(1, socket.MSG_PEEK)
        came = loop.create_future()
        try:
            loop.add_reader(connection, came.set_result, None)
        except NotImplementedError:  # the event loop of Windows
            await asyncio.sleep(_POLL)
            continue
        try:
            await came
        finally:
            loop.remove_reader(connection)
