"""Rules of hearing: which actors hear which other actors, and how loudness falls with distance."""

from __future__ import annotations

import enum

# Loudness at a distance: 1/d as in a free field, zero beyond REACH.


REFERENCE = 1.0
"""[m] Distance up to which a sound is as loud as it was recorded."""

REACH = 25.0
"""[m] Distance beyond which nothing is heard, and no voice crosses the network. GUESSED."""

FADE = 5.0
"""[m] Length of the distance before :data:`REACH` over which loudness fades to zero, so that no sound begins abruptly.
GUESSED."""


def gain(distance: float) -> float:
    """Returns the amplitude of a sound at a ``distance`` [m], relative to its amplitude within :data:`REFERENCE`.

    The amplitude falls with 1/d and is 0 from :data:`REACH` on.
    """
    if not distance < REACH:
        return 0.0
    return REFERENCE / max(distance, REFERENCE) * min(1.0, (REACH - distance) / FADE)


# Who hears whom: people and robots hear each other; whether they hear spectators is a setting of the server
# (CANOPIES D6.4, section 4.3).


class SpectatorsSpeakTo(enum.StrEnum):
    """Setting of the server: which actors hear spectators."""

    NOBODY = "nobody"
    PEOPLE = "people"
    """People and other spectators hear spectators; robots do not."""
    ALL = "all"


def may_hear(speaker: str, hearer: str, setting: SpectatorsSpeakTo) -> bool:
    """Returns whether an actor of the kind ``hearer`` hears an actor of the kind ``speaker``.

    Kinds are "robot", "human" and "spectator".
    """
    if speaker != "spectator" or setting is SpectatorsSpeakTo.ALL:
        return True
    return setting is SpectatorsSpeakTo.PEOPLE and hearer != "robot"
