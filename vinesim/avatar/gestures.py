"""Gestures: named finger poses of a hand, either made by the buttons of a controller or defined by the user.

Touching a button bends the thumb, the trigger bends the index finger, the grip bends the other three (D6.4, section
3.4). Six of the eight combinations are gestures. A TOML file can define more poses and assign them to buttons a and b:

    [poses]
    victory = [1.0, 0.0, 0.0, 1.0, 1.0]   # thumb, index, middle, ring, little finger

    [buttons]
    a = "victory"
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Annotated

import msgspec

from vinesim.core.toml_loader import DataError, load_toml

FingerBend = tuple[float, float, float, float, float]
"""[1] Bend of each finger from 0 to 1, thumb first; see :class:`vinesim.scene.values.HumanPose`."""

OPEN_HAND: FingerBend = (0.0, 0.0, 0.0, 0.0, 0.0)
FIST: FingerBend = (1.0, 1.0, 1.0, 1.0, 1.0)
GESTURES: dict[str, FingerBend] = {
    "open_hand": OPEN_HAND,
    "fist": FIST,
    "point": (1.0, 0.0, 1.0, 1.0, 1.0),
    "thumb_up": (0.0, 1.0, 1.0, 1.0, 1.0),
    "thumb_and_index": (0.0, 0.0, 1.0, 1.0, 1.0),
    "pinch": (1.0, 1.0, 0.0, 0.0, 0.0),
}
"""The six gestures. The two other combinations need no name: a bent thumb alone is close to the open hand, a bent index
finger alone is close to the pinch."""
MAX_DIFFERENCE = 0.4
"""Largest difference of any finger's bend at which a hand still shows a gesture [1]. GUESSED."""

_Bend = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class GestureError(DataError):
    """Error: a file of gestures cannot be used."""


class _Buttons(msgspec.Struct, forbid_unknown_fields=True):
    a: str = ""
    b: str = ""


class _GestureFile(msgspec.Struct, forbid_unknown_fields=True):
    poses: dict[str, tuple[_Bend, _Bend, _Bend, _Bend, _Bend]] = {}
    buttons: _Buttons = msgspec.field(default_factory=_Buttons)


@dataclasses.dataclass(frozen=True)
class Gestures:
    """The finger poses that one person can make."""

    poses: Mapping[str, FingerBend] = dataclasses.field(default_factory=lambda: dict(GESTURES))
    """Finger poses by name: those of :data:`GESTURES` and the person's own poses."""
    buttons: Mapping[str, FingerBend] = dataclasses.field(default_factory=dict)
    """Poses assigned to the buttons ``a`` and ``b`` of either controller (labelled x and y on a left one)."""

    @classmethod
    def load(cls, path: pathlib.Path) -> Gestures:
        """Returns the poses of :data:`GESTURES` and of a file. Raises :class:`GestureError` if the file cannot be
        used."""
        given = load_toml(path, _GestureFile, GestureError)
        poses = GESTURES | given.poses
        buttons = {button: name for button, name in msgspec.structs.asdict(given.buttons).items() if name}
        for button, name in buttons.items():
            if name not in poses:
                raise GestureError(f"{path}: buttons.{button}: no pose {name!r}; give one of {', '.join(poses)}")
        return cls(poses, {button: poses[name] for button, name in buttons.items()})

    def name_of(self, fingers: tuple[float, ...]) -> str:
        """Returns the name of the pose closest to ``fingers``; empty if none is within :data:`MAX_DIFFERENCE`."""
        away = {name: max(abs(a - b) for a, b in zip(fingers, pose, strict=True)) for name, pose in self.poses.items()}
        nearest = min(away, key=lambda name: away[name])
        return nearest if away[nearest] <= MAX_DIFFERENCE else ""


def finger_bend(*, closed: bool) -> FingerBend:
    """Returns the finger pose of a closed or open hand."""
    return FIST if closed else OPEN_HAND


def shears_grip(*, closed: bool) -> FingerBend:
    """Returns the finger pose of a hand that holds closed or open shears. GUESSED."""
    return (0.4, 0.8, 0.8, 0.8, 0.8) if closed else (0.2, 0.5, 0.5, 0.5, 0.5)
