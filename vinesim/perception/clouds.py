"""Pictures and scans as point clouds of Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.perception.open3d_library import load_open3d
from vinesim.scene.camera_geometry import pixel_rays
from vinesim.scene.values import CameraFrame, LidarScan


def depth_of(frame: CameraFrame, exact: bool) -> np.ndarray:
    """Returns the depth [height, width] m of a picture, exact or measured. Raises :class:`UsageError` if the picture
    does not have it."""
    depth = frame.exact_depth if exact else frame.depth
    if depth is None or not depth.size:
        raise UsageError(f"the picture of {frame.name!r} has no {'exact' if exact else 'measured'} depth; render it")
    return depth


def picture_points(frame: CameraFrame, exact: bool = False) -> np.ndarray:
    """Returns the point [height, width, 3] m that each pixel shows, in the optical frame; NaN where there is no
    depth."""
    depth = depth_of(frame, exact)
    across, down = pixel_rays(frame.info)
    z = np.where(np.isfinite(depth), depth, np.nan).astype(float)
    return np.stack([across * z, down * z, z], -1)


def picture_cloud(
    frame: CameraFrame, *, world: bool = False, exact: bool = False, ids: bool = False, step: int = 1
) -> Any:
    """Returns a picture as an ``open3d.t.geometry.PointCloud`` with a point for every pixel that has depth.

    Args:
        frame: the picture.
        world: points in the frame of the world instead of the camera's optical frame.
        exact: use the exact depth instead of the measured depth.
        ids: add the attributes ``labels`` [point, 1] int32 (:func:`vinesim.scene.ids.label`) and ``pixels`` [point, 2]
            int32 (column, row).
        step: use every ``step``-th row and column only.
    """
    if step < 1:
        raise UsageError(f"step is {step}; give 1 or more")
    points = picture_points(frame, exact)[::step, ::step]
    shown = np.isfinite(points[..., 2])
    colours = frame.rgb[::step, ::step][shown] if frame.rgb.size else None
    attributes = {}
    if ids:
        if not frame.labels.size:
            raise UsageError(f"the picture of {frame.name!r} has no labels; render it with labels")
        rows, columns = np.nonzero(shown)
        attributes["labels"] = frame.labels[::step, ::step][shown][:, None]
        attributes["pixels"] = np.stack([columns * step, rows * step], 1)
    return _cloud(points[shown], frame.pose if world else None, colours, attributes)


def scan_cloud(scan: LidarScan, *, world: bool = False, ids: bool = False) -> Any:
    """Returns a scan as an ``open3d.t.geometry.PointCloud`` with the attributes ``intensity`` [point, 1] float32,
    ``ring`` [point, 1] int32 and ``time`` [point, 1] float32 s after the scan's first firing.

    Args:
        scan: the scan. Points are placed as if the lidar had been at ``scan.pose`` during the whole revolution.
        world: points in the frame of the world instead of the lidar's frame.
        ids: add the attribute ``labels`` [point, 1] int32 (:func:`vinesim.scene.ids.label`).
    """
    attributes = {"intensity": scan.intensity[:, None], "ring": scan.ring[:, None], "time": scan.offset[:, None]}
    if ids:
        attributes["labels"] = scan.labels[:, None]
    return _cloud(scan.xyz, scan.pose if world else None, None, attributes)


def as_matrix(pose: np.ndarray) -> np.ndarray:
    """Returns a pose [7] as a matrix [4, 4], as Open3D uses them."""
    matrix = np.eye(4)
    matrix[:3, :3] = frames.to_matrix(np.asarray(pose, float)[3:])
    matrix[:3, 3] = pose[:3]
    return matrix


def _cloud(
    points: np.ndarray, pose: np.ndarray | None, colours: np.ndarray | None, attributes: dict[str, np.ndarray]
) -> Any:
    """Returns points [n, 3] m, moved by ``pose`` [7], with colours [n, 3] 0 to 255 and further attributes [n, k]."""
    o3d = load_open3d()
    if pose is not None:
        points = pose[:3] + frames.rotate(np.asarray(pose, float)[3:], points.astype(float))
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points, np.float32)))
    if colours is not None:
        cloud.point.colors = o3d.core.Tensor(np.ascontiguousarray(colours, np.float32) / np.float32(255.0))
    for name, values in attributes.items():
        dtype = np.int32 if values.dtype.kind in "iu" else np.float32
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values, dtype))
    return cloud
