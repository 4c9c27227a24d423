"""Signals of robots and people: indicator lights, and what a person intends to do."""

from __future__ import annotations

import dataclasses
import enum

Color = tuple[int, int, int]
"""sRGB, each 0 to 255."""

UNLIT: Color = (0, 0, 0)
"""Colour of a lamp between two flashes."""

INTENTIONS = ("", "walk", "pick", "cut", "carry", "hand over", "put down", "point", "wait", "ask for help")
"""What a person may indicate to do, and nothing; the place in this list crosses the network."""


class LightPattern(enum.IntEnum):
    """What indicator lights say (CANOPIES D6.4, section 3.3)."""

    OFF = 0
    NOTIFICATION = 1
    WARNING = 2
    ALARM = 3


FREQUENCY = {LightPattern.NOTIFICATION: 0.4, LightPattern.WARNING: 0.8, LightPattern.ALARM: 2.0}
"""[Hz] Flashes; slow ones are 0.4 to 0.8 Hz, normal ones 1.4 to 2.8 Hz (IEC 60073)."""

TONE = {LightPattern.NOTIFICATION: 600.0, LightPattern.WARNING: 900.0, LightPattern.ALARM: 1500.0}
"""[Hz] What is heard while a lamp is lit, if it sounds: within the 500 to 2500 Hz of danger signals (ISO 7731)."""

TONE_LEVEL = 0.5
"""Amplitude of that tone within 1 m. GUESSED."""

USUAL_COLOR: dict[LightPattern, Color] = {
    LightPattern.OFF: UNLIT,
    LightPattern.NOTIFICATION: (255, 255, 255),
    LightPattern.WARNING: (255, 150, 0),
    LightPattern.ALARM: (255, 0, 0),
}
"""Colours unless others are asked for (IEC 60073)."""


@dataclasses.dataclass(frozen=True, slots=True)
class Lights:
    """The indicator lights of a robot."""

    pattern: LightPattern = LightPattern.OFF
    color: Color = UNLIT
    has_sound: bool = False
    """Whether a tone is heard while the lamps are lit; hearers make it, no sound crosses the network."""

    def shown(self, time: float) -> Color | None:
        """The colour at a time of the world [s], :data:`UNLIT` between flashes; None: off, as the URDF has them.

        All clients show the same: the flashes follow from the time.
        """
        if self.pattern is LightPattern.OFF:
            return None
        return self.color if time * FREQUENCY[self.pattern] % 1.0 < 0.5 else UNLIT

    def tone(self, time: float) -> float:
        """Frequency of the tone that is heard at a time of the world [s] [Hz]; 0: none."""
        return TONE.get(self.pattern, 0.0) if self.has_sound and self.shown(time) != UNLIT else 0.0


LIGHTS_OFF = Lights()


@dataclasses.dataclass(frozen=True, slots=True)
class Intention:
    """What a person indicates to do (CANOPIES D6.4, section 3.5)."""

    person: str
    what: str
    """One of :data:`INTENTIONS`."""
    start: float
    """[s] of the world"""
    end: float | None = None
    """[s] of the world; None: it goes on."""


@dataclasses.dataclass(frozen=True, slots=True)
class HandGestures:
    """What the hands of a person show (CANOPIES D6.4, section 3.4): names of finger poses, empty for any other."""

    person: str
    left: str
    right: str
