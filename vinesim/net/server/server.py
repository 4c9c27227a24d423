"""The server: a Zenoh router that admits actors, has the clock, and keeps retained state for actors that join later.

CANOPIES D6.4 section 2.3: "The network server has only the task to manage the synchronization between the clients." The
server simulates nothing. Of the state of the world it subscribes to retained records only, not to poses and states.
"""

from __future__ import annotations

import contextlib
import logging
import pathlib
import threading
import time
from collections.abc import Sequence
from typing import Any, Self

import zenoh

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.core.errors import UsageError
from vinesim.net import pace
from vinesim.net.codec.control import decode_time, encode_time, encode_welcome
from vinesim.net.codec.header import MAX_MESSAGE, MessageError, is_valid_name
from vinesim.net.codec.meshes import decode_part, decode_request, encode_part, encode_wanted
from vinesim.net.pace import MIN_FACTOR, WorldClock
from vinesim.net.replication.interest import Cell
from vinesim.net.server.admission import GRACE_TIME, AdmissionControl, JoinLimits, SceneId, is_loopback
from vinesim.net.server.main_server_watch import WATCH_PERIOD, MainServerWatch
from vinesim.net.server.mesh_store import MeshStore
from vinesim.net.server.retained_store import Quota, RetainedStore
from vinesim.net.server.sessions import SessionTable, fit_sessions
from vinesim.net.transport import endpoints
from vinesim.net.transport.access_control import SERVER, acl_config, server_answers_config, tls_config
from vinesim.net.transport.bus import BusError
from vinesim.net.transport.signatures import SealCheck
from vinesim.net.transport.zenoh_bus import ROOT, WORLD
from vinesim.net.transport.zenoh_session import close_session, config, open_session
from vinesim.scene.triangles import is_digest

log = logging.getLogger(__name__)

LISTEN = f"tcp/127.0.0.1:{endpoints.PORT}"
"""Default endpoint of a server, reachable from this machine only."""

LEASE = 1000
"""Time after which a silent server is considered lost [ms]: half of the time for an actor."""


RELEASE_TIMEOUT = 5.0
"""Longest time for which a closed session may keep its ports [s]."""

REOPEN_DELAY = 0.25
"""Shortest time between closing a router and opening it again [s].

Linked routers compute their routes 100 ms after a link was lost (Zenoh 1.10). If a new router connects sooner, they do
not report to it which of their clients are live: observed in 5 to 15 % of restarts, and in none of 180 restarts after
0.15 s or more. A process that is started again takes longer than that."""


MAX_EMPTY_WORLDS = 64
"""Largest number of worlds without actors whose clocks are kept."""

MAX_KNOWN_SESSIONS = 64
"""Largest number of sessions whose public keys are kept. They are in every record and query."""

MAX_WARNED = 1000
"""Largest number of keys whose first problem is logged."""

TIDY_PERIOD = 1.0
"""Time between two looks for actors and worlds that are gone [s]."""

EMPTY_WORLD_TIME = 60.0
"""Time after which a world without actors and records is forgotten [s]. Until then its last records may arrive."""


class PortTaken(BusError):
    """The server cannot listen on an endpoint."""

    def __init__(self, endpoint: str, reason: str) -> None:
        protocol = endpoint.partition("/")[0]
        super().__init__(
            f"cannot listen on {endpoint} ({reason}): another server is running there, or choose another port, "
            f"e.g. {protocol}/0.0.0.0:{endpoints.PORT + 1}, or port 0 for any free one"
        )


