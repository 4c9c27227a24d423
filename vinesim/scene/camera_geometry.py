"""Geometry of pictures: intrinsic matrix, rays, lens distortion, projection and its inverse, depth, coloured points."""

from __future__ import annotations

import functools

import numpy as np

from vinesim.scene.values import CameraFrame, CameraInfo

MAX_MILLIMETRES = 65535.5
"""Smallest depth [mm] that does not fit into 16 bits."""
POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
"""One point of a cloud: metres in the optical frame, colour packed as 0x00RRGGBB (as in the PCL)."""


def intrinsic_matrix(info: CameraInfo) -> list[float]:
    """Returns the matrix K of sensor_msgs/CameraInfo, row by row [9] px."""
    return [info.fx, 0.0, info.cx, 0.0, info.fy, info.cy, 0.0, 0.0, 1.0]


def distortion_model(info: CameraInfo) -> tuple[str, tuple[float, ...]]:
    """Returns the name of the distortion model and its coefficients D, as in sensor_msgs/CameraInfo."""
    coefficients = info.distortion or NONE
    return MODELS[len(coefficients)], coefficients


@functools.lru_cache(maxsize=16)
def pixel_rays(info: CameraInfo) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ratios x / z and y / z of the ray through each pixel, float32. Pixel centres are whole numbers.

    The shapes are [1, width] and [height, 1] for a pinhole, to be broadcast, and [height, width] for a distorting lens.
    """
    across = (np.arange(info.width, dtype=np.float32)[None] - np.float32(info.cx)) / np.float32(info.fx)
    down = (np.arange(info.height, dtype=np.float32)[:, None] - np.float32(info.cy)) / np.float32(info.fy)
    if not info.distortion:
        return across, down
    rays = undistort(np.stack(np.broadcast_arrays(across, down), -1), info.distortion)
    return rays[..., 0].astype(np.float32), rays[..., 1].astype(np.float32)


def project_points(points: np.ndarray, info: CameraInfo) -> np.ndarray:
    """Returns the pixels [..., 2] (column, row) of points [..., 3] m in the optical frame; NaN behind the camera."""
    points = np.asarray(points, float)
    z = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    across = points[..., 0] / z
    down = points[..., 1] / z
    if info.distortion:
        bent = distort(np.stack([across, down], -1), info.distortion)
        across = bent[..., 0]
        down = bent[..., 1]
    return np.stack([across * info.fx + info.cx, down * info.fy + info.cy], -1)


def back_project(pixels: np.ndarray, depth: np.ndarray, info: CameraInfo) -> np.ndarray:
    """Returns the points [..., 3] m in the optical frame seen at pixels [..., 2] (column, row) at depths [...] m.

    The inverse of :func:`project_points`; pixels need not be whole. NaN at pixels that no ray reaches.
    """
    rays = (np.asarray(pixels, float) - [info.cx, info.cy]) / [info.fx, info.fy]
    if info.distortion:
        rays = undistort(rays, info.distortion)
    depth = np.asarray(depth, float)[..., None]
    return np.concatenate([rays * depth, np.broadcast_to(depth, (*rays.shape[:-1], 1))], -1)


def depth_millimetres(depth: np.ndarray) -> np.ndarray:
    """Returns a depth picture [height, width] m in the encoding 16UC1 of REP-118: millimetres, 0 for pixels without a
    measurement or beyond 16 bits."""
    millimetres = np.where(np.isfinite(depth), depth * 1000.0, 0.0)
    return np.where(millimetres < MAX_MILLIMETRES, np.round(millimetres), 0.0).astype(np.uint16)


def write_points(frame: CameraFrame, points_out: np.ndarray) -> None:
    """Write an organised cloud of :data:`POINT_DTYPE` [height, width]; x, y and z are NaN where there is no depth."""
    depth = np.where(np.isfinite(frame.depth), frame.depth, np.float32(np.nan))
    across, down = pixel_rays(frame.info)
    np.multiply(depth, across, out=points_out["x"])
    np.multiply(depth, down, out=points_out["y"])
    points_out["z"] = depth
    red, green, blue = (frame.rgb[..., i].astype(np.uint32) for i in range(3))
    points_out["rgb"] = red << 16 | green << 8 | blue


def measured_points(frame: CameraFrame, step: int = 1) -> np.ndarray:
    """Returns the measured pixels of every ``step``-th row and column as :data:`POINT_DTYPE` [point], in the optical
    frame."""
    cloud = np.empty(frame.depth.shape, POINT_DTYPE)
    write_points(frame, cloud)
    cloud = cloud[::step, ::step]
    return cloud[np.isfinite(cloud["z"])]


# Lens distortion as in sensor_msgs/CameraInfo and OpenCV: plumb_bob (Brown 1966) and rational_polynomial.
#
# The coefficients are k1 k2 p1 p2 k3; the second model adds k4 k5 k6. A point x, y of the plane at depth 1 appears at
#
#     x (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2), r2 = x^2 + y^2
#
# and likewise for y, with p1 and p2 exchanged.


MODELS = {5: "plumb_bob", 8: "rational_polynomial"}
"""Names of the models of lens distortion (as in sensor_msgs/CameraInfo), by their number of coefficients."""
NONE = (0.0, 0.0, 0.0, 0.0, 0.0)
"""Coefficients of a lens without distortion."""
_STEPS = 20
_TOLERANCE = 1e-9
"""[1] Tolerance of Newton's method in :func:`undistort`, for points in the plane at depth 1, in which a pixel is about
1e-3 wide.
"""


def _polynomials(r2: np.ndarray, coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the radial factor of the lens distortion and its derivative with respect to ``r2``, the squared distance
    of a point from the optical axis in the plane at depth 1.
    """
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(coefficients, (0, 8 - len(coefficients)))
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    slope_above = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    slope_below = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6)
    return above / below, (slope_above * below - above * slope_below) / below**2


def distort(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Returns the positions [..., 2] that a lens with these distortion coefficients gives to points [..., 2] in the
    plane at depth 1.
    """
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
    """Returns the derivatives of :func:`distort`: dx/dx, dx/dy (which equals dy/dx) and dy/dy."""
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
    """Returns the inverse of :func:`distort` at ``points`` [..., 2], by Newton's method; NaN where there is no inverse.

    A solution is accepted only if the map is one-to-one from the optical axis to the solution. Further out, a lens with
    these coefficients would show two directions at one point.
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
