"""Serves the page and, on a web socket, the world: an HTTP server with an event loop in its own thread.

At most :data:`WINDOW` states that the page has not drawn yet are on their way to it. Then the server waits, and the
next state that it sends is the newest one. So after a stall of any duration a page is at most :data:`WINDOW` states
late.
"""

from __future__ import annotations

import asyncio
import collections
import hmac
import logging
import ssl
import threading
from collections.abc import Callable
from typing import Any, Protocol, Self

import numpy as np
from aiohttp import WSMsgType, web

from vinesim.core.errors import UsageError
from vinesim.web import page_files
from vinesim.web.https_site import HttpsSite
from vinesim.web.page_files import PAGE
from vinesim.web.page_input import PageInput, decode_input, decode_place
from vinesim.web.voice_socket import Sound, VoiceSocket

log = logging.getLogger(__name__)

WINDOW = 2
"""Largest number of states that were sent to one page and that it has not drawn yet. Without a limit a page on a busy
machine was 0.4 to 1 s late."""
_MAX_INPUT = 8192
"""Longest message of a page [B]."""
_NEEDS_HTTPS = "this page needs https: open the address that the client has printed, with https:// and its token"
"""Answer to requests by plain http."""
_THIS_MACHINE = ("localhost", "127.0.0.1", "::1")
_POLICY = "; ".join(
    (
        "default-src 'self'",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data:",
        "media-src 'self' blob:",
        "worker-src 'self' blob:",
        "object-src 'none'",
        "base-uri 'none'",
    )
)
"""Content Security Policy: the page can load nothing from other hosts, whatever its scripts request."""


class World(Protocol):
    """Interface of an object that provides the world to pages (connected browser tabs) and takes their input. All
    methods are called in the server's thread.

    Messages are encoded by :mod:`vinesim.web.array_message`.
    """

    def scene(self) -> bytes:
        """Returns a message with everything that does not change while a page is open, such as ground, textures and
        light."""
        ...

    def plants(self, place: np.ndarray) -> bytes:
        """Returns a message with the plants around ``place`` [3] m, for a vineyard that is too large to be loaded as a
        whole."""
        ...

    def rigid(self) -> bytes:
        """Returns a message with the shapes of the present rigid bodies."""
        ...

    def state(self, since: int, page: int) -> tuple[int, bytes] | None:
        """Returns the tick of the newest state, and a message with everything that has moved after tick ``since``; None
        without changes. ``page``: number of the page that receives it."""
        ...

    def take(self, page: int, said: PageInput) -> None:
        """Apply a message of a page. ``page``: number of the page, counted from 0; ``said``: content of the message."""
        ...

    def leave(self, page: int) -> None:
        """Called when the page with this number has disconnected."""
        ...


