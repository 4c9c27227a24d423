"""Opens and closes Zenoh sessions (eclipse-zenoh 1.10): configuration, errors of the connection, callbacks, closing at
exit."""

from __future__ import annotations

import ctypes
import functools
import json
import logging
import pathlib
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import zenoh

from vinesim.net.codec.header import MAX_MESSAGE
from vinesim.net.transport.bus import BusError
from vinesim.net.transport.endpoints import PORT, Endpoint, can_connect

if TYPE_CHECKING:
    from vinesim.net.transport.certificate_watch import CertificateWatch

log = logging.getLogger(__name__)

LEASE = 2000
"""Lease of Zenoh's links: time after which a silent session is considered lost [ms]."""

MAX_RECEIVE = 4 * MAX_MESSAGE
"""Largest size of a fragmented message that Zenoh reassembles, in clients and in the router [B]."""

CONNECT_TIMEOUT = 2.0
"""Time limit for connecting, and for each query [s]."""

EXIT_TIMEOUT = 10.0
"""Longest time that a program waits at its exit until Zenoh has released all callbacks [s]."""


class ServerUnreachable(BusError):
    """No server answers at an endpoint."""

    def __init__(self, endpoint: str, reason: str, waited: float = CONNECT_TIMEOUT) -> None:
        """``waited``: time without an answer [s]."""
        super().__init__(
            f"no vinesim server answers at {endpoint} within {waited:g} s ({reason}): "
            f"start one with 'vinesim server', or give its endpoint, e.g. {endpoint.partition('/')[0]}/HOST:{PORT}"
        )


class SessionRefused(ServerUnreachable):
    """A program listens at an endpoint and opens no session, like a server with as many sessions as it admits."""

    def __init__(self, endpoint: str, waited: float = CONNECT_TIMEOUT) -> None:
        BusError.__init__(
            self,
            f"{endpoint} accepts connections but opened no session within {waited:g} s: a vinesim server there has as "
            "many sessions as it admits (its log then has a line, and --max-sessions or --max-clients raises the "
            "number), its machine is overloaded (try again), or another program listens there",
        )


class NoServer(BusError):
    """A Zenoh router without a vinesim server answers at an endpoint."""

    def __init__(self, endpoint: str, ros_nodes: int) -> None:
        """``ros_nodes``: number of ROS 2 nodes and topics that the router knows."""
        kind = (
            "the router of a ROS 2 graph (rmw_zenohd)" if ros_nodes else "a Zenoh router, such as rmw_zenohd of ROS 2"
        )
        super().__init__(
            f"no vinesim server there: at {endpoint} is {kind}, and no server answers through it: start one with "
            f"'vinesim server', or give its endpoint, e.g. {endpoint.partition('/')[0]}/HOST:{PORT}"
        )


def config(mode: str, **settings: Any) -> zenoh.Config:
    """Returns the configuration of a session: no scouting, no shared memory, a short lease, and further ``settings``.

    ``mode``: Zenoh's mode, like ``client``. Keys of ``settings`` are those of Zenoh's configuration file, with ``__``
    for ``/``. Shared memory is off, so that the counted bytes are those that cross the network.
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
"""Open sessions, which are closed when the main thread ends."""

_closer: list[threading.Thread] = []

_direct: set[object] = set()
"""A mark for each callback of :func:`called_directly` that Zenoh has not released yet."""

MAX_THREAD_STATES = 128
"""Largest number of threads of Zenoh whose Python thread states are kept. A state takes about 16 kB, also after its
thread has ended: Zenoh's pools start and end threads when the machine is busy."""

_kept = threading.local()
"""Marks the Python thread states of Zenoh's threads that are kept."""

_kept_count: list[None] = []
"""One entry for each thread state that is kept."""


