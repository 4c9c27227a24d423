"""Retained records between a client and the server: published until received, received from peers, queried by cell.

A record is published once, wherever the peers are, because the server keeps it. After the server was lost, the client
publishes all of its own records again, because a new server may have none.
"""

from __future__ import annotations

import math
from collections.abc import Collection

from vinesim.net.codec.control import RetainedRecord, encode_records
from vinesim.net.codec.header import MAX_DATAGRAM
from vinesim.net.codec.messages import Counters
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.retained import RetainedState
from vinesim.net.transport.bus import KEEP_ALL, Bus, Publisher, Subscription

QUERY_TIMEOUT = 0.5
"""Time after which the server is first queried again if it has not replied [s]. The time is doubled for each query."""

MAX_QUERY_PERIOD = 8.0
"""Longest time between two queries to a server that has not replied [s]."""

TYPICAL_RECORD_SIZE = 110
"""Upper estimate of an encoded record without the state of a tree [B]."""


class RetainedSync:
    """The retained state as one client knows it, and the records that it still has to publish."""

    def __init__(self, bus: Bus, counters: Counters) -> None:
        self.bus = bus
        self.counters = counters
        self.state = RetainedState()
        self._pending: dict[Cell, dict[int, RetainedRecord]] = {}
        self._authored: dict[int, tuple[Cell, RetainedRecord]] = {}
        self._publishers: dict[Cell, Publisher] = {}
        self._subscriptions: dict[Cell, Subscription] = {}
        self._asked: dict[Cell, tuple[float, float]] = {}
        self._is_disconnected = False
        self._window_changes = -1
        self._next_query = math.inf
        """Time of the next query to the server [s]."""

    def publish(self, cell: Cell, record: RetainedRecord) -> None:
        """Queue an own record about an object in ``cell``."""
        self.state.merge(cell, record)
        if record.object in self._authored:
            before = self._authored[record.object][0]
            self._pending.get(before, {}).pop(record.object, None)
        self._authored[record.object] = cell, record
        self._pending.setdefault(cell, {})[record.object] = record

    def merge(self, cell: Cell, record: RetainedRecord) -> bool:
        """Merge a record of a peer or the server. Returns whether that changed anything."""
        is_new = self.state.merge(cell, record)
        if is_new and record.author != self.bus.name:
            held = self.state.get(record.object)
            if held is not None and held.author != self.bus.name and record.object in self._authored:
                cell_before, _ = self._authored.pop(record.object)
                self._pending.get(cell_before, {}).pop(record.object, None)
        return is_new

    def update_window(self, window: Collection[Cell], changes: int, now: float) -> None:
        """Subscribe to the records of the cells in ``window``, and query the server for cells that are new.

        ``changes``: number of changes of the window so far. While it and all else stays the same, nothing is done.
        """
        is_disconnected = bool(self.bus.status_message)
        if (
            (now < self._next_query or is_disconnected)
            and is_disconnected == self._is_disconnected
            and changes == self._window_changes
            and len(self._publishers) == len(window)
        ):
            return
        wanted = set(window)
        self._window_changes = changes
        if self._is_disconnected and not is_disconnected:
            for object_id, (cell, record) in self._authored.items():
                self._pending.setdefault(cell, {})[object_id] = record
            self._asked = dict.fromkeys(wanted, (now, QUERY_TIMEOUT))
        self._is_disconnected = is_disconnected
        for cell in sorted(self._subscriptions.keys() - wanted):
            self._subscriptions.pop(cell).close()
            self._asked.pop(cell, None)
        for cell in sorted(wanted - self._subscriptions.keys()):
            self._subscriptions[cell] = self.bus.subscribe(f"fact/{cell[0]}/{cell[1]}/*", KEEP_ALL)
            self._asked[cell] = now, QUERY_TIMEOUT
        for cell in sorted(self._publishers.keys() - wanted - self._pending.keys()):
            self._publishers.pop(cell).close()
        for cell in sorted(wanted - self._publishers.keys()):
            self._publishers[cell] = self._publisher(cell)
        if not is_disconnected:
            for cell, (due, period) in sorted(self._asked.items()):
                if now >= due:
                    self._asked[cell] = now + period, min(2.0 * period, MAX_QUERY_PERIOD)
                    self.bus.query(f"snap/{cell[0]}/{cell[1]}")
        self._next_query = min((due for due, _ in self._asked.values()), default=math.inf)

    def mark_answered(self, cell: Cell) -> None:
        """Note that the server has replied for a cell."""
        self._asked.pop(cell, None)

    def flush(self) -> None:
        """Send queued records, one message for each cell; without a subscriber they wait."""
        for cell in sorted(self._pending):
            waiting = self._pending[cell]
            publisher = self._publishers.get(cell)
            if publisher is None:
                publisher = self._publishers[cell] = self._publisher(cell)
            if waiting and publisher.matching:
                batch = []
                free_bytes = MAX_DATAGRAM
                for object_id in sorted(waiting):
                    free_bytes -= TYPICAL_RECORD_SIZE + len(waiting[object_id].trees)
                    if free_bytes < 0 and batch:
                        break
                    batch.append(object_id)
                payload = encode_records([waiting[object_id] for object_id in batch])
                if publisher.put(payload):
                    self.counters.retained.count_out(payload)
                    for object_id in batch:
                        del waiting[object_id]
            if not waiting:
                del self._pending[cell]

    def _publisher(self, cell: Cell) -> Publisher:
        return self.bus.publisher(f"fact/{cell[0]}/{cell[1]}/{self.bus.name}", reliable=True)
