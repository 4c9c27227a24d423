"""Tracks of a point of a cane from RGB-D pictures, without markers: the cane is followed from its clamp.

The pixels of the cane are those whose measured point is within the cane's reach of the clamp. Their centre line is
integrated from the clamp to a given distance along the cane, so the point is fixed in the wood. Depth has whole pixels
and grows at edges; so the position across the cane comes from its colours, which differ from the background. Only one
point is tracked: its origin is fitted, which removes constant errors of the camera.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy import ndimage

from vinesim.core import frames
from vinesim.scene.camera_geometry import back_project, project_points
from vinesim.scene.plant_parameters import Specimen
from vinesim.scene.values import CameraFrame
from vinesim.tune.marker_track import MIN_PIXELS
from vinesim.tune.specimen import marker_at
from vinesim.tune.trajectory import MIN_SAMPLES, Trajectory, TrajectoryError

REACH = 1.05
"""Distance from the clamp up to which a point may belong to the cane, in lengths of the cane [1]."""
SLAB = 0.3
"""Largest difference in depth between the clamp and a point of the cane, in lengths of the cane [1]: the camera looks
across the cane, and a wall may be behind it."""
CLEAR = 0.05
"""[1] Distance from the clamp below which points do not count, in lengths of the cane: the clamp itself is there."""
DEGREE = 3
"""Degree of the polynomial across the cane through the pixels with depth, near which the colours are searched."""
LINE_DEGREE = 5
"""Degree of the polynomial across the cane through its colours; the second mode has three extrema."""
DEPTH_DEGREE = 2
"""Degree of the polynomial of the depth along the cane."""
GROW = 3
"""[pixel] Gaps in the depth of a cane that do not separate its parts."""
PROFILE = 14
"""[pixel] Half of the length of the profiles across the cane."""
BORDER = 4
"""[pixel] Length of either end of a profile that shows the background."""
LEAST_CONTRAST = 12.0
"""[1] Difference of the cane's colour from the background, of 255, below which the depth alone is used."""
FACE = 0.785
"""Mean distance of a rod's visible surface in front of its axis, in radii [1]: pi / 4."""


def track_cane(
    pictures: Iterable[CameraFrame],
    specimen: Specimen,
    *,
    base: np.ndarray,
    percent: int = 80,
    source: str = "pictures",
) -> Trajectory:
    """Track the point of a cane at ``percent`` of its length in RGB-D pictures.

    A picture is a gap if depth is missing around this point. Nothing else may be within the cane's reach of the clamp;
    what is connected to the cane in the picture is taken for the cane.

    Args:
        pictures: pictures in order of time, with colours and measured depth. Only one at a time is kept in memory.
        specimen: the cane; its length and diameters are used.
        base: [3] m, position of the clamp in the world of the pictures' poses.
        percent: place of the tracked point, 20 to 97 % of the length from the clamp.
        source: name for messages.

    Raises :class:`~vinesim.tune.trajectory.TrajectoryError` for too few pictures, or if no picture shows the cane.
    """
    time = []
    position = []
    for picture in pictures:
        time.append(picture.time)
        position.append(_follow(picture, specimen, np.asarray(base, float), 0.01 * percent))
    track = np.array(position).reshape(-1, 1, 3)
    if len(time) >= MIN_SAMPLES and not np.isfinite(track).any():
        x, y, z = np.asarray(base, float).round(3).tolist()
        raise TrajectoryError(
            f"{source}: none of {len(time)} pictures has depth of a cane up to {percent} % of its length from a clamp "
            f"at {x}, {y}, {z}; check the camera's pose, the clamp's position, and that the cane is in sight"
        )
    return Trajectory(np.array(time), track, (marker_at(percent),), source=source)


def _follow(picture: CameraFrame, specimen: Specimen, base: np.ndarray, share: float) -> np.ndarray:
    """Returns the point [3] m at the fraction ``share`` of the cane's length, in the world; NaN if it is not seen."""
    length = specimen.length.value
    clamp = frames.rotate(frames.conjugate(picture.pose[3:]), base - picture.pose[:3])
    pixel, depth = _cane_pixels(picture, clamp, length)
    if len(pixel) < MIN_PIXELS:
        return np.full(3, np.nan)
    thick, thin = 0.5 * specimen.base_diameter.value, 0.5 * specimen.tip_diameter.value
    depth = depth + FACE * (thick + (thin - thick) * share)
    # coordinates of the picture along the cane and across it, from the clamp's pixel on
    start = project_points(clamp, picture.info)
    along = _principal_direction(pixel, start)
    across = np.array([-along[1], along[0]])
    u = (pixel - start) @ along
    v = (pixel - start) @ across

    def line(at: np.ndarray, off: np.ndarray, away: np.ndarray) -> np.ndarray:
        """Points [n, 3] m in the camera's frame of pixels ``at`` along and ``off`` across the cane, ``away`` [m]."""
        return back_project(start + at[:, None] * along + off[:, None] * across, away, picture.info)

    scale = float(u.max())
    rough = np.polynomial.Polynomial(_robust_fit(u / scale, v, DEGREE, through=0.0))
    away = np.polynomial.Polynomial(_robust_fit(u / scale, depth, DEPTH_DEGREE, through=float(clamp[2])))
    # the middle of the cane across it by the colours of all of its pixels, then the distance from the clamp along it
    columns = np.arange(np.ceil(u.min()), scale)
    centre = rough(columns / scale)
    centre = centre + _centre_by_colour(picture.rgb, start + columns[:, None] * along, centre, across)
    side = np.polynomial.Polynomial(_robust_fit(columns / scale, centre, LINE_DEGREE))
    grid = np.linspace(0.0, scale, 400)
    curve = line(grid, side(grid / scale), away(grid / scale))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    if way[-1] < share * length:
        return np.full(3, np.nan)
    place = np.array([np.interp(share * length, way, grid)])
    point = line(place, side(place / scale), away(place / scale))[0]
    return picture.pose[:3] + frames.rotate(picture.pose[3:], point)


