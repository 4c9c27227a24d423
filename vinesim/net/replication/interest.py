"""Interest management: cells of the ground, windows of cells around actors, and exact distances. No I/O.

The ground is divided into square cells. The owner of a moving object publishes its states under the object's cell. A
client that needs states subscribes to the 3x3 cells around itself, its window. A publisher without a subscriber sends
nothing (CANOPIES D6.4, section 5.1).

A cell is 6 m wide. With 1 m of hysteresis, 3x3 cells then cover 5 m on all sides: an arm, a bunch and the useful range
of a camera, about two vines of a tendone. Larger cells would cover more, but also contain more objects that are near no
actor: with ten robots and five people on 60 x 40 m, each moving five trees, a client receives 7.9 kB/s of trees with
cells of 6 m and 15.1 kB/s with cells of 8 m. Smaller cells would not cover 5 m. Among the objects that arrive in a
window, the exact distance decides which ones are used.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

CELL_SIZE = 6.0
"""Edge length of a cell [m]. All clients need the same value, because keys contain cells."""

HYSTERESIS = 1.0
"""Distance from the middle cell of its window at which an actor moves the window [m]."""

MAX_INTEREST_RADIUS = CELL_SIZE - HYSTERESIS
"""Distance around an actor that its window covers on all sides at any time [m]."""

INTEREST_RADIUS = 5.0
"""Default of the distance within which an actor receives states of objects that peers move [m]."""

POSE_RATE = 60.0
"""Number of poses that an actor publishes a second, each on one of the :data:`POSE_LAYERS`."""


class PoseLayer(NamedTuple):
    """A layer of poses: a share of an actor's poses under one key. Receivers subscribe to the layers that they need."""

    suffix: str
    """Suffix of the layer's key, after ``a/<actor>``."""
    every: int
    """Divisor of the pose rate: this layer and the layers before it in :data:`POSE_LAYERS` together contain every
    ``every``-th pose."""
    distance: float
    """Distance within which actors subscribe to the layer [m]."""


POSE_LAYERS = (
    PoseLayer("/far", 12, math.inf),
    PoseLayer("/mid", 4, 12.0),
    PoseLayer("/near", 2, 6.0),
    PoseLayer("", 1, 3.0),
)
"""Layers of poses: 5 Hz for all actors, and in all 15, 30 and 60 Hz within 12, 6 and 3 m.

The rate falls with the distance, so that an actor of a given speed moves by the same angle between two poses as seen
from the receiver. Within 3 m hands can touch each other."""

LAYER_HYSTERESIS = 1.2
"""Factor on the distance of a layer of poses beyond which a receiver unsubscribes from the layer."""

TREE_CELL_SIZE = 2.0
"""Edge length of the cells for states of trees [m]. It is small, so that receivers get few states of trees that are
beyond the distance of a layer."""


class TreeLayer(NamedTuple):
    """A layer of states of trees: a share of the states, under the keys of one family."""

    family: str
    """First chunk of the layer's keys."""
    distance: float
    """Distance within which actors receive the layer [m]. The interest radius is an upper bound."""
    tolerance: float
    """Error of a tree's copies above which a state is sent on this layer, as a factor on
    :data:`~vinesim.net.replication.dead_reckoning.POSITION_ERROR` and
    :data:`~vinesim.net.replication.dead_reckoning.ANGLE_ERROR`. The copies are those at peers that receive this layer
    and no later one."""


TREE_LAYERS = (TreeLayer("tree", MAX_INTEREST_RADIUS, 3.0), TreeLayer("near", 3.0, 1.0))
"""Layers of states of trees: copies are within 15 mm for all actors, and within 5 mm for those nearer than 3 m.

15 mm seen from 3 m are 5 mrad, like 5 mm seen from 1 m. A state on one layer also updates the copies of receivers that
subscribe to further layers."""

Cell = tuple[int, int]


