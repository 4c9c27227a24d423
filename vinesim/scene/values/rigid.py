"""Rigid bodies as sensors see them: shapes, meshes, names."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene.ids import Organ


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles, seen from where their corners run counter-clockwise."""

    corners: np.ndarray
    """[face, 3, 3] m"""
    normals: np.ndarray
    """[face, 3, 3] of the smooth surface at each corner."""


@dataclasses.dataclass(frozen=True, slots=True)
class Shape:
    """One visible or touchable primitive, in the frame of the link or body that carries it.

    ``kind`` is ``"capsule"`` (size: radius, half length along z), ``"sphere"`` (radius), ``"ellipsoid"``
    (half axes), ``"box"`` (half edges), ``"cylinder"`` (radius, half length along z), ``"cone"`` with round ends
    (radii at -z and +z, half length along z) or ``"mesh"`` (scale; ``file`` or ``mesh``).
    """

    kind: str
    size: tuple[float, ...]
    pose: np.ndarray
    """[7] m, 1"""
    rgba: tuple[float, float, float, float] = (0.6, 0.6, 0.6, 1.0)
    """sRGB"""
    file: str = ""
    surface: str = ""
    """What it is made of (:data:`vinesim.scene.appearance.SURFACES`); empty: what such things are usually made of."""
    mesh: Mesh | None = None


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigidBox:
    """An open box that can be moved, as it is when it comes into the world."""

    pose: np.ndarray
    """[7] m, 1 of the middle of its underside."""
    size: np.ndarray
    """[3] m, outer length, width, height."""
    mass: float
    """[kg]"""


@dataclasses.dataclass(frozen=True, slots=True)
class RigidVisual:
    """One rigid body as sensors see it: its name, what it is, and its shapes."""

    name: str
    """Full name, ``actor/link`` or ``box/3``."""
    organ: Organ
    index: int
    """Which robot, human or box: the index of its label."""
    shapes: tuple[Shape, ...]
