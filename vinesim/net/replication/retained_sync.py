"""Exchange of retained records between one actor, its peers and the server.

A record is published once, wherever the peers are, because the server keeps it for others. Records of peers arrive by
subscription, and earlier records of a cell by a query to the server. When the connection to the server was lost and is
back, the actor publishes all its own records again, because the server may be a new one without records, and queries
all cells again. It also does so some time after signs that messages were lost on their way, like a message of a session
that did not seem to hold its name, or a connection between others that was lost. So a machine that is overloaded delays
records and loses none.
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
"""Time after which a query without a reply is first repeated [s]. Each repetition doubles the time."""

MAX_QUERY_PERIOD = 8.0
"""Longest time between two repetitions of a query without a reply [s]."""

REPAIR_DELAY = 8.0
"""Time from a sign of lost messages until records are exchanged again [s]. By then the server has what the messages
said, even if their sender had to join again. GUESSED."""

REPAIR_PERIOD = 30.0
"""Shortest time between two such exchanges [s], whatever others send. GUESSED."""

TYPICAL_RECORD_SIZE = 110
"""Upper estimate of the size of an encoded record without the state of a tree [B]."""


class RetainedSync:
    """The retained records that one actor knows, and its own records that are not published yet."""

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
        self._admissions = 0
        """Number of admissions of this actor when the records were last published and queried for a new connection."""
        self._missed = 0
        """Number of signs of lost messages after which records were exchanged again or will be."""
        self._repair_due = math.inf
        """Time at which records are exchanged again because messages may be lost [s]."""
        self._repaired_at = -math.inf
        self._window_changes = -1
        self._next_query = math.inf
        """Time at which the next query to the server is due [s]."""

    def publish(self, cell: Cell, record: RetainedRecord) -> None:
        """Queue a record of this actor about an object in ``cell``. :meth:`flush` sends it."""
        self.state.merge(cell, record)
        if record.object in self._authored:
            before = self._authored[record.object][0]
            self._pending.get(before, {}).pop(record.object, None)
        self._authored[record.object] = cell, record
        self._pending.setdefault(cell, {})[record.object] = record

    def merge(self, cell: Cell, record: RetainedRecord) -> bool:
        """Merge a record from a peer or the server. Returns whether the retained state has changed."""
        is_new = self.state.merge(cell, record)
        if is_new and record.author != self.bus.name:
            held = self.state.get(record.object)
            if held is not None and record.object in self._authored:
                cell_before, _ = self._authored.pop(record.object)
                if held.author == self.bus.name:  # it has taken over the other one's cuts
                    self._authored[record.object] = cell_before, held
                else:
                    self._pending.get(cell_before, {}).pop(record.object, None)
        return is_new

    def update_window(self, window: Collection[Cell], changes: int, now: float) -> None:
        """Subscribe to the records of the cells in ``window``, and query the server for the records of new cells.

        ``changes``: number of changes of the window so far. ``now``: own time [s]. Returns at once if neither the
        window nor the connection to the server has changed, no message may be lost and no query is due.
        """
        is_disconnected = bool(self.bus.status_message)
        # a loop that gets no processor time may not see that the connection is lost, but the server admits it again
        admissions = self._admissions if is_disconnected else self.bus.admissions
        if (
            (now < self._next_query or is_disconnected)
            and is_disconnected == self._is_disconnected
            and admissions == self._admissions
            and (self.bus.missed == self._missed or self._repair_due < math.inf)
            and changes == self._window_changes
            and len(self._publishers) == len(window)
        ):
            return
        wanted = set(window)
        self._window_changes = changes
        is_new_connection = admissions != self._admissions or (self._is_disconnected and not is_disconnected)
        is_repair = now >= self._repair_due and not is_disconnected
        if is_repair:
            self._repair_due = math.inf
            self._repaired_at = now
        if is_new_connection or is_repair:
            for object_id, (cell, record) in self._authored.items():
                self._pending.setdefault(cell, {})[object_id] = record
            self._asked = dict.fromkeys(wanted, (now, QUERY_TIMEOUT))
        self._admissions = admissions
        self._is_disconnected = is_disconnected
        if self._repair_due == math.inf and self.bus.missed != self._missed:
            self._missed = self.bus.missed
            self.repair(now)
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
        self._next_query = min(self._next_query, self._repair_due)

    @property
    def window(self) -> frozenset[Cell]:
        """Cells whose records this actor receives now. Of other cells it may know records that are no longer valid."""
        return frozenset(self._subscriptions)

    def repair(self, now: float) -> None:
        """Exchange all records again after :data:`REPAIR_DELAY`, because a message was lost at own time ``now`` [s]."""
        if self._repair_due == math.inf:
            self._repair_due = max(now + REPAIR_DELAY, self._repaired_at + REPAIR_PERIOD)
        self._next_query = min(self._next_query, self._repair_due)

    def mark_answered(self, cell: Cell) -> None:
        """Note that the server has replied to the query for a cell."""
        self._asked.pop(cell, None)

    def flush(self) -> None:
        """Send queued records, one message for each cell. Records in cells without a subscriber wait."""
        for cell in sorted(self._pending):
            waiting = self._pending[cell]
            publisher = self._publishers.get(cell)
            if publisher is None:
                publisher = self._publishers[cell] = self._publisher(cell)
            if waiting and publisher.matching:
                batch = []
                free_bytes = MAX_DATAGRAM
                for object_id in sorted(waiting):
                    free_bytes -= TYPICAL_RECORD_SIZE + len(waiting[object_id].trees) + len(waiting[object_id].wood)
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