def cell_of(position: np.ndarray) -> Cell:
    """Returns the cell that contains a position [2 or 3] m in the world."""
    return int(position[0] // CELL_SIZE), int(position[1] // CELL_SIZE)


def cells_of(positions: np.ndarray, size: float = CELL_SIZE) -> np.ndarray:
    """Returns the cells [k, 2] int that contain positions [k, 2 or 3] m in the world. ``size``: edge length of a cell
    [m]."""
    return np.floor(positions[:, :2] / size).astype(np.int64)


def tree_cells_within(position: np.ndarray, distance: float) -> set[Cell]:
    """Returns the cells for states of trees that have a point within ``distance`` [m] of a ``position`` [2 or 3] m."""
    low, high = (np.floor((position[:2] + way * distance) / TREE_CELL_SIZE).astype(int) for way in (-1.0, 1.0))
    x, y = (np.arange(low[axis], high[axis] + 1) for axis in (0, 1))
    # distance to the nearest edge of each column and each row of cells
    away = [
        np.maximum(np.maximum(TREE_CELL_SIZE * k - p, p - TREE_CELL_SIZE * (k + 1)), 0.0)
        for k, p in ((x, position[0]), (y, position[1]))
    ]
    column, row = np.nonzero(np.hypot(away[0][:, None], away[1][None, :]) <= distance)
    return set(zip(x[column].tolist(), y[row].tolist(), strict=True))


def cell_window(middle: Cell) -> frozenset[Cell]:
    """Returns the 3x3 cells around the cell ``middle``."""
    return frozenset((middle[0] + x, middle[1] + y) for x in (-1, 0, 1) for y in (-1, 0, 1))


def move_window(middle: Cell | None, position: np.ndarray) -> Cell:
    """Returns the middle cell of the window of an actor at ``position`` [m], with hysteresis.

    ``middle``: middle cell until now; None: there was none.
    """
    if middle is not None:
        x, y = position[:2].tolist()
        low_x = CELL_SIZE * middle[0] - HYSTERESIS
        low_y = CELL_SIZE * middle[1] - HYSTERESIS
        width = CELL_SIZE + 2.0 * HYSTERESIS
        if low_x <= x <= low_x + width and low_y <= y <= low_y + width:
            return middle
    return cell_of(position)


def check_radius(near: float) -> float:
    """Returns the interest radius ``near`` [m]. Raises ValueError if a window of cells does not cover it."""
    if not 0.0 < near <= MAX_INTEREST_RADIUS:
        raise ValueError(
            f"near = {near} m: must be above 0 and at most {MAX_INTEREST_RADIUS} m, what 3x3 "
            f"cells of {CELL_SIZE} m cover"
        )
    return float(near)


def count_listeners(middles: np.ndarray, actors: np.ndarray, near: float) -> np.ndarray:
    """Returns, for each position, the number of actors within the distance ``near`` [m] on the ground: [k] int.

    ``middles`` [k, 3] m: the positions. ``actors`` [a, 3] m: positions of the actors.
    """
    if not len(actors) or not len(middles):
        return np.zeros(len(middles), np.int64)
    x = middles[:, None, 0] - actors[None, :, 0]
    y = middles[:, None, 1] - actors[None, :, 1]
    return np.count_nonzero(x * x + y * y <= near * near, axis=1)


def count_layers(distance: float, now: int) -> int:
    """Returns how many of the :data:`POSE_LAYERS` to subscribe to, from the first on, for an actor at ``distance`` [m].

    ``now``: number of layers that are received at present, for hysteresis.
    """
    factors = (LAYER_HYSTERESIS if number < now else 1.0 for number in range(len(POSE_LAYERS)))
    return sum(distance <= layer.distance * factor for layer, factor in zip(POSE_LAYERS, factors, strict=True))


def pose_layer(before: int, number: int) -> int:
    """Returns the index of the layer in :data:`POSE_LAYERS` on which the pose with a ``number`` is sent.

    ``before``: number of the last pose that was sent. The pose also replaces skipped poses between ``before`` and
    ``number``, so the lowest index of the layers of all these poses is returned.
    """
    return next(i for i, layer in enumerate(POSE_LAYERS) if number // layer.every != before // layer.every)
