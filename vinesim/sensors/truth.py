"""What a picture truly shows: which bunches, how much of them, and where."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from vinesim.world.ids import LABEL_STRIDE, Organ
from vinesim.world.values import CameraFrame


@dataclasses.dataclass(frozen=True, slots=True)
class Sighting:
    """One bunch in one picture."""

    bunch: int
    """Index in the model."""
    pixels: int
    """How many pixels show it."""
    box: tuple[int, int, int, int]
    """First column, first row, last column, last row (inclusive) of those pixels."""
    distance: float
    """Median depth [m] of the pixels that measured; NaN if none did."""


def bunches(frame: CameraFrame) -> tuple[Sighting, ...]:
    """Every bunch of which at least one pixel is seen, by index."""
    rows, columns = np.nonzero(frame.labels // LABEL_STRIDE == int(Organ.BUNCH))
    index = frame.labels[rows, columns] % LABEL_STRIDE
    order = np.argsort(index, kind="stable")
    index, rows, columns = index[order], rows[order], columns[order]
    edges = np.flatnonzero(np.diff(index, prepend=-1, append=-1))
    sightings = []
    for first, last in itertools.pairwise(edges):
        r, c = rows[first:last], columns[first:last]
        depth = frame.depth[r, c]
        depth = depth[np.isfinite(depth)]
        sightings.append(
            Sighting(
                int(index[first]),
                int(last - first),
                (int(c.min()), int(r.min()), int(c.max()), int(r.max())),
                float(np.median(depth)) if len(depth) else float("nan"),
            )
        )
    return tuple(sightings)
