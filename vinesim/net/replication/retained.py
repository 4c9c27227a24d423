"""Retained state: the record with the greatest claim of each object, and the cell it belongs to; a CRDT; pure.

A last-writer-wins map: merging is a join of a semilattice, so that equal sets of records give equal maps, in whatever
order and however often they arrive. Of two records of one object the one with the greater claim holds
(:func:`authority.wins`); an author therefore never publishes two different records under one claim. Cuts accumulate:
the winner takes over the cuts of the loser. The server keeps one such map for a world, and every client keeps a map of
the records that it has received.
Source: M. Shapiro et al., Conflict-free Replicated Data Types, 2011.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from vinesim.net.codec.control import RetainedRecord
from vinesim.net.replication import authority
from vinesim.net.replication.interest import Cell


class RetainedState:
    """The winning record of every object. An object is in one cell: the cell of the record with its greatest claim."""

    def __init__(self) -> None:
        self._cell_of: dict[int, Cell] = {}
        self._records: dict[Cell, dict[int, RetainedRecord]] = {}

    def merge(self, cell: Cell, record: RetainedRecord) -> bool:
        """Merge a record that was published under ``cell``. Returns whether that changed anything."""
        held = self.get(record.object)
        if held is None:
            self._put(cell, record)
            return True
        cuts = tuple(sorted({*held.cut, *record.cut}))
        if authority.wins(record.claim, held.claim):
            self._records[self._cell_of[record.object]].pop(record.object)
        elif cuts != held.cut:
            cell = self._cell_of[record.object]
            record = held
        else:
            return False
        self._put(cell, record if cuts == record.cut else msgspec.structs.replace(record, cut=cuts))
        return True

    def get(self, object_id: int) -> RetainedRecord | None:
        """The record of an object, or None."""
        cell = self._cell_of.get(object_id)
        return None if cell is None else self._records[cell][object_id]

    def in_cell(self, cell: Cell) -> list[RetainedRecord]:
        """Records of all objects in a cell, in the order of their ids."""
        here = self._records.get(cell, {})
        return [here[object_id] for object_id in sorted(here)]

    def __iter__(self) -> Iterator[tuple[Cell, RetainedRecord]]:
        """All cells and records, in the order of object ids."""
        for object_id in sorted(self._cell_of):
            cell = self._cell_of[object_id]
            yield cell, self._records[cell][object_id]

    def __len__(self) -> int:
        return len(self._cell_of)

    def _put(self, cell: Cell, record: RetainedRecord) -> None:
        self._cell_of[record.object] = cell
        self._records.setdefault(cell, {})[record.object] = record
