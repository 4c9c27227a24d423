"""Registration of two point clouds: the motion between them by ICP from a coarse pose, compared with the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.perception.clouds import as_matrix
from vinesim.perception.open3d_library import load_open3d

REACHES = (0.3, 0.1, 0.03)
"""Largest distances [m] between points that are paired, one for each run of ICP, from coarse to fine."""
NEIGHBOURS = 12
"""Number of neighbours from which the normal of a point is computed."""
_ITERATIONS = 50


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Result of :func:`register`."""

    pose: np.ndarray
    """[7] pose of the moving cloud's frame in the frame of the fixed cloud."""
    fitness: float
    """Share of the moving points that have a fixed point within the last reach, 0 to 1."""
    rmse: float
    """Root mean square distance [m] of these pairs."""

    def error(self, truth: Sequence[float] | np.ndarray) -> tuple[float, float]:
        """Returns the distance [m] and the angle [rad] between :attr:`pose` and the true pose ``truth`` [7]."""
        true = np.asarray(truth, float)
        turn = frames.multiply(frames.conjugate(true[3:]), self.pose[3:])
        return float(np.linalg.norm(self.pose[:3] - true[:3])), float(np.linalg.norm(frames.log(turn)))


def register(
    moving: Any,
    fixed: Any,
    start: Sequence[float] | np.ndarray | None = None,
    *,
    reaches: Sequence[float] = REACHES,
) -> Registration:
    """Find the pose of cloud ``moving`` in the frame of cloud ``fixed`` by point-to-plane ICP.

    Args:
        moving: point cloud of Open3D, such as ``scan.to_open3d()``.
        fixed: point cloud of Open3D.
        start: coarse pose [7] of the moving cloud's frame in the fixed cloud's frame; identity unless given.
        reaches: largest distances [m] between paired points, one for each run of ICP.
    """
    o3d = load_open3d()
    source, target = (_legacy(cloud, name) for cloud, name in ((moving, "moving"), (fixed, "fixed")))
    target.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    if not reaches or min(reaches) <= 0.0:
        raise UsageError(f"reaches are {list(reaches)}; give distances above 0 m")
    found = as_matrix(np.array([0, 0, 0, 0, 0, 0, 1.0]) if start is None else np.asarray(start, float))
    registration = o3d.pipelines.registration
    result: Any = None
    for reach in reaches:
        # a robust kernel: leaves that only one of the clouds shows have little weight
        plane = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(reach))
        criteria = registration.ICPConvergenceCriteria(1e-8, 1e-8, _ITERATIONS)
        result = registration.registration_icp(source, target, reach, found, plane, criteria)
        found = result.transformation
    pose = np.array([*found[:3, 3], *frames.from_matrix(found[:3, :3])])
    return Registration(pose, float(result.fitness), float(result.inlier_rmse))


def relative_pose(moving: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """Returns the true pose [7] of a sensor at pose ``moving`` [7] in the frame of a sensor at pose ``fixed`` [7]."""
    return frames.compose(frames.inverse(np.asarray(fixed, float)), np.asarray(moving, float))


def _legacy(cloud: Any, name: str) -> Any:
    """Returns a copy of a cloud as ``open3d.geometry.PointCloud`` without attributes."""
    o3d = load_open3d()
    points = cloud.point.positions.numpy() if hasattr(cloud, "point") else np.asarray(cloud.points)
    if len(points) < NEIGHBOURS:
        raise UsageError(f"the {name} cloud has {len(points)} points; give at least {NEIGHBOURS}")
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, float)))