def _cane_pixels(picture: CameraFrame, clamp: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixels [n, 2] (column, row) of the cane and their depths [n] m. ``clamp`` [3] m: in the camera's
    frame."""
    near, far = CLEAR * length, REACH * length
    row, column = np.nonzero(pixels_within(picture, clamp, near, far, SLAB * length))
    return np.stack([column, row], -1).astype(float), picture.depth[row, column].astype(float)


def pixels_within(picture: CameraFrame, clamp: np.ndarray, near: float, far: float, slab: float) -> np.ndarray:
    """Returns the pixels [height, width] bool of the largest connected things whose measured points are ``near``
    to ``far`` [m] from the ``clamp`` and differ in depth by less than ``slab`` [m] from it.

    ``clamp`` [3] m: in the camera's frame.
    """
    seen = np.isfinite(picture.depth) & (np.abs(picture.depth - clamp[2]) < slab)
    row, column = np.nonzero(seen)
    pixel = np.stack([column, row], -1).astype(float)
    off = np.linalg.norm(back_project(pixel, picture.depth[seen].astype(float), picture.info) - clamp, axis=1)
    inside = (off < far) & (off > near)
    mask = np.zeros(seen.shape, bool)
    mask[row[inside], column[inside]] = True
    parts = np.zeros(mask.shape, np.int32)
    ndimage.label(ndimage.binary_dilation(mask, iterations=GROW), output=parts)
    sizes = np.bincount(parts[mask], minlength=2)
    sizes[0] = 0
    # parts of the plant behind a gap count; specks do not
    return mask & np.isin(parts, np.flatnonzero(sizes > 0.05 * sizes.max()))


def _centre_by_colour(rgb: np.ndarray, place: np.ndarray, off: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Returns offsets [n] pixel of the cane's middle from the line ``place`` + ``off`` * ``across``, by its colours.

    Args:
        rgb: picture [height, width, 3].
        place: [n, 2] pixels along the cane.
        off: [n] pixels, offset of the line from them.
        across: [2] unit vector across the cane.
    """
    reach = np.arange(-PROFILE, PROFILE + 1.0)
    column, row = np.moveaxis(place[:, None] + (off[:, None] + reach)[..., None] * across, -1, 0)
    profile = np.stack(
        [ndimage.map_coordinates(rgb[..., i].astype(float), [row, column], order=1, mode="nearest") for i in range(3)],
        -1,
    )  # [n, offset, colour]
    ends = profile[:, :BORDER].mean(1), profile[:, -BORDER:].mean(1)
    share = ((reach + PROFILE) / (2.0 * PROFILE))[:, None]
    contrast = np.linalg.norm(profile - (1.0 - share) * ends[0][:, None] - share * ends[1][:, None], axis=-1)
    top = contrast.max(1)
    weight = np.maximum(contrast - 0.3 * top[:, None], 0.0)
    clear = top > LEAST_CONTRAST
    return np.where(clear, (weight @ reach) / np.maximum(weight.sum(1), 1e-9), 0.0)


def _principal_direction(pixel: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Returns the unit vector [2] of the longest extent of pixels [n, 2], away from ``start``."""
    off = pixel - pixel.mean(0)
    along = np.linalg.svd(off, full_matrices=False)[2][0]
    return along if (pixel.mean(0) - start) @ along > 0.0 else -along


def _robust_fit(x: np.ndarray, y: np.ndarray, degree: int, through: float | None = None) -> np.ndarray:
    """Returns the coefficients [degree + 1], constant first, of a polynomial through points [n] with outliers.

    ``through``: value at 0; free unless given.
    """
    powers = np.vander(x, degree + 1, increasing=True)
    fixed = 0.0 if through is None else through
    basis = powers if through is None else powers[:, 1:]
    weight = np.ones(len(x))
    found = np.zeros(basis.shape[1])
    for _ in range(4):
        found = np.linalg.lstsq(basis * weight[:, None], (y - fixed) * weight, rcond=None)[0]
        off = np.abs(y - fixed - basis @ found)
        weight = 1.0 / np.sqrt(1.0 + (off / max(3.0 * float(np.median(off)), 1e-9)) ** 2)
    return found if through is None else np.concatenate([[fixed], found])
