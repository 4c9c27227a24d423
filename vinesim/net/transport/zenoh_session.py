"""Zenoh sessions as vinesim opens them (eclipse-zenoh 1.10): configuration, connection errors, closing at exit."""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import pathlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import zenoh

from vinesim.net.codec.header import MAX_MESSAGE
from vinesim.net.transport.bus import BusError
from vinesim.net.transport.endpoints import Endpoint

if TYPE_CHECKING:
    from vinesim.net.transport.certificate_watch import CertificateWatch

log = logging.getLogger(__name__)

LEASE = 2000
"""A peer that is silent for this long is taken to have left [ms]."""

MAX_RECEIVE = 4 * MAX_MESSAGE
"""Fragmented messages beyond this size are not even reassembled, here or in the router [B]."""

CONNECT_TIMEOUT = 2.0
"""Time limit of connecting and of every query [s]."""

EXIT_TIMEOUT = 10.0
"""Longest time that a program waits at its exit for running callbacks to end [s]."""


class ServerUnreachable(BusError):
    """No server answers at the endpoint."""

    def __init__(self, endpoint: str, reason: str) -> None:
        super().__init__(
            f"no vinesim server answers at {endpoint} within {CONNECT_TIMEOUT:g} s ({reason}): "
            f"start one with 'vinesim server', or give its endpoint, e.g. {endpoint.partition('/')[0]}/HOST:7447"
        )


def config(mode: str, **settings: Any) -> zenoh.Config:
    """Configuration of a session: no scouting of any kind, no shared memory, a short lease, then ``settings``.

    Keys of ``settings`` are those of Zenoh's configuration file, with ``__`` for ``/``. Shared memory is off so that
    counted bytes are those that cross the network.
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
"""Sessions to close when the main thread ends."""

_closer: list[threading.Thread] = []

_direct: set[object] = set()
"""One for each callback that a thread of Zenoh may still call."""


def open_session(settings: zenoh.Config) -> zenoh.Session:
    """Open a session and close it when the main thread ends, unless it was closed before.

    Zenoh runs Python callbacks in threads that the interpreter joins at exit, so an open session would block the exit.
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
    threading.main_thread().join()
    for session in list(_open_sessions):
        close_session(session)
    deadline = time.monotonic() + EXIT_TIMEOUT
    while _direct and time.monotonic() < deadline:  # a thread that enters Python while that ends aborts the program
        time.sleep(0.005)


@contextlib.contextmanager
def _user_facing(endpoint: str) -> Iterator[None]:
    """Turn a Zenoh error into :class:`ServerUnreachable`."""
    try:
        yield
    except zenoh.ZError as error:
        raise ServerUnreachable(endpoint, str(error).split(" at /")[0].rstrip(".")) from error


def open_client(endpoint: Endpoint, credentials: dict[str, Any]) -> zenoh.Session:
    """Open a client session over one endpoint; :class:`ServerUnreachable` if no router answers."""
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


def watch_certificates(folder: pathlib.Path, name: str) -> CertificateWatch | None:
    """Check the certificate of ``name``, and watch it from now on; None without the library that reads certificates."""
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
    """A callback that the threads of Zenoh call which read the network. It must not wait for anything.

    No Python code runs after its mark is gone: between two instructions the thread may give the interpreter away, which
    ends then, and aborts the program when the thread wants it back.
    """
    mark = object()
    _direct.add(mark)
    return zenoh.handlers.Callback(callback, functools.partial(_direct.discard, mark), indirect=False)


def has_match(entity: zenoh.Publisher | zenoh.Querier) -> bool:
    """Whether a publisher has a subscriber, or a querier a queryable."""
    status: Any = entity.matching_status  # zenoh's type stubs call it a bool
    return status.matching
