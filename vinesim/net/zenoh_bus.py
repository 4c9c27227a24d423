"""The bus over Zenoh (eclipse-zenoh 1.10): a client session to one router, nothing else listens or scouts.

What the design's measurements ask for: publishers on exact keys (without a subscriber not one byte leaves), callbacks
that only store, poses as best effort that may be dropped, events reliable and sent by a thread outside the tick because
they may block, a lease of two seconds, shared memory off so that counted bytes are true.
"""

from __future__ import annotations

import collections
import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self

import zenoh

from vinesim.net import messages
from vinesim.net.bus import NEWEST, Answer, BusError, NameTaken, Store

log = logging.getLogger(__name__)

ROOT = "vs/1"
"""First chunks of every key: the layout of keys, then the world."""

WORLD = "vineyard"
"""World of those who name none."""

CONNECT = "tcp/127.0.0.1:7447"
"""Where a server on the same machine listens."""

LEASE = 2000
"""A peer that is silent for this long is gone [ms]."""

PATIENCE = 2.0
"""How long connecting may take [s]."""


class ServerUnreachable(BusError):
    """No server answers at the endpoint."""

    def __init__(self, endpoint: str, reason: str) -> None:
        super().__init__(
            f"no vinesim server answers at {endpoint} within {PATIENCE:g} s ({reason}): "
            f"start one with 'vinesim server', or give its endpoint, e.g. tcp/HOST:7447"
        )


def config(mode: str, **settings: Any) -> zenoh.Config:
    """A session's configuration: no scouting of any kind, no shared memory, a short lease, then ``settings``.

    Keys of ``settings`` are Zenoh's, with ``__`` for ``/``.
    """
    common = {
        "mode": mode,
        "scouting__multicast__enabled": False,
        "scouting__gossip__enabled": False,
        "scouting__delay": 0,
        "transport__link__tx__lease": LEASE,
        "transport__shared_memory__enabled": False,
        "transport__unicast__open_timeout": 1500,
        "transport__unicast__accept_timeout": 1500,
    }
    made = zenoh.Config()
    for key, value in {**common, **settings}.items():
        made.insert_json5(key.replace("__", "/"), json.dumps(value))
    return made


_open_sessions: set[zenoh.Session] = set()
_guard: list[threading.Thread] = []


def open_session(settings: zenoh.Config) -> zenoh.Session:
    """A session that is closed at the latest when the main thread ends.

    Zenoh runs Python callbacks in threads for which the interpreter waits before it exits, so a forgotten session
    would hang for ever.
    """
    session = zenoh.open(settings)
    _open_sessions.add(session)
    if not _guard:
        _guard.append(threading.Thread(target=_close_all, name="closes forgotten sessions"))
        _guard[0].start()
    return session


def close_session(session: zenoh.Session) -> None:
    """Close a session; the second time nothing happens."""
    _open_sessions.discard(session)
    if not session.is_closed():
        session.close()


def _close_all() -> None:
    threading.main_thread().join()
    for session in list(_open_sessions):
        close_session(session)


