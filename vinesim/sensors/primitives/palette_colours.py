"""A palette as kernels and pages use it: the colours that belong to no single primitive, by name."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels.shading import materials
from vinesim.scene.palette import DEFAULT, Palette, Rgb

_GROUND_COLOURS = ("soil_dark", "soil_light", "turf_dark", "turf_light", "field", "dry", "straw")
_GROUND_SHARES = ("cover", "most_cover", "far_cover", "strip", "dry_share", "straw_share")
_LEAF_COLOURS = ("margin", "scorch", "through", "under", "under_vein", "vein")
_WOOD_COLOURS = ("blotch", "bark_dark", "bark_light")
_SOIL_RATIO = 0.72
_SOD_RATIO = 1.45
"""Ratio of green to red albedo of the default palette's ground: up to ``_SOIL_RATIO`` it is bare soil, from
``_SOD_RATIO`` on it is sod. GUESSED."""
_CONTRAST = 3.0
"""Contrast of dry and green patches in sod, and of straw and bare patches in soil. GUESSED."""


def shared_colours(palette: Palette) -> dict[str, Rgb | float]:
    """Returns the fields of :class:`vinesim.kernels.shading.materials.Colours` by name: colours (linear RGB), shares
    and ratios."""
    ground = palette.ground
    soil, sod = _ratios(palette)
    return {
        **{name: getattr(ground, name) for name in (*_GROUND_COLOURS, *_GROUND_SHARES)},
        **{name: getattr(palette.leaf, name) for name in _LEAF_COLOURS},
        **{name: getattr(palette.wood, name) for name in _WOOD_COLOURS},
        "dry_gain": _gain(ground.dry_share),
        "straw_gain": _gain(ground.straw_share),
        "soil_ratio": soil,
        "sod_ratio": sod,
    }


def colour_struct(palette: Palette) -> materials.Colours:
    """Returns the kernel struct of the palette's shared colours."""
    struct = materials.Colours()
    for name, value in shared_colours(palette).items():
        setattr(struct, name, wp.vec3(*value) if isinstance(value, tuple) else float(value))
    return struct


def _gain(share: float) -> float:
    """Returns how much a share varies from place to place: not at all where it is 0 or 1."""
    return 4.0 * _CONTRAST * share * (1.0 - share)


def _ratios(palette: Palette) -> tuple[float, float]:
    """Returns the ratios of green to red albedo of bare soil and of sod; dry grass counts as soil."""
    ground = palette.ground
    if ground == DEFAULT.ground:
        return _SOIL_RATIO, _SOD_RATIO
    soil = max(green / max(red, 1e-6) for red, green, _ in (ground.soil_dark, ground.soil_light)) * 1.03
    turf = float(np.mean([green / max(red, 1e-6) for red, green, _ in (ground.turf_dark, ground.turf_light)]))
    return soil, max(turf, soil + 0.1)