class Server:
    """A running server: a Zenoh router in this process, from construction to :meth:`close`. A context manager."""

    def __init__(
        self,
        listen: str | Sequence[str] = LISTEN,
        *,
        connect: Sequence[str] = (),
        state_folder: pathlib.Path | None = None,
        scene: SceneId | None = None,
        max_actors: int | None = None,
        spectators_speak_to: SpectatorsSpeakTo = SpectatorsSpeakTo.PEOPLE,
        quota: Quota = Quota(),
        certificates: pathlib.Path | None = None,
        world: str = WORLD,
        real_time_factor: float | None = None,
        limits: JoinLimits = JoinLimits(),
        max_sessions: int | None = None,
    ) -> None:
        """Listen on endpoints like ``tcp/0.0.0.0:7377``. Port 0 chooses a free port, see :attr:`endpoint`.

        ``connect``: endpoints of routers or servers to link to. A server that is linked to another one only routes. The
        server that connects to no other one admits actors and retains records. If that one does not answer, a warning
        tells it, and this server goes on trying. ``state_folder``: folder of the journals; None: retained records are
        lost when the server ends. ``scene``: the only scene that is allowed. ``max_actors``: largest number of actors
        at a time. ``spectators_speak_to``: who hears spectators. ``quota``: rate at which one actor may publish
        records.

        ``certificates``: folder of the server's certificates (:mod:`vinesim.net.transport.certificates`), which is read
        again when its files change. With it, ``world`` is the only world, and every actor needs a certificate.
        ``real_time_factor``: fixed real-time factor of all worlds; None: each world is as fast as its clients can
        follow, at most 1. ``limits``: limits for joins; ``max_actors`` replaces one of them. ``max_sessions``: largest
        number of Zenoh sessions, of which a client on another machine opens two; None: as many as ``max_actors`` need,
        see :func:`vinesim.net.server.sessions.fit_sessions`.

        Raises :class:`PortTaken`, :class:`vinesim.core.errors.UsageError` for an invalid endpoint or combination,
        :class:`vinesim.net.server.journal.JournalError` and
        :class:`vinesim.net.transport.access_control.CertificateError`.
        """
        listen = (listen,) if isinstance(listen, str) else listen
        is_secured = certificates is not None
        linked = [endpoints.parse(text, secured=is_secured) for text in connect]
        if real_time_factor is not None and not MIN_FACTOR <= real_time_factor <= 1.0:
            raise UsageError(f"the real-time factor is {real_time_factor:g}: give auto, or {MIN_FACTOR:g} to 1")
        if linked and (state_folder, scene, max_actors, real_time_factor) != (None, None, None, None):
            raise UsageError(
                f"a server linked to {linked[0]} only routes: give --state-dir, --scene, --max-clients and "
                "--real-time-factor to the one server that connects to no other"
            )
        self._certificates = certificates
        self._seals = SealCheck(max_sessions=MAX_KNOWN_SESSIONS)
        self._linked = linked
        self._root = f"{ROOT}/{'*' if certificates is None else world}"
        """Key expression of all worlds. With certificates it names only one world, because access control denies
        others."""
        self._watcher = self._new_watcher()  # before the files are read, to notice changes meanwhile
        settings = self._access_settings()
        try:
            self.endpoints = endpoints.resolve_ports(listen, secured=is_secured)
        except OSError as error:
            raise PortTaken(listen[0], str(error.strerror)) from error
        self._fixed_factor = real_time_factor
        self._start = time.monotonic(), time.time()
        """Readings of ``time.monotonic`` and of ``time.time`` (seconds since 1970) when the server started [s]. The
        time of every new world counts from the second reading and advances by the monotonic clock. So the time of a
        world does not jump when the date or time of the machine is set."""
        self._clocks: dict[str, WorldClock] = {}
        """Clocks by world."""
        self.pings = 0
        """Number of clock queries since the start."""
        self.foreign = 0
        """Number of messages with records that a session sent under the name of another session."""
        self._malformed = 0
        self._admission = AdmissionControl(scene, max_actors, spectators_speak_to, limits)
        self._admission.reserved_until = time.monotonic() + GRACE_TIME
        self._max_sessions = fit_sessions(max_sessions, max_actors)
        self._sessions = SessionTable(self._max_sessions)
        self._empty_since: dict[str, float] = {}
        """Time since when a world of the store has no actors [s], by world."""
        self._lock = threading.Lock()
        self._session_lock = threading.Lock()
        """Held while the router is closed and opened again."""
        self._stop = threading.Event()
        self._warned: set[str] = set()
        self.store = None if linked else RetainedStore(state_folder, quota)
        """Store of retained records; None if another server keeps them."""
        self.meshes = MeshStore()
        """Meshes of robots, for clients that do not have the files."""
        try:
            self._session = _open_router(self.endpoints, linked, settings, self._max_sessions)
        except PortTaken:
            if self.store is not None:
                self.store.close()
            raise
        self._declared = self._declare(self._root)
        if self._watcher is not None:
            self._watcher.start()
        threading.Thread(target=self._run_clocks, name="clocks of the worlds", daemon=True).start()
        self._main_server = MainServerWatch(linked, f"{ROOT}/{world}/server/{SERVER}") if linked else None
        if linked:
            threading.Thread(target=self._watch_main_server, name="watch of the main server", daemon=True).start()
        log.info("listening on %s", ", ".join(map(str, self.endpoints)))

    def _access_settings(self) -> dict[str, Any]:
        """Returns Zenoh's settings for TLS and access control. Raises :class:`CertificateError` if a certificate is
        unusable."""
        if self._certificates is None:
            return {} if self._linked else server_answers_config(ROOT)
        from vinesim.net.transport import certificates

        settings = tls_config(self._certificates, SERVER)
        certificates.check(self._certificates, SERVER)
        return settings | acl_config(self._root, certificates.roles(self._certificates))

    def _declare(self, root: str) -> list[object]:
        """Subscribe to liveliness tokens. Unless this server only routes, also declare the queryables and subscribe to
        records.

        Returns the declared entities.
        """
        session = self._session
        self._sessions.clear()
        declared: list[object] = [
            session.liveliness().declare_subscriber(f"{root}/live/*/*", self._on_liveliness, history=True)
        ]
        if self.store is not None:
            declared += [  # join first, because actors that reconnect join before they publish
                session.declare_queryable(f"{root}/join/*/*", self._on_join_query),
                session.declare_queryable(f"{root}/holder/*", self._on_holder_query),
                session.declare_queryable(f"{root}/clock/*", self._on_clock_query),
                session.declare_queryable(f"{root}/snap/*/*", self._on_snapshot_query),
                session.declare_subscriber(f"{root}/fact/**", self._on_record),
                session.declare_queryable(f"{root}/offer/*", self._on_mesh_offer),
                session.declare_queryable(f"{root}/mesh/*", self._on_mesh_query),
            ]
        declared += [
            session.info.declare_link_events_listener(self._on_link, history=True),
            session.info.declare_transport_events_listener(self._on_transport),
            session.declare_queryable(f"{root}/server/*", _on_server_query),
        ]
        return declared

    @property
    def endpoint(self) -> str:
        """Text of the first endpoint on which the server listens, with its actual port."""
        return str(self.endpoints[0])

    @property
    def actors(self) -> list[str]:
        """Returns the actors that are live now, as ``world/name``, sorted."""
        with self._lock:
            return self._admission.actors

    @property
    def joined(self) -> int:
        """Number of times that an actor has become live since the start."""
        return self._admission.joined

    @property
    def malformed(self) -> int:
        """Number of messages and queries that could not be decoded, since the start."""
        return self._malformed + (self.store.counters.malformed if self.store is not None else 0)

    def _clock(self, world: str) -> WorldClock:
        """Returns the clock of a world. Hold :attr:`_lock` during the call.

        A new clock is kept only if an actor is live in the world.
        """
        if (clock := self._clocks.get(world)) is not None:
            return clock
        now = time.monotonic()
        (real, begin) = self._start
        clock = WorldClock(
            now,
            begin + (now - real) * (self._fixed_factor or 1.0),
            self._fixed_factor,
            open_until=self._admission.reserved_until,
        )
        if self._admission.has_actors(world) and len(self._clocks) < self._admission.limits.worlds:
            for name in [name for name in self._clocks if not self._admission.has_actors(name)][:-MAX_EMPTY_WORLDS]:
                del self._clocks[name]
            self._clocks[world] = clock
        return clock

    @property
    def time(self) -> float:
        """Present time of the default world [s]."""
        with self._lock:
            return self._clock(WORLD).time(time.monotonic())

    def _run_clocks(self) -> None:
        """Body of the thread that advances the clocks of all worlds and so adapts their real-time factors, and tidies
        up."""
        tidied_at = time.monotonic()
        while not self._stop.wait(pace.STEP):
            now = time.monotonic()
            if now - tidied_at >= TIDY_PERIOD:
                tidied_at = now
                try:
                    self._tidy(now)
                except Exception:  # go on: this thread has the clocks
                    log.exception("an error while the server tidied up")
            with self._lock:
                for clock in self._clocks.values():
                    clock.advance(now)

    def _tidy(self, now: float) -> None:
        """Release what actors hold that were admitted and did not come, and forget worlds that nobody needs."""
        with self._lock:
            gone = self._admission.expire(now)
            worlds = [] if self.store is None else self.store.all_worlds()
            empty = {world for world in worlds if not self._admission.has_actors(world)}
        self._release(gone)
        self._empty_since = {world: self._empty_since.get(world, now) for world in empty}
        for world, since in self._empty_since.items():
            if self.store is None or now - since < EMPTY_WORLD_TIME:
                continue
            if (kept := self.store.scene_of(world)) is not None:
                with self._lock:
                    self._admission.pin_scene(world, kept)
            else:
                self.store.forget(world)

    def _release(self, actors: Sequence[tuple[str, str]]) -> None:
        """Release what actors hold that are gone."""
        for world, name in actors:
            self.meshes.release((world, name))
            with self._lock:
                if world in self._clocks:
                    self._clocks[world].forget(name)

    def _watch_main_server(self) -> None:
        """Body of the thread that looks for the server to which this one is linked."""
        assert self._main_server is not None
        while not self._stop.wait(WATCH_PERIOD):
            with contextlib.suppress(zenoh.ZError):  # the session was closed meanwhile
                self._main_server.check(self._session, time.monotonic())

    def figures(self) -> dict[str, Any]:
        """Returns the content of a status line: live actors, number of links, clocks, and counters since the start."""
        figures: dict[str, Any] = {
            "endpoints": [str(endpoint) for endpoint in self.endpoints],
            "actors": self.actors,
            "links": self._link_count(),
            "sessions": len(self._sessions),
            "max_sessions": self._max_sessions,
            "joined": self.joined,
            "refused": self._admission.refused,
            "pings": self.pings,
            "malformed": self.malformed,
            "foreign": self.foreign,
            "clocks": self._clock_figures(),
        }
        if self._main_server is not None:
            figures["trouble"] = self._main_server.trouble
        if self.store is not None:
            counters = self.store.counters
            figures |= {
                "facts": self.store.count(),
                "facts_heard": counters.received,
                "facts_over_quota": counters.over_quota,
                "facts_strange": counters.rejected,
                "facts_failed": counters.errors,
                "snapshots": counters.snapshots,
                "meshes": len(self.meshes),
                "mesh_bytes": self.meshes.bytes,
                "meshes_corrupt": self.meshes.counters.corrupt,
                "meshes_refused": self.meshes.counters.refused,
                "trouble": self.store.status_message,
            }
        return figures

    def _clock_figures(self) -> dict[str, dict[str, Any]]:
        """Returns, by world, the real-time factor, what limits it, and the clients for which the world does not
        wait."""
        with self._lock:
            return {
                world: {"real_time_factor": one.factor, "cause": one.cause, "left_behind": one.left_behind}
                for world, one in sorted(self._clocks.items())
            }

    def _link_count(self) -> int:
        with self._session_lock:
            return 0 if self._session.is_closed() else len(self._session.info.links())

    def run(self, duration: float | None = None) -> None:
        """Wait until a signal handler or another thread calls :meth:`stop`, but not longer than ``duration`` [s]."""
        self._stop.wait(duration)

    def stop(self) -> None:
        """Make :meth:`run` return."""
        self._stop.set()

    def close(self) -> None:
        """Close the router and the store. Idempotent. :attr:`unwritten` then has the worlds whose records are lost."""
        self.stop()
        with self._session_lock:
            close_session(self._session)
        if self.store is not None:
            self.store.close()

    @property
    def unwritten(self) -> list[str]:
        """Returns the worlds with records that are not on the disk, sorted."""
        return [] if self.store is None else self.store.unwritten

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------ certificates that change

    def _new_watcher(self) -> threading.Thread | None:
        """Returns a thread that opens the router again when the files of certificates change; None without
        certificates.

        Zenoh 1.10 reads certificates and access control only when a session is opened. Actors reconnect by themselves,
        as after a restart of the server. The store, the clocks and the counters are kept.
        """
        if self._certificates is None:
            return None
        from vinesim.net.transport.certificate_watch import WATCH_PERIOD, CertificateWatch

        watch = CertificateWatch(self._certificates)

        def run() -> None:
            watch.warn()
            while not self._stop.wait(WATCH_PERIOD):
                if watch.has_changed() or self._session.is_closed():
                    self._open_again()
                watch.warn()

        return threading.Thread(target=run, name="certificates of the server", daemon=True)

    def _open_again(self) -> None:
        """Close the router and open it with the present certificates, unless they are unusable."""
        try:
            settings = self._access_settings()
        except (BusError, OSError) as error:
            log.error("the certificates changed and cannot be used; the earlier ones stay in use: %s", error)
            return
        with self._session_lock:
            if self._stop.is_set():
                return
            close_session(self._session)
            with self._lock:
                gone = self._admission.forget_actors()
                self._admission.reserved_until = time.monotonic() + GRACE_TIME
            self._release(gone)
            # a session that fails to open may keep some sockets, so wait until all of them are free
            until = time.monotonic() + RELEASE_TIMEOUT
            self._stop.wait(REOPEN_DELAY)
            while time.monotonic() < until and not all(map(endpoints.can_listen, self.endpoints)):
                self._stop.wait(0.02)
            try:
                self._session = _open_router(self.endpoints, self._linked, settings, self._max_sessions)
                self._declared = self._declare(self._root)
            except BusError as error:
                log.error("no client can connect until the server listens again; it goes on trying: %s", error)
                return
        log.warning("the certificates changed: opened the server again with them; actors reconnect by themselves")

    # ------------------------------------------------------------ called by Zenoh's threads

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        if event.kind == zenoh.SampleKind.PUT:
            self._sessions.add(str(event.link.zid), str(event.link.dst))

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        if event.kind == zenoh.SampleKind.PUT:
            return
        session = str(event.transport.zid)
        self._sessions.remove(session)
        with self._lock:
            gone = self._admission.end_session(session)
        self._release(gone)

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        world, _, name, session = str(sample.key_expr).split("/")[-4:]
        if not all(map(is_valid_name, (world, name, session))):
            self._count_malformed(_strip_root(sample.key_expr)[:200], MessageError("a token of no valid actor"))
            return
        is_live = sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            (self._admission.on_join if is_live else self._admission.on_leave)(world, name, session)
            has_left = not self._admission.is_live(world, name)
            if has_left and world in self._clocks:
                self._clocks[world].forget(name)
        if has_left:
            self.meshes.release((world, name))
        log.info("%s/%s %s", world, name, "came" if is_live else "left")

    def _on_record(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT or self.store is None:
            return
        key = _strip_root(sample.key_expr)
        world, _, rest = key.partition("/")
        if not is_valid_name(world):
            self._count_malformed(key[:200], MessageError("the record belongs to no valid world"))
            return
        with self._lock:
            publisher = self._admission.publisher(world, rest.rpartition("/")[2])
        if len(sample.payload) > MAX_MESSAGE:
            self._count_malformed(key, MessageError(f"the records are larger than {MAX_MESSAGE} B"))
            return
        payload = sample.payload.to_bytes()
        if not self._is_from(publisher, sample, payload):
            self.foreign += 1
            self._warn_once(key, "dropped records of a session that did not join with this name, or of a spectator")
            return
        self.store.submit(key, payload)

    def _is_from(self, session: str, message: zenoh.Sample | zenoh.Query, payload: bytes) -> bool:
        """Whether a message or query comes from a ``session``: by its signature, or with certificates, where the router
        checks the name in the key, by the session that it states.

        Copies of old messages are accepted: a record that comes again has a claim that is not greater."""
        if self._certificates is not None:
            source = message.source_info
            return source is not None and str(source.source_id.zid) == session
        seal = message.attachment
        sealed = None if seal is None else seal.to_bytes()
        return self._seals.is_from(session, str(message.key_expr), payload, sealed, once=False)

    def _on_clock_query(self, query: zenoh.Query) -> None:
        with query:
            key = _strip_root(query.key_expr)
            world, _, name = key.split("/") if key.count("/") == 2 else ("*", "", "")
            payload = _query_payload(query)
            try:
                if not is_valid_name(world) or not is_valid_name(name):
                    raise MessageError("the query names no world, or no valid actor")
                question = decode_time(payload)
            except MessageError as error:
                self._count_malformed(key, error)
                return
            self.pings += 1
            report = question.report
            if report is not None:
                with self._lock:
                    holder = self._admission.holder(world, name) if self._admission.may_slow(world, name) else ""
                if not holder or not self._is_from(holder, query, payload):
                    report = None
            with self._lock:
                now = time.monotonic()
                clock = self._clock(world)
                if report is not None:
                    clock.report(name, now, report)
                elif question.report is not None and clock.awaits_report(now):
                    return  # this client may know the time, and asks again when it has joined
                world_time = clock.time(now)
                factor = clock.factor
                cause = clock.cause
            query.reply(str(query.key_expr), encode_time(question.asked, world_time, factor, real=now, cause=cause))

    def _on_join_query(self, query: zenoh.Query) -> None:
        with query:
            key = _strip_root(query.key_expr)
            if "*" in key or key.count("/") != 3 or self.store is None:
                self._count_malformed(key, MessageError("an actor can only ask for itself"))
                return
            world, _, name, session = key.split("/")
            greeting = _query_payload(query)
            is_signed = self._certificates is not None or self._is_from(session, query, greeting)
            with self._lock:
                if (kept := self.store.scene_of(world)) is not None:
                    self._admission.pin_scene(world, kept)
                if is_signed:
                    address = self._address(session)
                    welcome = self._admission.decide(world, name, session, greeting, time.monotonic(), address)
                else:
                    welcome = self._admission.refuse(
                        f"the greeting of {name[:60]!r} is not signed by the session that it names: use the same "
                        "release of vinesim"
                    )
                if not welcome.refused:
                    self.store.open(world, self._admission.scene_of(world))
            if welcome.refused:
                self._warn_once(key[:200], f"refused: {welcome.refused}")
            query.reply(str(query.key_expr), encode_welcome(welcome))

    def _address(self, session: str) -> str:
        """Returns the address of a session; empty if it is connected to another server."""
        if address := self._sessions.address(session):
            return address
        for link in self._session.info.links():  # its event may be on its way
            if str(link.zid) == session:
                self._sessions.add(session, str(link.dst))
        return self._sessions.address(session)

    def _on_holder_query(self, query: zenoh.Query) -> None:
        with query:
            key = _strip_root(query.key_expr)
            world, _, name = key.split("/") if key.count("/") == 2 else ("*", "", "")
            if not is_valid_name(world) or not is_valid_name(name):
                self._count_malformed(key[:200], MessageError("the query names no actor"))
                return
            with self._lock:
                holder = self._admission.reserved_by(world, name, time.monotonic())
            query.reply(str(query.key_expr), holder.encode())

    def _on_snapshot_query(self, query: zenoh.Query) -> None:
        with query:
            key = _strip_root(query.key_expr)
            world, *_, x, y = key.split("/") if key.count("/") == 3 else ("*", "", "")
            if "*" in world or self.store is None:
                self._count_malformed(key, MessageError("the query names no world or no cell"))
                return
            cells: list[Cell]
            try:
                if "*" in x or "*" in y:
                    wanted = query.key_expr
                    cells = [
                        cell
                        for cell in self.store.cells(world)
                        if wanted.intersects(zenoh.KeyExpr(f"{ROOT}/{world}/snap/{cell[0]}/{cell[1]}"))
                    ]
                else:
                    cells = [(int(x), int(y))]
            except ValueError:
                self._count_malformed(_strip_root(query.key_expr), MessageError("the query names no cell"))
                return
            for cell, payload in self.store.snapshot(world, cells):
                query.reply(f"{ROOT}/{world}/snap/{cell[0]}/{cell[1]}", payload)

    def _on_mesh_offer(self, query: zenoh.Query) -> None:
        with query:
            key = _strip_root(query.key_expr)
            world, _, name = key.split("/") if key.count("/") == 2 else ("*", "", "")
            try:
                if "*" in key:
                    raise MessageError("an actor can only offer its own meshes")
                with self._lock:
                    holder = self._admission.holder(world, name)
                    address = self._admission.address(world, name)
                payload = _query_payload(query)
                if not holder or not self._is_from(holder, query, payload):
                    raise MessageError("only an actor that has joined can offer meshes")
                group = address if address and not is_loopback(address) else f"{world}/{name}"
                wanted = self.meshes.offer((world, name), decode_part(payload), group)
            except MessageError as error:
                self._count_malformed(key, error)
                return
            query.reply(str(query.key_expr), encode_wanted(wanted))

    def _on_mesh_query(self, query: zenoh.Query) -> None:
        with query:
            key = _strip_root(query.key_expr)
            digest = key.rpartition("/")[2]
            try:
                if not is_digest(digest) or "*" in key:
                    raise MessageError("the query names no mesh")
                part = self.meshes.part(digest, decode_request(_query_payload(query)))
            except MessageError as error:
                self._count_malformed(key, error)
                return
            query.reply(str(query.key_expr), encode_part(part))

    def _count_malformed(self, key: str, error: MessageError) -> None:
        """Count an invalid query, and log the first one for each key."""
        self._malformed += 1
        self._warn_once(key, f"this query cannot be answered: {error}")

    def _warn_once(self, key: str, reason: str) -> None:
        """Log a problem with what arrived under a key, but only the first one for each key."""
        if key not in self._warned and len(self._warned) < MAX_WARNED:
            self._warned.add(key)
            log.warning("%s: %s (logged once)", key, reason)


def _open_router(
    listen: Sequence[endpoints.Endpoint],
    connect: Sequence[endpoints.Endpoint],
    settings: dict[str, Any],
    max_sessions: int,
) -> zenoh.Session:
    """Open a Zenoh router. Raises :class:`PortTaken` if it cannot listen on all endpoints."""
    try:
        return open_session(
            config(
                "router",
                listen__endpoints=[endpoint.locator for endpoint in listen],
                listen__exit_on_failure=True,
                connect__endpoints=[endpoint.locator for endpoint in connect],
                connect__timeout_ms=-1,
                connect__exit_on_failure=False,
                connect__retry={"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2},
                transport__link__tx__lease=LEASE,
                transport__unicast__max_sessions=max_sessions,
                **settings,
            )
        )
    except zenoh.ZError as error:
        reason = "address already in use" if "in use" in str(error) else str(error).split(" at /")[0]
        raise PortTaken(", ".join(map(str, listen)), reason) from error


def _strip_root(key: zenoh.KeyExpr) -> str:
    """Returns a key without :data:`ROOT`, so that its first chunk is the world."""
    return str(key)[len(ROOT) + 1 :]


def _on_server_query(query: zenoh.Query) -> None:
    """Tell a client that a server of vinesim is here, which a Zenoh router of another program does not."""
    with query:
        if "*" not in str(query.key_expr):
            query.reply(str(query.key_expr), b"")


def _query_payload(query: zenoh.Query) -> bytes:
    """Returns the payload of a query; empty if the query has none or it is too large."""
    payload = query.payload
    return payload.to_bytes() if payload is not None and len(payload) <= MAX_MESSAGE else b""