@contextmanager
def _meant_for_the_user(endpoint: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise ServerUnreachable(endpoint, str(error).split(" at /")[0].rstrip(".")) from error


class _Publisher:
    """See :class:`vinesim.net.bus.Publisher`."""

    def __init__(self, bus: ZenohBus, publisher: zenoh.Publisher, reliable: bool) -> None:
        self._bus, self._publisher, self._reliable = bus, publisher, reliable

    @property
    def matching(self) -> bool:
        return self._publisher.matching_status.matching

    def put(self, payload: bytes) -> bool:
        if not self.matching:
            return False
        self._bus.bytes_out += len(payload)
        if self._reliable:
            self._bus.outside(lambda: self._publisher.put(payload))
        else:
            self._publisher.put(payload)
        return True

    def close(self) -> None:
        self._bus.outside(self._publisher.undeclare)


class _Subscription:
    """See :class:`vinesim.net.bus.Subscription`."""

    def __init__(self, bus: ZenohBus) -> None:
        self._bus = bus
        self.declared: zenoh.Subscriber | None = None

    def close(self) -> None:
        self._bus.outside(lambda: self.declared and self.declared.undeclare())


class ZenohBus:
    """See :class:`vinesim.net.bus.Bus`. A context manager: a session left open hangs at exit."""

    def __init__(self, name: str, *, connect: str = CONNECT, world: str = WORLD, live: bool = True) -> None:
        """Join ``world`` as ``name`` through the server at ``connect``; not ``live``: nobody sees that one is there.

        :class:`ServerUnreachable` after two seconds without a server, :class:`NameTaken` if the name is live,
        :class:`ValueError` if name or world cannot be part of a key.
        """
        for what, text in (("actor name", name), ("world", world)):
            if not messages.valid_name(text):
                raise ValueError(f"{what} {text!r}: use 1 to 48 letters, digits, '_', '-' or '.'")
        self.name, self.world, self.endpoint = name, world, connect
        self.bytes_in = self.bytes_out = self._huge = 0
        self._prefix = f"{ROOT}/{world}/"
        self._store = Store()
        self._answers: collections.deque[tuple[str, bytes, float]] = collections.deque()
        self._live: dict[str, set[str]] = {}
        self._me = frozenset((name,)) if live else frozenset()
        self._alive = self._me
        self._lock = threading.Lock()
        self._connected = True
        with _meant_for_the_user(connect):
            self._session = open_session(
                config(
                    "client",
                    connect__endpoints=[connect],
                    connect__timeout_ms=int(1000 * PATIENCE),
                    connect__exit_on_failure=True,
                    connect__retry={"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2},
                )
            )
        try:
            liveliness = self._session.liveliness()
            self._declared: list[object] = [
                self._session.info.declare_transport_events_listener(self._transport),
                *([self._claim_name()] if live else []),
            ]
            for reply in liveliness.get(f"{self._prefix}live/*/*", timeout=PATIENCE):
                if reply.ok is not None:
                    self._living(str(reply.ok.key_expr), True)
            self._declared.append(liveliness.declare_subscriber(f"{self._prefix}live/*/*", self._notice, history=True))
        except BaseException:
            self.close()
            raise
        self._work: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._worker = threading.Thread(target=_run, args=(self._work,), name=f"bus of {name}", daemon=True)
        self._worker.start()

    def _claim_name(self) -> zenoh.LivelinessToken:
        """Declare the token of this name, unless another session has it.

        Of two who come at once, the one whose token the router took second sees the first's, so never both stay; if
        both look after both declared, neither does.
        """
        liveliness, mine = self._session.liveliness(), str(self._session.zid())
        if self._holders() - {mine}:
            raise NameTaken(self.name, self.world)
        token = liveliness.declare_token(f"{self._prefix}live/{self.name}/{mine}")
        if self._holders() - {mine}:
            raise NameTaken(self.name, self.world)
        return token

    def _holders(self) -> set[str]:
        replies = self._session.liveliness().get(f"{self._prefix}live/{self.name}/*", timeout=PATIENCE)
        return {str(reply.ok.key_expr).rpartition("/")[2] for reply in replies if reply.ok is not None}

    # ------------------------------------------------------------ called by Zenoh's threads

    def _transport(self, event: zenoh.TransportEvent) -> None:
        self._connected = event.kind == zenoh.SampleKind.PUT
        if self._connected:
            log.info("%s: connected to %s again", self.name, self.endpoint)
        else:
            log.warning("%s: lost the server at %s; goes on alone and tries to come back", self.name, self.endpoint)

    def _notice(self, sample: zenoh.Sample) -> None:
        self._living(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    def _living(self, key: str, there: bool) -> None:
        name, session = key.split("/")[-2:]
        with self._lock:
            sessions = self._live.setdefault(name, set())
            (sessions.add if there else sessions.discard)(session)
            self._alive = frozenset(name for name, sessions in self._live.items() if sessions) | self._me

    # ------------------------------------------------------------ the bus

    @property
    def lost(self) -> int:
        return self._store.overflowed + self._huge

    @property
    def trouble(self) -> str:
        if self._connected:
            return ""
        return f"the server at {self.endpoint} is gone; the local simulation goes on and reconnects by itself"

    def publisher(self, key: str, reliable: bool = False) -> _Publisher:
        if "*" in key:
            raise ValueError(f"publisher key {key!r} has a wildcard: only exact keys send nothing when nobody listens")
        declared = self._session.declare_publisher(
            self._prefix + key,
            congestion_control=zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH if reliable else zenoh.Priority.REAL_TIME,
            reliability=zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
            express=False,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        return _Publisher(self, declared, reliable)

    def subscribe(self, pattern: str, depth: int = NEWEST) -> _Subscription:
        subscription = _Subscription(self)
        skip = len(self._prefix)

        def store(sample: zenoh.Sample) -> None:
            size = len(sample.payload)
            self.bytes_in += size
            if size > messages.LARGEST:
                self._huge += 1
            else:
                self._store.put(depth, str(sample.key_expr)[skip:], sample.payload.to_bytes())

        def declare() -> None:
            subscription.declared = self._session.declare_subscriber(
                self._prefix + pattern, store, allowed_origin=zenoh.Locality.REMOTE
            )

        self.outside(declare)
        return subscription

    def drain(self) -> list[tuple[str, bytes]]:
        return self._store.take()

    def ask(self, key: str, payload: bytes = b"") -> None:
        skip = len(self._prefix)

        def hear(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= messages.LARGEST:
                arrived = time.monotonic()
                self._answers.append((str(reply.ok.key_expr)[skip:], reply.ok.payload.to_bytes(), arrived))

        self.outside(lambda: self._session.get(self._prefix + key, hear, payload=payload, timeout=PATIENCE))

    def answers(self) -> list[Answer]:
        now, found = time.monotonic(), []
        while self._answers:
            key, payload, arrived = self._answers.popleft()
            found.append(Answer(key, payload, now - arrived))
        return found

    def serve(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        def answer(query: zenoh.Query) -> None:
            with query:
                asked = query.payload
                query.reply(str(query.key_expr), respond(asked.to_bytes() if asked is not None else b""))

        self._declared.append(self._session.declare_queryable(self._prefix + key, answer))

    def alive(self) -> frozenset[str]:
        return self._alive

    def outside(self, what: Callable[[], object]) -> None:
        """Do something that may take its time, in order, in the thread outside the tick."""
        self._work.put(what)

    def close(self) -> None:
        work = getattr(self, "_work", None)
        if work is not None:
            work.put(None)
            self._worker.join(timeout=PATIENCE)
        close_session(self._session)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _run(work: queue.SimpleQueue) -> None:
    while (what := work.get()) is not None:
        try:
            what()
        except zenoh.ZError as error:
            log.warning("the network refused: %s", error)
