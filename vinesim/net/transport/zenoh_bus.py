"""The bus over Zenoh (eclipse-zenoh 1.10): client sessions to one router, without scouting and without listening.

Publishers have keys without wildcards, so that not one byte is sent without a subscriber. The threads of Zenoh that
read the network call the callbacks, which only store samples. Otherwise Zenoh would keep a Python thread for every
subscription, about a hundred in a client. Poses are best effort and may be dropped. Events are reliable. A thread of
the bus sends them, because sending may block.

If the server is on another machine, poses and states use a second session over datagrams, so that neither a lost packet
nor a large snapshot delays them. If no datagrams arrive, poses and states use the stream of the first session.
"""

from __future__ import annotations

import collections
import contextlib
import logging
import pathlib
import queue
import threading
import time
from collections.abc import Callable
from typing import Any, Self

import zenoh

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.core.errors import UsageError
from vinesim.net.codec.header import MAX_MESSAGE, is_valid_name
from vinesim.net.transport.access_control import tls_config
from vinesim.net.transport.bus import KEEP_ALL, KEEP_LAST_1, NameTaken, Reply, SampleStore, SenderBudget
from vinesim.net.transport.endpoints import PORT, Endpoint, client_links
from vinesim.net.transport.name_holders import NameHolders, bound_name
from vinesim.net.transport.signatures import Identity, SealCheck, Sealer
from vinesim.net.transport.zenoh_admission import ServerAdmission
from vinesim.net.transport.zenoh_session import (
    CONNECT_TIMEOUT,
    ServerUnreachable,
    called_directly,
    close_session,
    has_match,
    open_client,
    watch_certificates,
)

log = logging.getLogger(__name__)

ROOT = "vs/1"
"""First chunks of every key, with the version of the key layout. The next chunk is the name of the world."""

WORLD = "vineyard"
"""Default name of a world."""

CONNECT = f"tcp/127.0.0.1:{PORT}"
"""Default endpoint: a server on this machine."""

WATCH_PERIOD = 0.5
"""Time between two checks of the links, like whether datagrams still arrive [s]."""

LOSS_NOTICE = 1.0
"""Time after which a lost connection to the server is reported [s]. Shorter losses, like a connection that is replaced
while a client joins, need no attention."""

SILENCE_TIMEOUT = 3.0
"""Time without datagrams, while the stream works, after which poses move to the stream [s]."""

DATAGRAM_RETRY_PERIOD = 10.0
"""Time between two attempts to open the session over datagrams again [s]."""

UNSERVED_TIMEOUT = 10.0
"""Time without the server of this world, while the link to its router works, after which a session is opened anew if
the server answers there [s]."""

MAX_ASKED_NAMES = 8
"""Largest number of names that several sessions claim and for which the server is asked in one
:data:`WATCH_PERIOD`."""

SEALED_QUERIES = frozenset(("clock", "offer"))
"""Queries that do something in the name of an actor, by the first chunk of their keys. The query to join is signed,
too."""

FETCH_TIMEOUT = 10.0
"""Time limit of :meth:`ZenohBus.fetch` [s], long enough for large replies over slow links."""

MAX_PENDING_PUTS = 10_000
"""Largest number of reliable messages that wait to be sent. Further messages are refused."""

MAX_PENDING_BYTES = 32 << 20
"""Largest size of all reliable messages that wait to be sent [B]."""

MAX_PENDING_REPLIES = 1000
"""Largest number of replies to queries that wait for :meth:`ZenohBus.replies`. Further replies are discarded and
counted."""


