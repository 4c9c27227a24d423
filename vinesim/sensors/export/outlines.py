"""Polygons along the pixel boundaries of masks, as trainers of instance segmentation read them.

A corner of a polygon is a corner of a pixel: pixel (column, row) fills the square from (column, row) to (column + 1,
row + 1), as in COCO. A polygon cannot have a hole by itself. So a cut of no width, there and back, joins each hole to
the outline around it. Rasterisers that count crossings, such as that of pycocotools, then leave the hole empty.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np


def mask_polygons(mask: np.ndarray) -> list[list[int]]:
    """Returns the polygons of a mask [height, width], one for each part: x and y of the corners [px] in turn.

    Pixels that touch at a corner belong to one part. The polygons fill exactly the pixels of the mask.
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
        polygons.append(_corners((ring + 1) // 2 + corner).ravel().tolist())
    return polygons


def join_polygons(polygons: Sequence[Sequence[int]]) -> list[int]:
    """Returns one polygon of all the ``polygons``, joined by lines of no width, there and back, between near
    corners: a line of a YOLO file has one polygon."""
    rings = [np.array(one).reshape(-1, 2) for one in polygons]
    joined = rings.pop(0)
    while rings:
        others = np.concatenate(rings)
        squares = ((joined[:, None] - others[None]) ** 2).sum(-1)
        here, there = divmod(int(squares.argmin()), len(others))
        part = 0
        while there >= len(rings[part]):
            there -= len(rings[part])
            part += 1
        joined = _splice(joined, here, rings.pop(part), there)
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
