"""The server's store of retained records of all worlds: in memory and, if a folder is given, in journals on disk.

Threads of the network only queue records. A thread of the store decodes, counts, merges and writes them.
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

from vinesim.net.codec.control import MAX_RECORDS, RetainedRecord, decode_records, encode_records
from vinesim.net.codec.header import MAX_MESSAGE, MessageError
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.retained import RetainedState
from vinesim.net.server.admission import SceneId
from vinesim.net.server.journal import SUFFIX, Journal, JournalError, load_all

log = logging.getLogger(__name__)

MAX_REPLY = 64_000
"""Largest size of one message of a snapshot [B]. A single record may exceed this."""

MAX_OBJECTS = 100_000
"""Largest number of objects with a retained record in one world."""

SYNC_PERIOD = 0.5
"""Time after which appended records are forced to the disk [s]."""

RETRY_PERIOD = 5.0
"""Time between two attempts to write after a disk error [s]."""

MAX_QUEUED = 10_000
"""Largest number of messages in the store's queue. Further messages are dropped."""

MAX_QUEUED_BYTES = 64 << 20
"""Largest size of all messages in the store's queue [B]."""


MAX_BUCKETS = 256
"""Number of actors with a quota from which on the quotas of idle ones are removed."""

MAX_WARNED = 1000
"""Largest number of actors whose first problem is logged."""


class Quota(NamedTuple):
    """Sustained rate at which one actor may publish records. The records of :data:`BURST_TIME` may arrive at once."""

    messages: float = 200.0
    """Number of messages a second. After a restart of the server an actor publishes all its records again, with one
    message for each step and cell."""
    payload: float = 200_000.0
    """Size of messages a second [B/s]."""


MAX_EARLY = 1000
"""Largest number of messages that wait for the admission of their author.

An actor may publish records before a restarted server has admitted it again."""

MAX_EARLY_BYTES = 16 << 20
"""Largest size of all messages that wait for the admission of their author [B]."""

BURST_TIME = 5.0
"""Time for which an actor may save up its :class:`Quota`, to use it at once [s]."""


class _Sum:
    """A sum to which several threads add."""

    def __init__(self) -> None:
        self.value = 0
        self._lock = threading.Lock()

    def add(self, amount: int) -> None:
        """Add an amount, which may be negative."""
        with self._lock:
            self.value += amount


class _TokenBucket:
    """Token bucket that limits the messages and bytes of one actor to its :class:`Quota`."""

    def __init__(self, quota: Quota, now: float) -> None:
        self._quota = quota
        self._updated_at = now
        self._tokens = [BURST_TIME * rate for rate in quota]

    def is_idle(self, now: float) -> bool:
        """Whether nothing was spent for so long that all tokens are there again."""
        return now - self._updated_at > BURST_TIME

    def spend(self, size: int, now: float) -> bool:
        """Take the tokens for a message of ``size`` [B]. Returns False, and takes none, if there are too few."""
        elapsed = now - self._updated_at
        self._updated_at = now
        self._tokens = [
            min(tokens + elapsed * rate, BURST_TIME * rate)
            for tokens, rate in zip(self._tokens, self._quota, strict=True)
        ]
        if self._tokens[0] < 1.0 or self._tokens[1] < size:
            return False
        self._tokens = [self._tokens[0] - 1.0, self._tokens[1] - size]
        return True


@dataclasses.dataclass(slots=True)
class StoreCounters:
    """Counters of messages with records that arrived at the store."""

    received: int = 0
    """Number of messages with records that arrived."""
    malformed: int = 0
    """Number of messages that could not be decoded."""
    over_quota: int = 0
    """Number of messages that were dropped because their author had exceeded its quota."""
    rejected: int = 0
    """Number of messages and records that were dropped: the world has no admitted actor, or the limit of objects, of
    queued messages or of early messages is reached."""
    errors: int = 0
    """Number of messages that caused an unexpected error."""
    snapshots: int = 0
    """Number of queries for the records of cells."""


