"""Channels: subscriptions and publishers of one actor for cells of the ground
(:mod:`vinesim.net.replication.interest`).

An actor has open channels for the cells around itself and for the cells of the objects that it owns.
"""

from __future__ import annotations

import math

import numpy as np

from vinesim.net.replication import interest
from vinesim.net.replication.interest import TREE_LAYERS, Cell
from vinesim.net.transport.bus import KEEP_ALL, KEEP_LAST_64, Bus, Publisher, Subscription

OPEN_MARGIN = 0.3
CLOSE_MARGIN = 0.8
"""Margins [m] at which the channels of a cell, which are its subscriptions and publishers, are opened and closed.

The channels of a cell are opened when the actor is nearer to the cell than the distance of a layer
(:data:`vinesim.net.replication.interest.TREE_LAYERS`) plus OPEN_MARGIN. They are closed beyond that distance plus
CLOSE_MARGIN. OPEN_MARGIN is needed because peers know this actor's position late. The margins differ so that channels
do not open and close in turn for an actor that walks along the edge of a cell.
"""

STEP = 0.1
"""Distance that the actor moves before its cells are chosen again [m]."""


class CellChannels:
    """The channels of one actor for states of boxes and bunches and for events, which follow the actor's position.

    The channels of a cell are two subscriptions and two publishers: for states and for events.

    Keys: ``c/<x>/<y>/<actor>`` for states of boxes and bunches that move (best effort), ``own/<x>/<y>/<actor>`` for
    claims and states at rest (reliable).
    """

    def __init__(self, bus: Bus, interest_radius: float) -> None:
        """``interest_radius`` [m]: distance from an object within which peers receive its states. Checked by
        :func:`interest.check_radius`."""
        self._bus = bus
        self.interest_radius = interest.check_radius(interest_radius)
        self.position = np.zeros(3)
        """Position of the actor in the world [m]."""
        self.centre: Cell | None = None
        """Cell in the middle of the window of 3x3 cells around the actor; None before the first :meth:`update`."""
        self.subscriptions: dict[Cell, tuple[Subscription, Subscription]] = {}
        """Subscriptions to states and to events, by cell."""
        self.publishers: dict[Cell, tuple[Publisher, Publisher]] = {}
        """Publishers of states and of events, by cell."""
        self.changes = 0
        """Number of calls of :meth:`update` that have opened or closed channels."""

    def update(self, owned_cells: set[Cell]) -> None:
        """Open the channels of the 3x3 cells around :attr:`position` and of ``owned_cells``, and close all others.

        ``owned_cells``: cells with objects that this actor owns.
        """
        centre = interest.move_window(self.centre, self.position)
        if centre == self.centre and owned_cells <= self.subscriptions.keys() and len(self.subscriptions) <= 9:
            return
        self.centre = centre
        wanted = interest.cell_window(centre) | owned_cells
        self.changes += 1
        for cell in sorted(self.subscriptions.keys() - wanted):
            for channel in (*self.subscriptions.pop(cell), *self.publishers.pop(cell)):
                channel.close()
        for cell in sorted(wanted - self.subscriptions.keys()):
            x, y = cell
            self.subscriptions[cell] = (
                self._bus.subscribe(f"c/{x}/{y}/*", KEEP_LAST_64),
                self._bus.subscribe(f"own/{x}/{y}/*", KEEP_ALL),
            )
            self.publishers[cell] = (
                self._bus.publisher(f"c/{x}/{y}/{self._bus.name}"),
                self._bus.publisher(f"own/{x}/{y}/{self._bus.name}", reliable=True),
            )

    def event_publisher(self, cell: Cell | None) -> Publisher | None:
        """Returns the publisher of events of a cell; None if the channels of the cell are not open."""
        return self.publishers[cell][1] if cell in self.publishers else None

    def is_within_radius(self, positions: np.ndarray) -> np.ndarray:
        """Returns which of the positions [k, 3] m are within the interest radius plus the hysteresis of cells: [k]
        bool."""
        if self.centre is None:
            return np.zeros(len(positions), bool)
        offset = positions[:, :2] - self.position[:2]
        return np.einsum("ij,ij->i", offset, offset) <= (self.interest_radius + interest.HYSTERESIS) ** 2


class TreeChannels:
    """The channels of one actor for states of moving trees: subscriptions and publishers, by layer and cell.

    Keys: ``tree/<x>/<y>/<actor>`` for all actors within the interest radius, ``near/<x>/<y>/<actor>`` for additional
    states that only actors near the tree need (:data:`vinesim.net.replication.interest.TREE_LAYERS`). An actor
    subscribes to the cells within the distance of a layer instead of a window of 3x3 cells, so that it does not receive
    trees that are farther away.
    """

    def __init__(self, bus: Bus, interest_radius: float) -> None:
        """``interest_radius`` [m]: distance of the first layer, and upper bound of the distances of all layers."""
        self._bus = bus
        self.distances = tuple(min(layer.distance, interest_radius) for layer in TREE_LAYERS)
        """Distance of each layer [m]."""
        self.subscriptions: tuple[dict[Cell, Subscription], ...] = tuple({} for _ in TREE_LAYERS)
        self.publishers: tuple[dict[Cell, Publisher], ...] = tuple({} for _ in TREE_LAYERS)
        self._position: np.ndarray | None = None
        self._owned: set[Cell] = set()

    def update(self, position: np.ndarray, owned: set[Cell]) -> None:
        """Open and close channels for the actor's ``position`` [3] m and for the cells ``owned`` of trees that it owns.

        Publishers are open in these cells, and in those where the actor could touch a tree.
        """
        moved = self._position is None or _distance(position, self._position) > STEP
        if not moved and owned == self._owned:
            return
        self._position = position.copy()
        self._owned = set(owned)
        reach = self.distances[-1]
        touchable = interest.tree_cells_within(position, reach + OPEN_MARGIN) | owned
        kept_touchable = interest.tree_cells_within(position, reach + CLOSE_MARGIN) | owned
        for layer, subscriptions, publishers, distance in zip(
            TREE_LAYERS, self.subscriptions, self.publishers, self.distances, strict=True
        ):
            opened = interest.tree_cells_within(position, distance + OPEN_MARGIN)
            kept = interest.tree_cells_within(position, distance + CLOSE_MARGIN)
            for cell in sorted(subscriptions.keys() - kept):
                subscriptions.pop(cell).close()
            for cell in sorted(opened - subscriptions.keys()):
                subscriptions[cell] = self._bus.subscribe(f"{layer.family}/{cell[0]}/{cell[1]}/*", KEEP_LAST_64)
            for cell in sorted(publishers.keys() - kept_touchable):
                publishers.pop(cell).close()
            for cell in sorted(touchable - publishers.keys()):
                publishers[cell] = self._bus.publisher(f"{layer.family}/{cell[0]}/{cell[1]}/{self._bus.name}")


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the distance [m] on the ground between two positions [3] m."""
    return math.hypot(a[0] - b[0], a[1] - b[1])