class ZenohBus:
    """The bus over Zenoh. Implements :class:`vinesim.net.transport.bus.Bus`.

    A context manager. An open session delays the exit of the program.
    """

    def __init__(
        self,
        name: str,
        *,
        connect: str = CONNECT,
        world: str = WORLD,
        certificates: pathlib.Path | None = None,
        live: bool = True,
    ) -> None:
        """Connect the actor ``name`` to ``world`` through the server at the endpoint ``connect``.

        ``certificates``: folder with ``ca.pem`` and this actor's ``NAME.pem`` and ``NAME.key``. The endpoint is then
        ``tls/HOST:PORT`` or ``quic/HOST:PORT``. ``live``: whether to declare a liveliness token, without which others
        do not know of this actor. Which sessions are opened: :func:`endpoints.client_links`.

        Raises :class:`ServerUnreachable` after two seconds without a server, and after 30 s at a server that is too
        busy to answer, :class:`NoServer` after two seconds at a Zenoh router without a server, :class:`JoinRejected` if
        the server does not know the certificate, :class:`NameTaken` if another session holds the name, and
        :class:`vinesim.core.errors.UsageError` if the name, the world or the endpoint is invalid.
        """
        for what, text in (("actor name", name), ("world", world)):
            if not is_valid_name(text):
                raise UsageError(f"{what} {text!r}: use 1 to 48 letters, digits, '_', '-' or '.'")
        links = client_links(connect, secured=certificates is not None)
        self.is_secured = certificates is not None
        """Whether certificates are used, so that the router checks all names."""
        self._credentials = {} if certificates is None else tls_config(certificates, name)
        self._certificate_watch = None if certificates is None else watch_certificates(certificates, name)
        self.name = name
        self.world = world
        self.endpoint = str(links.bulk)
        self.bytes_in = self.bytes_out = self._oversized = self.failures = self.foreign = 0
        self._missed = 0
        self.early = 0
        """Number of messages that were dropped because their session had not shown its public key yet, as it does once
        a second."""
        self.seal_bytes_in = self.seal_bytes_out = 0
        """Size of all seals that were received and sent [B], which :attr:`bytes_in` and :attr:`bytes_out` do not
        contain."""
        self._put_count = self._put_bytes = self._sent_count = self._sent_bytes = 0
        self._prefix = f"{ROOT}/{world}/"
        self._store = SampleStore()
        self._budget = SenderBudget()
        self._replies: collections.deque[tuple[str, bytes, float]] = collections.deque()
        self._names = NameHolders(frozenset((name,) if live else ()))
        self._lost_endpoints: set[str] = set()
        """Endpoints whose connection is lost now."""
        self._lost_since: float | None = None
        self._is_loss_reported = False
        """Whether the server is lost and the user was told so."""
        self._datagram_endpoint = links.live
        self._silent_since: float | None = None
        self._pose_watch: object = None
        self._probe: threading.Thread | None = None
        self._probed: zenoh.Session | None = None
        """Session over datagrams that was opened again, until poses are moved to it."""
        self._next_probe = time.monotonic() + DATAGRAM_RETRY_PERIOD
        self.unreliable: set[BusPublisher | BusSubscription] = set()
        """Best-effort publishers and subscriptions, which use the session of poses."""
        self.reliable: set[BusPublisher | BusSubscription] = set()
        """Reliable publishers and subscriptions."""
        self._unserved_since: float | None = None
        self._opener: threading.Thread | None = None
        """Thread that opens a session anew."""
        self._opened: tuple[zenoh.Session, Identity] | None = None
        """Session that was opened anew, until it replaces :attr:`_session`."""
        self.sessions_opened_anew = 0
        """Number of times that a session was opened anew because the server did not serve the old one."""
        self._bulk_endpoint = links.bulk
        self._live = live
        self._queryables: list[Callable[[], object]] = []
        """Functions that declare the queryables on the present session."""
        self.identity = Identity()
        """Keys of the session that holds the actor's name. All samples have its signature, also those of the session of
        poses. With certificates the router checks the names, and nothing is signed."""
        self._seals = SealCheck()
        self._session = self._pose_session = open_client(links.bulk, self._credentials, self.identity.session)
        self.source = zenoh.SourceInfo(self._session.id, 0) if self.is_secured else None
        """With certificates, the id of the session that holds the actor's name, which all samples state."""
        self._admission = ServerAdmission(
            self._session,
            self._prefix,
            name=name,
            world=world,
            endpoint=self.endpoint,
            is_secured=certificates is not None,
            submit=self.submit,
            seal=self.seal,
        )
        try:
            self._admission.find_server()
            self._declared: list[object] = [
                self._watch_connection(self._session, self.endpoint),
                *([self._claim_name()] if live else []),
            ]
            self._names.start(self._tokens())
            self._declared.append(self._watch_tokens())
            if links.live is not None:
                self._pose_session = self._open_datagrams(links.live)
        except BaseException:
            self.close()
            raise
        self._work: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._worker = threading.Thread(target=self._run, name=f"bus of {name}", daemon=True)
        self._worker.start()

    def _open_datagrams(self, endpoint: Endpoint) -> zenoh.Session:
        """Open and return the session for poses, over datagrams. If no router answers there, return
        the session over the stream."""
        try:
            session = open_client(endpoint, self._credentials)
        except ServerUnreachable:
            log.warning(
                "%s: no datagrams pass to %s: poses use %s as well, where one lost packet delays all messages after it",
                self.name,
                endpoint,
                self.endpoint,
            )
            return self._session
        self._pose_watch = self._watch_connection(session, str(endpoint))
        if zenoh.Reliability.BEST_EFFORT not in [link.reliability for link in session.info.links()]:
            log.warning(
                "%s: the router at %s offers no datagrams on that link, so lost packets delay poses; "
                "the router is older than Zenoh 1.10, or listens without mixed_rel",
                self.name,
                endpoint,
            )
        return session

    def session_for(self, reliable: bool) -> zenoh.Session:
        """Returns the session for ``reliable`` messages, or the session for best-effort ones."""
        return self._session if reliable else self._pose_session

    def _watch_links(self) -> None:
        """Check datagrams, the server and certificates. The bus's own thread calls this once a :data:`WATCH_PERIOD`."""
        self._watch_server()
        self._watch_datagrams()
        self._admission.watch()
        self._watch_service()
        self._ask_for_holders()
        if (watch := self._certificate_watch) is not None:
            if watch.has_changed():  # Zenoh reads the files at each connection
                log.warning("%s: its certificates changed: the next connection uses the new ones", self.name)
            watch.warn()

    def _watch_server(self) -> None:
        """Report that the connection to the server has been lost for :data:`LOSS_NOTICE`, and that it works again."""
        if self.endpoint not in self._lost_endpoints:
            if self._is_loss_reported:
                log.warning("%s: connected to the server at %s again", self.name, self.endpoint)
            self._lost_since = None
            self._is_loss_reported = False
            return
        now = time.monotonic()
        self._lost_since = self._lost_since or now
        if not self._is_loss_reported and now - self._lost_since >= LOSS_NOTICE:
            self._is_loss_reported = True
            log.warning("%s: lost the server at %s; simulates alone and tries to reconnect", self.name, self.endpoint)

    def _watch_service(self) -> None:
        """Open a session anew if the server does not serve this one though the link works.

        Another thread opens a session beside the present one. Only if the server answers there, it replaces the present
        one: if the server is gone from behind a router that works, nothing changes.
        """
        if (opened := self._opened) is not None:
            self._opened = None
            self._replace_session(*opened)
        now = time.monotonic()
        if self._admission.is_served or self.endpoint in self._lost_endpoints:
            self._unserved_since = None
            return
        self._unserved_since = self._unserved_since or now
        is_opening = self._opener is not None and self._opener.is_alive()
        if now - self._unserved_since >= UNSERVED_TIMEOUT and not is_opening:
            self._unserved_since = now
            self._opener = threading.Thread(target=self._try_anew, name=f"new session of {self.name}", daemon=True)
            self._opener.start()

    def _try_anew(self) -> None:
        """Body of the thread that opens a session beside the present one, and keeps it if the server answers there."""
        identity = Identity()
        try:
            session = open_client(self._bulk_endpoint, self._credentials, identity.session)
        except ServerUnreachable as error:
            log.warning("%s: %s", self.name, error)
            return
        if self._admission.answers(session):
            self._opened = session, identity
        else:
            close_session(session)

    def _replace_session(self, session: zenoh.Session, identity: Identity) -> None:
        """Use another session in the place of the present one, with all that was declared."""
        log.warning("%s: the server at %s did not serve this session: opened a new one", self.name, self.endpoint)
        abandoned, self._session = self._session, session
        self.identity = identity
        self.sessions_opened_anew += 1
        self.source = zenoh.SourceInfo(session.id, 0) if self.is_secured else None
        self._lost_endpoints.discard(self.endpoint)
        close_session(abandoned)  # which withdraws its token, so that the name is free
        self._declared = [self._watch_connection(session, self.endpoint)]
        if self._live:
            self._declared.append(session.liveliness().declare_token(f"{self._prefix}live/{self.name}/{session.zid()}"))
        self._names.refresh(self._tokens())
        self._declared.append(self._watch_tokens())
        self._declared += [declare() for declare in self._queryables]
        if self._pose_session is abandoned:
            self._move_poses(session)
        for entity in list(self.reliable):
            entity.move_to(session)
        self._admission.move_to(session)

    def _ask_for_holders(self) -> None:
        """Ask the server which session it admitted, for names that several sessions claim."""
        for name in self._names.contested()[:MAX_ASKED_NAMES]:
            if holder := self._holder(name):
                self._names.prefer(name, holder)

    def _holder(self, name: str) -> str | None:
        """Returns the session that the server admitted with a name; empty if it admitted none, None without a
        server."""
        replies = self._session.get(f"{self._prefix}holder/{name}", timeout=CONNECT_TIMEOUT)
        found = [
            reply.ok.payload.to_string()
            for reply in replies
            if reply.ok is not None and self._admission.is_server(reply.replier_id)
        ]
        return found[0] if found else None

    def _tokens(self) -> list[tuple[str, str]]:
        """Returns name and session of all liveliness tokens of the world."""
        tokens = self._session.liveliness().get(f"{self._prefix}live/*/*", timeout=CONNECT_TIMEOUT)
        return [_token(reply.ok.key_expr) for reply in tokens if reply.ok is not None]

    def _watch_tokens(self) -> object:
        return self._session.liveliness().declare_subscriber(
            f"{self._prefix}live/*/*", called_directly(self._on_liveliness), history=True
        )

    def _watch_datagrams(self) -> None:
        """Move poses to the stream if datagrams stop arriving while the stream works, and back if they arrive again."""
        endpoint = str(self._datagram_endpoint)
        if self._pose_session is self._session:
            if self._datagram_endpoint is not None and self.endpoint not in self._lost_endpoints:
                self._return_to_datagrams(self._datagram_endpoint)
            return
        if endpoint not in self._lost_endpoints or self.endpoint in self._lost_endpoints:
            self._silent_since = None
            return
        now = time.monotonic()
        self._silent_since = self._silent_since or now
        if now - self._silent_since < SILENCE_TIMEOUT:
            return
        log.warning("%s: no datagrams pass to %s any more: poses use %s", self.name, endpoint, self.endpoint)
        abandoned = self._pose_session
        self._move_poses(self._session)
        self._lost_endpoints.discard(endpoint)
        self._next_probe = now + DATAGRAM_RETRY_PERIOD
        close_session(abandoned)

    def _return_to_datagrams(self, endpoint: Endpoint) -> None:
        """Move poses back to datagrams if another thread could open a session over them; else start such a thread if
        due.

        Opening a session may take long, so the bus's own thread does not do it.
        """
        if (session := self._probed) is not None:
            self._probed = None
            self._pose_watch = self._watch_connection(session, str(endpoint))
            self._silent_since = None
            log.info("%s: datagrams pass to %s: poses use them", self.name, endpoint)
            self._move_poses(session)
        elif time.monotonic() >= self._next_probe and (self._probe is None or not self._probe.is_alive()):
            self._next_probe = time.monotonic() + DATAGRAM_RETRY_PERIOD
            self._probe = threading.Thread(
                target=self._try_datagrams, args=(endpoint,), name=f"datagrams of {self.name}", daemon=True
            )
            self._probe.start()

    def _try_datagrams(self, endpoint: Endpoint) -> None:
        """Body of the thread that tries to open a session over datagrams."""
        with contextlib.suppress(ServerUnreachable):
            self._probed = open_client(endpoint, self._credentials)

    def _move_poses(self, session: zenoh.Session) -> None:
        """Move all best-effort publishers and subscriptions to another session."""
        self._pose_session = session
        for entity in list(self.unreliable):
            entity.move_to(session)

    @property
    def links(self) -> list[str]:
        """One line of text for each present connection, with its endpoint and reliability."""
        sessions = dict.fromkeys((self._session, self._pose_session))
        links = [link for session in sessions for link in session.info.links()]
        return sorted(
            f"{str(link.dst).partition('?')[0]} "
            f"{'best effort' if link.reliability == zenoh.Reliability.BEST_EFFORT else 'reliable'}"
            for link in links
        )

    def _claim_name(self) -> zenoh.LivelinessToken:
        """Declare the liveliness token of this actor's name. Raises :class:`NameTaken` if another session holds it: by
        a token, unless the server says that no session joined with the name.

        After the declaration this is checked again. If two sessions declare the name at once, the later one finds the
        token of the earlier one and leaves. If both read the tokens after both declarations, both leave.
        """
        mine = str(self._session.zid())
        self._check_name(mine)
        token = self._session.liveliness().declare_token(f"{self._prefix}live/{self.name}/{mine}")
        self._check_name(mine)
        return token

    def _check_name(self, mine: str) -> None:
        """Raise :class:`NameTaken` if another session than ``mine`` holds this actor's name.

        The server is asked first, because a router of Zenoh 1.10 keeps some kB of each key that was ever asked for
        tokens, for good.
        """
        if self._holder(self.name) in ("", mine):
            return
        replies = self._session.liveliness().get(f"{self._prefix}live/{self.name}/*", timeout=CONNECT_TIMEOUT)
        if {_token(reply.ok.key_expr)[1] for reply in replies if reply.ok is not None} - {mine}:
            raise NameTaken(self.name, self.world)

    # ------------------------------------------------------------ called by Zenoh's threads

    def _watch_connection(self, session: zenoh.Session, endpoint: str) -> object:
        """Declare a listener that notes when the connection of a session is lost or restored, and return it."""

        def on_event(event: zenoh.TransportEvent) -> None:
            if session.is_closed() or session not in (self._session, self._pose_session):
                return  # the bus itself closed this session: no loss
            if event.kind == zenoh.SampleKind.PUT:
                self._lost_endpoints.discard(endpoint)
            else:
                self._lost_endpoints.add(endpoint)

        return session.info.declare_transport_events_listener(on_event)

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        """Note that a liveliness token was declared or withdrawn."""
        self._names.update(*_token(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    def seal(self, key: str, payload: bytes) -> bytes | None:
        """Returns the seal of a message or query under a whole ``key``; None with certificates."""
        return None if self.is_secured else self.identity.seal(key, payload)

    def _is_foreign(
        self, key: str, payload: bytes, source: zenoh.EntityGlobalId | None, seal: zenoh.ZBytes | None, *, once: bool
    ) -> bool:
        """Whether a message comes from another session than the one that holds the name in its key. Counts such
        messages.

        ``source``: session that the message states; with certificates it counts, because the router checks the name.
        ``seal``: what the message carries beside its payload. ``once``: whether messages under the key have an order.
        """
        name = bound_name(key)
        if not name:
            return False
        holder = self._names.holder(name)
        if self.is_secured:
            is_own = source is not None and str(source.zid) == holder
        else:
            sealed = None if seal is None else seal.to_bytes()
            if self._seals.is_early(holder, sealed):
                self.early += 1
                return True
            is_own = self._seals.is_from(holder, self._prefix + key, payload, sealed, once=once)
        if is_own:
            return False
        self.foreign += 1
        if self.foreign == 1:
            log.warning(
                "%s: dropped %s from a session that does not hold the name %r as far as is known here: after a lost "
                "connection this ends by itself, and the records are asked for again; if it goes on, another program "
                "speaks under that name; further messages are only counted",
                self.name,
                key[:100],
                name[:50],
            )
        return True

    # ------------------------------------------------------------ the bus

    @property
    def dropped(self) -> int:
        return self._store.overflowed + self._oversized + self._budget.dropped

    @property
    def missed(self) -> int:
        return self._missed + self._store.missed + self._names.returned

    @property
    def status_message(self) -> str:
        if self._admission.rejection:
            return self._admission.rejection
        if self._is_loss_reported:
            return f"the server at {self.endpoint} is gone; the local simulation goes on and reconnects by itself"
        if self._lost_endpoints == {str(self._datagram_endpoint)}:
            return f"datagrams from the server at {self._datagram_endpoint} have stopped; messages still pass"
        if not self._admission.is_served:
            return (
                f"behind {self.endpoint} the server that keeps world {self.world!r} is gone; retained records "
                "are published again when it is back"
            )
        return ""

    def join(self, greeting: bytes) -> None:
        self._admission.join(greeting)

    def publisher(self, key: str, reliable: bool = False) -> BusPublisher:
        if "*" in key:
            raise UsageError(f"publisher key {key!r} has a wildcard: only exact keys send nothing without a subscriber")

        def declare(session: zenoh.Session) -> zenoh.Publisher:
            return session.declare_publisher(
                self._prefix + key,
                congestion_control=zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH if reliable else zenoh.Priority.REAL_TIME,
                reliability=zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
                express=False,
                allowed_destination=zenoh.Locality.REMOTE,
            )

        return BusPublisher(self, declare, self._prefix + key, reliable)

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> BusSubscription:
        skip = len(self._prefix)

        def store(sample: zenoh.Sample) -> None:
            size = len(sample.payload)
            source = sample.source_info
            seal = sample.attachment
            key = str(sample.key_expr)[skip:]
            is_taken = False
            if size > MAX_MESSAGE:
                self._oversized += 1
            elif self.is_secured and not self._budget.admits(bound_name(key), time.monotonic()):
                pass  # counted by the budget; the router has checked the name
            else:
                payload = sample.payload.to_bytes()
                if self._is_foreign(key, payload, None if source is None else source.source_id, seal, once=True):
                    pass
                elif self.is_secured or self._budget.admits(bound_name(key), time.monotonic()):
                    self._store.put(depth, key, payload)
                    is_taken = True
            self._missed += depth >= KEEP_ALL and not is_taken
            self.bytes_in += size
            self.seal_bytes_in += 0 if seal is None else len(seal)

        def declare(session: zenoh.Session) -> zenoh.Subscriber:
            return session.declare_subscriber(
                self._prefix + pattern, called_directly(store), allowed_origin=zenoh.Locality.REMOTE
            )

        return BusSubscription(self, declare, depth >= KEEP_ALL)

    def poll(self) -> list[tuple[str, bytes]]:
        return self._store.take()

    def query(self, key: str, payload: bytes = b"") -> None:
        skip = len(self._prefix)

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= MAX_MESSAGE:
                arrived = time.monotonic()
                reply_key = str(reply.ok.key_expr)[skip:]
                payload = reply.ok.payload.to_bytes()
                if bound_name(reply_key):
                    is_foreign = self._is_foreign(reply_key, payload, reply.replier_id, reply.ok.attachment, once=False)
                else:
                    is_foreign = not self._admission.is_server(reply.replier_id)
                    self.foreign += is_foreign
                if len(self._replies) >= MAX_PENDING_REPLIES:
                    self._oversized += 1
                elif not is_foreign:
                    self._replies.append((reply_key, payload, arrived))

        # by default Zenoh keeps one reply for each key, but a snapshot has several
        no_consolidation = zenoh.ConsolidationMode.NONE
        self.submit(
            lambda: self._session.get(
                self._prefix + key,
                called_directly(on_reply),
                payload=payload,
                attachment=self._seal_of_query(key, payload),
                timeout=CONNECT_TIMEOUT,
                consolidation=no_consolidation,
            )
        )

    def _seal_of_query(self, key: str, payload: bytes) -> bytes | None:
        """Returns the seal of a query that asks for something in the actor's name; None for other queries."""
        return self.seal(self._prefix + key, payload) if key.partition("/")[0] in SEALED_QUERIES else None

    def replies(self) -> list[Reply]:
        now = time.monotonic()
        found = []
        while self._replies:
            key, payload, arrived = self._replies.popleft()
            found.append(Reply(key, payload, now - arrived))
        return found

    def fetch(self, key: str, payload: bytes = b"") -> list[bytes]:
        try:
            replies = self._session.get(
                self._prefix + key,
                payload=payload,
                attachment=self._seal_of_query(key, payload),
                source_info=self.source,
                timeout=FETCH_TIMEOUT,
                priority=zenoh.Priority.BACKGROUND,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            found = [reply.ok.payload for reply in replies if reply.ok is not None]
        except zenoh.ZError as error:
            self.count_failure(error)
            return []
        return [payload.to_bytes() for payload in found if len(payload) <= MAX_MESSAGE]

    @property
    def spectators_speak_to(self) -> SpectatorsSpeakTo:
        return self._admission.spectators_speak_to

    @property
    def admissions(self) -> int:
        return self._admission.count

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        def on_query(query: zenoh.Query) -> None:
            with query:
                request = query.payload
                try:
                    answer = respond(request.to_bytes() if request is not None else b"")
                    key = str(query.key_expr)
                    query.reply(key, answer, attachment=self.seal(key, answer))
                except zenoh.ZError as error:
                    self.count_failure(error)

        def declare() -> object:
            return self._session.declare_queryable(self._prefix + key, on_query)

        self._queryables.append(declare)
        self._declared.append(declare())

    def alive(self) -> frozenset[str]:
        return self._names.live

    def submit(self, task: Callable[[], object]) -> None:
        """Have the bus's own thread call a function that may block. Functions are called in order of submission."""
        self._work.put(task)

    def submit_put(self, put: Callable[[], object], size: int) -> bool:
        """Have the bus's own thread call ``put``, which sends a reliable message of ``size`` [B].

        Returns False, and counts a failure, if too many messages wait already. Only the thread of the real-time loop
        may call this, so that the counters need no lock.
        """
        if (
            self._put_count - self._sent_count >= MAX_PENDING_PUTS
            or self._put_bytes - self._sent_bytes + size > MAX_PENDING_BYTES
        ):
            self.failures += 1
            return False

        def run() -> None:
            try:
                put()
            finally:
                self._sent_count += 1
                self._sent_bytes += size

        self._put_count += 1
        self._put_bytes += size
        self.submit(run)
        return True

    def count_failure(self, error: Exception) -> None:
        """Count a failed operation of the network, and log the first one."""
        self.failures += 1
        if self.failures == 1:
            log.warning("%s: an operation failed on the network, further ones are only counted: %s", self.name, error)

    def _run(self) -> None:
        """Body of the bus's own thread."""
        due = time.monotonic() + WATCH_PERIOD
        while True:
            task: Callable[[], object] | None = self._watch_links
            if (left := due - time.monotonic()) > 0.0:
                with contextlib.suppress(queue.Empty):
                    task = self._work.get(timeout=left)
            if task is None:
                return
            if task == self._watch_links:
                due = time.monotonic() + WATCH_PERIOD
            try:
                task()
            except zenoh.ZError as error:
                self.count_failure(error)
            except Exception as error:  # go on: this thread sends all reliable messages
                log.exception("%s: an error in the thread of the bus", self.name)
                self.count_failure(error)

    def close(self) -> None:
        work = getattr(self, "_work", None)
        if work is not None:
            work.put(None)
            self._worker.join(timeout=CONNECT_TIMEOUT)
        if self._probe is not None:
            self._probe.join(timeout=2.0 * CONNECT_TIMEOUT)
        if self._opener is not None:
            self._opener.join(timeout=3.0 * CONNECT_TIMEOUT)
        if not self._session.is_closed():
            # a router of Zenoh 1.10 keeps about 20 kB of the publishers of a session that closes without this
            for entity in [*self.unreliable, *self.reliable]:
                entity.undeclare()
            self._admission.close()
            for declared in reversed(getattr(self, "_declared", [])):
                _undeclare(declared)
        opened = None if self._opened is None else self._opened[0]
        for session in (self._probed, opened, self._pose_session, self._session):
            if session is not None:
                close_session(session)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _token(key: zenoh.KeyExpr) -> tuple[str, str]:
    """Returns the name and the session of a liveliness token."""
    name, session = str(key).split("/")[-2:]
    return name, session


# Publishers and subscriptions of a bus, which can move between its sessions.
#
# While the real-time loop publishes, the bus's own thread may move a publisher to another session. If an operation
# fails because of that, it is counted, and the publisher is declared again.


class BusPublisher:
    """A publisher of a :class:`ZenohBus`. Implements :class:`vinesim.net.transport.bus.Publisher`.

    Failures of the network are counted and never raised.
    """

    def __init__(
        self, bus: ZenohBus, declare: Callable[[zenoh.Session], zenoh.Publisher], key: str, reliable: bool
    ) -> None:
        """``key``: whole key of the messages."""
        self._bus = bus
        self._declare = declare
        self._key = key
        self._sealer = Sealer(key)
        self._reliable = reliable
        self._publisher: zenoh.Publisher | None = None
        self._is_closed = self._is_renewing = False
        (bus.reliable if reliable else bus.unreliable).add(self)
        session = bus.session_for(reliable)
        try:
            self._publisher = declare(session)
        except zenoh.ZError as error:
            self._fail(error)
        if bus.session_for(reliable) is not session:  # poses were moved meanwhile
            self._renew_soon()

    @property
    def matching(self) -> bool:
        publisher = self._publisher
        try:
            return publisher is not None and has_match(publisher)
        except zenoh.ZError as error:
            self._fail(error)
            return False

    def put(self, payload: bytes) -> bool:
        publisher = self._publisher
        if publisher is None or not self.matching:
            return False
        bus = self._bus
        if self._reliable:
            if not bus.submit_put(lambda: self._put_reliably(payload), len(payload)):
                return False
        else:
            seal = None if bus.is_secured else self._sealer.seal(bus.identity, payload)
            try:
                publisher.put(payload, source_info=bus.source, attachment=seal)
            except zenoh.ZError as error:
                self._fail(error)
                return False
            bus.seal_bytes_out += 0 if seal is None else len(seal)
        bus.bytes_out += len(payload)
        return True

    def _put_reliably(self, payload: bytes) -> None:
        """Sign and send a reliable message. The bus's own thread calls this, so that the message has the signature of
        the session that sends it."""
        if (publisher := self._publisher) is not None:
            bus = self._bus
            seal = bus.seal(self._key, payload)
            bus.seal_bytes_out += 0 if seal is None else len(seal)
            publisher.put(payload, source_info=bus.source, attachment=seal)

    def move_to(self, session: zenoh.Session) -> None:
        """Declare the publisher on another session instead of the present one."""
        before = self._publisher
        self._publisher = self._declare(session)
        _undeclare(before)

    def undeclare(self) -> None:
        """Undeclare the publisher at once, because its bus closes."""
        self._is_closed = True
        _undeclare(self._publisher)

    def close(self) -> None:
        self._is_closed = True
        self._bus.unreliable.discard(self)
        self._bus.reliable.discard(self)
        self._bus.submit(lambda: _undeclare(self._publisher))

    def _fail(self, error: zenoh.ZError) -> None:
        """Count a failure, and have the publisher declared again."""
        self._bus.count_failure(error)
        self._renew_soon()

    def _renew_soon(self) -> None:
        """Have the bus's own thread declare the publisher again on the present session, unless that is already
        submitted."""
        if not self._is_renewing:
            self._is_renewing = True
            self._bus.submit(self._renew)

    def _renew(self) -> None:
        self._is_renewing = False
        if not self._is_closed:
            self.move_to(self._bus.session_for(self._reliable))


class BusSubscription:
    """A subscription of a :class:`ZenohBus`. Implements :class:`vinesim.net.transport.bus.Subscription`."""

    def __init__(self, bus: ZenohBus, declare: Callable[[zenoh.Session], zenoh.Subscriber], reliable: bool) -> None:
        self._bus = bus
        self._declare = declare
        self._declared: zenoh.Subscriber | None = None
        (bus.reliable if reliable else bus.unreliable).add(self)
        bus.submit(lambda: self.move_to(bus.session_for(reliable)))

    def move_to(self, session: zenoh.Session) -> None:
        """Declare the subscription on another session instead of the present one."""
        before = self._declared
        self._declared = self._declare(session)
        _undeclare(before)

    def undeclare(self) -> None:
        """Undeclare the subscription at once, because its bus closes."""
        _undeclare(self._declared)

    def close(self) -> None:
        self._bus.unreliable.discard(self)
        self._bus.reliable.discard(self)
        self._bus.submit(lambda: _undeclare(self._declared))


def _undeclare(entity: Any) -> None:
    """Undeclare a publisher, a subscriber or another entity of Zenoh. Does nothing if its session is closed."""
    if entity is not None:
        with contextlib.suppress(zenoh.ZError):
            entity.undeclare()
