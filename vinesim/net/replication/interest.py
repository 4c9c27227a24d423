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

REGION_SIZE = 4.0 * CELL_SIZE
"""Edge length of a region, which is a cell for poses of actors [m]. All clients need the same value."""

BODY_DISTANCE = REGION_SIZE - 2.0 * HYSTERESIS
"""Distance within which an actor receives the poses of another one and gives it a body [m].

The windows of both actors cover it at any time: each of the two may be up to :data:`HYSTERESIS` outside the middle of
its window. Two people who walk towards each other at 1.5 m/s are 10 m apart 4 s later, and the body is made meanwhile.
"""

MAX_BODIES = 64
"""Largest number of other actors, the nearest ones, that an actor gives bodies. GUESSED: a step with 64 bodies takes
0.3 s of processor time on a small machine."""

NEARER = 0.8
"""Factor on the distance of the farthest actor with a body below which another one takes its place if there is no room,
so that two actors at the same distance do not change places all the time."""

POSE_RATE = 60.0
"""Number of poses that an actor publishes a second, each on one of the :data:`POSE_LAYERS`."""

REGION_BUDGET = 110.0
"""Largest number of poses a second that an actor shall receive from its window of regions, without the faster layers.

If more actors share a window, each of them publishes more rarely. GUESSED, such that an actor in any crowd receives at
most 60 kB/s: 110 poses of its window, 200 of the faster layers, and 50 coarse poses, of at most 162 B each."""

FAR_KEY = "a/{actor}/far"
"""Key of an actor's coarse poses, which have no joints, for all actors."""

FAR_EVERY = 120
"""Divisor of the pose rate: every ``FAR_EVERY``-th pose is also published as a coarse pose, 0.5 a second."""

FAR_BUDGET = 50.0
"""Largest number of coarse poses a second that an actor shall receive: with more than 100 actors each of them publishes
more rarely, with 1,000 actors every 20 s. GUESSED."""


class PoseLayer(NamedTuple):
    """A layer of poses: a share of an actor's poses under one key. Receivers subscribe to the layers that they need."""

    key: str
    """Key of the layer, with ``{actor}`` for the actor's name and ``{region}`` for its region, like ``3/-1``."""
    every: int
    """Divisor of the pose rate: this layer and the layers before it in :data:`POSE_LAYERS` together contain every
    ``every``-th pose."""
    distance: float
    """Distance within which actors subscribe to the layer [m]."""
    nearest: int
    """Largest number of other actors, the nearest ones, whose poses on this layer an actor receives. For hysteresis it
    keeps one more."""


POSE_LAYERS = (
    PoseLayer("pose/{region}/{actor}", 12, BODY_DISTANCE, MAX_BODIES),
    PoseLayer("a/{actor}/mid", 4, 12.0, 8),
    PoseLayer("a/{actor}/near", 2, 6.0, 4),
    PoseLayer("a/{actor}", 1, 3.0, 2),
)
"""Layers of poses: 5 Hz in the window of regions, and in all 15, 30 and 60 Hz within 12, 6 and 3 m.

The rate falls with the distance, so that an actor of a given speed moves by the same angle between two poses as seen
from the receiver. Within 3 m hands can touch each other. In a crowd the nearest actors come first: 60 Hz for two, 30 Hz
for two more and 15 Hz for another four. GUESSED."""

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


def cell_of(position: np.ndarray, size: float = CELL_SIZE) -> Cell:
    """Returns the cell that contains a position [2 or 3] m in the world. ``size``: edge length of a cell [m]."""
    return int(position[0] // size), int(position[1] // size)


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


def move_window(middle: Cell | None, position: np.ndarray, size: float = CELL_SIZE) -> Cell:
    """Returns the middle cell of the window of an actor at ``position`` [m], with hysteresis.

    ``middle``: middle cell until now; None: there was none. ``size``: edge length of a cell [m].
    """
    if middle is not None:
        x, y = position[:2].tolist()
        low_x = size * middle[0] - HYSTERESIS
        low_y = size * middle[1] - HYSTERESIS
        width = size + 2.0 * HYSTERESIS
        if low_x <= x <= low_x + width and low_y <= y <= low_y + width:
            return middle
    return cell_of(position, size)


def region_chunks(region: Cell) -> str:
    """Returns the chunks of a key that name a region, like ``3/-1``."""
    return f"{region[0]}/{region[1]}"


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


def count_layers(distance: float, now: int, rank: int = 0) -> int:
    """Returns how many of the :data:`POSE_LAYERS` to receive, from the first on, of an actor at ``distance`` [m].

    ``now``: number of layers that are received at present, for hysteresis. ``rank``: number of actors that are nearer.
    """
    kept = [number < now for number in range(len(POSE_LAYERS))]
    return sum(
        distance <= layer.distance * (LAYER_HYSTERESIS if keep else 1.0) and rank < layer.nearest + keep
        for layer, keep in zip(POSE_LAYERS, kept, strict=True)
    )


def thinning(count: int, rate: float, budget: float) -> int:
    """Returns the whole number by which each of ``count`` actors divides its ``rate`` [1/s] of messages, so that all of
    them together send at most ``budget`` [1/s]."""
    return max(1, math.ceil(count * rate / budget))


def pose_layer(before: int, number: int, region_thinning: int = 1) -> int:
    """Returns the index of the layer in :data:`POSE_LAYERS` on which the pose with a ``number`` is sent.

    ``before``: number of the last pose that was sent. The pose also replaces skipped poses between ``before`` and
    ``number``, so the lowest index of the layers of all these poses is returned. ``region_thinning``: whole number by
    which the rate of the first layer is divided; the second layer gets the poses that the first one leaves out.
    """
    every = [layer.every for layer in POSE_LAYERS]
    every[0] *= region_thinning
    return next(i for i, share in enumerate(every) if number // share != before // share)
