"""The list of rigid bodies that sensors show, with a version, as the client sends it to the sensor process.

The list is compared by content: a new list with the same content keeps its version. A message has the shapes only of
the bodies that the process does not have yet.
"""

from __future__ import annotations

import dataclasses

from vinesim.client.processes.shared_memory import SharedArrays
from vinesim.scene.values import RigidVisual, Shape

_FIRST_CAPACITY = 256
"""Number of bodies for whose poses there is room at first. It is doubled whenever there are more bodies."""

_Key = tuple[str, int, int, int]
"""Key of a body: its name, organ and index, and the identity of its shapes."""


@dataclasses.dataclass(frozen=True)
class VisualListMessage:
    """Message with one version of the list."""

    version: int
    numbers: tuple[int, ...]
    """Number of each body. Equal numbers mean the same body in all versions."""
    new: dict[int, RigidVisual]
    """Bodies that no earlier version had, by number."""
    visual_q: SharedArrays | None
    """Memory for the poses of the bodies, or None if it is the memory of the version before."""


class VisualListSender:
    """The client's side, for one run of the process."""

    def __init__(self) -> None:
        self.version = 0
        self._visuals: tuple[RigidVisual, ...] | None = None
        self._numbers: tuple[int, ...] = ()
        self._known: dict[_Key, tuple[int, tuple[Shape, ...]]] = {}
        """Number of each body in the list. The shapes are kept alive, so that no other object gets their identity."""
        self._next_number = 0
        self.capacity = 0
        self._memory: SharedArrays | None = None

    def update(self, visuals: tuple[RigidVisual, ...]) -> VisualListMessage | None:
        """The message to send before poses of this list are written. None if the list equals that of the last call."""
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
        """Room for the poses of the list's bodies, ``visual_q`` [capacity, 7]."""
        assert self._memory is not None, "no list was passed yet"
        return self._memory

    def close(self) -> None:
        """Release the memory."""
        if self._memory is not None:
            self._memory.close()


class VisualListReceiver:
    """The process's side."""

    def __init__(self) -> None:
        self.version = 0
        self.visuals: tuple[RigidVisual, ...] = ()
        """The bodies of the list. It is the same object as long as the version is the same."""
        self.memory: SharedArrays | None = None
        self._by_number: dict[int, RigidVisual] = {}

    def take(self, message: VisualListMessage) -> None:
        """Take over a version of the list."""
        known = self._by_number | message.new
        self._by_number = {number: known[number] for number in message.numbers}
        self.visuals = tuple(self._by_number.values())
        self.version = message.version
        if message.visual_q is not None:
            if self.memory is not None:
                self.memory.close()
            self.memory = message.visual_q
