"""Who hears whom, and how loud."""

from __future__ import annotations

import enum

# How loud a sound is at a distance: the free field's 1/d, nothing beyond hearing reach.


REFERENCE = 1.0
"""[m] Up to here a sound is as loud as it was recorded."""

REACH = 25.0
"""[m] Beyond it nothing is heard, and no voice crosses the network. GUESSED."""

FADE = 5.0
"""[m] Before :data:`REACH`: here loudness falls to nothing, so that nothing begins at once. GUESSED."""


def gain(distance: float) -> float:
    """Amplitude of a sound at a ``distance`` [m], relative to that within :data:`REFERENCE`: 1/d, and 0 from
    :data:`REACH` on."""
    if not distance < REACH:
        return 0.0
    return REFERENCE / max(distance, REFERENCE) * min(1.0, (REACH - distance) / FADE)


# Who hears whom: people and robots hear each other; whether they hear spectators is a setting of the server
# (CANOPIES D6.4, section 4.3).


class SpectatorsSpeakTo(enum.StrEnum):
    """Who hears spectators."""

    NOBODY = "nobody"
    PEOPLE = "people"
    """People and other spectators; robots are deaf to them."""
    ALL = "all"


def may_hear(speaker: str, hearer: str, setting: SpectatorsSpeakTo) -> bool:
    """Whether an actor of the kind ``hearer`` hears one of the kind ``speaker``: robot, human or spectator."""
    if speaker != "spectator" or setting is SpectatorsSpeakTo.ALL:
        return True
    return setting is SpectatorsSpeakTo.PEOPLE and hearer != "robot"
