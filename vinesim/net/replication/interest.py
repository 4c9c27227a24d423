"""Interest management: cells of the ground, windows of cells around actors, and exact distances; pure.

The ground is divided into square cells. The owner of a moving object publishes under the object's cell; a client that
needs states subscribes to the 3x3 cells around itself. A publisher without a subscriber sends nothing (CANOPIES D6.4,
section 5.1).

A cell is 6 m wide. With 1 m of hysteresis 3x3 cells then guarantee 5 m on all sides: an arm, a bunch and a camera's
good range, about two vines of a tendone. Larger cells reach farther but carry more that is near no actor: with ten
robots and five people on 60 x 40 m, each moving five trees, a client receives 7.9 kB/s of trees with cells of 6 m and
15.1 kB/s with cells of 8 m. Smaller ones would not cover 5 m. Inside the window the exact distance decides.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

CELL_SIZE = 6.0
"""Edge of a cell [m]; equal for all clients, because cells are part of the keys."""

HYSTERESIS = 1.0
"""A window moves only when its actor is this far outside of the middle cell [m]."""

MAX_INTEREST_RADIUS = CELL_SIZE - HYSTERESIS
"""Distance that a window covers on all sides, wherever in its hysteresis the actor is [m]."""

INTEREST_RADIUS = 5.0
"""Default distance within which an actor receives states of objects that peers move [m]."""

POSE_RATE = 60.0
"""Number of poses that an actor publishes a second. Each goes to one layer only. A receiver subscribes to the layers
that it needs."""


class PoseLayer(NamedTuple):
    """A share of the poses of an actor, under a key of its own."""

    suffix: str
    """Suffix that is appended to the key ``a/<actor>``."""
    every: int
    """This layer and all layers before it in the list together carry every ``every``-th pose."""
    distance: float
    """[m] Actors within this distance subscribe to the layer."""


POSE_LAYERS = (
    PoseLayer("/far", 12, math.inf),
    PoseLayer("/mid", 4, 12.0),
    PoseLayer("/near", 2, 6.0),
    PoseLayer("", 1, 3.0),
)
"""Layers of poses: 5 Hz for all actors, and 15, 30 and 60 Hz within 12, 6 and 3 m. The rate falls with the distance so
that an actor of a given speed moves by the same angle between two poses, seen from the receiver. Hands touch within
3 m."""

LAYER_HYSTERESIS = 1.2
"""A layer is received until the actor is farther away than this factor times the distance of the layer."""

TREE_CELL_SIZE = 2.0
"""Edge of a cell of the states of trees [m]. It is small so that few states arrive from trees beyond the distance of a
layer."""


class TreeLayer(NamedTuple):
    """A share of the states of trees, under a family of keys of its own."""

    family: str
    """First chunk of the keys."""
    distance: float
    """[m] Actors within this distance receive the layer. For the first layer the interest radius is the upper bound."""
    tolerance: float
    """A state is sent if the copies of receivers that receive no further layer are wrong by this factor times
    :data:`~vinesim.net.replication.dead_reckoning.POSITION_ERROR` or
    :data:`~vinesim.net.replication.dead_reckoning.ANGLE_ERROR`."""


TREE_LAYERS = (TreeLayer("tree", MAX_INTEREST_RADIUS, 3.0), TreeLayer("near", 3.0, 1.0))
"""Beyond 3 m a copy of a tree may be wrong by 15 mm, which is 5 mrad seen from there; an error of 5 mm is seen from 1 m
at the same angle. A state on a layer counts for all layers after it."""

Cell = tuple[int, int]


def cell_of(position: np.ndarray) -> Cell:
    """The cell of a position [2 or 3] m, world axes."""
    return int(position[0] // CELL_SIZE), int(position[1] // CELL_SIZE)


def cells_of(positions: np.ndarray, size: float = CELL_SIZE) -> np.ndarray:
    """Cells [k, 2] int of ``size`` [m] of positions [k, 2 or 3] m."""
    return np.floor(positions[:, :2] / size).astype(np.int64)


def tree_cells_within(position: np.ndarray, distance: float) -> set[Cell]:
    """Cells of the states of trees that have a point within ``distance`` [m] of ``position`` [2 or 3] m."""
    low, high = (np.floor((position[:2] + way * distance) / TREE_CELL_SIZE).astype(int) for way in (-1.0, 1.0))
    x, y = (np.arange(low[axis], high[axis] + 1) for axis in (0, 1))
    # how far the nearest edge of each column and row is away
    away = [
        np.maximum(np.maximum(TREE_CELL_SIZE * k - p, p - TREE_CELL_SIZE * (k + 1)), 0.0)
        for k, p in ((x, position[0]), (y, position[1]))
    ]
    column, row = np.nonzero(np.hypot(away[0][:, None], away[1][None, :]) <= distance)
    return set(zip(x[column].tolist(), y[row].tolist(), strict=True))


def cell_window(middle: Cell) -> frozenset[Cell]:
    """The 3x3 cells around ``middle``."""
    return frozenset((middle[0] + x, middle[1] + y) for x in (-1, 0, 1) for y in (-1, 0, 1))


def move_window(middle: Cell | None, position: np.ndarray) -> Cell:
    """Middle cell of the window of an actor at ``position`` [m] whose middle cell was ``middle``, with hysteresis."""
    if middle is not None:
        x, y = position[:2].tolist()
        low_x = CELL_SIZE * middle[0] - HYSTERESIS
        low_y = CELL_SIZE * middle[1] - HYSTERESIS
        width = CELL_SIZE + 2.0 * HYSTERESIS
        if low_x <= x <= low_x + width and low_y <= y <= low_y + width:
            return middle
    return cell_of(position)


def check_radius(near: float) -> float:
    """Returns the radius ``near`` [m] if a window covers it. Otherwise raises ValueError with the bound."""
    if not 0.0 < near <= MAX_INTEREST_RADIUS:
        raise ValueError(
            f"near = {near} m: must be above 0 and at most {MAX_INTEREST_RADIUS} m, what 3x3 "
            f"cells of {CELL_SIZE} m cover"
        )
    return float(near)


def count_listeners(middles: np.ndarray, actors: np.ndarray, near: float) -> np.ndarray:
    """Number of ``actors`` [a, 3] m within ``near`` [m], on the ground, of each position [k, 3] m: [k] int."""
    if not len(actors) or not len(middles):
        return np.zeros(len(middles), np.int64)
    x = middles[:, None, 0] - actors[None, :, 0]
    y = middles[:, None, 1] - actors[None, :, 1]
    return np.count_nonzero(x * x + y * y <= near * near, axis=1)


def count_layers(distance: float, now: int) -> int:
    """Number of :data:`POSE_LAYERS` to receive from an actor at ``distance`` [m], with hysteresis. ``now``: number of
    layers that are received at present."""
    factors = (LAYER_HYSTERESIS if number < now else 1.0 for number in range(len(POSE_LAYERS)))
    return sum(distance <= layer.distance * factor for layer, factor in zip(POSE_LAYERS, factors, strict=True))


def pose_layer(before: int, number: int) -> int:
    """Layer on which one pose is sent for all poses after number ``before`` up to ``number``: the lowest of their
    layers."""
    return next(i for i, layer in enumerate(POSE_LAYERS) if number // layer.every != before // layer.every)