class PageServer:
    """A context manager that serves the page until it is left."""

    def __init__(
        self,
        world: World,
        port: int = 0,
        host: str = "127.0.0.1",
        *,
        tls: ssl.SSLContext | None = None,
        token: str | None = None,
        sound: Sound | None = None,
    ) -> None:
        """Start the server of a world.

        Args:
            world: the world to show.
            port: port to listen on; 0: any free port.
            host: address to listen on.
            tls: serve by https with this context.
            token: secret that browsers must have in the address; None: no secret is needed.
            sound: sound from and to pages; None: no sound.

        Raises :class:`UsageError` if files of the page are missing or the port is taken.
        """
        page_files.check()
        self._world = world
        self._host = host
        self._asked = port
        self._tls = tls
        self._token = token
        self.voice = None if sound is None else VoiceSocket(sound)
        """The web socket for sound."""
        self.port = 0
        self._pages = 0
        self.states_sent = 0
        self.refused = 0
        """Number of invalid messages of pages."""
        self._loop = asyncio.new_event_loop()
        self._fresh: set[asyncio.Event] = set()
        self._stopping: asyncio.Event | None = None
        self._started = threading.Event()
        self._failure: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="page server", daemon=True)

    @property
    def address(self) -> str:
        """Address of the page for a browser."""
        scheme = "http" if self._tls is None else "https"
        token = "" if self._token is None else f"?token={self._token}"
        return f"{scheme}://{self._host}:{self.port}/{token}"

    @property
    def has_viewers(self) -> bool:
        """Whether any page is connected."""
        return bool(self._fresh)

    @property
    def refused_messages(self) -> int:
        """Number of refused messages and sound frames of pages: invalid ones, or too many."""
        return self.refused + (0 if self.voice is None else self.voice.refused)

    def notify(self) -> None:
        """Announce a new state. Called in the loop of the client; does not wait."""
        if self._fresh:
            self._loop.call_soon_threadsafe(self._wake)

    def __enter__(self) -> Self:
        self._thread.start()
        self._started.wait()
        if self._failure is not None:
            self._thread.join()
            raise UsageError(f"--page {self._asked}: {self._failure.strerror}; give another port") from self._failure
        return self

    def __exit__(self, *exception: Any) -> None:
        assert self._stopping is not None
        self._loop.call_soon_threadsafe(self._stopping.set)
        self._thread.join()

    # ------------------------------------------------------------------ in the server's thread

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()
            self._started.set()

    async def _serve(self) -> None:
        self._stopping = asyncio.Event()
        app = web.Application(middlewares=[_refuse_other_origins, self._refuse_strangers])
        app.router.add_get("/", self._index)
        app.router.add_get("/scene", self._scene)
        app.router.add_get("/plants", self._plants)
        app.router.add_get("/rigid", self._rigid)
        app.router.add_get("/state", self._state)
        if self.voice is not None:
            app.router.add_get("/voice", self.voice.serve)
        app.router.add_static("/", PAGE)
        site: HttpsSite | None = None
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        try:
            if self._tls is None:
                await web.TCPSite(runner, self._host, self._asked).start()
                self.port = runner.addresses[0][1]
            else:
                assert runner.server is not None
                site = HttpsSite(runner.server, self._tls, _NEEDS_HTTPS)
                self.port = site.listen(self._host, self._asked)
            self._started.set()
            await self._stopping.wait()
        except OSError as failure:
            self._failure = failure
        finally:
            for event in self._fresh:
                event.set()
            if self.voice is not None:
                await self.voice.close()
            if site is not None:
                await site.close()
            await runner.cleanup()

    def _wake(self) -> None:
        for event in self._fresh:
            event.set()

    @web.middleware
    async def _refuse_strangers(self, request: web.Request, handler: Callable[..., Any]) -> web.StreamResponse:
        """Refuse requests without permission.

        If the server has a token, a request must have the token in the address, or in the cookie that the server then
        sets. Without a token, the request must use a host name of this machine, because any site can make its own name
        point to this address.
        """
        given = request.query.get("token", request.cookies.get("token", ""))
        if self._token is not None and not hmac.compare_digest(given.encode(), self._token.encode()):
            raise web.HTTPForbidden(text="open the address with its token, as the client has printed it")
        if self._token is None and request.url.host not in (self._host, *_THIS_MACHINE):
            raise web.HTTPForbidden(text=f"this is not {request.url.host}; open {self.address}")
        return await handler(request)

    async def _index(self, _: web.Request) -> web.FileResponse:
        headers = {"Cache-Control": "no-cache", "Content-Security-Policy": _POLICY}
        page = web.FileResponse(PAGE / "index.html", headers=headers)
        if self._token is not None:
            page.set_cookie("token", self._token, httponly=True, samesite="Strict", secure=self._tls is not None)
        return page

    async def _scene(self, _: web.Request) -> web.Response:
        return _binary(self._world.scene())

    async def _plants(self, request: web.Request) -> web.Response:
        if (place := decode_place(request.query)) is None:
            raise web.HTTPBadRequest(text="no place: give x, y and z in metres, each from -1e5 to 1e5")
        return _binary(self._world.plants(place))

    async def _rigid(self, _: web.Request) -> web.Response:
        return _binary(self._world.rigid())

    async def _state(self, request: web.Request) -> web.WebSocketResponse:
        """Serve the socket of one page: send states as fast as the page draws them, and handle its messages."""
        socket = web.WebSocketResponse(heartbeat=10.0, compress=False, max_msg_size=_MAX_INPUT)
        await socket.prepare(request)
        fresh = asyncio.Event()
        self._fresh.add(fresh)
        fresh.set()
        flight: collections.deque[int] = collections.deque()
        page = self._pages
        self._pages = self._pages + 1
        reader = asyncio.ensure_future(self._read(page, socket, flight, fresh))
        tick = -1
        try:
            while not (reader.done() or self._stopping is None or self._stopping.is_set()):
                await fresh.wait()
                fresh.clear()
                if len(flight) >= WINDOW or reader.done() or (found := self._world.state(tick, page)) is None:
                    continue
                tick, message = found
                flight.append(tick)
                self.states_sent += 1
                await socket.send_bytes(message)
        except (ConnectionError, asyncio.CancelledError):
            pass
        finally:
            self._fresh.discard(fresh)
            reader.cancel()
            self._world.leave(page)
            await socket.close()
        return socket

    async def _read(
        self, page: int, socket: web.WebSocketResponse, flight: collections.deque[int], fresh: asyncio.Event
    ) -> None:
        """Read the messages of a page until it disconnects, and pass them to the world. ``page``: number of the page.
        ``flight``: ticks of the states that were sent and that the page has not drawn yet. ``fresh``: set when the page
        can take a state."""
        async for message in socket:
            if message.type is not WSMsgType.TEXT or (said := decode_input(message.data)) is None:
                if self.refused == 0:
                    log.warning("a page sent an invalid message, which was refused (further ones are only counted)")
                self.refused += 1
                continue
            while flight and flight[0] <= said.drawn:
                flight.popleft()
            self._world.take(page, said)
            fresh.set()
        fresh.set()


def _binary(body: bytes) -> web.Response:
    return web.Response(body=body, content_type="application/octet-stream", headers={"Cache-Control": "no-store"})


@web.middleware
async def _refuse_other_origins(request: web.Request, handler: Callable[..., Any]) -> web.StreamResponse:
    """Refuse requests of other sites that are open in the same browser."""
    origin = request.headers.get("Origin")
    if origin is not None and origin.split("://")[-1] != request.host:
        raise web.HTTPForbidden(text=f"pages of {origin} may not connect; open {request.url.origin()} itself")
    return await handler(request)
