"""Tells the users of a server that only routes whether a server answers at its links."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import zenoh

from vinesim.net.transport.endpoints import Endpoint
from vinesim.net.transport.zenoh_admission import ROS_TOKENS
from vinesim.net.transport.zenoh_session import CONNECT_TIMEOUT, NoServer, ServerUnreachable

log = logging.getLogger(__name__)

WATCH_PERIOD = 0.5
"""Time between two checks [s]."""

PATIENCE = 2.0 * CONNECT_TIMEOUT
"""Time without an answer after which it is reported [s]. A server that is started again takes less."""


class MainServerWatch:
    """Reports once that no server answers, and once that it answers again."""

    def __init__(self, connect: Sequence[Endpoint], key: str) -> None:
        """``connect``: endpoints to which the server is linked. ``key``: key under which servers answer."""
        self._connect = connect
        self._key = key
        self._missing_since: float | None = None
        self.trouble = ""
        """What is reported now; empty while a server answers."""

    def check(self, session: zenoh.Session, now: float) -> None:
        """Ask at the time ``now`` [s] whether another server than that of ``session`` answers.

        Raises :class:`zenoh.ZError` if the session was closed meanwhile.
        """
        replies = session.get(self._key, target=zenoh.QueryTarget.ALL, timeout=CONNECT_TIMEOUT)
        # a querier would tell it without queries, but with one a router of Zenoh 1.10 may panic when a link is lost
        if any(reply.ok and reply.replier_id and reply.replier_id.zid != session.info.zid() for reply in replies):
            self._missing_since = None
            if self.trouble:
                self.trouble = ""
                log.warning("a vinesim server answers now at %s", ", ".join(map(str, self._connect)))
            return
        if self._missing_since is None:
            self._missing_since = now
        elif now - self._missing_since > PATIENCE and not self.trouble:
            reasons = [self._reason(session, endpoint) for endpoint in self._connect]
            self.trouble = f"{'; '.join(reasons)}; this server goes on trying"
            log.warning("%s", self.trouble)

    @staticmethod
    def _reason(session: zenoh.Session, endpoint: Endpoint) -> str:
        """Returns why no server answers at an endpoint: nothing is there, or a router of another program."""
        if not any(str(link.dst).partition("?")[0].endswith(f":{endpoint.port}") for link in session.info.links()):
            return str(ServerUnreachable(str(endpoint), "no connection", PATIENCE))
        tokens = session.liveliness().get(ROS_TOKENS, timeout=CONNECT_TIMEOUT)
        return str(NoServer(str(endpoint), sum(reply.ok is not None for reply in tokens)))
