"""Exchanges the sound of one client's actors with the network, once in each step.

Pages and ROS deliver sound in their own threads; it is stored until the step. Received sound is passed to listeners,
which only store it or send it on. Nothing is decoded or mixed here.
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
"""Largest number of frames of one actor that wait for the next step (two seconds); older frames are dropped."""

RESTART = 0.08
"""[s] Largest difference between the arrival of a frame and the time at which it is due. Beyond it, a voice with a late
frame restarts, and an early frame is dropped."""

RESET = 2.0
"""[s] Time by which a frame must be early to show that the clock was set. The voice then restarts."""


class Spoken(NamedTuple):
    """A frame of sound and the position of its source."""

    speaker: str
    frame: VoiceFrame
    place: np.ndarray
    """Position of the source [3] m."""


class Tone(NamedTuple):
    """The tone of a robot's lights."""

    source: str
    frequency: float
    """[Hz]; 0: the tone has ended"""
    place: np.ndarray
    """Position of the robot's lights [3] m."""


@dataclasses.dataclass(frozen=True, slots=True)
class SoundStep:
    """Sound that reaches an actor in one step."""

    now: float
    """[s] Network time."""
    to_world: float
    """[s] World time minus network time."""
    frames: list[Spoken]
    tones: list[Tone]


class Listener(Protocol):
    """Receiver of the sound that an actor hears: a page, or the microphone of a robot."""

    @property
    def is_open(self) -> bool:
        """Whether the listener wants to receive sound now."""
        ...

    @property
    def decodes_opus(self) -> bool: ...

    def hear(self, step: SoundStep) -> None:
        """Receive the sound of one step. The client's loop calls this method, which must return at once."""
        ...


class Voice(NamedTuple):
    """Audience of an actor: whether other actors hear it, and in which codec."""

    may_speak: bool
    """Whether anyone may hear the actor."""
    is_heard: bool = False
    is_heard_plain: bool = False
    """Whether one of the hearers cannot decode Opus."""


class _Speaker:
    """Sound of one local actor that waits to be sent."""

    def __init__(self) -> None:
        self.waiting: collections.deque[tuple[Codec, bytes, bool]] = collections.deque(maxlen=MAX_WAITING)
        self.next_time: dict[bool, float] = {}
        """Time at which the next frame of sound begins if the voice continues without a pause [s], by kind of frame.
        True: main frames, in the codec of the page or loudspeaker. False: extra frames, which repeat the same sound in
        PCM16 for listeners that cannot decode Opus."""
        self.number = 0

    def stamp(self, now: float, is_main: bool) -> float | None:
        """Returns the start time [s] of a frame of sound that has just arrived. Frames of one voice follow without gaps
        or overlap.

        None if the frame must be dropped, because a page stalled and now sends many frames at once. ``now``: network
        time [s]. ``is_main``: False for an extra frame, which repeats a sound in PCM16 for listeners without Opus.
        """
        began = now - FRAME
        expected = self.next_time.get(is_main, -np.inf)
        if RESTART <= expected - began < RESET:
            return None
        time = expected if abs(expected - began) < RESTART else began
        self.next_time[is_main] = time + FRAME
        return time


class SoundClient(Protocol):
    """Interface of the client to its sound exchange."""

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
    """Exchanges the sound of one client's actors between threads and the network."""

    def __init__(self, client: SoundClient) -> None:
        self._client = client
        self._listeners: list[tuple[str, Listener]] = []
        self._was_open = False
        """Whether any listener was open after the last step."""
        self._speakers: dict[str, _Speaker] = {}
        self._loudspeakers: dict[str, Loudspeaker] = {}
        self._voices: dict[str, Voice] = {}
        self._dropped = 0
        client.post_step.append(lambda _: self._exchange())

    # ------------------------------------------------------------------ from any thread

    def listen(self, actor: str, listener: Listener) -> None:
        """Start to pass the sound that reaches a local actor to a listener."""
        self._listeners = [*self._listeners, (actor, listener)]

    def stop_listening(self, listener: Listener) -> None:
        """Stop passing sound to a listener."""
        self._listeners = [one for one in self._listeners if one[1] is not listener]

    @property
    def dropped(self) -> int:
        """Number of frames dropped because pages or loudspeakers had too many frames at once."""
        refused = [one.refused for one in list(self._loudspeakers.values())]
        return self._dropped + sum(math.ceil(size / (2 * FRAME_SAMPLES)) for size in refused)

    def speak(self, actor: str, codec: Codec, data: bytes, *, is_main: bool = True) -> None:
        """Send a frame that a local actor has just spoken; see :meth:`vinesim.net.replication.voices.VoiceSync.say`."""
        waiting = self._speaker(actor).waiting
        self._dropped += len(waiting) == MAX_WAITING
        waiting.append((codec, data, is_main))

    def play(self, robot: str, pcm: bytes) -> None:
        """Append PCM16 of any length to the queue of a local robot's loudspeaker."""
        self._loudspeakers.setdefault(robot, Loudspeaker()).play(pcm)

    def voice_of(self, actor: str) -> Voice:
        """Returns the audience of a local actor, which is computed from the first request on."""
        self._speaker(actor)
        return self._voices.get(actor, Voice(True))

    def _speaker(self, actor: str) -> _Speaker:
        return self._speakers.setdefault(actor, _Speaker())

    # ------------------------------------------------------------------ in the loop

    def _exchange(self) -> None:
        """Send local sound, and pass received sound to listeners."""
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
        """Send the frames of local actors. Returns the frames that other local actors may hear."""
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
        """Returns the tones of all robots whose lights sound."""
        client = self._client
        tones = []
        time = client.physics.time + client.world_time.offset
        for name, actor in (*client.robots.items(), *client.remote_actors.items()):
            if isinstance(actor, RobotInstance) and actor.lights.has_sound:
                place = client.physics.rigid.base_state(name)[0][:3] + ROBOT_MOUTH
                tones.append(Tone(name, actor.lights.tone(time), place))
        return tones

    def place_of(self, actor: str) -> np.ndarray:
        """Returns the position [3] m of a local actor's voice and ears: person's head, spectator's eyes, above a
        robot's base."""
        client = self._client
        if actor in client.humans:
            return client.humans[actor].pose.head[:3]
        if actor in client.robots:
            return client.physics.rigid.base_state(actor)[0][:3] + ROBOT_MOUTH
        return np.asarray(getattr(client, "pose", np.zeros(3)), float)[:3]
