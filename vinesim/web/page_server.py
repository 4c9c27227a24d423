"""Serves the page and, on a web socket, the world: an HTTP server with an event loop in its own thread.

At most :data:`WINDOW` states that the page has not drawn yet are on their way to it. Then the server waits, and the
next state that it sends is the newest one. So after a stall of any duration a page is at most :data:`WINDOW` states
late.
"""

from __future__ import annotations

import asyncio
import collections
import hmac
import html
import logging
import re
import ssl
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, Self

import numpy as np
from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from vinesim.core.errors import UsageError
from vinesim.web import page_files, page_token
from vinesim.web.page_input import PageInput, decode_input, decode_place
from vinesim.web.page_listener import IDLE_TIMEOUT, PageListener
from vinesim.web.voice_socket import Sound, VoiceSocket

log = logging.getLogger(__name__)

WINDOW = 2
"""Largest number of states that were sent to one page and that it has not drawn yet. Without a limit a page on a busy
machine was 0.4 to 1 s late."""
_MAX_INPUT = 8192
"""Longest message of a page [B]."""
_NEEDS_HTTPS = "this page needs https: open the whole address that the client has printed, with https://"
"""Answer to requests by plain http."""
_THIS_MACHINE = ("localhost", "127.0.0.1", "::1")
_POLICY = (
    "default-src 'self'",
    "style-src 'self' 'unsafe-inline'",
    "img-src 'self' data:",
    "media-src 'self' blob:",
    "worker-src 'self' blob:",
    "object-src 'none'",
    "base-uri 'none'",
    "form-action 'none'",
)
"""Content Security Policy: the page can load nothing from other hosts, whatever its scripts request."""
_NO_FRAMES = "frame-ancestors 'none'"
_NOTEBOOKS = " ".join(
    (
        "frame-ancestors 'self'",
        *(f"{scheme}://{host}:*" for scheme in ("http", "https") for host in ("localhost", "127.0.0.1")),
        "vscode-webview:",
        "vscode-file:",
    )
)
"""Rule for the page in a cell of a notebook: Jupyter on this machine, and Visual Studio Code, may frame it."""
_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::([0-9]{1,5}))?", re.ASCII)
"""A host, and a port if it is not the usual one (RFC 9110, section 7.2)."""
_OTHER_SITES = ("cross-site", "same-site")
"""Values of ``Sec-Fetch-Site`` of requests from other sites. A page on another port of this machine is "same-site"."""
_NO_SECRET = """This is a vineyard of vinesim, but the address is not complete. The whole address has a secret in its
path, so that nobody else can look into the vineyard or control its person.

The client prints the whole address when it starts: in the terminal of vinesim client, demo or replay, look for the line
with "in a browser: {address}...". In Python, client.page().address is the address."""
"""Answer to requests without the page's secret."""
_HEADERS = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-cache"}
"""Headers of all files of the page."""


