"""Geometry of pictures: intrinsic matrix, rays, projection and its inverse, depth in millimetres, coloured points."""

from __future__ import annotations

import functools

import numpy as np

from vinesim.scene import lens_distortion
from vinesim.scene.values import CameraFrame, CameraInfo

MAX_MILLIMETRES = 65535.5
"""From this depth [mm] on 16 bits cannot hold it."""
POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
"""One point: metres in the optical frame, colour packed as 0x00RRGGBB (the PCL's convention)."""


def intrinsic_matrix(info: CameraInfo) -> list[float]:
    """The matrix K of sensor_msgs/CameraInfo, row by row [9] px."""
    return [info.fx, 0.0, info.cx, 0.0, info.fy, info.cy, 0.0, 0.0, 1.0]


def distortion_model(info: CameraInfo) -> tuple[str, tuple[float, ...]]:
    """Name of the model of distortion and its coefficients D, as sensor_msgs/CameraInfo has them."""
    coefficients = info.distortion or lens_distortion.NONE
    return lens_distortion.MODELS[len(coefficients)], coefficients


@functools.lru_cache(maxsize=16)
def pixel_rays(info: CameraInfo) -> tuple[np.ndarray, np.ndarray]:
    """x per z and y per z of pixels, float32, to be broadcast: [1, width] and [height, 1] of a pinhole.

    Of a lens with distortion both are [height, width]. Pixel centres are whole numbers.
    """
    across = (np.arange(info.width, dtype=np.float32)[None] - np.float32(info.cx)) / np.float32(info.fx)
    down = (np.arange(info.height, dtype=np.float32)[:, None] - np.float32(info.cy)) / np.float32(info.fy)
    if not info.distortion:
        return across, down
    rays = lens_distortion.undistort(np.stack(np.broadcast_arrays(across, down), -1), info.distortion)
    return rays[..., 0].astype(np.float32), rays[..., 1].astype(np.float32)


def project_points(points: np.ndarray, info: CameraInfo) -> np.ndarray:
    """Pixels [..., 2] (column, row) of points [..., 3] m in the optical frame; NaN behind the camera."""
    points = np.asarray(points, float)
    z = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    across = points[..., 0] / z
    down = points[..., 1] / z
    if info.distortion:
        bent = lens_distortion.distort(np.stack([across, down], -1), info.distortion)
        across = bent[..., 0]
        down = bent[..., 1]
    return np.stack([across * info.fx + info.cx, down * info.fy + info.cy], -1)


def back_project(pixels: np.ndarray, depth: np.ndarray, info: CameraInfo) -> np.ndarray:
    """Points [..., 3] m in the optical frame that appear at pixels [..., 2] (column, row) at depths [...] m.

    The inverse of :func:`project_points`; pixels need not be whole. NaN where the lens shows nothing.
    """
    rays = (np.asarray(pixels, float) - [info.cx, info.cy]) / [info.fx, info.fy]
    if info.distortion:
        rays = lens_distortion.undistort(rays, info.distortion)
    depth = np.asarray(depth, float)[..., None]
    return np.concatenate([rays * depth, np.broadcast_to(depth, (*rays.shape[:-1], 1))], -1)


def depth_millimetres(depth: np.ndarray) -> np.ndarray:
    """Depth [height, width] m as the 16UC1 of REP-118: millimetres, 0 where nothing was measured or 16 bits
    overflow."""
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
    """Measured pixels as :data:`POINT_DTYPE` [point], in the optical frame; of every ``step``-th row and column."""
    cloud = np.empty(frame.depth.shape, POINT_DTYPE)
    write_points(frame, cloud)
    cloud = cloud[::step, ::step]
    return cloud[np.isfinite(cloud["z"])]
