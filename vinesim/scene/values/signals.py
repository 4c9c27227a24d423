"""Signals of robots and people: indicator lights, and intentions of people."""

from __future__ import annotations

import dataclasses
import enum

Color = tuple[int, int, int]
"""Colour: red, green and blue in sRGB, each 0 to 255."""

UNLIT: Color = (0, 0, 0)
"""Colour of a lamp between two flashes."""

INTENTIONS = ("", "walk", "pick", "cut", "carry", "hand over", "put down", "point", "wait", "ask for help")
"""Intentions that a person may indicate, empty for none. Messages contain the index into this list."""


class LightPattern(enum.IntEnum):
    """Meanings of indicator lights (CANOPIES D6.4, section 3.3)."""

    OFF = 0
    NOTIFICATION = 1
    WARNING = 2
    ALARM = 3


FREQUENCY = {LightPattern.NOTIFICATION: 0.4, LightPattern.WARNING: 0.8, LightPattern.ALARM: 2.0}
"""[Hz] Flash rate of the lamps for each pattern; slow flashing is 0.4 to 0.8 Hz, normal flashing 1.4 to 2.8 Hz (IEC
60073)."""

TONE = {LightPattern.NOTIFICATION: 600.0, LightPattern.WARNING: 900.0, LightPattern.ALARM: 1500.0}
"""[Hz] Frequency of the tone while a lamp with sound is lit, for each pattern; within the 500 to 2500 Hz of danger
signals (ISO 7731)."""

TONE_LEVEL = 0.5
"""Amplitude of the tone of a lamp within 1 m. GUESSED."""

USUAL_COLOR: dict[LightPattern, Color] = {
    LightPattern.OFF: UNLIT,
    LightPattern.NOTIFICATION: (255, 255, 255),
    LightPattern.WARNING: (255, 150, 0),
    LightPattern.ALARM: (255, 0, 0),
}
"""Default colour of the lamps for each pattern (IEC 60073)."""


@dataclasses.dataclass(frozen=True, slots=True)
class Lights:
    """The indicator lights of a robot."""

    pattern: LightPattern = LightPattern.OFF
    color: Color = UNLIT
    has_sound: bool = False
    """Whether a tone sounds while the lamps are lit. Clients that play the tone generate it; no sound is sent over the
    network."""

    def shown(self, time: float) -> Color | None:
        """Returns the colour at world ``time`` [s], :data:`UNLIT` between flashes; None if the lights are off and keep
        their colour in the URDF.

        All clients show the same flashes, because these depend only on the time.
        """
        if self.pattern is LightPattern.OFF:
            return None
        return self.color if time * FREQUENCY[self.pattern] % 1.0 < 0.5 else UNLIT

    def tone(self, time: float) -> float:
        """Returns the frequency [Hz] of the tone at world ``time`` [s]; 0: no tone."""
        return TONE.get(self.pattern, 0.0) if self.has_sound and self.shown(time) != UNLIT else 0.0


LIGHTS_OFF = Lights()


@dataclasses.dataclass(frozen=True, slots=True)
class Intention:
    """An intention that a person indicates (CANOPIES D6.4, section 3.5)."""

    person: str
    what: str
    """One of :data:`INTENTIONS`."""
    start: float
    """[s] World time at which the intention began."""
    end: float | None = None
    """[s] World time at which the intention ended; None while it lasts."""


@dataclasses.dataclass(frozen=True, slots=True)
class HandGestures:
    """Gestures of a person's hands (CANOPIES D6.4, section 3.4). A gesture is the name of a finger pose; empty for a
    pose without a name.
    """

    person: str
    left: str
    right: str
