"""The server: a Zenoh router that carries messages, knows who is there, has a clock, and keeps what stays true.

CANOPIES D6.4 section 2.3: "The network server has only the task to manage the synchronization between the clients."
It simulates nothing. Of the environment it hears facts and nothing else: no motion, no pose.
"""

from __future__ import annotations

import logging
import pathlib
import threading
import time
from collections.abc import Sequence
from typing import Any, Self

import zenoh

from vinesim.errors import UsageError
from vinesim.net.codec import messages
from vinesim.net.codec.messages import MessageError
from vinesim.net.replication.interest import Cell
from vinesim.net.server.admission import AdmissionControl, SceneId
from vinesim.net.server.retained_store import Quota, RetainedStore
from vinesim.net.transport import endpoints
from vinesim.net.transport.access_control import SERVER, acl_config, tls_config
from vinesim.net.transport.bus import BusError
from vinesim.net.transport.zenoh_bus import ROOT, WORLD
from vinesim.net.transport.zenoh_session import close_session, config, open_session

log = logging.getLogger(__name__)

LISTEN = "tcp/0.0.0.0:7447"
"""All interfaces, Zenoh's port."""

LEASE = 1000
"""A server that is silent for this long is gone [ms]: half of what actors are granted, for it does nothing else."""


class PortTaken(BusError):
    """The endpoint cannot be listened on."""

    def __init__(self, endpoint: str, reason: str) -> None:
        protocol = endpoint.partition("/")[0]
        super().__init__(
            f"cannot listen on {endpoint} ({reason}): another server is running there, or choose another port, "
            f"e.g. {protocol}/0.0.0.0:7448, or port 0 for any free one"
        )


