"""The axis of one cane from its point cloud: the shape in which the cane hangs at rest, for a specimen.

Points are ordered by the length of the shortest path along the cloud from the base. The points are cut into slices of
this length, whose centres form the axis. Clouds that are not one cane (leaves, a second branch, a gap) are refused.
"""

from __future__ import annotations

import pathlib
from typing import Any

import msgspec
import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from vinesim.core.errors import UsageError
from vinesim.scene.plant_import.ply import read_points
from vinesim.scene.plant_parameters import AXIS_LENGTH, Specimen

VOXEL = 0.003
"""[m] Points that are nearer to each other than this are merged."""
GAP = 0.02
"""[m] Wider gaps separate two objects."""
SLICE = 0.025
"""[m] Length along the cane of the slice from which one point of the axis is computed."""
SPREAD = 0.02
"""[m] Largest distance of a slice's points from its centre: more than half a slice and the radius of any cane."""
MISSED = 0.05
"""[1] Largest fraction of the points that may be cut off by gaps."""


def with_cloud(specimen: Specimen, cloud: str | pathlib.Path | np.ndarray) -> Specimen:
    """Returns the specimen with its axis from a point cloud of the hanging cane.

    Args:
        specimen: a cane; the cloud replaces its ``direction`` and ``bow``.
        cloud: points [n, 3] m, world axes (z up), of this cane alone, with the clamped end nearest to the origin; or a
            file of points: PLY, or text with x, y and z in each line.

    Raises :class:`~vinesim.core.errors.UsageError` if the points are not one cane of the specimen's length.
    """
    if specimen.organ != "cane":
        raise UsageError(f"the specimen is a {specimen.organ}; only a cane takes its shape from a point cloud")
    source = "the point cloud" if isinstance(cloud, np.ndarray) else str(cloud)
    points = cloud if isinstance(cloud, np.ndarray) else read_points(pathlib.Path(cloud))
    axis = trace_axis(points, source)
    length = float(np.linalg.norm(np.diff(axis, axis=0), axis=1).sum())
    own = specimen.length.value
    if abs(length / own - 1.0) > AXIS_LENGTH:
        raise UsageError(
            f"{source}: its axis is {length:.3g} m long, the specimen {own:.3g} m; correct specimen.length, the unit "
            "of the points (m), or cut the cloud where the cane is clamped"
        )
    rows = tuple((round(x, 5), round(y, 5), round(z, 5)) for x, y, z in axis.tolist())
    return msgspec.structs.replace(specimen, axis=rows, direction=None, bow=(0.0, 0.0))


def trace_axis(points: np.ndarray, source: str = "the point cloud") -> np.ndarray:
    """Returns the axis [k, 3] m of one cane from points [n, 3] m on or near it; the axis begins at the origin.

    The base is the end nearest to the origin. Raises :class:`~vinesim.core.errors.UsageError` if the points are not one
    cane.
    """
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise UsageError(f"{source}: points have the shape {points.shape}; give [n, 3] finite numbers")
    _, cell = np.unique(np.floor(points / VOXEL).astype(np.int64), axis=0, return_inverse=True)
    count = np.bincount(cell.ravel())
    thin = np.stack([np.bincount(cell.ravel(), points[:, i]) / count for i in range(3)], -1)
    if len(thin) < 8:
        raise UsageError(f"{source}: {len(thin)} points further than {1e3 * VOXEL:g} mm apart; give more, in metres")
    tree = KDTree(thin)
    graph = tree.sparse_distance_matrix(tree, GAP, output_type="coo_matrix").tocsr()
    reached = np.isfinite(_ways(graph, int(np.argmin(np.linalg.norm(thin, axis=1)))))
    if reached.mean() < 1.0 - MISSED:
        raise UsageError(
            f"{source}: {(~reached).sum()} of {len(thin)} points are cut off from the base by gaps of more than "
            f"{1e3 * GAP:g} mm; give the points of one cane, in metres, without gaps"
        )
    thin = thin[reached]
    graph = graph[reached][:, reached]
    end = int(np.argmax(_ways(graph, int(np.argmin(np.linalg.norm(thin, axis=1))))))
    other = int(np.argmax(_ways(graph, end)))
    base = min(end, other, key=lambda one: float(np.linalg.norm(thin[one])))
    way = _ways(graph, base)
    count = max(round(float(way.max()) / SLICE), 2)
    number = np.minimum((count * way / way.max()).astype(int), count - 1)
    centres = np.array([thin[number == i].mean(0) for i in range(count)])
    _check_slices(thin, number, centres, source)
    # the ends are half a slice beyond the outermost centres
    first, last = (1.5 * centres[i] - 0.5 * centres[j] for i, j in ((0, 1), (-1, -2)))
    axis = np.concatenate([first[None], centres, last[None]])
    return axis - axis[0]


def _ways(graph: Any, start: int) -> np.ndarray:
    """Returns the length [point] m of the shortest path along the cloud from the point ``start`` to each point."""
    return dijkstra(graph, directed=False, indices=start)


def _check_slices(points: np.ndarray, number: np.ndarray, centres: np.ndarray, source: str) -> None:
    off = np.linalg.norm(points - centres[number], axis=1)
    if off.max() > SPREAD:
        worst = points[int(np.argmax(off))]
        x, y, z = worst.round(3).tolist()
        raise UsageError(
            f"{source}: the point {x}, {y}, {z} is {1e3 * off.max():.0f} mm off the axis: leaves, a second branch or "
            "stray points; cut them out of the cloud"
        )
