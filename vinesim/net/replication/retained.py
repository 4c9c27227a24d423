"""Retained state: for each object the record with the greatest claim, and its cell. A CRDT, without I/O.

A last-writer-wins map. Merging is a join of a semilattice: equal sets of records result in equal maps, in whatever
order and however often the records arrive. Of two records of one object the one with the greater claim is kept
(:func:`authority.wins`). An author therefore never publishes two different records with the same claim. Cuts
accumulate: the record that is kept also takes over the cuts and stumps of the other one, what else has changed the tree
(:func:`vinesim.net.codec.wood.joined_wood`), and the berries that a bunch has lost. If two records name the same body
as stumps of different cuts, the lower segment and the lower place are kept. The server keeps one map for each world,
and every client keeps a map of the records that it has received.
Source: M. Shapiro et al., Conflict-free Replicated Data Types, 2011.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from vinesim.net.codec.control import RetainedRecord
from vinesim.net.codec.wood import joined_wood
from vinesim.net.replication import authority
from vinesim.net.replication.interest import Cell


class RetainedState:
    """The map of retained records: for each object the record with the greatest claim, and the cell of that record."""

    def __init__(self) -> None:
        self._cell_of: dict[int, Cell] = {}
        self._records: dict[Cell, dict[int, RetainedRecord]] = {}

    def merge(self, cell: Cell, record: RetainedRecord) -> bool:
        """Merge a record that was published under ``cell``. Returns whether the map has changed."""
        held = self.get(record.object)
        if held is None:
            self._put(cell, record)
            return True
        cuts = tuple(sorted({*held.cut, *record.cut}))
        stumps = _joined_stumps(held.stumps, record.stumps)
        wood = joined_wood(held.wood, record.wood)
        fruit = _joined_fruit(held.fruit, record.fruit)
        joined = cuts, stumps, wood, fruit
        if authority.wins(record.claim, held.claim):
            self._records[self._cell_of[record.object]].pop(record.object)
        elif joined != (held.cut, held.stumps, held.wood, held.fruit):
            cell = self._cell_of[record.object]
            record = held
        else:
            return False
        if joined != (record.cut, record.stumps, record.wood, record.fruit):
            record = msgspec.structs.replace(record, cut=cuts, stumps=stumps, wood=wood, fruit=fruit)
        self._put(cell, record)
        return True

    def get(self, object_id: int) -> RetainedRecord | None:
        """Returns the record of an object, or None."""
        cell = self._cell_of.get(object_id)
        return None if cell is None else self._records[cell][object_id]

    def cell_of(self, object_id: int) -> Cell | None:
        """Returns the cell of the record of an object, or None."""
        return self._cell_of.get(object_id)

    def in_cell(self, cell: Cell) -> list[RetainedRecord]:
        """Returns the records of all objects in a cell, in the order of object ids."""
        here = self._records.get(cell, {})
        return [here[object_id] for object_id in sorted(here)]

    def __iter__(self) -> Iterator[tuple[Cell, RetainedRecord]]:
        """Yield the cell and the record of each object, in the order of object ids."""
        for object_id in sorted(self._cell_of):
            cell = self._cell_of[object_id]
            yield cell, self._records[cell][object_id]

    def __len__(self) -> int:
        return len(self._cell_of)

    def _put(self, cell: Cell, record: RetainedRecord) -> None:
        self._cell_of[record.object] = cell
        self._records.setdefault(cell, {})[record.object] = record


def _joined_fruit(one: tuple[float, float] | None, other: tuple[float, float] | None) -> tuple[float, float] | None:
    """Returns the greater numbers of burst and of lost berries of two records."""
    if one is None or other is None:
        return one if other is None else other
    return max(one[0], other[0]), max(one[1], other[1])


def _joined_stumps(
    one: tuple[tuple[int, int, int], ...], other: tuple[tuple[int, int, int], ...]
) -> tuple[tuple[int, int, int], ...]:
    """Returns the stumps of two records. Of two cuts that name the same stump, the lower segment and place is kept."""
    if one == other or not other:
        return one
    kept: dict[int, tuple[int, int, int]] = {}
    for stump in sorted({*one, *other}):
        kept.setdefault(stump[0], stump)
    return tuple(kept.values())
