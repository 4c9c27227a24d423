"""What the server keeps for those who come later: the winning fact of every thing of every world.

Facts are only put on a shelf by whoever hears them; a thread of the archive's own believes, counts and writes them.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import logging
import pathlib
import threading
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

from vinesim.net.codec import messages
from vinesim.net.codec.messages import MessageError, RetainedRecord
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.retained import RetainedState
from vinesim.net.server.admission import SceneId
from vinesim.net.server.journal import SUFFIX, Journal, JournalError, load_all

log = logging.getLogger(__name__)

MAX_REPLY = 64_000
"""No reply of a snapshot is larger than this, as far as single facts allow [B]."""

MAX_OBJECTS = 100_000
"""Things of one world about which facts are kept."""

SYNC_PERIOD = 0.5
"""Between two moments at which facts are made safe against the end of the machine [s]."""

RETRY_PERIOD = 5.0
"""Between two attempts to write again, after a disk did not take something [s]."""

MAX_QUEUED = 10_000
"""Facts that may wait to be believed; what comes beyond is dropped."""


class Quota(NamedTuple):
    """How much one actor may say for good, sustained over time; five seconds' worth may come at once."""

    messages: float = 200.0
    """[1/s]: an actor says all its facts again to a server that was gone, one message a tick and cell."""
    payload: float = 200_000.0
    """[B/s]"""


MAX_EARLY = 1000
"""Messages that wait for their author to be let in: it says its facts again at once when a server is back."""

BURST_TIME = 5.0
"""Seconds of its quota that an actor may spend at once."""


class _TokenBucket:
    """What an actor may still spend: it fills with time up to a burst."""

    def __init__(self, quota: Quota, now: float) -> None:
        self._quota, self._at = quota, now
        self._left = [BURST_TIME * rate for rate in quota]

    def spend(self, size: int, now: float) -> bool:
        """Whether there is enough for one message of ``size`` bytes; if not, nothing is taken."""
        elapsed, self._at = now - self._at, now
        self._left = [
            min(left + elapsed * rate, BURST_TIME * rate) for left, rate in zip(self._left, self._quota, strict=True)
        ]
        if self._left[0] < 1.0 or self._left[1] < size:
            return False
        self._left = [self._left[0] - 1.0, self._left[1] - size]
        return True


@dataclasses.dataclass(slots=True)
class StoreCounters:
    """What became of facts."""

    received: int = 0
    """Messages of facts that arrived."""
    malformed: int = 0
    """... that could not be believed."""
    over_quota: int = 0
    """... of actors that said too much."""
    rejected: int = 0
    """... of worlds nobody is let into, of too many things, or that came faster than they could be kept."""
    snapshots: int = 0
    """Questions for a cell's facts."""


