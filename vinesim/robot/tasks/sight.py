"""What a robot sees of a canopy: bunches and obstacles, as values without ids. A detector makes them
(:mod:`vinesim.perception.bunch_detection`), tasks use them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

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
