"""Signals of robots and people: indicator lights, intentions, and gestures of hands.

Lights flash by the time of the world, and so are equal on all clients.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

from vinesim.avatar.gestures import Gestures
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.robot.drives.robot_instance import RobotInstance
from vinesim.scene.values import HandGestures, HumanPose, Intention


def show_lights(actors: Iterable[RobotInstance | RemoteHuman], time: float) -> None:
    """Let the indicator lights of all robots show their state at ``time`` of the world [s]. Call it once a step."""
    for actor in actors:
        if isinstance(actor, RobotInstance):
            actor.show_lights(time)


class IntentionLog:
    """The last intention that each person indicated, with its begin and end."""

    def __init__(self) -> None:
        self._known: dict[str, Intention] = {}

    @property
    def intentions(self) -> tuple[Intention, ...]:
        """The last intention of each person, sorted by the person's name."""
        return tuple(self._known[name] for name in sorted(self._known))

    def update(self, present: Mapping[str, str], time: float) -> bool:
        """Record the intentions of all ``present`` people, by name, at ``time`` of the world [s].

        Returns whether any has changed. If a person leaves, the person's intention ends.
        """
        has_changed = False
        for name in self._known.keys() | present.keys():
            known = self._known.get(name)
            what = present.get(name, "")
            if (known.what if known is not None and known.end is None else "") == what:
                continue
            if what:
                self._known[name] = Intention(name, what, time)
            elif known is not None:
                self._known[name] = dataclasses.replace(known, end=time)
            has_changed = True
        return has_changed


class GestureLog:
    """The gestures that the hands of all people show, of six kinds, by name."""

    def __init__(self) -> None:
        self._known = Gestures()
        self._fingers: list[tuple[str, tuple[float, ...], tuple[float, ...]]] = []
        self.gestures: tuple[HandGestures, ...] = ()
        """Gestures of the hands of each person, sorted by the person's name."""

    def update(self, people: Mapping[str, HumanPose]) -> bool:
        """Record the gestures in the poses of all people, by name. Returns whether the gesture of any hand has
        changed."""
        fingers = [(name, people[name].left_fingers, people[name].right_fingers) for name in sorted(people)]
        if fingers == self._fingers:
            return False
        self._fingers = fingers
        before = self.gestures
        name_of = self._known.name_of
        self.gestures = tuple(HandGestures(name, name_of(left), name_of(right)) for name, left, right in fingers)
        return self.gestures != before
