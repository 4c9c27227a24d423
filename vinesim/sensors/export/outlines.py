"""Polygons along the pixel boundaries of masks, as trainers of instance segmentation read them.

A corner of a polygon is a corner of a pixel: pixel (column, row) fills the square from (column, row) to (column + 1,
row + 1), as in COCO. A polygon cannot have a hole by itself. So a cut of no width, there and back, joins each hole to
the outline around it. Rasterisers that count crossings, such as that of pycocotools, then leave the hole empty.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

_INSET_STEPS = 20
"""Number of insets in a pixel: an inset is 0.05 px. The raster of pycocotools, 0.2 px, is too coarse to see it."""


def mask_polygons(mask: np.ndarray, *, inset: bool = False) -> list[list[float]]:
    """Returns the polygons of a mask [height, width], one for each part: x and y of the corners [px] in turn.

    Pixels that touch at a corner belong to one part. The polygons fill exactly the pixels of the mask.

    Args:
        mask: bool or uint8 [height, width].
        inset: False: corners are whole numbers. True: corners lie 0.05 px inside of the mask, so that they remain in
            their pixel when a program truncates them, and fills the polygon together with its boundary.
    """
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return []
    corner = columns.min(), rows.min()
    window = mask[corner[1] : rows.max() + 1, corner[0] : columns.max() + 1]
    # In an image of twice the size, the contours of cv2, which run through pixels, tell the sides of a pixel apart.
    double = np.repeat(np.repeat(np.asarray(window, np.uint8), 2, 0), 2, 1)
    contours, tree = cv2.findContours(double, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = [contour[:, 0] for contour in contours]
    parents = [int(one[3]) for one in tree[0]]
    polygons = []
    for part, ring in enumerate(rings):
        if parents[part] >= 0:
            continue
        holes = [rings[k] for k, parent in enumerate(parents) if parent == part]
        for hole in sorted(holes, key=lambda hole: int(hole[:, 0].min())):
            ring = _cut_to_hole(double, ring, hole)
        lattice = (ring + 1) // 2 + corner
        if inset:  # an odd number is the right or lower side of a pixel
            polygons.append((_corners(_INSET_STEPS * lattice + 1 - 2 * (ring % 2)) / _INSET_STEPS).ravel().tolist())
        else:
            polygons.append(_corners(lattice).ravel().tolist())
    return polygons


def join_polygons(polygons: Sequence[Sequence[float]]) -> list[float]:
    """Returns one polygon of all the ``polygons``, joined by lines of no width, there and back, between near
    corners: a line of a YOLO file has one polygon."""
    rings = [np.array(one).reshape(-1, 2) for one in polygons]
    points = np.concatenate(rings)
    part = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    first = np.searchsorted(part, np.arange(len(rings)))
    squares = np.full(len(points), np.inf)  # squared distance of each point from the nearest one of `joined`, ...
    nearest = np.zeros_like(points)  # ... and that one
    joined = added = rings[0]
    left = np.flatnonzero(part != 0)
    while len(left):
        away = ((points[left, None] - added[None]) ** 2).sum(-1)  # only the part added last can be nearer than before
        is_nearer = away.min(1) < squares[left]
        squares[left[is_nearer]] = away.min(1)[is_nearer]
        nearest[left[is_nearer]] = added[away.argmin(1)[is_nearer]]
        there = int(left[squares[left].argmin()])
        here = int(np.flatnonzero((joined == nearest[there]).all(1))[0])
        added = rings[part[there]]
        joined = _splice(joined, here, added, there - int(first[part[there]]))
        left = left[part[left] != part[there]]
    return joined.ravel().tolist()


def _cut_to_hole(double: np.ndarray, ring: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Returns ``ring`` with a cut to a ``hole``, from the hole's leftmost pixel along its row to the left.

    The cut ends at the outline, or at a hole that begins farther left and is therefore part of ``ring`` already.
    """
    there = int(hole[:, 0].argmin())
    column, row = hole[there]
    gaps = np.flatnonzero(double[row, :column] == 0)
    end = gaps[-1] + 1 if len(gaps) else 0
    here = int(np.flatnonzero((ring == (end, row)).all(1))[0])
    return _splice(ring, here, hole, there)


def _splice(ring: np.ndarray, here: int, other: np.ndarray, there: int) -> np.ndarray:
    """Returns the ``ring``, with a line from its point ``here`` to point ``there`` of the ``other`` ring, once around
    it, and back."""
    return np.concatenate([ring[: here + 1], np.roll(other, -there, 0), other[there : there + 1], ring[here:]])


def _corners(ring: np.ndarray) -> np.ndarray:
    """Returns the points [n, 2] of a closed ring in which it turns."""
    ring = ring[(ring != np.roll(ring, 1, 0)).any(1)]
    before = ring - np.roll(ring, 1, 0)
    after = np.roll(ring, -1, 0) - ring
    is_straight = (before[:, 0] * after[:, 1] == before[:, 1] * after[:, 0]) & ((before * after).sum(1) > 0)
    return ring[~is_straight]
