"""Shapes as figure files describe them: paints, cones, cylinders, ellipsoids and boxes."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from vinesim.core import frames
from vinesim.core.toml_loader import DataError
from vinesim.scene.values import Shape

SURFACES = ("paint", "plastic", "cloth", "skin", "rubber", "metal", "straw", "reflex", "glass", "lamp")
"""Surfaces that a shape can have in addition to its colour."""
Surface = Literal["paint", "plastic", "cloth", "skin", "rubber", "metal", "straw", "reflex", "glass", "lamp"]
Point = tuple[float, float, float]
_Z_TO_X = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))


class AppearanceError(DataError):
    """Raised for a figure file that cannot be used. The message is one line with file, field, error and correction."""


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Paint(Table, frozen=True):
    """Colour and surface of a shape."""

    rgb: Point
    """Colour in sRGB, 0 to 1."""
    surface: Surface


class ShapeSpec(Table, frozen=True, kw_only=True):
    """Description of one shape of a part [m, rad]. ``kind`` determines which fields are used."""

    kind: Literal["cone", "cylinder", "ellipsoid", "box", "loft"]
    paint: str | tuple[str, ...]
    """Name of a :class:`Paint`; a loft may have one name for each strip between two rings."""
    start: Point = (0.0, 0.0, 0.0)
    """Start of the axis of a cone or a cylinder."""
    end: Point = (0.0, 0.0, 0.0)
    """End of the axis of a cone or a cylinder."""
    radius: tuple[float, float] = (0.0, 0.0)
    """Radii at both ends of a cone. A cylinder has the first radius at both ends."""
    at: Point = (0.0, 0.0, 0.0)
    """Centre of an ellipsoid or a box."""
    half: Point = (0.0, 0.0, 0.0)
    """Half axes of an ellipsoid, half edges of a box."""
    turn: Point = (0.0, 0.0, 0.0)
    """Rotation vector of an ellipsoid or a box [rad]."""
    twin: bool = False
    """Whether there is also a mirrored shape on the other side of the body."""
    along: Literal["x", "z"] = "z"
    """Axis of a loft: z (front is x) or x (front is z); left is y."""
    rings: tuple[tuple[float, ...], ...] = ()
    """[m] Rings of a loft. Each has: position on the axis, extent to the rear, extent to the front, half width, and
    offset to the left (default 0)."""
    arc: tuple[float, float] = (-180.0, 180.0)
    """Range of angles that a loft covers [degrees], counter-clockwise about its axis from the front."""
    arc_end: tuple[float, float] | None = None
    """Range of angles at the last ring, if it differs from ``arc``. Then ``arc`` applies at the first ring, and the
    range changes linearly between the two."""
    swell: float = 0.0
    """Distance by which a loft's rings are widened, for a patch on top of another loft."""
    sides: int = 20
    """Number of edges of a whole ring."""
    square: float = 2.0
    """Exponent of the rings: 2 for an ellipse, larger for a rounded rectangle."""


def check_spec(paints: dict[str, Paint], spec: ShapeSpec, place: str) -> None:
    """Raise :class:`AppearanceError`, with a message that names ``place``, if paints are unknown or the rings of a loft
    are wrong."""
    names = (spec.paint,) if isinstance(spec.paint, str) else spec.paint
    if missing := [name for name in names if name not in paints]:
        raise AppearanceError(f"{place}.paint is {missing[0]!r}; give one of: {', '.join(paints)}")
    if spec.kind != "loft":
        return
    if len(spec.rings) < 2 or any(len(ring) not in (4, 5) for ring in spec.rings):
        raise AppearanceError(
            f"{place}.rings: give two rings or more, each [place, rear, front, half width] or one more"
        )
    if not isinstance(spec.paint, str) and len(spec.paint) != len(spec.rings) - 1:
        raise AppearanceError(f"{place}.paint names {len(spec.paint)} paints; give one, or {len(spec.rings) - 1}")


def surface_fields(paint: Paint) -> tuple[tuple[float, float, float, float], str, str]:
    """Returns the fields ``rgba``, ``file`` and ``surface`` of a :class:`Shape` with this paint."""
    return (*paint.rgb, 1.0), "", paint.surface


def rod_shape(
    start: ArrayLike, end: ArrayLike, radius: tuple[float, float], scale: float, paint: Paint, kind: str = "cone"
) -> Shape:
    """Returns a round cone or a cylinder from one point [3] to another; all lengths [m] are multiplied by ``scale``."""
    a = scale * np.asarray(start, float)
    b = scale * np.asarray(end, float)
    half = 0.5 * float(np.linalg.norm(b - a))
    turn = frames.multiply(frames.from_x_axis(b - a), _Z_TO_X)
    ends = tuple(scale * r for r in radius) if kind == "cone" else (scale * radius[0],)
    return Shape(kind, (*ends, half), frames.pose(0.5 * (a + b), turn), *surface_fields(paint))
