"""Harvest crates: slatted boxes built from a few dimensions in ``data/figures``."""

from __future__ import annotations

import functools
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import load_toml
from vinesim.scene.appearance.shapes import AppearanceError, Paint, Table, surface_fields
from vinesim.scene.values import Shape


class Crate(Table, frozen=True):
    """Dimensions [m] and paints of a harvest crate. The scene contains its outer size."""

    source: str
    paints: Annotated[tuple[Paint, ...], msgspec.Meta(min_length=1)]
    """Paints. Crate i of the scene has paint i modulo the number of paints."""
    wall: float
    """Thickness of walls and bottom."""
    slat: float
    """Height of a slat."""
    gap: float
    """Gap between two slats."""
    post: float
    """Width of the corner posts."""
    rib: float
    """Width of upright ribs."""
    ribs: float
    """Distance between ribs."""
    rim: float
    """Height of the rim."""
    grip: tuple[float, float]
    """Width and height of the handle hole below the rim at either end."""
    grid: float
    """Distance between bars of the bottom."""
    bar: float
    """Width of a bar."""


@functools.lru_cache(256)
def crate_shapes(size: tuple[float, float, float], number: int, name: str = "crate") -> tuple[Shape, ...]:
    """Returns the shapes of a slatted, open crate of outer ``size`` [m]. The origin is in the middle of its underside.
    ``number``: index of the crate."""
    one = load_toml(find_data_file("figures", name, ".toml"), Crate, AppearanceError)
    t = one.wall
    look = surface_fields(one.paints[number % len(one.paints)])
    length, width, height = size
    found: list[Shape] = []

    def add(low: ArrayLike, high: ArrayLike) -> None:
        a = np.asarray(low, float)
        b = np.asarray(high, float)
        if (b - a > 1e-6).all():
            found.append(Shape("box", tuple(0.5 * (b - a)), frames.pose(0.5 * (a + b)), *look))

    x = 0.5 * length
    y = 0.5 * width
    for half, side, along in ((x, y, 0), (y, x, 1)):  # bars along x, and bars along y on top of them
        count = max(round(2.0 * side / one.grid), 1) + 1
        for at in np.linspace(0.5 * one.bar - side, side - 0.5 * one.bar, count):
            order = [1, 0, 2] if along else [0, 1, 2]
            low = (-half, at - 0.5 * one.bar, 0.5 * t * along)
            high = (half, at + 0.5 * one.bar, 0.5 * t * (along + 1))
            add([low[k] for k in order], [high[k] for k in order])
    shelf = height - one.rim

    for half, side, along in ((x, y, 0), (y, x, 1)):  # the two end walls stand between the long walls
        for sign in (-1.0, 1.0):
            outer = sign * side
            inner = sign * (side - t)
            thin = sign * (side - 0.45 * t)

            def wall(a: float, b: float, low: float, high: float, depth: float, outer=outer, along=along) -> None:
                """Add a box to a wall: from ``a`` to ``b`` along the wall, from ``low`` to ``high``, of thickness
                ``depth`` from the outer face inwards."""
                first = (a, min(outer, depth), low)
                second = (b, max(outer, depth), high)
                order = [1, 0, 2] if along else [0, 1, 2]
                add([first[k] for k in order], [second[k] for k in order])

            reach = half if not along else half - t
            wall(-reach, reach, shelf, height, inner)
            wall(-reach, reach, 0.0, t + one.slat, thin)
            for end in (-1.0, 1.0):
                low, high = sorted((end * reach, end * (half - one.post)))
                wall(low, high, 0.0, shelf, inner)
            level = t + one.slat + one.gap
            hole = one.grip[0] / 2.0 if along else 0.0
            while level < shelf - 0.3 * one.gap:
                top = min(level + one.slat, shelf)
                if hole and top > shelf - one.grip[1]:
                    wall(-reach, -hole, level, top, thin)
                    wall(hole, reach, level, top, thin)
                else:
                    wall(-reach, reach, level, top, thin)
                level += one.slat + one.gap
            count = max(round(2.0 * half / one.ribs), 2)
            for at in np.linspace(-half, half, count + 1)[1:-1]:
                ceiling = shelf - one.grip[1] if hole > abs(at) else shelf
                wall(at - one.rib / 2.0, at + one.rib / 2.0, 0.0, ceiling, inner)
    return tuple(found)
