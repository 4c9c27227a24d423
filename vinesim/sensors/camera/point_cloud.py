"""Depth pictures as coloured points."""

from __future__ import annotations

import numpy as np

from vinesim.scene.values import CameraFrame, CameraInfo

POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
"""One point: metres in the optical frame, colour packed as 0x00RRGGBB (the PCL's convention)."""


def point_cloud(frame: CameraFrame, step: int = 1) -> np.ndarray:
    """Measured pixels as :data:`POINT` [point], in the optical frame (z forward, x right, y down).

    Only every ``step``-th row and column is taken.
    """
    info = frame.info
    z = frame.depth[::step, ::step]
    v, u = np.nonzero(np.isfinite(z))
    z = z[v, u]
    cloud = np.empty(len(z), POINT_DTYPE)
    cloud["x"] = (u * step - info.cx) / info.fx * z
    cloud["y"] = (v * step - info.cy) / info.fy * z
    cloud["z"] = z
    red, green, blue = frame.rgb[v * step, u * step].T.astype(np.uint32)
    cloud["rgb"] = red << 16 | green << 8 | blue
    return cloud


def project_points(points: np.ndarray, info: CameraInfo) -> np.ndarray:
    """Pixels [..., 2] of points [..., 3] m in the optical frame; NaN behind the camera."""
    points = np.asarray(points, float)
    z = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    return np.stack([points[..., 0] / z * info.fx + info.cx, points[..., 1] / z * info.fy + info.cy], -1)
