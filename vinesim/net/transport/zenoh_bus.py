"""The bus over Zenoh (eclipse-zenoh 1.10): client sessions to one router, nothing else listens or scouts.

What measurements ask for: publishers on exact keys (without a subscriber not one byte leaves), callbacks that only
store, poses as best effort that may be dropped, events reliable and sent by a thread outside the tick because they may
block, a lease of two seconds, shared memory off so that counted bytes are true.

Poses and motion have a session of their own, over datagrams, wherever the server is on another machine: so neither
a lost packet nor a large snapshot holds them up. Everything else goes over a stream, and they do so as well where no
datagrams pass.
"""

from __future__ import annotations

import collections
import contextlib
import json
import logging
import pathlib
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Self

import zenoh

from vinesim.errors import UsageError
from vinesim.net.codec import messages
from vinesim.net.transport.access_control import tls_config
from vinesim.net.transport.bus import (
    KEEP_ALL,
    KEEP_LAST_1,
    BusError,
    JoinRejected,
    NameTaken,
    Reply,
    SampleStore,
)
from vinesim.net.transport.endpoints import Endpoint, client_links

log = logging.getLogger(__name__)

ROOT = "vs/1"
"""First chunks of every key: the layout of keys, then the world."""

WORLD = "vineyard"
"""World of those who name none."""

CONNECT = "tcp/127.0.0.1:7447"
"""Where a server on the same machine listens."""

LEASE = 2000
"""A peer that is silent for this long is gone [ms]."""

MAX_RECEIVE = 4 * messages.MAX_MESSAGE
"""What is larger [B] is not even put together from its fragments, here or in the router."""

CONNECT_TIMEOUT = 2.0
"""How long connecting may take [s]."""


WATCH_PERIOD = 0.5
"""Between two looks at whether datagrams pass [s]."""

SILENCE_TIMEOUT = 3.0
"""They do not if they have not for so long, while the stream did [s]."""

RETRY_PERIOD = 0.05
"""Between two attempts to be let in again [s]."""


