"""All sound that leaves and reaches the actors of one client; once a step, between threads and the network.

Pages and ROS give sound in their own threads, which is stored until the step; what arrives is handed to listeners,
which only store or send it on. Nothing is decoded or mixed here.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from vinesim.audio.frame import FRAME, FRAME_SAMPLES, Codec
from vinesim.audio.hearing import may_hear
from vinesim.audio.loudspeaker import Loudspeaker
from vinesim.avatar.local_human import LocalHuman
from vinesim.client.world_time import WorldTime
from vinesim.net.codec.voice import VoiceFrame
from vinesim.net.replication.replicator import Replicator
from vinesim.net.replication.voices import ROBOT_MOUTH
from vinesim.robot.drives.robot_instance import RobotInstance
from vinesim.world import Physics

MAX_WAITING = 100
"""Frames of one actor that wait for the next step: two seconds; older ones are dropped."""

RESTART = 0.08
"""[s] A voice whose frames come this much after their time begins anew, what comes this much before it is dropped."""

RESET = 2.0
"""[s] By this much the clock was set, and the voice begins anew."""


class Spoken(NamedTuple):
    """A frame of sound and where it comes from."""

    speaker: str
    frame: VoiceFrame
    place: np.ndarray
    """[3] m"""


class Tone(NamedTuple):
    """The tone of a robot's lights."""

    source: str
    frequency: float
    """[Hz]; 0: silent now"""
    place: np.ndarray
    """[3] m"""


@dataclasses.dataclass(frozen=True, slots=True)
class SoundStep:
    """What reaches an actor in one step."""

    now: float
    """[s] of the network."""
    to_world: float
    """[s] Time of the world less that of the network."""
    frames: list[Spoken]
    tones: list[Tone]


class Listener(Protocol):
    """Something that listens for an actor: a page, or the microphone of a robot."""

    @property
    def is_open(self) -> bool:
        """Whether it wants to hear now."""
        ...

    @property
    def decodes_opus(self) -> bool: ...

    def hear(self, step: SoundStep) -> None:
        """Take what has arrived; called in the loop, and must return at once."""
        ...


class Voice(NamedTuple):
    """Who listens to an actor."""

    may_speak: bool
    """Whether anyone may hear it."""
    is_heard: bool = False
    is_heard_plain: bool = False
    """Whether one of them cannot decode Opus."""


class _Speaker:
    """Sound of one local actor on its way."""

    def __init__(self) -> None:
        self.waiting: collections.deque[tuple[Codec, bytes, bool]] = collections.deque(maxlen=MAX_WAITING)
        self.next_time: dict[bool, float] = {}
        """[s] When the next frame begins if the voice goes on, of each kind."""
        self.number = 0

    def stamp(self, now: float, is_main: bool) -> float | None:
        """When a frame that has just arrived began [s]; frames of one voice follow each other without gaps or overlap.

        None: it is one too many, of a page that stood still and sends all at once.
        """
        began = now - FRAME
        expected = self.next_time.get(is_main, -np.inf)
        if RESTART <= expected - began < RESET:
            return None
        time = expected if abs(expected - began) < RESTART else began
        self.next_time[is_main] = time + FRAME
        return time


class SoundClient(Protocol):
    """What the exchange needs of the client whose sound it carries."""

    @property
    def post_step(self) -> list[Callable[[Any], None]]: ...
    @property
    def clock(self) -> Callable[[], float]: ...
    @property
    def physics(self) -> Physics: ...
    @property
    def world_time(self) -> WorldTime: ...
    @property
    def replicator(self) -> Replicator: ...
    @property
    def replicators(self) -> Mapping[str, Replicator]: ...
    @property
    def robots(self) -> Mapping[str, RobotInstance]: ...
    @property
    def humans(self) -> Mapping[str, LocalHuman]: ...
    @property
    def remote_actors(self) -> Mapping[str, object]: ...


