"""Who hears whom: people and robots hear each other; whether they hear spectators is a setting of the server
(CANOPIES D6.4, section 4.3)."""

from __future__ import annotations

import enum


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