class RetainedStore:
    """The retained records of all worlds. Any thread may call :meth:`submit`, :meth:`open` and :meth:`snapshot`."""

    def __init__(self, folder: pathlib.Path | None = None, quota: Quota = Quota()) -> None:
        """``folder``: folder of the journals; None: keep records in memory only. ``quota``: limit of each actor.

        Raises :class:`vinesim.net.server.journal.JournalError` if a journal in the folder cannot be used.
        """
        self.counters = StoreCounters()
        self._folder = folder
        self._quota = quota
        journals = load_all(folder) if folder is not None else {}
        self._journals: dict[str, Journal] = {world: one for world, one in journals.items() if len(one.state)}
        self._states: dict[str, RetainedState] = {world: journal.state for world, journal in self._journals.items()}
        self._scenes: dict[str, SceneId] = {world: journal.scene_id for world, journal in self._journals.items()}
        self._queue: collections.deque[tuple[str, bytes]] = collections.deque()
        self._early: collections.deque[tuple[str, bytes]] = collections.deque()
        self._early_bytes = 0
        self._queued_bytes = _Sum()
        self._buckets: dict[tuple[str, str], _TokenBucket] = {}
        self._warned: set[tuple[str, str]] = set()
        self._lock = threading.Lock()
        self._wakeup = threading.Event()
        self._closing = False
        self._troubles: dict[str, str] = {}
        """Reason why the journal of a world cannot be written now, by world. Its records stay in memory until it can
        be. Other worlds are written."""
        self._ended = ""
        """Error that ended the store's thread; empty while it runs."""
        self._thread = threading.Thread(target=self._run, name="retained store", daemon=True)
        self._thread.start()

    @property
    def status_message(self) -> str:
        """Reason why records cannot be written now; empty if they can. Names one world, and the number of others."""
        troubles = list(self._troubles.items())
        if self._ended or not troubles:
            return self._ended
        more = f" (and {len(troubles) - 1} more worlds)" if len(troubles) > 1 else ""
        return f"world {troubles[0][0]!r}{more}: {troubles[0][1]}"

    @property
    def unwritten(self) -> list[str]:
        """Returns the worlds with records that are not on the disk, sorted. After :meth:`close` they are lost."""
        with self._lock:
            return sorted(self._states if self._ended and self._folder is not None else self._troubles)

    def scene_of(self, world: str) -> SceneId | None:
        """Returns the scene of a world that has retained records; None for any other world."""
        with self._lock:
            return self._scenes[world] if self._states.get(world) else None  # without records any scene may join

    def count(self) -> int:
        """Number of objects with a retained record, in all worlds together."""
        with self._lock:
            return sum(len(records) for records in self._states.values())

    def all_worlds(self) -> list[str]:
        """Returns the worlds that were opened or have records."""
        with self._lock:
            return list(self._states)

    def forget(self, world: str) -> None:
        """Forget a world without records, because its last actor has left."""
        with self._lock:
            if world in self._states and not self._states[world] and world not in self._journals:
                del self._states[world]
                self._scenes.pop(world, None)

    def open(self, world: str, scene: SceneId) -> None:
        """Retain the records of a world, because an actor was admitted to it. ``scene``: the scene of the world."""
        with self._lock:
            if not self._states.get(world):
                self._scenes[world] = scene
                self._states.setdefault(world, RetainedState())
            early, self._early, early_bytes, self._early_bytes = self._early, collections.deque(), self._early_bytes, 0
            self._queue.extend(early)
            self._queued_bytes.add(early_bytes)
        self._wakeup.set()

    def submit(self, key: str, payload: bytes) -> None:
        """Queue a message with records that arrived under ``<world>/fact/<cx>/<cy>/<actor>``. Returns at once."""
        self.counters.received += 1
        if len(payload) > MAX_MESSAGE:
            payload = b""  # the thread counts an empty message as malformed
        if len(self._queue) >= MAX_QUEUED or self._queued_bytes.value + len(payload) > MAX_QUEUED_BYTES:
            self.counters.rejected += 1
            return
        self._queued_bytes.add(len(payload))
        self._queue.append((key, payload))
        self._wakeup.set()

    def snapshot(self, world: str, cells: Iterable[Cell]) -> list[tuple[Cell, bytes]]:
        """Returns messages with all records of these cells, each with its cell; at least one message for each cell."""
        self.counters.snapshots += 1
        found: list[tuple[Cell, bytes]] = []
        with self._lock:
            records = self._states.get(world, RetainedState())
            by_cell = {cell: records.in_cell(cell) for cell in cells}
        for cell, cell_records in by_cell.items():
            found += [(cell, payload) for payload in _split_messages(cell_records)]
        return found

    def cells(self, world: str) -> list[Cell]:
        """Returns the cells of a world that have retained records."""
        with self._lock:
            return sorted({cell for cell, _ in self._states.get(world, RetainedState())})

    def close(self) -> None:
        """Process all queued messages, write all records and end the thread. Idempotent."""
        self._closing = True
        self._wakeup.set()
        self._thread.join()

    # ------------------------------------------------------------ the store's own thread

    def _run(self) -> None:
        """Body of the store's thread. If an error ends the thread, :attr:`status_message` has the error."""
        try:
            self._keep_records()
        except Exception as error:
            log.exception("the thread that keeps records has ended")
            self._ended = f"the thread that keeps records has ended, restart the server: {error!r}"

    def _keep_records(self) -> None:
        """Process the queue and force records to the disk until the store is closed."""
        synced_at = retried_at = time.monotonic()
        unsynced: set[str] = set()
        while True:
            self._wakeup.wait(SYNC_PERIOD if unsynced else RETRY_PERIOD if self._troubles else None)
            self._wakeup.clear()
            closing = self._closing
            while self._queue:
                if world := self._ingest_guarded(*self._queue.popleft()):
                    unsynced.add(world)
                if time.monotonic() - synced_at >= SYNC_PERIOD:
                    break
            now = time.monotonic()
            if self._troubles and (closing or now - retried_at >= RETRY_PERIOD):
                self._recover()
                retried_at = now
            if now - synced_at >= SYNC_PERIOD:
                for world in sorted(unsynced - self._troubles.keys()):
                    self._try_write(world, self._journals[world].sync)
                unsynced.clear()
                synced_at = now
            if self._queue:
                self._wakeup.set()
            elif closing:
                break
        for world, journal in self._journals.items():
            self._try_write(world, journal.close)
        for world in self.unwritten:
            log.error("the records of world %r are lost, because they could not be written", world)

    def _recover(self) -> None:
        """Try to write the journals again that could not be written."""
        for world in list(self._troubles):
            journal = self._journals.get(world)
            write = journal.rewrite if journal is not None else functools.partial(self._open_journal, world)
            if self._try_write(world, write):
                del self._troubles[world]
                log.warning("records of world %r are written again", world)

    def _ingest_guarded(self, key: str, payload: bytes) -> str:
        """Call :meth:`_ingest` with a message. If this raises an unexpected error, drop the message and count the
        error."""
        self._queued_bytes.add(-len(payload))
        try:
            return self._ingest(key, payload)
        except Exception:
            if self.counters.errors == 0:
                log.exception("records under %r ended in an error; further ones are only counted", key)
            self.counters.errors += 1
            return ""

    def _ingest(self, key: str, payload: bytes) -> str:
        """Merge the records of one message. Returns the name of the world if its journal has changed, else "".

        ``key``: key of the message, which begins with the world.
        """
        chunks = key.split("/")
        world = chunks[0]
        where = chunks[2:-1]
        actor = chunks[-1]
        try:
            cell = (int(where[0]), int(where[1])) if len(where) == 2 else None
            if cell is None or not all(-(1 << 31) <= number < 1 << 31 for number in cell):
                raise ValueError
        except ValueError:
            self._count_malformed(world, actor, f"{key!r} names no cell")
            return ""
        with self._lock:
            state = self._states.get(world)
            if state is None:
                self._early.append((key, payload))
                self._early_bytes += len(payload)
                while len(self._early) > MAX_EARLY or self._early_bytes > MAX_EARLY_BYTES:
                    self._early_bytes -= len(self._early.popleft()[1])
                    self.counters.rejected += 1
                return ""
        now = time.monotonic()
        if len(self._buckets) >= MAX_BUCKETS:  # one that was idle for this long is as full as a new one
            self._buckets = {one: kept for one, kept in self._buckets.items() if not kept.is_idle(now)}
        bucket = self._buckets.setdefault((world, actor), _TokenBucket(self._quota, now))
        if not bucket.spend(len(payload), now):
            self.counters.over_quota += 1
            self._warn_once(world, actor, "publishes more records than its quota allows; what exceeds is dropped")
            return ""
        try:
            records = decode_records(payload)
            if foreign_authors := [record.author for record in records if record.author != actor]:
                raise MessageError(f"record by {foreign_authors[0]!r} published by {actor!r}")
        except MessageError as error:
            self._count_malformed(world, actor, str(error))
            return ""
        is_changed = False
        for record in records:
            if len(state) >= MAX_OBJECTS and state.get(record.object) is None:
                self.counters.rejected += 1
                self._warn_once(world, actor, f"publishes records of more than {MAX_OBJECTS} objects; dropped")
            else:
                is_changed |= self._merge(world, cell, record)
        return world if is_changed else ""

    def _merge(self, world: str, cell: Cell, record: RetainedRecord) -> bool:
        """Merge a record and append it to the journal of its world. Returns whether a journal has changed."""
        with self._lock:
            records = self._states.get(world)
            if records is None or not records.merge(cell, record):
                return False
        if self._folder is None:
            return False
        # without the lock, so that snapshots do not wait for the disk
        journal = self._journals.get(world)
        if world in self._troubles:
            pass  # _recover writes it with everything else
        elif journal is not None:
            self._try_write(world, lambda: journal.append(cell, record))
        else:
            self._try_write(world, lambda: self._open_journal(world))
        return world in self._journals

    def _open_journal(self, world: str) -> None:
        """Create the journal of a world, with all its present records."""
        assert self._folder is not None
        path = self._folder / f"{world}{SUFFIX}"
        self._journals[world] = Journal(path, world, self._scenes[world], self._states[world])

    def _try_write(self, world: str, write: Callable[[], object]) -> bool:
        """Call ``write``, which writes the journal of a world. Returns whether it succeeded. Any error is trouble of
        this world only."""
        try:
            write()
            return True
        except (JournalError, OSError, ValueError) as error:
            if world not in self._troubles:
                log.error("records of world %r are kept in memory only until this is repaired: %s", world, error)
            self._troubles[world] = str(error)
            return False

    def _count_malformed(self, world: str, actor: str, reason: str) -> None:
        self.counters.malformed += 1
        self._warn_once(world, actor, f"sent an invalid message: {reason}")

    def _warn_once(self, world: str, actor: str, what: str) -> None:
        """Log a problem with the messages of an actor, but only the first one of each actor."""
        if (world, actor) not in self._warned and len(self._warned) < MAX_WARNED:
            self._warned.add((world, actor))
            log.warning("%s/%s %s (logged once)", world, actor, what)


def _split_messages(records: list[RetainedRecord]) -> list[bytes]:
    """Encode records as messages of at most :data:`MAX_REPLY` bytes each."""
    message = encode_records(records)
    if len(records) <= 1 or (len(message) <= MAX_REPLY and len(records) <= MAX_RECORDS):
        return [message]
    half = len(records) // 2
    return _split_messages(records[:half]) + _split_messages(records[half:])