class RetainedStore:
    """Facts of all worlds. :meth:`hear`, :meth:`open` and :meth:`snapshot` may be called by any thread."""

    def __init__(self, folder: pathlib.Path | None = None, quota: Quota = Quota()) -> None:
        """Kept in ``folder``, or in memory only; :class:`vinesim.net.server.journal.NotKept` if that cannot be."""
        self.counters = StoreCounters()
        self._folder, self._quota = folder, quota
        journals = load_all(folder) if folder is not None else {}
        self._journals: dict[str, Journal] = {world: one for world, one in journals.items() if len(one.state)}
        self._states: dict[str, RetainedState] = {world: journal.state for world, journal in self._journals.items()}
        self._plans: dict[str, SceneId] = {world: journal.scene_id for world, journal in self._journals.items()}
        self._queue: collections.deque[tuple[str, bytes]] = collections.deque()
        self._early: collections.deque[tuple[str, bytes]] = collections.deque()
        self._purses: dict[tuple[str, str], _TokenBucket] = {}
        self._blamed: set[tuple[str, str]] = set()
        self._lock = threading.Lock()
        self._wakeup = threading.Event()
        self._closing = False
        self.status_message = ""
        """Empty, or in words why nothing is written now; facts are then kept in memory until it is mended."""
        self._thread = threading.Thread(target=self._run, name="archive", daemon=True)
        self._thread.start()

    def scene_of(self, world: str) -> SceneId | None:
        """The scene of a world of which facts are kept."""
        with self._lock:
            return self._plans[world] if self._states.get(world) else None  # no facts, no bond

    def count(self) -> int:
        """About how many things of all worlds facts are kept."""
        with self._lock:
            return sum(len(facts) for facts in self._states.values())

    def open(self, world: str, plan: SceneId) -> None:
        """Somebody was let into a world with this scene: facts about it are kept from now on."""
        with self._lock:
            if not self._states.get(world):
                self._plans[world] = plan
                self._states.setdefault(world, RetainedState())
            early, self._early = self._early, collections.deque()
            self._queue.extend(early)
        self._wakeup.set()

    def submit(self, key: str, payload: bytes) -> None:
        """Facts that arrived under ``<world>/fact/<cx>/<cy>/<actor>``; returns at once."""
        self.counters.received += 1
        if len(payload) > messages.MAX_MESSAGE:
            payload = b""  # not worth its room; the archive says so
        if len(self._queue) >= MAX_QUEUED:
            self.counters.rejected += 1
            return
        self._queue.append((key, payload))
        self._wakeup.set()

    def snapshot(self, world: str, cells: Iterable[Cell]) -> list[tuple[Cell, bytes]]:
        """FACTS messages that together say all that is kept about these cells, at least one for each."""
        self.counters.snapshots += 1
        found: list[tuple[Cell, bytes]] = []
        with self._lock:
            facts = self._states.get(world, RetainedState())
            told = {cell: facts.in_cell(cell) for cell in cells}
        for cell, here in told.items():
            found += [(cell, payload) for payload in _split_messages(here)]
        return found

    def cells(self, world: str) -> list[Cell]:
        """Where something is kept."""
        with self._lock:
            return sorted({cell for cell, _ in self._states.get(world, RetainedState())})

    def close(self) -> None:
        """Believe what has arrived, write it down and end; the second time nothing happens."""
        self._closing = True
        self._wakeup.set()
        self._thread.join()

    # ------------------------------------------------------------ the archive's own thread

    def _run(self) -> None:
        settled = time.monotonic()
        unsettled: set[str] = set()
        while True:
            self._wakeup.wait(SYNC_PERIOD if unsettled else RETRY_PERIOD if self.status_message else None)
            self._wakeup.clear()
            closing = self._closing
            while self._queue:
                if world := self._ingest(*self._queue.popleft()):
                    unsettled.add(world)
                if time.monotonic() - settled >= SYNC_PERIOD:
                    break
            now = time.monotonic()
            if self.status_message and now - settled >= RETRY_PERIOD:
                self._recover()
                settled = now
            elif now - settled >= SYNC_PERIOD and not self.status_message:
                self._try_write(lambda: [self._journals[world].sync() for world in sorted(unsettled)])
                unsettled.clear()
                settled = now
            if self._queue:
                self._wakeup.set()
            elif closing:
                break
        for journal in self._journals.values():
            self._try_write(journal.close)

    def _recover(self) -> None:
        """The disk did not take something: try to write everything anew."""
        trouble, self.status_message = self.status_message, ""
        for world, facts in list(self._states.items()):
            if (journal := self._journals.get(world)) is not None:
                self._try_write(journal.rewrite)
            elif len(facts):
                self._try_write(functools.partial(self._open_journal, world))
        if self.status_message:
            self.status_message = trouble
        else:
            log.warning("facts are written again")

    def _ingest(self, key: str, payload: bytes) -> str:
        """Keep what a message says; the world that has changed, or nothing."""
        world, _, *where, actor = key.split("/")
        try:
            cell = (int(where[0]), int(where[1])) if len(where) == 2 else None
            if cell is None or not all(-(1 << 31) <= number < 1 << 31 for number in cell):
                raise ValueError
        except ValueError:
            self._count_malformed(world, actor, f"{key!r} names no cell")
            return ""
        with self._lock:
            kept = self._states.get(world)
            if kept is None:
                self._early.append((key, payload))
                if len(self._early) > MAX_EARLY:
                    self._early.popleft()
                    self.counters.rejected += 1
                return ""
        now = time.monotonic()
        if len(self._purses) >= MAX_QUEUED:
            self._purses.clear()  # so many actors are a flood of names: let all begin anew
        purse = self._purses.setdefault((world, actor), _TokenBucket(self._quota, now))
        if not purse.spend(len(payload), now):
            self.counters.over_quota += 1
            self._warn_once(world, actor, "says more for good than its quota allows; what exceeds is dropped")
            return ""
        try:
            facts = messages.decode_records(payload)
            if strangers := [fact.author for fact in facts if fact.author != actor]:
                raise MessageError(f"fact by {strangers[0]!r} said by {actor!r}")
        except MessageError as error:
            self._count_malformed(world, actor, str(error))
            return ""
        changed = False
        for fact in facts:
            if len(kept) >= MAX_OBJECTS and kept.get(fact.object) is None:
                self.counters.rejected += 1
                self._warn_once(world, actor, f"states facts of more than {MAX_OBJECTS} things; dropped")
            else:
                changed |= self._merge(world, cell, fact)
        return world if changed else ""

    def _merge(self, world: str, cell: Cell, fact: RetainedRecord) -> bool:
        """Take a fact in and write it down; whether it was news and there is a journal of its world."""
        facts = self._states[world]
        with self._lock:
            if not facts.merge(cell, fact):
                return False
        if self._folder is None:
            return False
        # no lock here: who asks for a snapshot does not wait for a disk
        journal = self._journals.get(world)
        if self.status_message:
            pass  # written with everything else when the disk takes it again
        elif journal is not None:
            self._try_write(lambda: journal.append(cell, fact))
        else:
            self._try_write(lambda: self._open_journal(world))
        return world in self._journals

    def _open_journal(self, world: str) -> None:
        """Begin a journal with all that is known of a world."""
        assert self._folder is not None
        path = self._folder / f"{world}{SUFFIX}"
        self._journals[world] = Journal(path, world, self._plans[world], self._states[world])

    def _try_write(self, write: Callable[[], object]) -> None:
        """Write; if that fails, facts are kept in memory until it does not."""
        try:
            write()
        except JournalError as error:
            if not self.status_message:
                log.error("facts are kept in memory only until this is mended: %s", error)
            self.status_message = str(error)

    def _count_malformed(self, world: str, actor: str, why: str) -> None:
        self.counters.malformed += 1
        self._warn_once(world, actor, f"sent what cannot be believed: {why}")

    def _warn_once(self, world: str, actor: str, what: str) -> None:
        """Once for each actor; the rest is only counted."""
        if (world, actor) not in self._blamed and len(self._blamed) < MAX_QUEUED:
            self._blamed.add((world, actor))
            log.warning("%s/%s %s (said once)", world, actor, what)


def _split_messages(facts: list[RetainedRecord]) -> list[bytes]:
    """Facts as messages, each as large as allowed."""
    whole = messages.encode_records(facts)
    if len(facts) <= 1 or (len(whole) <= MAX_REPLY and len(facts) <= messages.MAX_RECORDS):
        return [whole]
    half = len(facts) // 2
    return _split_messages(facts[:half]) + _split_messages(facts[half:])
