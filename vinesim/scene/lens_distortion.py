"""Distortion of lenses as in sensor_msgs/CameraInfo and OpenCV: plumb_bob (Brown 1966) and rational_polynomial.

Coefficients are k1 k2 p1 p2 k3, of the second model k4 k5 k6 as well. A point x, y of the plane at depth 1 appears at

    x (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2), r2 = x^2 + y^2

and likewise for y, with p1 and p2 exchanged.
"""

from __future__ import annotations

import numpy as np

MODELS = {5: "plumb_bob", 8: "rational_polynomial"}
"""Names of the models by their number of coefficients."""
NONE = (0.0, 0.0, 0.0, 0.0, 0.0)
"""No distortion."""
_STEPS = 20
_TOLERANCE = 1e-9
"""Of points of the plane at depth 1; a pixel is a thousandth there."""


def _polynomials(r2: np.ndarray, coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The radial factor and its derivative by r2."""
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(coefficients, (0, 8 - len(coefficients)))
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    slope_above = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    slope_below = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6)
    return above / below, (slope_above * below - above * slope_below) / below**2


def distort(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Where points [..., 2] of the plane at depth 1 appear in it [..., 2]."""
    x = points[..., 0]
    y = points[..., 1]
    r2 = x * x + y * y
    p1, p2 = coefficients[2:4]
    radial, _ = _polynomials(r2, coefficients)
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        -1,
    )


def _jacobian(points: np.ndarray, coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of :func:`distort`: of x by x, of x by y (and of y by x, which is equal), of y by y."""
    x = points[..., 0]
    y = points[..., 1]
    p1, p2 = coefficients[2:4]
    radial, slope = _polynomials(x * x + y * y, coefficients)
    return (
        radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    )


def undistort(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """The points [..., 2] of the plane at depth 1 that appear at ``points`` [..., 2]; NaN where there is none.

    By Newton's method. A point counts only if the map is one-to-one on the way to it from the axis: beyond, a lens
    that these coefficients describe would show two directions at one place.
    """
    points = np.asarray(points, float)
    found = points.copy()
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            off = points - distort(found, coefficients)
            xx, xy, yy = _jacobian(found, coefficients)
            turn = np.stack([yy * off[..., 0] - xy * off[..., 1], xx * off[..., 1] - xy * off[..., 0]], -1)
            step = turn / (xx * yy - xy * xy)[..., None]
            found = found + step
            if not (np.abs(step) > _TOLERANCE).any():
                break
        is_good = (np.abs(distort(found, coefficients) - points) < 1e-6).all(-1)
        for share in np.linspace(0.1, 1.0, 10):
            xx, xy, yy = _jacobian(share * found, coefficients)
            is_good &= (xx > 0.0) & (xx * yy - xy * xy > 0.0)
    return np.where(np.expand_dims(is_good, -1), found, np.nan)
