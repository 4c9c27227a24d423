"""A list of rigid bodies with a version, which the client sends to a process, and memory for the poses of the bodies.

The sensor process shows the bodies; the ROS process publishes their poses as ground truth. Lists are compared by
content: a new list with the same content keeps its version. A message has the shapes only of the bodies that the
process does not have yet.
"""

from __future__ import annotations

import dataclasses

from vinesim.client.processes.shared_memory import SharedArrays
from vinesim.scene.values import RigidVisual, Shape

_FIRST_CAPACITY = 256
"""Least number of bodies for which the memory has room. If there are more bodies than room, new memory has room for
twice their number."""

_Key = tuple[str, int, int, int]
"""Key of a body: its name, organ and index, and the identity of its shapes."""


@dataclasses.dataclass(frozen=True)
class VisualListMessage:
    """Message with one version of a list of rigid bodies."""

    version: int
    """Number of the version, from 1."""
    numbers: tuple[int, ...]
    """Number of each body of the list. A body has the same number in all versions, as long as it stays in the list."""
    new: dict[int, RigidVisual]
    """Bodies that the version before did not have, by number."""
    visual_q: SharedArrays | None
    """New memory for the poses of the bodies, or None if the memory of the version before is still used."""


class VisualListSender:
    """Makes the messages for one run of a process, in the client."""

    def __init__(self) -> None:
        self.version = 0
        """Number of the newest version. 0 before the first list."""
        self._visuals: tuple[RigidVisual, ...] | None = None
        self._numbers: tuple[int, ...] = ()
        self._known: dict[_Key, tuple[int, tuple[Shape, ...]]] = {}
        """Number and shapes of each body in the list. A reference to the shapes keeps their identity from being used
        for another object."""
        self._next_number = 0
        self.capacity = 0
        """Number of bodies for which the memory has room."""
        self._memory: SharedArrays | None = None

    def update(self, visuals: tuple[RigidVisual, ...]) -> VisualListMessage | None:
        """Returns the message to send before poses of the bodies ``visuals`` are written. None if the last call had the
        same list."""
        if visuals is self._visuals:
            return None
        self._visuals = visuals
        known = {}
        new = {}
        for visual in visuals:
            key = (visual.name, int(visual.organ), visual.index, id(visual.shapes))
            if key in self._known:
                known[key] = self._known[key]
            else:
                known[key] = self._next_number, visual.shapes
                new[self._next_number] = visual
                self._next_number += 1
        numbers = tuple(number for number, _ in known.values())
        if numbers == self._numbers and self.version:
            return None
        self._known = known
        self._numbers = numbers
        self.version += 1
        memory = None
        if self._memory is None or len(visuals) > self.capacity:
            self.close()
            self.capacity = max(_FIRST_CAPACITY, 2 * len(visuals))
            memory = self._memory = SharedArrays({"visual_q": ((self.capacity, 7), "f8")})
        return VisualListMessage(self.version, numbers, new, memory)

    @property
    def memory(self) -> SharedArrays:
        """Memory for the poses of the bodies: array ``visual_q`` [capacity, 7]."""
        assert self._memory is not None, "no list was passed yet"
        return self._memory

    def close(self) -> None:
        """Release the memory."""
        if self._memory is not None:
            self._memory.close()


class VisualListReceiver:
    """Takes the messages, in the process."""

    def __init__(self) -> None:
        self.version = 0
        """Number of the newest version that has arrived. 0 before the first list."""
        self.visuals: tuple[RigidVisual, ...] = ()
        """Bodies of the newest version. The tuple is the same object as long as the version is the same."""
        self.memory: SharedArrays | None = None
        """Memory for the poses of the bodies: array ``visual_q`` [capacity, 7]. None before the first list."""
        self._by_number: dict[int, RigidVisual] = {}

    def take(self, message: VisualListMessage) -> None:
        """Take a message with a new version of the list."""
        known = self._by_number | message.new
        self._by_number = {number: known[number] for number in message.numbers}
        self.visuals = tuple(self._by_number.values())
        self.version = message.version
        if message.visual_q is not None:
            if self.memory is not None:
                self.memory.close()
            self.memory = message.visual_q
