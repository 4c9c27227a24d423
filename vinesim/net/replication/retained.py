"""What stays true when everybody has gone: the greatest fact about each thing, and in which cell it lies; pure.

The server keeps one of these for those who come later, every client one for what it has heard. Adding is a join of a
semilattice: whatever the order, whatever came twice, equal sets of facts make equal stores. Of two facts about one
thing the one with the greater claim holds (:func:`authority.wins`), whoever said it first; an author therefore never
says two different things under one claim. What was cut off a tree stays cut: the winner takes the loser's cuts over.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from vinesim.net.codec.messages import RetainedRecord
from vinesim.net.replication import authority
from vinesim.net.replication.interest import Cell


class RetainedState:
    """The winning fact of every thing. A thing has one fact over all cells: it lies where the greatest claim says."""

    def __init__(self) -> None:
        self._cell_of: dict[int, Cell] = {}
        self._facts: dict[Cell, dict[int, RetainedRecord]] = {}

    def merge(self, cell: Cell, fact: RetainedRecord) -> bool:
        """Hear a fact that was said under ``cell``; whether anything is known now that was not before."""
        held = self.get(fact.object)
        if held is None:
            self._put(cell, fact)
            return True
        cuts = tuple(sorted({*held.cut, *fact.cut}))
        if authority.wins(fact.claim, held.claim):
            self._facts[self._cell_of[fact.object]].pop(fact.object)
        elif cuts != held.cut:
            cell, fact = self._cell_of[fact.object], held
        else:
            return False
        self._put(cell, fact if cuts == fact.cut else msgspec.structs.replace(fact, cut=cuts))
        return True

    def get(self, thing: int) -> RetainedRecord | None:
        """What is known of a thing."""
        cell = self._cell_of.get(thing)
        return None if cell is None else self._facts[cell][thing]

    def in_cell(self, cell: Cell) -> list[RetainedRecord]:
        """The facts about all things that lie in a cell, in the order of their numbers."""
        here = self._facts.get(cell, {})
        return [here[thing] for thing in sorted(here)]

    def __iter__(self) -> Iterator[tuple[Cell, RetainedRecord]]:
        """All facts and their cells, in the order of the things' numbers."""
        for thing in sorted(self._cell_of):
            cell = self._cell_of[thing]
            yield cell, self._facts[cell][thing]

    def __len__(self) -> int:
        return len(self._cell_of)

    def _put(self, cell: Cell, fact: RetainedRecord) -> None:
        self._cell_of[fact.object] = cell
        self._facts.setdefault(cell, {})[fact.object] = fact
