"""The Zenoh sessions that are connected to a server: their addresses, and how many there may be."""

from __future__ import annotations

import logging
import resource
import threading

log = logging.getLogger(__name__)

DEFAULT_MAX_SESSIONS = 4096
"""Largest number of sessions of a server without a limit of actors. Zenoh's own default is 1000."""

SESSIONS_PER_CLIENT = 2
"""Number of sessions that a client on another machine opens: one for its stream, one for datagrams."""

SPARE_SESSIONS = 100
"""Number of sessions above those of all actors, so that a client beyond the limit of actors is told the limit, and
recorders and pages find a place."""

SPARE_FILES = 256
"""Number of files that a server opens besides the sockets of its sessions."""


def max_sessions_for(max_actors: int | None) -> int:
    """Returns the largest number of sessions of a server that admits ``max_actors`` (None: any number)."""
    return DEFAULT_MAX_SESSIONS if max_actors is None else SESSIONS_PER_CLIENT * max_actors + SPARE_SESSIONS


def fit_sessions(sessions: int | None, max_actors: int | None) -> int:
    """Returns the largest number of sessions of a server: ``sessions``, or by default :func:`max_sessions_for`
    ``max_actors``, as far as the system has open files for them.

    Raises the limit of open files of this process for that. A warning tells if ``sessions`` or ``max_actors`` were
    given and the system allows less.
    """
    wanted = max_sessions_for(max_actors) if sessions is None else sessions
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= wanted + SPARE_FILES:
        return wanted
    allowed = wanted + SPARE_FILES if hard == resource.RLIM_INFINITY else min(wanted + SPARE_FILES, hard)
    if allowed > soft:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    fitting = max(1, max(allowed, soft) - SPARE_FILES)
    if fitting < wanted and (sessions, max_actors) != (None, None):
        log.warning(
            "the system allows this program %d open files, enough for %d of %d sessions: raise the limit (ulimit -n)",
            allowed,
            fitting,
            wanted,
        )
    return min(fitting, wanted)


class SessionTable:
    """Addresses of all connected sessions. Any thread may call the methods."""

    def __init__(self, most: int) -> None:
        """``most``: number of sessions at which Zenoh refuses further ones."""
        self._most = most
        self._addresses: dict[str, str] = {}
        self._is_full = False
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._addresses)

    def add(self, session: str, locator: str) -> None:
        """Note the link of a session. ``locator``: its other end, like ``tcp/10.0.0.7:41496``. Logs a line when no
        further session finds a place."""
        address = locator.partition("/")[2].partition("?")[0].rpartition(":")[0]
        with self._lock:
            self._addresses[session] = address
            was_full, self._is_full = self._is_full, len(self._addresses) >= self._most
            is_news = self._is_full and not was_full
        if is_news:
            log.warning("%d sessions: no further client can connect; raise --max-sessions or --max-clients", self._most)

    def remove(self, session: str) -> None:
        """Note that a session has ended."""
        with self._lock:
            self._addresses.pop(session, None)
            self._is_full = self._is_full and len(self._addresses) > 0.9 * self._most

    def address(self, session: str) -> str:
        """Returns the address of a session; empty if it is connected to another server."""
        return self._addresses.get(session, "")

    def clear(self) -> None:
        """Forget all sessions, because the router was closed."""
        with self._lock:
            self._addresses.clear()
            self._is_full = False
