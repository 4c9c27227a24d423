"""The second web socket of a page, for sound in both directions, so that pictures and voices do not wait for each
other.

The page sends one text with its abilities (:class:`PageEars`), then frames. A frame has one byte for the codec
(:class:`Codec`, plus :data:`EXTRA` if the frame repeats a sound for hearers without Opus), and the coded sound. The
page receives texts (JSON with ``may_speak``, ``send``, which lists the requested kinds of frames, and ``tones``) and
frames. A frame to the page consists of :data:`FRAME_HEADER`, the speaker's name, and the coded sound.
"""

from __future__ import annotations

import asyncio
import collections
import logging
import struct
import time
from typing import Protocol

import msgspec
from aiohttp import WSMsgType, web

from vinesim.audio.frame import FRAME, MAX_OPUS, Codec, find_fault

log = logging.getLogger(__name__)

EXTRA = 128
"""Number that is added to the codec of a frame whose sound was also sent in another codec."""

FRAME_HEADER = struct.Struct("<BBH3f")
"""Header of a frame to the page: codec, length of the speaker's name, frame number, position [m] of the speaker."""

MAX_WAITING = 64
"""Largest number of frames that wait for a page. Older frames are dropped and counted, so after a stall a page plays
the present sound."""

_MAX_MESSAGE = 1 + max(MAX_OPUS, 1000)
_BURST = 250.0
_PACE = 2.5 / FRAME
"""[1/s] Largest frame rate that a page may send: both codecs, 25 % faster than sound."""


class PageEars(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sound formats that a page (browser tab) can play."""

    opus: bool
    """Whether the page can decode Opus."""


_ears = msgspec.json.Decoder(PageEars)


class PageVoice:
    """The connection for sound to one page (browser tab). May be used from any thread."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._fresh = asyncio.Event()
        self._waiting: collections.deque[bytes | str] = collections.deque()
        self.ears: PageEars | None = None
        """Sound formats that the page can play; None until the page has sent them."""
        self.dropped = 0
        """Number of frames dropped because the page did not receive them in time."""

    def send(self, message: bytes | str) -> None:
        """Send a frame or a text; does not wait."""
        self._waiting.append(message)
        while len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self.dropped += 1
        self._loop.call_soon_threadsafe(self._fresh.set)

    async def pump(self, socket: web.WebSocketResponse) -> None:
        """Send waiting messages until the socket is closed."""
        while not socket.closed:
            await self._fresh.wait()
            self._fresh.clear()
            while self._waiting:
                message = self._waiting.popleft()
                await (socket.send_str(message) if isinstance(message, str) else socket.send_bytes(message))


class Sound(Protocol):
    """Interface of the client to the web socket for sound. All methods are called in the server's thread."""

    def join(self, page: PageVoice) -> None:
        """Called when a page begins to listen."""
        ...

    def leave(self, page: PageVoice) -> None:
        """Called when a page has disconnected."""
        ...

    def speak(self, page: PageVoice, codec: Codec, data: bytes, is_main: bool) -> None:
        """Called with every frame of sound from a page."""
        ...


class VoiceSocket:
    """Serves the socket of sound."""

    def __init__(self, sound: Sound) -> None:
        self._sound = sound
        self.refused = 0
        """Number of refused messages of pages: invalid ones, or too many."""
        self._sockets: set[web.WebSocketResponse] = set()

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        """Serve one page until it disconnects."""
        socket = web.WebSocketResponse(heartbeat=10.0, compress=False, max_msg_size=_MAX_MESSAGE)
        await socket.prepare(request)
        self._sockets.add(socket)
        page = PageVoice(asyncio.get_running_loop())
        pump = asyncio.ensure_future(page.pump(socket))
        credit = _BURST
        credited = time.monotonic()
        try:
            async for message in socket:
                now = time.monotonic()
                credit = min(_BURST, credit + _PACE * (now - credited))
                credited = now
                if credit < 1.0 or not self._take(page, message.type, message.data):
                    self.refused += 1
                    if self.refused == 1:
                        log.warning(
                            "a page sent invalid sound, or too much; it was dropped (further sound is only counted)"
                        )
                    continue
                credit -= 1.0
        except (ConnectionError, asyncio.CancelledError):
            pass
        finally:
            self._sockets.discard(socket)
            pump.cancel()
            if page.ears is not None:
                self._sound.leave(page)
            await socket.close()
        return socket

    async def close(self) -> None:
        """End all connections."""
        for socket in tuple(self._sockets):
            await socket.close()

    def _take(self, page: PageVoice, kind: WSMsgType, data: bytes | str) -> bool:
        """Store the page's sound formats, or pass on its frame of sound. Returns whether the message is valid."""
        if kind is WSMsgType.TEXT:
            try:
                ears = _ears.decode(data)
            except (msgspec.MsgspecError, RecursionError, UnicodeError):
                return False
            is_new = page.ears is None
            page.ears = ears
            if is_new:
                self._sound.join(page)
            return True
        if kind is not WSMsgType.BINARY or not data or page.ears is None:
            return False
        assert isinstance(data, bytes)
        codec = data[0] & ~EXTRA
        sound = data[1:]
        if find_fault(codec, sound):
            return False
        self._sound.speak(page, Codec(codec), sound, data[0] < EXTRA)
        return True


def encode_frame(speaker: str, number: int, codec: Codec, data: bytes, place: tuple[float, float, float]) -> bytes:
    """Encode a frame for a page; ``place`` [m] is the position of the speaker."""
    name = speaker.encode()[:255]
    return FRAME_HEADER.pack(codec, len(name), number, *place) + name + data
