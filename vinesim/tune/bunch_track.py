"""Tracks of a hanging bunch from RGB-D pictures, without markers: the centre of its silhouette is followed.

The silhouette of a rigid body that turns in the plane of the picture turns with it, so its centre is fixed in the
bunch. Pixels near the bunch's measured depth are its silhouette; its edge comes from the colours, because depth grows
at edges and has whole pixels. The peduncle, which bends, is too thin to count.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy import ndimage

from vinesim.core import frames
from vinesim.scene.camera_geometry import back_project
from vinesim.scene.plant_parameters import Specimen
from vinesim.scene.values import CameraFrame
from vinesim.tune.cane_track import pixels_within
from vinesim.tune.marker_track import MIN_PIXELS
from vinesim.tune.specimen import marker_below
from vinesim.tune.trajectory import MIN_SAMPLES, Trajectory, TrajectoryError

LONGEST = 0.35
"""[m] Length beyond the peduncle up to which a point may belong to the bunch."""
SLAB = 0.2
"""[m] Largest difference in depth between the clamp and a point of the bunch."""
GROWN = 8
"""[pixel] Width by which measured depth may grow at the edge of the bunch, or fall short of it."""
RING = 12
"""[pixel] Width of the ring around the bunch that shows the background."""


def track_bunch(
    pictures: Iterable[CameraFrame], specimen: Specimen, *, base: np.ndarray, source: str = "pictures"
) -> Trajectory:
    """Track the centre of a bunch's silhouette in RGB-D pictures.

    A picture is a gap if the bunch is cut by its edge or not seen. Nothing else may be near the bunch. The track's
    marker is named by its distance from the clamp, as in ``154 mm``.

    Args:
        pictures: pictures in order of time, with colours and measured depth. Only one at a time is kept in memory.
        specimen: the bunch; length and diameters of its peduncle are used.
        base: [3] m, position of the peduncle's clamp in the world of the pictures' poses.
        source: name for messages.

    Raises :class:`~vinesim.tune.trajectory.TrajectoryError` for too few pictures, or if no picture shows the bunch.
    """
    base = np.asarray(base, float)
    time = []
    position = []
    clamps = []
    poses = []
    for picture in pictures:
        time.append(picture.time)
        clamp = frames.rotate(frames.conjugate(picture.pose[3:]), base - picture.pose[:3])
        position.append(_centre(picture, specimen, clamp))
        clamps.append(clamp)
        poses.append(picture.pose)
    # the pictures show only the front; a bunch hangs below its clamp, so the mean of its depth is that of the clamp
    local, pose = np.array(position).reshape(-1, 3), np.array(poses).reshape(-1, 7)
    off = (local - np.array(clamps).reshape(-1, 3))[np.isfinite(local[:, 2]), 2]
    ahead = float(np.median(off)) if len(off) else 0.0
    local = local * (1.0 - ahead / local[:, 2:])
    track = (pose[:, :3] + frames.rotate(pose[:, 3:], local))[:, None]
    if len(time) >= MIN_SAMPLES and not np.isfinite(track).any():
        x, y, z = base.round(3).tolist()
        raise TrajectoryError(
            f"{source}: none of {len(time)} pictures shows a whole bunch that hangs from a clamp at {x}, {y}, {z}; "
            "check the camera's pose, the clamp's position, and that the bunch is in sight"
        )
    below = float(np.nanmedian(np.linalg.norm(track[:, 0] - base, axis=1))) if len(time) else 0.0
    return Trajectory(np.array(time), track, (marker_below(below),), source=source)


def _centre(picture: CameraFrame, specimen: Specimen, clamp: np.ndarray) -> np.ndarray:
    """Returns the middle [3] m of the bunch's front in the camera's frame; NaN if it is not seen as a whole. ``clamp``
    [3] m: in the camera's frame."""
    nowhere = np.full(3, np.nan)
    length = specimen.length.value
    measured = pixels_within(picture, clamp, 0.5 * length, length + LONGEST, SLAB)
    if measured.sum() < MIN_PIXELS:
        return nowhere
    thin = specimen.base_diameter.value * picture.info.fx / float(np.median(picture.depth[measured]))
    # only the pixels around the bunch are used
    row, column = np.nonzero(measured)
    first = np.maximum([row.min() - 2 * RING, column.min() - 2 * RING], 0)
    box = tuple(
        slice(low, high + 2 * RING) for low, high in zip(first.tolist(), (row.max(), column.max()), strict=True)
    )
    measured, depth = measured[box], picture.depth[box]
    core = _opened(measured, thin + 2.0 * GROWN)
    if core.sum() < MIN_PIXELS or core[[0, -1]].any() or core[:, [0, -1]].any():
        return nowhere
    share = _share_by_colour(picture.rgb[box], core)
    share *= ndimage.binary_dilation(_opened(share > 0.5, thin + 2.0))
    row, column = np.nonzero(share)
    weight = share[row, column]
    centre = np.array([weight @ column, weight @ row]) / weight.sum() + first[::-1]
    away = np.array([np.median(depth[core & measured])])
    return back_project(centre[None], away, picture.info)[0]


def _opened(mask: np.ndarray, width: float) -> np.ndarray:
    """Returns the pixels of a mask without its parts that are thinner than ``width`` [pixel], holes filled."""
    reach = 0.5 * width
    kept = _depth_in(_filled(mask)) > reach
    return _depth_in(~kept) <= reach if kept.any() else kept


def _filled(mask: np.ndarray) -> np.ndarray:
    """Returns a mask with its holes filled."""
    found: Any = ndimage.binary_fill_holes(mask)
    return found


def _depth_in(mask: np.ndarray) -> np.ndarray:
    """Returns the distance [pixel] of each pixel of a mask from the nearest pixel outside of the mask."""
    found: Any = ndimage.distance_transform_edt(mask)  # distances only, as no indices are asked for
    return found


def _share_by_colour(rgb: np.ndarray, core: np.ndarray) -> np.ndarray:
    """Returns the share [height, width] of each pixel that the bunch covers.

    The colours inside ``core`` and in a ring around it give Fisher's linear discriminant; a pixel between the two means
    is covered in part.
    """
    outside = _depth_in(~core)
    inner = _depth_in(core) > GROWN
    ring = (outside > GROWN) & (outside <= GROWN + RING)
    near = outside <= GROWN
    if inner.sum() < MIN_PIXELS or ring.sum() < MIN_PIXELS:
        return core.astype(float)
    bunch, wall = rgb[inner].astype(float), rgb[ring].astype(float)
    spread = np.cov(bunch.T) + np.cov(wall.T) + np.eye(3)
    step = bunch.mean(0) - wall.mean(0)
    axis = np.linalg.solve(spread, step)
    share = ((rgb - wall.mean(0)) @ axis / (step @ axis)).clip(0.0, 1.0) * near
    share[inner] = 1.0
    solid = _filled(share > 0.5)
    share[solid & ndimage.binary_erosion(solid)] = 1.0
    return share * ndimage.binary_dilation(solid, iterations=1)
