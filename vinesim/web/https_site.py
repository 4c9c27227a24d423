"""A listener for https. It answers plain http on the same port with a sentence, instead of dropping the connection."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import socket
import ssl

from aiohttp import web

log = logging.getLogger(__name__)

_HANDSHAKE = b"\x16"
"""First byte of every TLS connection (RFC 8446, section 5.1)."""
_FIRST_BYTE = 10.0
"""[s] Time in which a connection must send its first byte."""
_REQUEST = 2.0
"""[s] Time in which a plain request must be read and answered."""
_POLL = 0.01
"""[s] Period of polling for the first byte."""
_MAX_OPENING = 256
"""Largest number of connections that have not sent their first byte; further ones are closed."""


class HttpsSite:
    """Accepts connections and passes TLS connections on to an aiohttp server."""

    def __init__(self, server: web.Server, tls: ssl.SSLContext, sentence: str) -> None:
        """``sentence``: the answer to plain http."""
        self._server = server
        self._tls = tls
        self._sentence = sentence
        self._listener: socket.socket | None = None
        self._accepting: asyncio.Task[None] | None = None
        self._opening: set[asyncio.Task[None]] = set()

    def listen(self, host: str, port: int) -> int:
        """Start listening. Returns the port. Raises OSError if it is taken."""
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self._accepting = asyncio.ensure_future(self._accept(self._listener))
        return int(self._listener.getsockname()[1])

    async def close(self) -> None:
        """Stop accepting connections."""
        tasks = [*self._opening, *([self._accepting] if self._accepting else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._listener is not None:
            self._listener.close()

    async def _accept(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(listener)
            except OSError as failure:  # the peer has closed the connection already, or too many files are open
                if failure.errno in (errno.EMFILE, errno.ENFILE):
                    log.warning("a page cannot connect: %s", os.strerror(failure.errno))
                await asyncio.sleep(0.1)
                continue
            if len(self._opening) >= _MAX_OPENING:
                connection.close()
                continue
            task = asyncio.ensure_future(self._open(connection))
            self._opening.add(task)
            task.add_done_callback(self._opening.discard)

    async def _open(self, connection: socket.socket) -> None:
        """Serve one connection until it is passed on or answered."""
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        loop = asyncio.get_running_loop()
        try:
            if await asyncio.wait_for(_peek(connection), _FIRST_BYTE) == _HANDSHAKE:
                await loop.connect_accepted_socket(self._server, connection, ssl=self._tls)
                return
            await asyncio.wait_for(self._answer(connection), _REQUEST)
        except (OSError, TimeoutError):  # no first byte, or no valid handshake
            pass
        except asyncio.CancelledError:
            connection.close()
            raise
        connection.close()

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


async def _peek(connection: socket.socket) -> bytes:
    """Wait for the first byte without consuming it. Returns an empty string if the peer has closed."""
    while True:  # polling, because not every event loop can wait for this
        with contextlib.suppress(BlockingIOError):
            return connection.recv(1, socket.MSG_PEEK)
        await asyncio.sleep(_POLL)