class World(Protocol):
    """Interface of an object that provides the world to pages (connected browser tabs) and takes their input.

    :meth:`scene` and :meth:`plants` may take long. They are called in a thread of their own, one at a time, while pages
    receive states. All other methods are called in the server's thread.

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
        in_notebook: bool = False,
    ) -> None:
        """Start the server of a world.

        Args:
            world: the world to show.
            port: port to listen on; 0: any free port.
            host: address to listen on.
            tls: serve by https with this context.
            token: secret in the address; None: the one of this user for the port, see :mod:`vinesim.web.page_token`.
            sound: sound from and to pages; None: no sound.
            in_notebook: whether notebooks of this machine may show the page in a frame. No other site may.

        Raises :class:`UsageError` if files of the page are missing or the port is taken.
        """
        page_files.check()
        self._world = world
        self._host = host
        self._asked = port
        self._tls = tls
        self._token = token
        self._in_notebook = in_notebook
        self._files = page_files.served()
        self._worker: ThreadPoolExecutor | None = None
        self._listener: PageListener | None = None
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
        """Address of the page for a browser, with its secret."""
        return f"{self._origin}/{self._token}/"

    @property
    def _origin(self) -> str:
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"{'http' if self._tls is None else 'https'}://{host}:{self.port}"

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
        self._worker = ThreadPoolExecutor(1, "page layout")
        app = web.Application(
            middlewares=[self._serving, _refuse_invalid_hosts, self._refuse_strangers, self._refuse_sites]
        )
        app.router.add_get("/{token}", self._without_slash)
        app.router.add_get("/{token}/", self._index)
        app.router.add_get("/{token}/scene", self._scene)
        app.router.add_get("/{token}/plants", self._plants)
        app.router.add_get("/{token}/rigid", self._rigid)
        app.router.add_get("/{token}/state", self._state)
        if self.voice is not None:
            app.router.add_get("/{token}/voice", self.voice.serve)
        app.router.add_get("/{token}/{file:.+}", self._file)
        runner = web.AppRunner(
            app, access_log=None, shutdown_timeout=1.0, keepalive_timeout=IDLE_TIMEOUT, logger=_request_log()
        )
        await runner.setup()
        try:
            assert runner.server is not None
            self._listener = PageListener(runner.server, self._tls, _NEEDS_HTTPS)
            self.port = self._listener.listen(self._host, self._asked)
            self._token = self._token or page_token.lasting_token(self.port) or page_token.new_token()
            self._started.set()
            await self._stopping.wait()
        except OSError as failure:
            self._failure = failure
        finally:
            for event in self._fresh:
                event.set()
            if self.voice is not None:
                await self.voice.close()
            if self._listener is not None:
                await self._listener.close()
            await runner.cleanup()
            self._worker.shutdown(cancel_futures=True)

    def _wake(self) -> None:
        for event in self._fresh:
            event.set()

    @web.middleware
    async def _serving(self, request: web.Request, handler: Callable[..., Any]) -> web.StreamResponse:
        assert self._listener is not None
        with self._listener.serving(request):
            return await handler(request)

    @web.middleware
    async def _refuse_strangers(self, request: web.Request, handler: Callable[..., Any]) -> web.StreamResponse:
        """Refuse requests without the page's secret in their path.

        By http, a request must use a host name of this machine, too, because any site can make its own name point to
        this address.
        """
        if self._tls is None and request.url.host not in (self._host, *_THIS_MACHINE):
            raise web.HTTPForbidden(
                text=f"this is not {request.url.host}; open the address that the client has printed"
            )
        given = request.match_info.get("token", "")
        assert self._token is not None
        if not hmac.compare_digest(given.encode(errors="replace"), self._token.encode()):
            text = _NO_SECRET.format(address=f"{self._origin}/")
            if "text/html" in request.headers.get("Accept", ""):
                raise web.HTTPForbidden(text=_sheet(text), content_type="text/html", headers=self._index_headers())
            raise web.HTTPForbidden(text=text, headers=_HEADERS)
        assert self._listener is not None
        self._listener.know(request)
        return await handler(request)

    @web.middleware
    async def _refuse_sites(self, request: web.Request, handler: Callable[..., Any]) -> web.StreamResponse:
        """Refuse requests of other sites that are open in the same browser. Only the page itself may be opened from
        elsewhere, by a link or in the frame of a notebook."""
        origin = request.headers.get("Origin")
        if origin is not None and origin.split("://")[-1] != request.host:
            raise web.HTTPForbidden(text=f"pages of {origin} may not connect; open {request.url.origin()} itself")
        is_page = request.match_info.handler in (self._index, self._without_slash)
        is_opened = is_page and request.headers.get("Sec-Fetch-Mode") == "navigate"
        if request.headers.get("Sec-Fetch-Site") in _OTHER_SITES and not is_opened:
            raise web.HTTPForbidden(
                text="other sites may not use this page; open the address that the client has printed"
            )
        return await handler(request)

    def _index_headers(self) -> dict[str, str]:
        policy = "; ".join((*_POLICY, _NOTEBOOKS if self._in_notebook else _NO_FRAMES))
        frames = {} if self._in_notebook else {"X-Frame-Options": "DENY"}
        return {**_HEADERS, **frames, "Content-Security-Policy": policy}

    async def _without_slash(self, request: web.Request) -> web.Response:
        raise web.HTTPPermanentRedirect(f"/{self._token}/" + (f"?{request.query_string}" if request.query else ""))

    async def _index(self, _: web.Request) -> web.FileResponse:
        return web.FileResponse(self._files["index.html"], headers=self._index_headers())

    async def _file(self, request: web.Request) -> web.FileResponse:
        if (path := self._files.get(request.match_info["file"])) is None:
            raise web.HTTPNotFound(text="the page has no such file")
        return web.FileResponse(path, headers=_HEADERS)

    async def _made(self, make: Callable[..., bytes], *arguments: Any) -> web.Response:
        """Answer with what ``make`` returns; it runs in a thread of its own, so that states and sound go on."""
        return _binary(await asyncio.get_running_loop().run_in_executor(self._worker, make, *arguments))

    async def _scene(self, _: web.Request) -> web.Response:
        return await self._made(self._world.scene)

    async def _plants(self, request: web.Request) -> web.Response:
        if (place := decode_place(request.query)) is None:
            raise web.HTTPBadRequest(text="no place: give x, y and z in metres, each from -1e5 to 1e5")
        return await self._made(self._world.plants, place)

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
    headers = {**_HEADERS, "Cache-Control": "no-store"}
    return web.Response(body=body, content_type="application/octet-stream", headers=headers)


@web.middleware
async def _refuse_invalid_hosts(request: web.Request, handler: Callable[..., Any]) -> web.StreamResponse:
    """Refuse requests whose ``Host`` is missing, doubled or malformed."""
    hosts = request.headers.getall("Host", [])
    found = _HOST.fullmatch(hosts[0]) if len(hosts) == 1 else None
    if found is None or int(found[2] or 0) > 65535:
        raise web.HTTPBadRequest(text="a request needs one valid Host")
    return await handler(request)


def _sheet(text: str) -> str:
    """Returns sentences as a small page in HTML."""
    paragraphs = "".join(f"<p>{html.escape(part)}</p>" for part in text.split("\n\n"))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>vinesim</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,"></head>'
        '<body style="max-width: 40em; margin: 3em auto; padding: 0 1em; font: 16px/1.5 system-ui, sans-serif">'
        f"{paragraphs}</body></html>"
    )


def _request_log() -> logging.Logger:
    """Returns a log for errors of the aiohttp server, without those of malformed requests: strangers could fill it."""
    found = logging.getLogger(f"{__name__}.requests")
    if not found.filters:
        found.addFilter(lambda record: not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError)))
    return found
