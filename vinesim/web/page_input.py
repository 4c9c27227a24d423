"""Messages that a page (browser tab) sends: the last state that it has drawn, its viewpoint, and the poses of its
person's head and hands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec
import numpy as np

_Coordinate = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
_Component = Annotated[float, msgspec.Meta(ge=-1.01, le=1.01)]
_Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]

Pose = tuple[_Coordinate, _Coordinate, _Coordinate, _Component, _Component, _Component, _Component]
"""Pose [7] m, 1 in the world: x forward, z up."""


class TrackedHand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One hand of a person."""

    pose: Pose
    """Pose of the middle of the palm: x along the fingers, z out of the back of the hand."""
    closed: bool = False
    fingers: tuple[_Share, _Share, _Share, _Share, _Share] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Bend of thumb, index, middle, ring and little finger, from 0 to 1."""


class PlantWork(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Work on the plant next to the person's right hand."""

    what: Literal["tie", "untie", "take_leaves"]
    """As in :data:`vinesim.interaction.handwork.PLANT_WORK`."""
    number: Annotated[int, msgspec.Meta(ge=1)]
    """Number of this wish in the page. The page repeats its newest wish in every message."""


class TrackedPerson(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State of a person from a headset, or from mouse and keys. A hand that is None hangs down."""

    head: Pose
    left: TrackedHand | None = None
    right: TrackedHand | None = None
    intention: Annotated[str, msgspec.Meta(max_length=32)] = ""
    """Intention that the person indicates; empty: none."""
    shears: tuple[bool, bool] = (False, False)
    """Whether the left and the right hand have shears."""
    work: PlantWork | None = None
    """Newest work that the page's user wants; None: none so far."""


class ReplayCommand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A page's command to the player of a recording."""

    paused: bool
    speed: Annotated[float, msgspec.Meta(ge=0.05, le=20.0)]
    seek: Annotated[float, msgspec.Meta(ge=0.0, le=1e7)] | None = None
    """[s] Time since the beginning of the recording; None: continue at the present time."""


class PageInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One message of a page."""

    drawn: Annotated[int, msgspec.Meta(ge=-1)]
    """Tick of the newest state that the page has drawn."""
    view: Pose
    person: TrackedPerson | None = None
    overlays: bool = False
    """Whether the page shows contact forces or owners."""
    replay: ReplayCommand | None = None
    """Command of the user, only in pages of a recording."""

    def poses(self) -> list[Pose]:
        """All poses in the message."""
        person = self.person
        hands = () if person is None else (person.left, person.right)
        return [self.view, *(() if person is None else (person.head,)), *(hand.pose for hand in hands if hand)]


_decoder = msgspec.json.Decoder(PageInput)


def decode_input(text: str) -> PageInput | None:
    """Decode a page's message. Returns None if the message is invalid, or if a quaternion is not of unit length within
    1 %."""
    try:
        found = _decoder.decode(text)
    except (msgspec.MsgspecError, RecursionError, UnicodeError):
        return None
    squares = (sum(value * value for value in pose[3:]) for pose in found.poses())
    return found if all(abs(square - 1.0) < 0.02 for square in squares) else None


class _Place(msgspec.Struct, frozen=True):
    x: _Coordinate
    y: _Coordinate
    z: _Coordinate


def decode_place(query: Mapping[str, str]) -> np.ndarray | None:
    """Returns the position [3] m in x, y and z of a URL's query; None if they are missing or invalid."""
    try:
        found = msgspec.convert(dict(query), _Place, strict=False)
    except msgspec.ValidationError:
        return None
    place = np.array([found.x, found.y, found.z])
    return place if np.isfinite(place).all() else None
