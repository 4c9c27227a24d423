"""Subscriptions and publishers of one actor in the interest cells around it and around the objects that it owns.

Keys: ``c/<x>/<y>/<actor>`` for states of boxes and bunches that move (best effort), ``own/<x>/<y>/<actor>`` for claims
and states at rest (reliable). States of trees have channels of their own
(:mod:`vinesim.net.replication.tree_channels`).
"""

from __future__ import annotations

import numpy as np

from vinesim.net.replication import interest
from vinesim.net.replication.interest import Cell
from vinesim.net.transport.bus import KEEP_ALL, KEEP_LAST_64, Bus, Publisher, Subscription


class CellChannels:
    """The channels that are open now, and the position that they follow."""

    def __init__(self, bus: Bus, interest_radius: float) -> None:
        """``interest_radius`` [m]: distance within which others see what moves (:func:`interest.check_radius`)."""
        self._bus = bus
        self.interest_radius = interest.check_radius(interest_radius)
        self.position = np.zeros(3)
        """Of the actor [m], world."""
        self.centre: Cell | None = None
        """Cell in the middle of the window; None before the first :meth:`update`."""
        self.subscriptions: dict[Cell, tuple[Subscription, Subscription]] = {}
        """Of states and of events."""
        self.publishers: dict[Cell, tuple[Publisher, Publisher]] = {}
        """Of states and of events."""
        self.changes = 0
        """How often channels were opened or closed."""

    def update(self, owned_cells: set[Cell]) -> None:
        """Move the 3x3 window to the position and keep the cells in which an owned object is."""
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
        """The reliable publisher of a cell; None outside of the window."""
        return self.publishers[cell][1] if cell in self.publishers else None

    def is_within_radius(self, positions: np.ndarray) -> np.ndarray:
        """Which positions [k, 3] m are within the interest radius, with the hysteresis of cells: [k] bool."""
        if self.centre is None:
            return np.zeros(len(positions), bool)
        offset = positions[:, :2] - self.position[:2]
        return np.einsum("ij,ij->i", offset, offset) <= (self.interest_radius + interest.HYSTERESIS) ** 2
