"""Tracks of markers from RGB-D pictures. A marker is a coloured ball on a plant: its pixels are found by their colour,
and its centre is computed from the measured depth."""

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
"""Largest difference in hue between a pixel and the colour of a marker for which the pixel belongs to the marker [rad].

The difference is the angle between the two chromaticities as seen from grey. The shaded side of a ball differs from the
sunny side by 20 degrees.
"""
LEAST_SATURATION = 0.5
"""Smallest saturation with which a pixel belongs to a marker [1]: distance of the pixel's chromaticity from grey,
divided by the distance of the marker's colour from grey. A pixel that the marker covers by half has 0.5."""
DARKEST = 60
"""Smallest sum of red, green and blue (at most 765) with which a pixel may belong to a marker [1]; darker pixels have
no reliable hue."""
MIN_PIXELS = 12
"""Smallest number of pixels of a ball from which its centre is computed."""
MIDDLE_DEPTH = 0.707
"""Distance by which a ball's visible surface is nearer than its centre, in radii [1]: the median over the ball's
disc."""


Colour = tuple[int, int, int]
"""[3] Red, green and blue, 0 to 255; only their ratios matter."""


def track_marker(
    pictures: Iterable[CameraFrame], colour: Colour | Mapping[str, Colour], *, radius: float, source: str = "pictures"
) -> Trajectory:
    """Track a coloured ball at the tip, or several balls with different colours.

    In each picture the largest patch of the colour is the ball. The ball's direction is the centroid of the patch, its
    distance the median depth of the patch plus 0.7 radii. A picture is a gap if the patch is too small, touches the
    edge or has no depth.

    Args:
        pictures: pictures in order of time, with colours and measured depth. Only one at a time is kept in memory.
        colour: colour of the ball in the pictures, or of each marker by name. It should be saturated, with a hue that
            nothing else in the pictures has.
        radius: radius of the balls [m].
        source: name for messages.

    Raises :class:`~vinesim.tune.trajectory.TrajectoryError` for too few pictures, or if no picture shows the ball.
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
    """Returns the pixels [height, width] bool of the largest patch of a colour in ``rgb`` [height, width, 3], with
    holes filled.

    None if the patch is too small or touches the edge.
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
    sizes[0] = 0  # label 0 is the background
    largest = int(np.argmax(sizes))
    if sizes[largest] < MIN_PIXELS:
        return None
    patch = np.asarray(ndimage.binary_fill_holes(patches == largest))
    if patch[[0, -1]].any() or patch[:, [0, -1]].any():
        return None
    return patch


def _off_grey(rgb: np.ndarray) -> np.ndarray:
    """Returns the offset of each colour's chromaticity from grey [..., 3]: red, green and blue, each divided by their
    sum, minus 1/3."""
    return rgb / np.maximum(rgb.sum(-1, dtype=np.int32), 1)[..., None] - 1.0 / 3.0


def _centre(picture: CameraFrame, patch: np.ndarray | None, radius: float) -> np.ndarray:
    """Returns the centre [3] m in the world of the ball whose pixels are ``patch`` [height, width]; NaN if there is no
    patch."""
    depth = np.zeros(0) if patch is None else picture.depth[patch]
    depth = depth[np.isfinite(depth)]
    if patch is None or len(depth) < MIN_PIXELS:
        return np.full(3, np.nan)
    pixel = np.argwhere(patch).mean(0)[::-1]
    away = float(np.median(depth)) + MIDDLE_DEPTH * radius
    local = back_project(pixel, np.array(away), picture.info)
    return picture.pose[:3] + frames.rotate(picture.pose[3:], local)
