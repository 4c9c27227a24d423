"""Tracks from RGB-D pictures: a marker ball found by its colour, its centre by the measured depth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from scipy import ndimage

from vinesim.core import frames
from vinesim.scene.camera_geometry import back_project
from vinesim.scene.values import CameraFrame
from vinesim.tune.specimen import TIP
from vinesim.tune.trajectory import MIN_SAMPLES, Trajectory, TrajectoryError

MAX_TURN = np.radians(30.0)
"""[rad] Largest difference in hue between a pixel of the marker and its colour, as the angle between their
chromaticities seen from grey. The side of a ball in the shade is 20 degrees off the side in the sun."""
LEAST_SATURATION = 0.5
"""[1] Least distance of its chromaticity from grey over the colour's: a pixel that is half marker has half of it."""
DARKEST = 60
"""[1] Sum of red, green and blue, of 765, below which a pixel has no colour to speak of."""
MIN_PIXELS = 12
"""Fewer do not show where the middle of a ball is."""
MIDDLE_DEPTH = 0.707
"""[1] Half of a ball's disc is nearer than its centre by more than so many radii: the median of its depth."""


Colour = tuple[int, int, int]
"""[3] red, green and blue, 0..255; only the ratios count."""


def track_marker(
    pictures: Iterable[CameraFrame], colour: Colour | Mapping[str, Colour], *, radius: float, source: str = "pictures"
) -> Trajectory:
    """The track of a ball of one colour at the tip, or of several, each of its own colour.

    In each picture the largest patch of that colour is the ball. Its place is the centroid of the patch, its distance
    the median of the depth there and 0.7 of the radius. A picture in which it is too small, touches the edge or has no
    depth is a gap.

    Args:
        pictures: in the order of time, with colours and measured depth. One at a time is held.
        colour: of the ball in the pictures, or of each marker by its name. It should be saturated, and of a hue that
            nothing else has.
        radius: [m] of the balls.
        source: a name for messages.

    :class:`~vinesim.tune.trajectory.TrajectoryError` for fewer pictures than a track has samples, or if none shows it.
    """
    colours = dict(colour) if isinstance(colour, Mapping) else {TIP: colour}
    time = []
    position = []
    patches = np.zeros(len(colours), int)
    for picture in pictures:
        time.append(picture.time)
        found = [find_marker(picture.rgb, one) for one in colours.values()]
        patches += [patch is not None for patch in found]
        position.append([_centre(picture, patch, radius) for patch in found])
    track = np.array(position).reshape(-1, len(colours), 3)
    for name, count, places in zip(colours, patches, track.swapaxes(0, 1), strict=True):
        if len(time) < MIN_SAMPLES or np.isfinite(places).any():
            continue
        if count:
            trouble = f"was found in {count} of {len(time)} pictures, but none has depth there; record aligned depth"
        else:
            trouble = f"was found in none of {len(time)} pictures; pick its colour in one of them"
        raise TrajectoryError(f"{source}: the marker {name!r} of colour {','.join(map(str, colours[name]))} {trouble}")
    return Trajectory(np.array(time), track, tuple(colours), source=source)


def find_marker(rgb: np.ndarray, colour: Colour) -> np.ndarray | None:
    """The pixels [height, width] bool of the largest patch of a colour in ``rgb`` [height, width, 3], holes filled.

    None if it is too small or touches the edge.
    """
    wanted = _off_grey(np.array(colour))
    tint = _off_grey(rgb)
    size = np.linalg.norm(wanted)
    along = tint @ (wanted / size)
    alike = (along > np.cos(MAX_TURN) * np.linalg.norm(tint, axis=-1)) & (along > LEAST_SATURATION * size)
    alike &= rgb.sum(-1, dtype=np.int32) > DARKEST
    patches = np.zeros(alike.shape, np.int32)
    ndimage.label(alike, output=patches)
    sizes = np.bincount(patches.ravel())
    sizes[0] = 0  # what is no patch
    largest = int(np.argmax(sizes))
    if sizes[largest] < MIN_PIXELS:
        return None
    patch = np.asarray(ndimage.binary_fill_holes(patches == largest))
    if patch[[0, -1]].any() or patch[:, [0, -1]].any():
        return None
    return patch


def _off_grey(rgb: np.ndarray) -> np.ndarray:
    """Shares [..., 3] of red, green and blue in their sum, less a third."""
    return rgb / np.maximum(rgb.sum(-1, dtype=np.int32), 1)[..., None] - 1.0 / 3.0


def _centre(picture: CameraFrame, patch: np.ndarray | None, radius: float) -> np.ndarray:
    """The centre [3] m in the world of the ball that shows as a patch [height, width]; NaN where there is none."""
    depth = np.zeros(0) if patch is None else picture.depth[patch]
    depth = depth[np.isfinite(depth)]
    if patch is None or len(depth) < MIN_PIXELS:
        return np.full(3, np.nan)
    pixel = np.argwhere(patch).mean(0)[::-1]
    away = float(np.median(depth)) + MIDDLE_DEPTH * radius
    local = back_project(pixel, np.array(away), picture.info)
    return picture.pose[:3] + frames.rotate(picture.pose[3:], local)