class SoundExchange:
    """See the module; one of each client."""

    def __init__(self, client: SoundClient) -> None:
        self._client = client
        self._listeners: list[tuple[str, Listener]] = []
        self._was_open = False
        """Whether anything listened after the last step."""
        self._speakers: dict[str, _Speaker] = {}
        self._loudspeakers: dict[str, Loudspeaker] = {}
        self._voices: dict[str, Voice] = {}
        self._dropped = 0
        client.post_step.append(lambda _: self._exchange())

    # ------------------------------------------------------------------ from any thread

    def listen(self, actor: str, listener: Listener) -> None:
        """Hand what reaches a local actor to a listener from now on."""
        self._listeners = [*self._listeners, (actor, listener)]

    def stop_listening(self, listener: Listener) -> None:
        """Hand nothing to a listener any more."""
        self._listeners = [one for one in self._listeners if one[1] is not listener]

    @property
    def dropped(self) -> int:
        """Frames that came all at once, of pages, or for loudspeakers that have enough to play."""
        refused = [one.refused for one in list(self._loudspeakers.values())]
        return self._dropped + sum(math.ceil(size / (2 * FRAME_SAMPLES)) for size in refused)

    def speak(self, actor: str, codec: Codec, data: bytes, *, is_main: bool = True) -> None:
        """Say 20 ms that a local actor has just said; see :meth:`vinesim.net.replication.voices.VoiceSync.say`."""
        waiting = self._speaker(actor).waiting
        self._dropped += len(waiting) == MAX_WAITING
        waiting.append((codec, data, is_main))

    def play(self, robot: str, pcm: bytes) -> None:
        """Play PCM16 of any length at the loudspeaker of a local robot, behind what it plays."""
        self._loudspeakers.setdefault(robot, Loudspeaker()).play(pcm)

    def voice_of(self, actor: str) -> Voice:
        """Who listens to a local actor that has asked before."""
        self._speaker(actor)
        return self._voices.get(actor, Voice(True))

    def _speaker(self, actor: str) -> _Speaker:
        return self._speakers.setdefault(actor, _Speaker())

    # ------------------------------------------------------------------ in the loop

    def _exchange(self) -> None:
        """Send what was said, and hand on what has arrived."""
        is_open = any(listener.is_open for _, listener in self._listeners)
        was_open = self._was_open
        self._was_open = is_open
        if not (is_open or was_open or self._speakers or self._loudspeakers):
            return
        client = self._client
        now = client.replicator.network_time(client.clock())
        said = self._send(now)
        tones = self._tones()
        to_world = client.physics.time + client.world_time.offset - now
        for actor, replicator in client.replicators.items():
            open_ = [one for name, one in self._listeners if name == actor and one.is_open]
            voices = replicator.voices
            voices.listens = bool(open_)
            voices.decodes_opus = all(one.decodes_opus for one in open_)
            frames = [Spoken(heard.speaker.name, heard.frame, heard.place) for heard in voices.take()]
            if not open_:
                continue
            setting = replicator.bus.spectators_speak_to
            frames += [
                one
                for one in said
                if one.speaker != actor
                and may_hear(client.replicators[one.speaker].hello.kind, replicator.hello.kind, setting)
            ]
            step = SoundStep(now, to_world, frames, [tone for tone in tones if tone.source != actor])
            for listener in open_:
                listener.hear(step)

    def _send(self, now: float) -> list[Spoken]:
        """Send what local actors have said; what other local actors hear of it."""
        said = []
        for robot, loudspeaker in list(self._loudspeakers.items()):
            for _, data in loudspeaker.frames(now):
                self.speak(robot, Codec.PCM16, data)
        for name, speaker in list(self._speakers.items()):
            if (replicator := self._client.replicators.get(name)) is None:
                continue
            voices = replicator.voices
            self._voices[name] = Voice(voices.may_speak, voices.is_heard, voices.is_heard_plain)
            for _ in range(len(speaker.waiting)):
                codec, data, is_main = speaker.waiting.popleft()
                if (time := speaker.stamp(now, is_main)) is None:
                    self._dropped += 1
                    continue
                voices.say(time, codec, data, is_main=is_main)
                if is_main and len(self._client.replicators) > 1:
                    said.append(Spoken(name, VoiceFrame(speaker.number, time, codec, data), self.place_of(name)))
                    speaker.number = (speaker.number + 1) % 65536
        return said

    def _tones(self) -> list[Tone]:
        """Tones of all robots whose lights sound."""
        client = self._client
        tones = []
        time = client.physics.time + client.world_time.offset
        for name, actor in (*client.robots.items(), *client.remote_actors.items()):
            if isinstance(actor, RobotInstance) and actor.lights.has_sound:
                place = client.physics.rigid.base_state(name)[0][:3] + ROBOT_MOUTH
                tones.append(Tone(name, actor.lights.tone(time), place))
        return tones

    def place_of(self, actor: str) -> np.ndarray:
        """Where a local actor speaks and hears [3] m: a person's head, a spectator's eyes, above a robot's base."""
        client = self._client
        if actor in client.humans:
            return client.humans[actor].pose.head[:3]
        if actor in client.robots:
            return client.physics.rigid.base_state(actor)[0][:3] + ROBOT_MOUTH
        return np.asarray(getattr(client, "pose", np.zeros(3)), float)[:3]
