"""Admission of an actor by the vinesim server of a world, and again by every server that starts later.

A server that was restarted does not know which actors are present. A querier with a matching listener notices the new
server, and the hello is sent again.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import zenoh

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.codec.control import Welcome, decode_welcome
from vinesim.net.codec.header import PROTOCOL, MessageError, WrongVersion
from vinesim.net.transport.bus import JoinRejected
from vinesim.net.transport.zenoh_session import CONNECT_TIMEOUT, has_match

log = logging.getLogger(__name__)

RETRY_PERIOD = 0.05
"""Time between two attempts to be admitted again [s]."""


class ServerAdmission:
    """Asks the server of a world to admit one actor, and watches whether that server is there."""

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        *,
        name: str,
        world: str,
        endpoint: str,
        is_secured: bool,
        submit: Callable[[Callable[[], object]], None],
    ) -> None:
        """``prefix``: key of the world with a trailing slash. ``submit`` runs a function in the bus's own thread."""
        self._session = session
        self._key = f"{prefix}join/{name}/{session.zid()}"
        self._name = name
        self._world = world
        self._endpoint = endpoint
        self._is_secured = is_secured
        self._submit = submit
        self.is_served = True
        """Whether the server of this world is present, or there never was a server."""
        self.rejection = ""
        """Reason why a server that was restarted rejects this actor, or "" if none does."""
        self.count = 0
        """How often a server has admitted this actor."""
        self.spectators_speak_to = SpectatorsSpeakTo.PEOPLE
        """Who hears spectators, as the server that admitted this actor has set it."""
        self._servers: frozenset[str] | None = None
        """The session that admitted this actor, if any did; None: it has not joined."""
        self._declared: list[object] = []
        self._querier: zenoh.Querier | None = None
        """Querier that knows whether a server is announced; None before the first hello."""
        self._was_announced = False
        """Whether a server was ever announced, even if none of its replies arrived."""
        self._hello = b""
        self._is_join_submitted = False

    def is_server(self, replier: zenoh.EntityGlobalId | None) -> bool:
        """Whether to accept answers for all actors (clock, retained records) from ``replier``: it must be the server
        that admitted this actor. A program that never joins accepts any."""
        return self._servers is None or (replier is not None and str(replier.zid) in self._servers)

    def join(self, hello: bytes) -> None:
        """Send an encoded hello. Raises :class:`JoinRejected` if a server rejects it. Without a server nothing
        happens."""
        welcomes = self._query(hello)
        if welcomes and welcomes[0].refused:
            raise JoinRejected(welcomes[0].refused)
        if not welcomes and self._is_secured:
            raise JoinRejected(
                f"the server at {self._endpoint} refuses actors named {self._name!r}: its folder of certificates must "
                f"hold {self._name}.pem, which it notices within seconds"
            )
        if not welcomes:
            log.info("%s: no vinesim server keeps world %r; actors check each other", self._name, self._world)
        elif len(welcomes) > 1:
            log.warning(
                "%s: %d servers keep world %r; link all but one to it with --connect",
                self._name,
                len(welcomes),
                self._world,
            )
        self.count += bool(welcomes)
        self._was_announced = bool(welcomes)
        querier = self._session.declare_querier(self._key)
        self._querier = querier
        self._hello = hello

        def on_matching(status: zenoh.MatchingStatus) -> None:
            self.is_served = status.matching
            self._was_announced |= status.matching
            self._submit_join()

        self._declared.append(querier.declare_matching_listener(on_matching))
        if not welcomes:
            self._submit_join()

    def watch(self) -> None:
        """Correct the state if Zenoh's threads reported events late or in another order. Called from time to time.

        A server may be reported as gone before the reply in which it admitted this actor is read, or after its
        successor was reported, or before it is reported itself: then the present state of the querier counts.
        """
        if self._querier is None:
            return
        if not self.is_served:
            self._submit_join()
        elif self._was_announced and not has_match(self._querier):
            self.is_served = False

    def _submit_join(self) -> None:
        """Have the hello sent again by the bus's own thread, unless that is submitted already."""
        if not self._is_join_submitted:
            self._is_join_submitted = True
            self._submit(self._join_again)

    def _join_again(self) -> None:
        """Send the hello to a server that has appeared, and note whether it rejects this actor.

        Between linked routers a server is announced before queries are routed to it: without a reply this is submitted
        again, behind what else the thread has to do, as long as the server is announced.
        """
        self._is_join_submitted = False
        if self._querier is None or not has_match(self._querier):
            return
        self._was_announced = True
        welcomes = self._query(self._hello)
        if not welcomes:
            time.sleep(RETRY_PERIOD)
            self._submit_join()
            return
        self.is_served = True  # whatever order Zenoh's threads report in that one server went and another came
        self.rejection = welcomes[0].refused
        self.count += not self.rejection
        if self.rejection:
            log.error("%s: the server that came back rejects this actor: %s", self._name, self.rejection)

    def _query(self, hello: bytes) -> list[Welcome]:
        """Replies of all servers. The first is the one that counts. An unreadable reply counts as a rejection."""
        replies = self._session.get(
            self._key, payload=hello, timeout=CONNECT_TIMEOUT, consolidation=zenoh.ConsolidationMode.NONE
        )
        found = {
            str(reply.replier_id.zid): reply.ok.payload.to_bytes()
            for reply in replies
            if reply.ok is not None and reply.replier_id is not None
        }
        known = self._servers or frozenset()
        routers = {str(router) for router in self._session.info.routers_zid()}
        order = sorted(found, key=lambda zid: (zid not in routers, zid not in known, zid))
        self._servers = frozenset(order[:1]) or known
        welcomes = [self._decode(found[zid]) for zid in order]
        if welcomes and not welcomes[0].refused:
            self.spectators_speak_to = welcomes[0].spectators_speak_to
        return welcomes

    def _decode(self, answer: bytes) -> Welcome:
        try:
            return decode_welcome(answer)
        except WrongVersion as error:
            return Welcome(
                f"the server at {self._endpoint} speaks protocol version {error.theirs}, {self._name!r} version "
                f"{PROTOCOL}: use the same release of vinesim"
            )
        except MessageError as error:
            return Welcome(f"the reply of the server at {self._endpoint} cannot be decoded: {error}")
