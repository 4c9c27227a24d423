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

import numpy as np

CELL_SIZE = 6.0
"""Edge of a cell [m]; equal for all clients, because cells are part of the keys."""

HYSTERESIS = 1.0
"""A window moves only when its actor is this far outside of the middle cell [m]."""

MAX_INTEREST_RADIUS = CELL_SIZE - HYSTERESIS
"""Distance that a window covers on all sides, wherever in its hysteresis the actor is [m]."""

INTEREST_RADIUS = 5.0
"""Default distance within which an actor receives states of objects that peers move [m]."""

FULL_RATE_DISTANCE = 10.0
"""Actors nearer than this receive each other's poses at the full rate [m] ..."""

REDUCED_RATE_DISTANCE = 12.0
"""... until they are this far apart [m]."""

Cell = tuple[int, int]


def cell_of(position: np.ndarray) -> Cell:
    """The cell of a position [2 or 3] m, world axes."""
    return int(position[0] // CELL_SIZE), int(position[1] // CELL_SIZE)


def cells_of(positions: np.ndarray) -> np.ndarray:
    """Cells [k, 2] int of positions [k, 2 or 3] m."""
    return np.floor(positions[:, :2] / CELL_SIZE).astype(np.int64)


def cell_window(middle: Cell) -> frozenset[Cell]:
    """The 3x3 cells around ``middle``."""
    return frozenset((middle[0] + x, middle[1] + y) for x in (-1, 0, 1) for y in (-1, 0, 1))


def move_window(middle: Cell | None, position: np.ndarray) -> Cell:
    """Middle cell of the window of an actor at ``position`` [m] whose middle cell was ``middle``, with hysteresis."""
    if middle is not None:
        x, y = position[:2].tolist()
        low_x, low_y = CELL_SIZE * middle[0] - HYSTERESIS, CELL_SIZE * middle[1] - HYSTERESIS
        width = CELL_SIZE + 2.0 * HYSTERESIS
        if low_x <= x <= low_x + width and low_y <= y <= low_y + width:
            return middle
    return cell_of(position)


def check_radius(near: float) -> float:
    """The radius [m] if a window covers it; ValueError with the bound otherwise."""
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


def is_full_rate(distance: float, now: bool) -> bool:
    """Whether an actor at ``distance`` [m] sends its poses at the full rate here, given whether it does ``now``."""
    return distance <= (REDUCED_RATE_DISTANCE if now else FULL_RATE_DISTANCE)
