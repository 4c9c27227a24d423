"""What a robot sees of a canopy: bunches, canes and obstacles, as values without ids. Detectors make them
(:mod:`vinesim.perception.bunch_detection`, :mod:`vinesim.perception.cane_detection`), tasks use them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SeenBunch:
    """A bunch that was found in a picture."""

    top: np.ndarray
    """[3] m in the world: its upper end, on its axis. The stalk is above it."""
    length: float
    """Its length [m]."""
    radius: float
    """Half of its width [m]."""
    rating: float
    """Mean rating of its pixels; more is surer."""
    distance: float
    """Distance of its axis from the camera, along the optical axis [m]."""
    is_cut_off: bool
    """Whether it reaches the edge of the picture, so that it may be longer or wider."""

    @property
    def centre(self) -> np.ndarray:
        """Its middle [3] m in the world."""
        return self.top - np.array([0.0, 0.0, 0.5 * self.length])


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What one picture shows."""

    bunches: tuple[SeenBunch, ...]
    """Bunches, surest first."""
    wood: np.ndarray
    """[n, 3] m in the world: points of wood, posts and wires."""
    fruit: np.ndarray
    """[n, 3] m in the world: points that may be fruit."""


Eyes = Callable[[], Sight]
"""Returns what the robot's camera shows now."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RowMap:
    """What a robot knows of a row: its trellis, and where the vines are planted."""

    wire: np.ndarray
    """[2, 3] m in the world: two places of the fruiting wire. The row is along them; the cordon lies near the wire."""
    posts: np.ndarray
    """[n, 2] m in the world."""
    post_radius: float
    """[m]"""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SeenCane:
    """The lower part of a cane that was found in a picture."""

    points: np.ndarray
    """[n, 3] m in the world: its axis, from its base on spur or cordon upwards."""
    diameter: float
    """[m]"""
    nodes: np.ndarray
    """[k] m along the axis from the base, upwards."""
    distance: float
    """Distance of its base from the camera [m]."""
    is_cut_off: bool
    """Whether its base is at the edge of the picture."""

    @property
    def base(self) -> np.ndarray:
        """Its base [3] m in the world."""
        return self.points[0]

    def at(self, along: float) -> np.ndarray:
        """Returns the place [3] m on its axis, ``along`` [m] from its base."""
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1)))
        return np.array([np.interp(along, way, self.points[:, axis]) for axis in range(3)])


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CaneSight:
    """What one picture of a dormant row shows."""

    canes: tuple[SeenCane, ...]
    """Nearest first."""


class CaneEyes(Protocol):
    """Eyes that find canes."""

    def canes(self, row: RowMap) -> CaneSight:
        """Returns what the robot's camera shows of a row now."""
        ...


class RobotSight(CaneEyes, Protocol):
    """Eyes that find bunches (:data:`Eyes`) and canes."""

    def __call__(self) -> Sight:
        """Returns the bunches that the robot's camera shows now."""
        ...
