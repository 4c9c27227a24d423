"""Signals by the time of the world: indicator lights of robots, alike on all clients, and what people intend."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.robot.drives.robot_instance import RobotInstance
from vinesim.scene.values import Intention


def show_lights(actors: Iterable[RobotInstance | RemoteHuman], time: float) -> None:
    """Let the indicator lights of all robots flash as at a ``time`` of the world [s]; once a step."""
    for actor in actors:
        if isinstance(actor, RobotInstance):
            actor.show_lights(time)


class IntentionLog:
    """What each person indicated last, since when, and until when."""

    def __init__(self) -> None:
        self._known: dict[str, Intention] = {}

    @property
    def intentions(self) -> tuple[Intention, ...]:
        """The last one of each person, sorted by name."""
        return tuple(self._known[name] for name in sorted(self._known))

    def update(self, present: Mapping[str, str], time: float) -> bool:
        """Take what all people indicate at a ``time`` of the world [s], by name; whether that has changed.

        An intention whose person leaves has ended.
        """
        has_changed = False
        for name in self._known.keys() | present.keys():
            known, what = self._known.get(name), present.get(name, "")
            if (known.what if known is not None and known.end is None else "") == what:
                continue
            if what:
                self._known[name] = Intention(name, what, time)
            elif known is not None:
                self._known[name] = dataclasses.replace(known, end=time)
            has_changed = True
        return has_changed
