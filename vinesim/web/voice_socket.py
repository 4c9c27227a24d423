"""The second socket of a page: sound, both ways, so that no picture waits for a voice and no voice for a picture.

From the page: one text, what it can (:class:`PageEars`); then frames, each one byte for the codec (:class:`Codec`, and
:data:`EXTRA` if it is the same sound once more, for those without Opus) and the coded sound. To the page: texts, JSON
with ``may_speak``, ``send`` (the kinds of frames that are wanted), ``tones``; and frames, :data:`FRAME_HEADER`, the
speaker's name, and the coded sound.
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
"""Added to the codec of a frame whose sound has come in another codec, too."""

FRAME_HEADER = struct.Struct("<BBH3f")
"""Codec, length of the speaker's name, number of the frame, place [m]."""

MAX_WAITING = 64
"""Frames that wait for a page; older ones are dropped, and counted: a page that stalls hears the present when it is
back."""

_MAX_MESSAGE = 1 + max(MAX_OPUS, 1000)
_BURST = 250.0
_PACE = 2.5 / FRAME
"""Frames a second that a page may send: both codecs, a quarter faster than sound."""


class PageEars(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a page can."""

    opus: bool
    """Decode Opus."""


_ears = msgspec.json.Decoder(PageEars)


class PageVoice:
    """The connection to one page, as the client sees it; may be used from any thread."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._fresh = asyncio.Event()
        self._waiting: collections.deque[bytes | str] = collections.deque()
        self.ears: PageEars | None = None
        """None until the page has said what it can."""
        self.dropped = 0
        """Frames for a page that took none."""

    def send(self, message: bytes | str) -> None:
        """Send a frame or a text; does not wait."""
        self._waiting.append(message)
        while len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self.dropped += 1
        self._loop.call_soon_threadsafe(self._fresh.set)

    async def pump(self, socket: web.WebSocketResponse) -> None:
        """Send what waits, until the socket is closed."""
        while not socket.closed:
            await self._fresh.wait()
            self._fresh.clear()
            while self._waiting:
                message = self._waiting.popleft()
                await (socket.send_str(message) if isinstance(message, str) else socket.send_bytes(message))


class Sound(Protocol):
    """What the socket needs of the client; every method is called in the server's thread."""

    def join(self, page: PageVoice) -> None:
        """A page listens from now on."""
        ...

    def leave(self, page: PageVoice) -> None:
        """A page is gone."""
        ...

    def speak(self, page: PageVoice, codec: Codec, data: bytes, is_main: bool) -> None:
        """A page has said a frame."""
        ...


class VoiceSocket:
    """Serves the socket of sound."""

    def __init__(self, sound: Sound) -> None:
        self._sound = sound
        self.refused = 0
        """Messages of pages that are none, or too many."""
        self._sockets: set[web.WebSocketResponse] = set()

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        """One page, from its connection to its end."""
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
                        log.warning("a page sent what is no sound, or too much: dropped; more is only counted")
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
        """Take a message of a page; whether it is one."""
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
    """A frame for a page; ``place`` [m] is where the speaker is."""
    name = speaker.encode()[:255]
    return FRAME_HEADER.pack(codec, len(name), number, *place) + name + data