def open_session(settings: zenoh.Config) -> zenoh.Session:
    """Open a session. It is closed when the main thread ends, unless it was closed before.

    Zenoh calls Python callbacks in threads that the interpreter joins at exit, so an open session would block the exit.
    """
    session = zenoh.open(settings)
    _open_sessions.add(session)
    if not _closer:
        _closer.append(threading.Thread(target=_close_all, name="close zenoh sessions"))
        _closer[0].start()
    return session


def close_session(session: zenoh.Session) -> None:
    """Close a session. Idempotent."""
    _open_sessions.discard(session)
    if not session.is_closed():
        session.close()


def _close_all() -> None:
    """Body of a thread: wait for the end of the main thread, close all sessions, and wait for running callbacks."""
    threading.main_thread().join()
    for session in list(_open_sessions):
        close_session(session)
    deadline = time.monotonic() + EXIT_TIMEOUT
    # a thread of Zenoh that calls Python while the interpreter ends would abort the program
    while _direct and time.monotonic() < deadline:
        time.sleep(0.005)


def open_client(endpoint: Endpoint, credentials: dict[str, Any], session_id: str = "") -> zenoh.Session:
    """Open a client session to a router at an endpoint. Raises :class:`ServerUnreachable` if no router answers,
    :class:`SessionRefused` if a program is there that opens no session.

    ``credentials``: Zenoh's TLS settings; empty without certificates. ``session_id``: id of the session, see
    :mod:`vinesim.net.transport.signatures`; empty: Zenoh chooses one.
    """
    named = {"id": session_id} if session_id else {}
    settings = config(
        "client",
        connect__endpoints=[endpoint.locator],
        connect__timeout_ms=int(1000 * CONNECT_TIMEOUT),
        connect__exit_on_failure=True,
        connect__retry={"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2},
        **credentials,
        **named,
    )
    try:
        return open_session(settings)
    except zenoh.ZError as error:
        if endpoint.protocol == "tcp" and can_connect(endpoint):
            raise SessionRefused(str(endpoint)) from error
        raise ServerUnreachable(str(endpoint), str(error).split(" at /")[0].rstrip(".")) from error


def watch_certificates(folder: pathlib.Path, name: str) -> CertificateWatch | None:
    """Check the certificate of ``name``, and return a watch of its folder.

    Returns None, without a check, if the library that reads certificates is not installed.
    """
    from vinesim.net.transport import certificates
    from vinesim.net.transport.certificate_watch import CertificateWatch

    try:
        certificates.check(folder, name)
    except certificates.CryptographyMissing:
        log.info(
            "%s: whether the certificates in %s are valid is not checked here without 'vinesim[tls]'", name, folder
        )
        return None
    return CertificateWatch(folder)


def called_directly(callback: Callable[[Any], object]) -> zenoh.handlers.Callback:
    """Make a callback that those threads of Zenoh call which read the network. ``callback`` must not wait for anything.

    The program exits only when the marks of all callbacks are gone (:data:`EXIT_TIMEOUT`). Removing the mark is the
    last Python code that a thread runs for a callback. A thread that still ran Python code later could lose the
    interpreter lock, and would abort the program when it requests the lock after the interpreter has ended.
    """
    mark = object()
    _direct.add(mark)

    def call(argument: Any) -> None:
        if not hasattr(_kept, "mark"):
            _keep_thread_state()
        callback(argument)

    return zenoh.handlers.Callback(call, functools.partial(_direct.discard, mark), indirect=False)


def _keep_thread_state() -> None:
    """Keep the Python thread state of this thread of Zenoh until the program ends.

    Otherwise each callback makes a state and deletes it, which takes 9 of the 13 us that a message costs.
    """
    if len(_kept_count) < MAX_THREAD_STATES:
        _kept_count.append(None)
        _kept.mark = True
        ctypes.pythonapi.PyGILState_Ensure()


def has_match(entity: zenoh.Publisher | zenoh.Querier) -> bool:
    """Whether a publisher has a subscriber, or a querier a queryable."""
    status: Any = entity.matching_status  # a bool by the type stubs of zenoh
    return status.matching
