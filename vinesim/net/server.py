"""The server: a Zenoh router that carries messages, knows who is there, and has a clock. It simulates nothing.

CANOPIES D6.4 section 2.3: "The network server has only the task to manage the synchronization between the clients."
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from typing import Self

import zenoh

from vinesim.net import messages
from vinesim.net.bus import BusError
from vinesim.net.zenoh_bus import ROOT, close_session, config, open_session

log = logging.getLogger(__name__)

LISTEN = "tcp/0.0.0.0:7447"
"""All interfaces, Zenoh's port."""


class PortTaken(BusError):
    """The endpoint cannot be listened on."""

    def __init__(self, endpoint: str, reason: str) -> None:
        super().__init__(
            f"cannot listen on {endpoint} ({reason}): another server is running there, or choose another port, "
            f"e.g. tcp/0.0.0.0:7448, or port 0 for any free one"
        )


class Server:
    """An embedded router; it carries messages from construction to :meth:`close`. A context manager."""

    def __init__(self, listen: str = LISTEN) -> None:
        """Listen on an endpoint like ``tcp/0.0.0.0:7447``; port 0 takes a free one, see :attr:`endpoint`.

        :class:`PortTaken` if that is not possible, :class:`ValueError` if it is no TCP endpoint.
        """
        self.endpoint = _chosen(listen)
        """Where the server listens, with its true port."""
        self.joined = 0
        """How many actors ever came."""
        self.pings = 0
        """How many times the clock was asked."""
        self.malformed = 0
        """How many questions to the clock could not be understood."""
        self._roster: dict[str, set[str]] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        try:
            self._session = open_session(
                config("router", listen__endpoints=[self.endpoint], listen__exit_on_failure=True)
            )
        except zenoh.ZError as error:
            reason = "address already in use" if "in use" in str(error) else str(error).split(" at /")[0]
            raise PortTaken(self.endpoint, reason) from error
        self._declared = (
            self._session.liveliness().declare_subscriber(f"{ROOT}/*/live/*/*", self._notice, history=True),
            self._session.declare_queryable(f"{ROOT}/*/clock", self._clock),
        )
        log.info("listening on %s", self.endpoint)

    @property
    def actors(self) -> list[str]:
        """Who is there now, as ``world/name``, sorted."""
        with self._lock:
            return sorted(name for name, sessions in self._roster.items() if sessions)

    def run(self, duration: float | None = None) -> None:
        """Carry messages until :meth:`stop` (from a signal handler or another thread), at most ``duration`` s."""
        self._stop.wait(duration)

    def stop(self) -> None:
        """Let :meth:`run` return."""
        self._stop.set()

    def close(self) -> None:
        """Stop carrying messages; the second time nothing happens."""
        self.stop()
        close_session(self._session)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------ called by Zenoh's threads

    def _notice(self, sample: zenoh.Sample) -> None:
        world, _, name, session = str(sample.key_expr).split("/")[-4:]
        there = sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            sessions = self._roster.setdefault(f"{world}/{name}", set())
            if there and not sessions:
                self.joined += 1
            (sessions.add if there else sessions.discard)(session)
        log.info("%s/%s %s", world, name, "joined" if there else "left")

    def _clock(self, query: zenoh.Query) -> None:
        with query:
            try:
                asked, _ = messages.decode_time(query.payload.to_bytes() if query.payload is not None else b"")
            except messages.MessageError:
                self.malformed += 1
                return
            self.pings += 1
            query.reply(str(query.key_expr), messages.encode_time(asked, time.time()))


def _chosen(listen: str) -> str:
    """The endpoint with port 0 replaced by a free one."""
    protocol, _, address = listen.partition("/")
    host, colon, port = address.rpartition(":")
    if protocol != "tcp" or not colon or not host or not port.isdigit() or int(port) > 65535:
        raise ValueError(f"endpoint {listen!r}: expected tcp/HOST:PORT, e.g. {LISTEN}")
    if int(port) != 0:
        return listen
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.bind((host.strip("[]"), 0))
        return f"tcp/{host}:{probe.getsockname()[1]}"
