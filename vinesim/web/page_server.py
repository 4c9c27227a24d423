"""Serves the page and, on a socket, the world: an HTTP server with an event loop in a thread of its own.

A connection never has more than :data:`WINDOW` states that the page has not drawn yet; then it waits, and the next
state is the newest one. A page that stalls is late by as many states, however long it stalls.
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
"""States in flight to one page. Without a limit a page on a busy machine was 0.4 to 1 s behind."""
_MAX_INPUT = 8192
"""Longest message of a page [B]."""
_NEEDS_HTTPS = "this page needs https: open the address that the client has printed, with https:// and its token"
"""For who opens it by plain http."""
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
"""Content Security Policy: browsers load nothing from other hosts for the page, whatever its scripts ask for."""


class World(Protocol):
    """What a page is told of the world; every method is called in the server's thread."""

    def scene(self) -> bytes:
        """All that does not change (:mod:`vinesim.web.array_message`)."""
        ...

    def plants(self, place: np.ndarray) -> bytes:
        """Of a vineyard that is not loaded as a whole the part around a ``place`` [3] m."""
        ...

    def rigid(self) -> bytes:
        """Shapes of the rigid bodies that there are now."""
        ...

    def state(self, since: int) -> tuple[int, bytes] | None:
        """Tick and message of the newest state: what has moved after the tick ``since``; None: nothing is new."""
        ...

    def take(self, page: int, said: PageInput) -> None:
        """What a page has sent; pages are counted from 0."""
        ...

    def leave(self, page: int) -> None:
        """A page is gone."""
        ...


class PageServer:
    """A context: the page is served until it is left."""

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
        """``port`` 0: any that is free; ``tls``: by https; ``token``: only who has it in the address is let in;
        ``sound``: what pages hear and say.

        Raises :class:`UsageError` if the page lacks anything or the port is taken.
        """
        page_files.check()
        self._world = world
        self._host = host
        self._asked = port
        self._tls = tls
        self._token = token
        self.voice = None if sound is None else VoiceSocket(sound)
        """The socket of sound."""
        self.port = 0
        self._pages = 0
        self.states_sent = 0
        self.refused = 0
        """Messages of pages that were not understood."""
        self._loop = asyncio.new_event_loop()
        self._fresh: set[asyncio.Event] = set()
        self._stopping: asyncio.Event | None = None
        self._started = threading.Event()
        self._failure: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="page server", daemon=True)

    @property
    def address(self) -> str:
        """What to type into a browser."""
        scheme = "http" if self._tls is None else "https"
        token = "" if self._token is None else f"?token={self._token}"
        return f"{scheme}://{self._host}:{self.port}/{token}"

    @property
    def has_viewers(self) -> bool:
        """Whether any page is connected."""
        return bool(self._fresh)

    @property
    def refused_messages(self) -> int:
        """Messages of pages, and frames of their sound, that were none or too many."""
        return self.refused + (0 if self.voice is None else self.voice.refused)

    def notify(self) -> None:
        """A new state is there. Called in the loop of the client; does not wait."""
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
        """With a token: who does not have it in the address, or as a cookie from then on. Without one: who calls this
        machine by a name that it does not have, since any site can give a name of its own this address."""
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
        """One page: sends states while it draws them, and takes where it looks from."""
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
                if len(flight) >= WINDOW or reader.done() or (found := self._world.state(tick)) is None:
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
        """Take what a page sends; ``flight`` are the ticks of the states that it has not drawn yet."""
        async for message in socket:
            if message.type is not WSMsgType.TEXT or (said := decode_input(message.data)) is None:
                if self.refused == 0:
                    log.warning("a page sent what is no message of a page: refused (further ones are only counted)")
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
    """Another site that is open in the same browser may not read the world."""
    origin = request.headers.get("Origin")
    if origin is not None and origin.split("://")[-1] != request.host:
        raise web.HTTPForbidden(text=f"pages of {origin} may not connect; open {request.url.origin()} itself")
    return await handler(request)