class Server:
    """An embedded router; it carries messages from construction to :meth:`close`. A context manager."""

    def __init__(
        self,
        listen: str | Sequence[str] = LISTEN,
        *,
        connect: Sequence[str] = (),
        keep: pathlib.Path | None = None,
        plan: SceneId | None = None,
        most: int | None = None,
        quota: Quota = Quota(),
        certificates: pathlib.Path | None = None,
        world: str = WORLD,
    ) -> None:
        """Listen on endpoints like ``tcp/0.0.0.0:7447``; port 0 takes a free one, see :attr:`endpoint`.

        ``connect``: servers or routers that this one is linked to. It then only carries: of linked servers one, which
        connects to nobody, answers and keeps. ``keep``: folder for facts, else they live as long as the server.
        ``plan``: the only scene allowed. ``most``: actors at a time. ``certificates``: folder of a server, see
        :mod:`vinesim.net.transport.certificates`; then only ``world`` exists, and in it only who has a certificate.

        :class:`PortTaken` if an endpoint is taken, :class:`UsageError` if it is none,
        :class:`vinesim.net.server.journal.NotKept` and :class:`vinesim.net.transport.access_control.NoCertificate` in
        words.
        """
        listen = (listen,) if isinstance(listen, str) else listen
        safe = certificates is not None
        linked = [endpoints.parse(text, secured=safe) for text in connect]
        if linked and (keep is not None or plan is not None or most is not None):
            raise UsageError(
                f"a server linked to {linked[0]} only carries: give --state-dir, --scene and --max-clients "
                "to the one server that connects to nobody"
            )
        settings: dict[str, Any] = {}
        if certificates is not None:
            from vinesim.net.transport.certificates import roles

            settings = tls_config(certificates, SERVER) | acl_config(f"{ROOT}/{world}", roles(certificates))
        try:
            self.endpoints = endpoints.resolve_ports(listen, secured=safe)
        except OSError as error:
            raise PortTaken(listen[0], str(error.strerror)) from error
        self.pings = 0
        """How many times the clock was asked."""
        self._unreadable = 0
        self._admission = AdmissionControl(plan, most)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._blamed: set[str] = set()
        self.store = None if linked else RetainedStore(keep, quota)
        """What is kept; None where another server keeps."""
        try:
            self._session = open_session(
                config(
                    "router",
                    listen__endpoints=[endpoint.locator for endpoint in self.endpoints],
                    listen__exit_on_failure=True,
                    connect__endpoints=[endpoint.locator for endpoint in linked],
                    connect__timeout_ms=-1,
                    connect__exit_on_failure=False,
                    connect__retry={"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2},
                    transport__link__tx__lease=LEASE,
                    **settings,
                )
            )
        except zenoh.ZError as error:
            if self.store is not None:
                self.store.close()
            reason = "address already in use" if "in use" in str(error) else str(error).split(" at /")[0]
            raise PortTaken(", ".join(map(str, self.endpoints)), reason) from error
        session = self._session
        # under access control a declaration that reaches beyond the one world would be told to nobody
        where = f"{ROOT}/{'*' if certificates is None else world}"
        self._declared: list[object] = [
            session.liveliness().declare_subscriber(f"{where}/live/*/*", self._on_liveliness, history=True)
        ]
        if self.store is not None:
            self._declared += [
                session.declare_queryable(
                    f"{where}/join/*/*", self._on_join_query
                ),  # first: who is back joins, then tells
                session.declare_queryable(f"{where}/clock", self._on_clock_query),
                session.declare_queryable(f"{where}/snap/*/*", self._on_snapshot_query),
                session.declare_subscriber(f"{where}/fact/**", self._on_record),
            ]
        log.info("listening on %s", ", ".join(map(str, self.endpoints)))

    @property
    def endpoint(self) -> str:
        """Where the server listens first, with its true port."""
        return str(self.endpoints[0])

    @property
    def actors(self) -> list[str]:
        """Who is there now, as ``world/name``, sorted."""
        with self._lock:
            return self._admission.actors

    @property
    def joined(self) -> int:
        """How many actors ever came."""
        return self._admission.joined

    @property
    def malformed(self) -> int:
        """How many messages and questions could not be understood."""
        return self._unreadable + (self.store.counters.malformed if self.store is not None else 0)

    def figures(self) -> dict[str, Any]:
        """What a status line says: who is there, and what was counted since the start."""
        figures: dict[str, Any] = {
            "endpoints": [str(endpoint) for endpoint in self.endpoints],
            "actors": self.actors,
            "links": len(self._session.info.links()),
            "joined": self.joined,
            "refused": self._admission.refused,
            "pings": self.pings,
            "malformed": self.malformed,
        }
        if self.store is not None:
            counters = self.store.counters
            figures |= {
                "facts": self.store.count(),
                "facts_heard": counters.received,
                "facts_over_quota": counters.over_quota,
                "facts_strange": counters.rejected,
                "snapshots": counters.snapshots,
                "trouble": self.store.status_message,
            }
        return figures

    def run(self, duration: float | None = None) -> None:
        """Carry messages until :meth:`stop` (from a signal handler or another thread), at most ``duration`` s."""
        self._stop.wait(duration)

    def stop(self) -> None:
        """Let :meth:`run` return."""
        self._stop.set()

    def close(self) -> None:
        """Stop carrying messages and write down what is kept; the second time nothing happens."""
        self.stop()
        close_session(self._session)
        if self.store is not None:
            self.store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------ called by Zenoh's threads

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        world, _, name, session = str(sample.key_expr).split("/")[-4:]
        there = sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            (self._admission.on_join if there else self._admission.on_leave)(world, name, session)
        log.info("%s/%s %s", world, name, "came" if there else "left")

    def _on_record(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and self.store is not None:
            payload = sample.payload.to_bytes() if len(sample.payload) <= messages.MAX_MESSAGE else b""
            self.store.submit(_strip_root(sample.key_expr), payload)

    def _on_clock_query(self, query: zenoh.Query) -> None:
        with query:
            try:
                asked, _ = messages.decode_time(_query_payload(query))
            except MessageError as error:
                self._count_malformed(f"{_strip_root(query.key_expr)}", error)
                return
            self.pings += 1
            query.reply(str(query.key_expr), messages.encode_time(asked, time.time()))

    def _on_join_query(self, query: zenoh.Query) -> None:
        with query:
            key = _strip_root(query.key_expr)
            world, _, name, session = key.split("/")
            if "*" in key or self.store is None:
                return
            with self._lock:
                if (kept := self.store.scene_of(world)) is not None:
                    self._admission.pin_scene(world, kept)
                welcome = self._admission.answer(world, name, session, _query_payload(query), time.monotonic())
                if not welcome.refused:
                    self.store.open(world, self._admission.scene_of(world))
            if welcome.refused:
                log.warning("refused %s/%s: %s", world, name, welcome.refused)
            query.reply(str(query.key_expr), messages.encode_welcome(welcome))

    def _on_snapshot_query(self, query: zenoh.Query) -> None:
        with query:
            world, _, x, y = _strip_root(query.key_expr).split("/")
            if world == "*" or self.store is None:
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
                self._count_malformed(_strip_root(query.key_expr), MessageError("the question names no cell"))
                return
            for cell, payload in self.store.snapshot(world, cells):
                query.reply(f"{ROOT}/{world}/snap/{cell[0]}/{cell[1]}", payload)

    def _count_malformed(self, key: str, error: MessageError) -> None:
        """Count what cannot be believed, and say so once for each key."""
        self._unreadable += 1
        if key not in self._blamed and len(self._blamed) < 1000:
            self._blamed.add(key)
            log.warning("a question to %s cannot be answered (said once): %s", key, error)


def _strip_root(key: zenoh.KeyExpr) -> str:
    """A key without the root: it starts with its world."""
    return str(key)[len(ROOT) + 1 :]


def _query_payload(query: zenoh.Query) -> bytes:
    payload = query.payload
    return payload.to_bytes() if payload is not None and len(payload) <= messages.MAX_MESSAGE else b""
