"""Visible rigid bodies: shapes, meshes, names."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene.ids import Organ


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles of a surface. A triangle's front is the side from which its corners are in counter-clockwise order."""

    corners: np.ndarray
    """[face, 3, 3] m, corners of each triangle."""
    normals: np.ndarray
    """[face, 3, 3] unit normals of the smooth surface at each corner."""


@dataclasses.dataclass(frozen=True, slots=True)
class Shape:
    """One primitive for sensors or collisions, in the frame of its link or body.

    ``kind`` is ``"capsule"`` (size: radius, half length along z), ``"sphere"`` (radius), ``"ellipsoid"``
    (half axes), ``"box"`` (half edges), ``"cylinder"`` (radius, half length along z), ``"cone"`` with round ends
    (radii at -z and +z, half length along z) or ``"mesh"`` (scale; ``file`` or ``mesh``).
    """

    kind: str
    size: tuple[float, ...]
    pose: np.ndarray
    """[7] m, xyzw: pose of the shape in the frame of its link or body."""
    rgba: tuple[float, float, float, float] = (0.6, 0.6, 0.6, 1.0)
    """Colour (sRGB) and opacity, 0 to 1."""
    file: str = ""
    surface: str = ""
    """Surface, one of :data:`vinesim.scene.appearance.SURFACES`; empty: a default for the kind of object."""
    mesh: Mesh | None = None
    is_indicator: bool = False
    """Whether the shape is one of a robot's indicator lights."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigidBox:
    """An open, movable box in its initial state."""

    pose: np.ndarray
    """[7] m, 1, pose of the middle of its underside."""
    size: np.ndarray
    """[3] m, outer length, width, height."""
    mass: float
    """[kg] Mass of the box."""


@dataclasses.dataclass(frozen=True, slots=True)
class Stalk:
    """Where a bunch was cut in its peduncle. It has the stalk beyond the cut; the stump stays on the vine."""

    segment: int
    """Body of the segment of the peduncle that was cut."""
    at: float
    """[m] Distance of the cut from the segment's origin."""
    pieces: int
    """Number of pieces of the stalk: the last shapes of the free bunch, from the cut to the bunch."""


@dataclasses.dataclass(frozen=True, slots=True)
class RigidVisual:
    """One visible rigid body for pictures, scans and the web page: name, organ, index and shapes."""

    name: str
    """Full name, such as ``robot_0/gripper_link`` (actor and link) or ``box/3``."""
    organ: Organ
    index: int
    """Index of the robot, person or box in label images (:func:`vinesim.scene.ids.label`)."""
    shapes: tuple[Shape, ...]
    stalk: Stalk | None = None
    """Stalk of a bunch that was cut in its peduncle."""
