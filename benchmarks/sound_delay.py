"""``python -m benchmarks sound``: delay of an alarm until it is seen and heard, and of voices, in simulated time.

A robot and a person 3 m from it belong to two clients on a network in memory. Again and again the robot switches its
lights to alarm with their tone, and also plays an alarm as a waveform; and the person says a word.

The light is seen when the copy of the robot in the person's client is lit. The tone is heard when the person's page is
told to make it; the waveform, when the page has received its first frame and has waited as long as a page does. The
word is heard when the robot's microphone has recorded a block of 20 ms with the word; that delay counts from the word's
first sample. The delays of a headset, a browser and a sound card are not included.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.support.fake_client import tree_row
from benchmarks.support.sound_recorder import SoundRecorder
from vinesim.audio.frame import FRAME_SAMPLES, SAMPLE_RATE, Codec, to_pcm
from vinesim.client.client import Client
from vinesim.client.sound.exchange import SoundStep
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.robot_instance import RobotInstance
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement
from vinesim.scene.values.signals import FREQUENCY, UNLIT, LightPattern, Lights

DELAYS = (0.0002, 0.02, 0.05, 0.1)
"""Delays one way, from client to client [s]. Jitter is a fifth of the delay; 1 % of the messages are lost."""
ALARMS = 20
STEP = 0.01
LISTENING = 0.7
"""Time after each alarm in which its signs are awaited [s]."""
PAUSE = 0.5
"""Silence between two alarms [s], after which voices begin as new ones."""
WAVEFORM = 500.0
WORD = 700.0
"""Frequency of the word [Hz]. ``ALARM`` is the frequency of the alarm that is played as a waveform."""
PAGE_WAITS = 0.01
"""Time from the first frame of a voice until a page plays it [s] (``vinesim/web/page/voice_worklet.js``)."""
HEARD = 0.01
"""Amplitude from which a block counts as containing a tone; 3 m away, alarms have 0.16."""
BUDGET = 500.0
"""Budget of the delay of voices [ms] (CANOPIES D6.4, section 5.5)."""

LIGHT = "the light is seen"
TONE_OF_LIGHTS = "its tone is heard"
AS_WAVEFORM = "the alarm as a waveform is heard"
VOICE = "a word reaches a microphone"


class _PageEars:
    """Stands in for the page of a person: notes which frames and tones arrive."""

    is_open = True
    decodes_opus = True

    def __init__(self) -> None:
        self.frames = 0
        self.has_tone = False

    def hear(self, step: SoundStep) -> None:
        self.frames += len(step.frames)
        self.has_tone |= any(tone.frequency for tone in step.tones)


class _World:
    """Two clients in simulated time: a robot ``bot`` and a person ``anna``."""

    def __init__(self, delay: float) -> None:
        self.hub = MemoryHub(delay=delay, jitter=0.2 * delay, loss=0.01, seed=1)
        self.now = 100.0
        scene = load_scene("demo")
        model = tree_row(1)
        robot = load_description("vinebot")
        self.bot, self.anna = (
            Client(
                scene,
                model,
                description,
                self.hub.bus(name),
                name=name,
                clock=lambda: self.now,
                pose=frames.pose(np.array([x, -5.0, 0.0])),
            )
            for name, description, x in (("bot", robot, 0.0), ("anna", None, 3.0))
        )
        self.at_bot = SoundRecorder(self.bot, "bot")
        self.at_anna = _PageEars()
        self.anna.sound.listen("anna", self.at_anna)
        self.run(1.0)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.step()

    def step(self) -> None:
        for client in (self.bot, self.anna):
            client.tick()
        self.hub.advance(STEP)
        self.now += STEP

    def world_time(self) -> float:
        """Returns the time of the world at the robot's client [s]."""
        return self.bot.physics.time + self.bot.world_time.offset

    def is_lit(self) -> bool:
        """Returns whether the robot's copy in the person's client shows the alarm."""
        robot = self.anna.remote_actors["bot"]
        anna = self.anna
        assert isinstance(robot, RobotInstance)
        return robot.lights.shown(anna.physics.time + anna.world_time.offset) not in (None, UNLIT)

    def alarm(self) -> dict[str, float]:
        """Play one alarm; return the time until each sign of it arrives [s], by name."""
        self.bot.robot.lights = Lights()
        self.run(PAUSE)
        while not 0.0 <= self.world_time() * FREQUENCY[LightPattern.ALARM] % 1.0 < 0.04:
            self.step()  # step to the beginning of a flash
        self.at_bot.blocks = []
        self.at_anna.frames = 0
        self.at_anna.has_tone = False
        begin = self.now
        self.bot.robot.lights = Lights(LightPattern.ALARM, (255, 0, 0), True)
        self.bot.sound.play("bot", to_pcm(_tone(WAVEFORM, 0.3)))
        word = to_pcm(_tone(WORD, 0.3)).ljust(30 * 2 * FRAME_SAMPLES, b"\0")
        found: dict[str, float] = {}
        for step in range(round(LISTENING / STEP)):
            if step % 2 == 0 and step > 0 and (said := word[(step - 2) * FRAME_SAMPLES : step * FRAME_SAMPLES]):
                self.anna.sound.speak("anna", Codec.PCM16, said)  # the samples since the last frame
            self.step()
            after = self.now - begin
            has_word = any(_level(block.samples, WORD) > HEARD for block in self.at_bot.blocks)
            for what, is_so in (
                (LIGHT, self.is_lit()),
                (TONE_OF_LIGHTS, self.at_anna.has_tone),
                (VOICE, has_word),
                (AS_WAVEFORM, self.at_anna.frames > 0),
            ):
                if is_so:
                    found.setdefault(what, after + (PAGE_WAITS if what == AS_WAVEFORM else 0.0))
            self.at_bot.blocks = []
        return found


def _tone(frequency: float, seconds: float) -> np.ndarray:
    return 0.5 * np.sin(2.0 * np.pi * frequency * np.arange(round(seconds * SAMPLE_RATE)) / SAMPLE_RATE)


def _level(samples: np.ndarray, frequency: float) -> float:
    """Returns the amplitude of a tone of ``frequency`` [Hz] in a block of ``samples`` [n]."""
    time = np.arange(len(samples)) / SAMPLE_RATE
    return 2.0 * abs(complex(np.mean(samples * np.exp(-2j * np.pi * frequency * time))))


def sound(delays: tuple[float, ...] = DELAYS, alarms: int = ALARMS) -> Iterator[Measurement]:
    """Measure the median and the largest delay of each sign of an alarm, and of a word, for each network delay [s]."""
    for delay in delays:
        world = _World(delay)
        found = [world.alarm() for _ in range(alarms)]
        for what in (LIGHT, TONE_OF_LIGHTS, AS_WAVEFORM, VOICE):
            took = 1e3 * np.array([one.get(what, np.inf) for one in found])
            for name, value in (("median", float(np.median(took))), ("largest", float(took.max()))):
                yield Measurement(
                    "sound",
                    f"{1e3 * delay:g} ms: {what}, {name} of {alarms}",
                    value,
                    "ms",
                    "budget",
                    BUDGET,
                    BUDGET / value,
                )
