"""The outline of a vine leaf: five lobes, saw teeth, and a sinus where the petiole joins.

Polar form around the petiole's junction, theta = 0 at the tip. A lobe at angle t with tip at distance L is the wedge
``r = L / (cos D + kappa |sin D|)``, D = theta - t; the blade is the union of its lobes. All lengths are in units of
``Model.leaf_size``, half of the blade's greatest width.
"""

from __future__ import annotations

import functools

import numpy as np

SHAPE_COUNT = 4
"""How many outlines there are, from deeply cut to round."""

_LOBES = ((0.0, 1.0), (np.radians(54.0), 0.88), (np.radians(112.0), 0.66))
"""Angle [rad] and length of middle, upper and lower lobes."""
_KAPPA = ((1.15, 1.0, 0.75), (1.45, 1.3, 0.9), (0.95, 0.85, 0.65), (1.3, 1.15, 0.8))
"""Slenderness of those lobes in each shape."""
_TEETH = 0.075
_TEETH_PER_LOBE = 11.0


def _blade(theta: np.ndarray, shape: int) -> np.ndarray:
    """Radius in units of the middle lobe."""
    radius = np.full_like(theta, 0.05)
    for (angle, length), kappa in zip(_LOBES, _KAPPA[shape], strict=True):
        for side in (1.0, -1.0) if angle else (1.0,):
            away = np.abs((theta - side * angle + np.pi) % (2.0 * np.pi) - np.pi)
            tooth = (_TEETH_PER_LOBE * away**0.85 + 0.17 * shape) % 1.0
            depth = _TEETH * np.clip(away / 0.06, 0.0, 1.0) * np.abs(2.0 * tooth - 1.0)
            wedge = length * (1.0 - depth) / (np.cos(away) + kappa * np.sin(away))
            radius = np.maximum(radius, np.where(away < 1.25, wedge, 0.0))
    closing = np.clip((np.pi - np.abs(theta) - 0.10) / 0.42, 0.0, 1.0)
    return radius * (0.06 + 0.94 * closing * closing * (3.0 - 2.0 * closing))


@functools.cache
def _circle(shape: int) -> tuple[float, float]:
    """Half width and area of the unscaled blade."""
    theta = np.linspace(-np.pi, np.pi, 4001)
    radius = _blade(theta, shape)
    width = float(np.abs(radius * np.sin(theta)).max())
    return width, float(np.trapezoid(0.5 * radius * radius, theta))


def blade_outline(theta: np.ndarray, shape: int = 0) -> np.ndarray:
    """Distance from the petiole's junction to the edge at ``theta`` [rad, -pi..pi], in units of ``leaf_size``."""
    return _blade(np.asarray(theta, float), shape) / _circle(shape)[0]


def blade_area(shape: int = 0) -> float:
    """Area of the flat blade [leaf_size^2]."""
    width, blade = _circle(shape)
    return blade / width**2


def blade_shape(leaf: np.ndarray) -> np.ndarray:
    """Which outline a leaf of that number has [leaf]: the same on every client."""
    scrambled = np.asarray(leaf, np.uint32) * np.uint32(2654435761)
    return (scrambled >> np.uint32(16)).astype(np.int32) % SHAPE_COUNT
