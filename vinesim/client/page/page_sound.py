"""Sound of one client for its pages (browser tabs): all pages hear what the client's actor hears, and the first page
that speaks is the actor's voice.

A page that only watches a robot hears what the robot hears, and cannot speak.
"""

from __future__ import annotations

import json

from vinesim.audio.frame import Codec
from vinesim.audio.hearing import FADE, REACH, REFERENCE
from vinesim.client.client import Client
from vinesim.client.sound.exchange import SoundStep
from vinesim.scene.values import TONE_LEVEL
from vinesim.web.voice_socket import PageVoice, encode_frame


class PageSound:
    """Sound of a client's pages.

    The server's thread calls the methods of :class:`vinesim.web.voice_socket.Sound`; the client's loop calls the
    listener of each page.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._name = client.name
        self._kind = client.replicator.hello.kind
        self._pages: dict[PageVoice, _Page] = {}
        self._speaker: PageVoice | None = None
        """The page that speaks for the actor; None before any page has spoken."""

    def join(self, page: PageVoice) -> None:
        """Start to send a page what the actor hears."""
        self._pages[page] = listener = _Page(self, page)
        self._client.sound.voice_of(self._name)
        self._client.sound.listen(self._name, listener)

    def leave(self, page: PageVoice) -> None:
        """Stop sending sound to a page that has disconnected. If the page spoke for the actor, another page may do so
        now."""
        self._client.sound.stop_listening(self._pages.pop(page))
        if self._speaker is page:
            self._speaker = None

    def speak(self, page: PageVoice, codec: Codec, data: bytes, is_main: bool) -> None:
        """Send a frame of sound from a page as the actor's voice, unless the page may not speak."""
        if self.objection(page):
            return
        self._speaker = page
        self._client.sound.speak(self._name, codec, data, is_main=is_main)

    def objection(self, page: PageVoice) -> str:
        """Returns the reason why a page may not speak, for the page's user; empty if it may."""
        if self._kind == "robot":
            return "this page shows a robot, which speaks by the ROS topic speaker/audio"
        if self._speaker not in (None, page):
            return "another page speaks for this actor: close it first"
        if not self._client.sound.voice_of(self._name).may_speak:
            return "the server lets nobody hear spectators (--spectators-speak-to)"
        return ""

    def status(self, page: PageVoice, tones: dict[str, list[float]]) -> str:
        """Returns the sound status of a page as JSON: why it may not speak, which frames it shall send, ``tones`` of
        robots, and how loudness falls with distance. The caller sends it to the page when it changes."""
        voice = self._client.sound.voice_of(self._name)
        objection = self.objection(page)
        send = [] if objection else ["main"] * voice.is_heard + ["pcm"] * voice.is_heard_plain
        return json.dumps(
            {
                "objection": objection,
                "send": send,
                "tones": tones,
                "law": [REFERENCE, REACH, FADE],
            }
        )


class _Page:
    """Listener that sends one page what the actor hears."""

    is_open = True

    def __init__(self, sound: PageSound, page: PageVoice) -> None:
        self._sound = sound
        self._page = page
        self._told = ""

    @property
    def decodes_opus(self) -> bool:
        """Whether the page can decode Opus."""
        return self._page.ears is not None and self._page.ears.opus

    def hear(self, step: SoundStep) -> None:
        """Send the sound of one step to the page, which computes loudness and generates tones itself."""
        for speaker, frame, place in step.frames:
            x, y, z = place.tolist()
            self._page.send(encode_frame(speaker, frame.number, frame.codec, frame.data, (x, y, z)))
        tones = {
            tone.source: [tone.frequency, TONE_LEVEL, *(round(float(value), 2) for value in tone.place)]
            for tone in step.tones
        }
        status = self._sound.status(self._page, tones)
        if status != self._told:
            self._told = status
            self._page.send(status)