class ServerUnreachable(BusError):
    """No server answers at the endpoint."""

    def __init__(self, endpoint: str, reason: str) -> None:
        super().__init__(
            f"no vinesim server answers at {endpoint} within {CONNECT_TIMEOUT:g} s ({reason}): "
            f"start one with 'vinesim server', or give its endpoint, e.g. {endpoint.partition('/')[0]}/HOST:7447"
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
        "transport__link__rx__max_message_size": MAX_RECEIVE,
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


@contextlib.contextmanager
def _user_facing(endpoint: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise ServerUnreachable(endpoint, str(error).split(" at /")[0].rstrip(".")) from error


def _opened(endpoint: Endpoint, credentials: dict[str, Any]) -> zenoh.Session:
    """A client session over one endpoint; :class:`ServerUnreachable` if nobody is there."""
    with _user_facing(str(endpoint)):
        return open_session(
            config(
                "client",
                connect__endpoints=[endpoint.locator],
                connect__timeout_ms=int(1000 * CONNECT_TIMEOUT),
                connect__exit_on_failure=True,
                connect__retry={"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2},
                **credentials,
            )
        )


class _Publisher:
    """See :class:`vinesim.net.transport.bus.Publisher`."""

    def __init__(self, bus: ZenohBus, declare: Callable[[zenoh.Session], zenoh.Publisher], reliable: bool) -> None:
        self._bus, self._declare, self._reliable = bus, declare, reliable
        self._publisher = declare(bus.session_for(reliable))

    @property
    def matching(self) -> bool:
        return self._publisher.matching_status.matching

    def put(self, payload: bytes) -> bool:
        if not self.matching:
            return False
        self._bus.bytes_out += len(payload)
        if self._reliable:
            self._bus.submit(lambda: self._publisher.put(payload))
        else:
            self._publisher.put(payload)
        return True

    def move(self, session: zenoh.Session) -> None:
        """Send over another session from now on."""
        self._publisher = self._declare(session)

    def close(self) -> None:
        self._bus.movable.discard(self)
        self._bus.submit(lambda: self._publisher.undeclare())


class _Subscription:
    """See :class:`vinesim.net.transport.bus.Subscription`."""

    def __init__(self, bus: ZenohBus, declare: Callable[[zenoh.Session], zenoh.Subscriber], reliable: bool) -> None:
        self._bus, self._declare = bus, declare
        self._declared: zenoh.Subscriber | None = None
        bus.submit(lambda: self.move(bus.session_for(reliable)))

    def move(self, session: zenoh.Session) -> None:
        """Hear it over another session from now on."""
        self._declared = self._declare(session)

    def close(self) -> None:
        self._bus.movable.discard(self)
        self._bus.submit(lambda: self._declared and self._declared.undeclare())


class ZenohBus:
    """See :class:`vinesim.net.transport.bus.Bus`. A context manager: a session left open hangs at exit."""

    def __init__(
        self, name: str, *, connect: str = CONNECT, world: str = WORLD, certificates: pathlib.Path | None = None,
        live: bool = True,
    ) -> None:  # fmt: skip
        """Come into ``world`` as ``name`` through the server at ``connect``, see :func:`endpoints.ways`.

        Not ``live``: nobody sees that one is there.

        ``certificates``: folder with ``ca.pem`` and this actor's ``NAME.pem`` and ``NAME.key``; the endpoint is then
        ``tls/`` or ``quic/``. :class:`ServerUnreachable` after two seconds without a server, :class:`NameTaken` if the
        name is live, :class:`UsageError` if name or world cannot be part of a key or the endpoint is none.
        """
        for what, text in (("actor name", name), ("world", world)):
            if not messages.is_valid_name(text):
                raise UsageError(f"{what} {text!r}: use 1 to 48 letters, digits, '_', '-' or '.'")
        way = client_links(connect, secured=certificates is not None)
        self._credentials = {} if certificates is None else tls_config(certificates, name)
        self.name, self.world, self.endpoint = name, world, str(way.bulk)
        self.bytes_in = self.bytes_out = self._huge = 0
        self._prefix = f"{ROOT}/{world}/"
        self._store = SampleStore()
        self._answers: collections.deque[tuple[str, bytes, float]] = collections.deque()
        self._live: dict[str, set[str]] = {}
        self._me = frozenset((name,)) if live else frozenset()
        self._alive = self._me
        self._lock = threading.Lock()
        self._gone: set[str] = set()
        """Endpoints that do not answer now."""
        self._datagrams_to = "" if way.live is None else str(way.live)
        self._silent_since: float | None = None
        self.movable: set[_Publisher | _Subscription] = set()
        """What goes over the session of poses."""
        self._kept = True
        """The server that keeps this world is there, or never was."""
        self._refusal = ""
        self._session = self._poses = _opened(way.bulk, self._credentials)
        try:
            liveliness = self._session.liveliness()
            self._declared: list[object] = [
                self._listen_for_loss(self._session, self.endpoint),
                *([self._claim_name()] if live else []),
            ]
            for reply in liveliness.get(f"{self._prefix}live/*/*", timeout=CONNECT_TIMEOUT):
                if reply.ok is not None:
                    self._living(str(reply.ok.key_expr), True)
            self._declared.append(liveliness.declare_subscriber(f"{self._prefix}live/*/*", self._notice, history=True))
            if way.live is not None:
                self._poses = self._datagrams(way.live)
        except BaseException:
            self.close()
            raise
        self._work: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._worker = threading.Thread(target=self._run, name=f"bus of {name}", daemon=True)
        self._worker.start()

    def _datagrams(self, endpoint: Endpoint) -> zenoh.Session:
        """A session for poses, or the one there is if no datagrams pass."""
        try:
            session = _opened(endpoint, self._credentials)
        except ServerUnreachable:
            log.warning(
                "%s: no datagrams pass to %s: poses go over %s as well, where one lost packet delays all that follow",
                self.name, endpoint, self.endpoint,
            )  # fmt: skip
            return self._session
        self._declared.append(self._listen_for_loss(session, str(endpoint)))
        if zenoh.Reliability.BEST_EFFORT not in [link.reliability for link in session.info.links()]:
            log.warning(
                "%s: the router at %s offers no datagrams on that link: poses go in line there; "
                "it is older than Zenoh 1.10, or listens without mixed_rel", self.name, endpoint,
            )  # fmt: skip
        return session

    def session_for(self, reliable: bool) -> zenoh.Session:
        """The session over which events go, or poses."""
        return self._session if reliable else self._poses

    def _watch(self) -> None:
        """Where datagrams pass no more while the stream lives, let poses take the stream from now on."""
        if self._poses is self._session:
            return
        if self._datagrams_to not in self._gone or self.endpoint in self._gone:
            self._silent_since = None
            return
        now = time.monotonic()
        self._silent_since = self._silent_since or now
        if now - self._silent_since < SILENCE_TIMEOUT:
            return
        log.warning("%s: no datagrams pass to %s any more: poses go over %s", self.name, self._datagrams_to,
                    self.endpoint)  # fmt: skip
        given_up, self._poses = self._poses, self._session
        for each in list(self.movable):
            each.move(self._session)
        self._gone.discard(self._datagrams_to)
        close_session(given_up)

    @property
    def links(self) -> list[str]:
        """Where this actor is connected now, one line a link: its endpoint and how much may be lost there."""
        sessions = dict.fromkeys((self._session, self._poses))
        links = [link for session in sessions for link in session.info.links()]
        return sorted(
            f"{str(link.dst).partition('?')[0]} "
            f"{'best effort' if link.reliability == zenoh.Reliability.BEST_EFFORT else 'reliable'}"
            for link in links
        )

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
        replies = self._session.liveliness().get(f"{self._prefix}live/{self.name}/*", timeout=CONNECT_TIMEOUT)
        return {str(reply.ok.key_expr).rpartition("/")[2] for reply in replies if reply.ok is not None}

    # ------------------------------------------------------------ called by Zenoh's threads

    def _listen_for_loss(self, session: zenoh.Session, endpoint: str) -> object:
        def notice(event: zenoh.TransportEvent) -> None:
            if session.is_closed() or (self._poses is self._session and session is not self._session):
                return  # left, or given up: that is no loss
            if event.kind == zenoh.SampleKind.PUT:
                self._gone.discard(endpoint)
                log.info("%s: connected to %s again", self.name, endpoint)
            else:
                self._gone.add(endpoint)
                log.warning("%s: lost the server at %s; goes on alone and tries to come back", self.name, endpoint)

        return session.info.declare_transport_events_listener(notice)

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
    def dropped(self) -> int:
        return self._store.overflowed + self._huge

    @property
    def status_message(self) -> str:
        if self._refusal:
            return self._refusal
        for endpoint in sorted(self._gone):
            return f"the server at {endpoint} is gone; the local simulation goes on and reconnects by itself"
        if not self._kept:
            return (
                f"behind {self.endpoint} the server that keeps world {self.world!r} is gone; what is said for good is "
                "said again when it is back"
            )
        return ""

    def join(self, greeting: bytes) -> None:
        key = f"{self._prefix}join/{self.name}/{self._session.zid()}"
        welcomes = self._query_admission(key, greeting)
        if any(welcome.refused for welcome in welcomes):
            raise JoinRejected(next(welcome.refused for welcome in welcomes if welcome.refused))
        if not welcomes and self._credentials:
            raise JoinRejected(
                f"the server at {self.endpoint} lets nobody named {self.name!r} in: its folder of certificates must "
                f"hold {self.name}.pem, and it reads them when it starts"
            )
        if not welcomes:
            log.info("%s: no vinesim server keeps world %r; actors judge each other", self.name, self.world)
        elif len(welcomes) > 1:
            log.warning("%s: %d servers keep world %r; link all but one to it with --connect", self.name, len(welcomes),
                        self.world)  # fmt: skip

        # a server that was started anew, or later, does not know who is there: whoever is says so again
        doorkeeper = self._session.declare_querier(key)

        def ask_again() -> None:
            answers, end = self._query_admission(key, greeting), time.monotonic() + CONNECT_TIMEOUT
            # between linked routers a server is announced before questions find the way to it
            while not answers and doorkeeper.matching_status.matching and time.monotonic() < end:
                time.sleep(RETRY_PERIOD)
                answers = self._query_admission(key, greeting)
            refused = [welcome.refused for welcome in answers if welcome.refused]
            self._refusal = refused[0] if refused else ""
            if refused:
                log.error("%s: the server that came back lets this actor in no more: %s", self.name, self._refusal)

        def notice(status: zenoh.MatchingStatus) -> None:
            self._kept = status.matching
            if status.matching:
                self.submit(ask_again)

        self._declared += [doorkeeper, doorkeeper.declare_matching_listener(notice)]
        if not welcomes and doorkeeper.matching_status.matching:
            self.submit(ask_again)

    def _query_admission(self, key: str, greeting: bytes) -> list[messages.Welcome]:
        replies = self._session.get(
            key, payload=greeting, timeout=CONNECT_TIMEOUT, consolidation=zenoh.ConsolidationMode.NONE
        )
        answers: Iterable[bytes] = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
        try:
            return [messages.decode_welcome(answer) for answer in answers]
        except messages.WrongVersion as error:
            return [
                messages.Welcome(
                    f"the server at {self.endpoint} speaks protocol version {error.theirs}, {self.name!r} version "
                    f"{messages.PROTOCOL}: use the same release of vinesim"
                )
            ]
        except messages.MessageError as error:
            return [messages.Welcome(f"what the server at {self.endpoint} answers cannot be read: {error}")]

    def publisher(self, key: str, reliable: bool = False) -> _Publisher:
        if "*" in key:
            raise UsageError(f"publisher key {key!r} has a wildcard: only exact keys send nothing when nobody listens")

        def declare(session: zenoh.Session) -> zenoh.Publisher:
            return session.declare_publisher(
                self._prefix + key,
                congestion_control=zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH if reliable else zenoh.Priority.REAL_TIME,
                reliability=zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
                express=False,
                allowed_destination=zenoh.Locality.REMOTE,
            )

        publisher = _Publisher(self, declare, reliable)
        if not reliable:
            self.movable.add(publisher)
        return publisher

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> _Subscription:
        skip = len(self._prefix)

        def store(sample: zenoh.Sample) -> None:
            size = len(sample.payload)
            self.bytes_in += size
            if size > messages.MAX_MESSAGE:
                self._huge += 1
            else:
                self._store.put(depth, str(sample.key_expr)[skip:], sample.payload.to_bytes())

        def declare(session: zenoh.Session) -> zenoh.Subscriber:
            return session.declare_subscriber(self._prefix + pattern, store, allowed_origin=zenoh.Locality.REMOTE)

        subscription = _Subscription(self, declare, depth >= KEEP_ALL)
        if depth < KEEP_ALL:
            self.movable.add(subscription)
        return subscription

    def poll(self) -> list[tuple[str, bytes]]:
        return self._store.take()

    def query(self, key: str, payload: bytes = b"") -> None:
        skip = len(self._prefix)

        def hear(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= messages.MAX_MESSAGE:
                arrived = time.monotonic()
                self._answers.append((str(reply.ok.key_expr)[skip:], reply.ok.payload.to_bytes(), arrived))

        # Zenoh's own choice would keep one reply of a key: a snapshot comes in several
        every = zenoh.ConsolidationMode.NONE
        self.submit(
            lambda: self._session.get(
                self._prefix + key, hear, payload=payload, timeout=CONNECT_TIMEOUT, consolidation=every
            )
        )

    def replies(self) -> list[Reply]:
        now, found = time.monotonic(), []
        while self._answers:
            key, payload, arrived = self._answers.popleft()
            found.append(Reply(key, payload, now - arrived))
        return found

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        def answer(query: zenoh.Query) -> None:
            with query:
                asked = query.payload
                query.reply(str(query.key_expr), respond(asked.to_bytes() if asked is not None else b""))

        self._declared.append(self._session.declare_queryable(self._prefix + key, answer))

    def alive(self) -> frozenset[str]:
        return self._alive

    def submit(self, what: Callable[[], object]) -> None:
        """Do something that may take its time, in order, in the thread outside the tick."""
        self._work.put(what)

    def _run(self) -> None:
        """The thread outside the tick."""
        due = time.monotonic() + WATCH_PERIOD
        while True:
            what: Callable[[], object] | None = self._watch
            if (left := due - time.monotonic()) > 0.0:
                with contextlib.suppress(queue.Empty):
                    what = self._work.get(timeout=left)
            if what is None:
                return
            if what == self._watch:
                due = time.monotonic() + WATCH_PERIOD
            try:
                what()
            except zenoh.ZError as error:
                log.warning("the network refused: %s", error)

    def close(self) -> None:
        work = getattr(self, "_work", None)
        if work is not None:
            work.put(None)
            self._worker.join(timeout=CONNECT_TIMEOUT)
        for session in (self._poses, self._session):
            close_session(session)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
