"""Signals by the time of the world: indicator lights of robots, alike on all clients; what people intend, and what
their hands show."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

from vinesim.avatar.gestures import Gestures
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.robot.drives.robot_instance import RobotInstance
from vinesim.scene.values import HandGestures, HumanPose, Intention


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
    """What the hands of all people show: the six gestures, by name."""

    def __init__(self) -> None:
        self._known = Gestures()
        self._fingers: list[tuple[str, tuple[float, ...], tuple[float, ...]]] = []
        self.gestures: tuple[HandGestures, ...] = ()
        """Sorted by the person's name."""

    def update(self, people: Mapping[str, HumanPose]) -> bool:
        """Take the poses of all people by name; whether what any hand shows has changed."""
        fingers = [(name, people[name].left_fingers, people[name].right_fingers) for name in sorted(people)]
        if fingers == self._fingers:
            return False
        self._fingers = fingers
        before = self.gestures
        name_of = self._known.name_of
        self.gestures = tuple(HandGestures(name, name_of(left), name_of(right)) for name, left, right in fingers)
        return self.gestures != before
