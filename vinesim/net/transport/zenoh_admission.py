"""Admission of an actor by the server of a world, and again by each server that is started later.

A server that was restarted does not know which actors are present. A Zenoh querier with a matching listener detects the
new server, and the hello is sent again.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable

import zenoh

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.codec.control import Welcome, decode_welcome
from vinesim.net.codec.header import PROTOCOL, MessageError, WrongVersion
from vinesim.net.transport.bus import JoinRejected
from vinesim.net.transport.zenoh_session import CONNECT_TIMEOUT, NoServer, ServerUnreachable, has_match

log = logging.getLogger(__name__)

RETRY_PERIOD = 0.05
"""Time between two attempts to reach a server that has just started, or was restarted [s]."""

SLOW_TIMEOUT = 28.0
"""Further time for a server that is there and does not answer, on a machine that is overloaded [s]."""

REJOIN_TIMEOUT = 60.0
"""Time for which the server may refuse a session that replaces another one [s]. It forgets a silent session after its
lease of 2 s, and on a machine that is overloaded much later."""

ROS_TOKENS = "@ros2_lv/**"
"""Keys of the liveliness tokens by which nodes with ``rmw_zenoh`` announce themselves and their topics."""


class ServerAdmission:
    """Asks the server of a world to admit one actor, and watches whether the server is present."""

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
        seal: Callable[[str, bytes], bytes | None] = lambda _key, _payload: None,
    ) -> None:
        """``prefix``: first chunks of the world's keys, with a trailing slash. ``name``: name of the actor.
        ``endpoint``: text of the server's endpoint. ``is_secured``: whether certificates are used. ``submit(task)``
        runs a function in the bus's own thread. ``seal(key, payload)`` returns the seal of a query; None with
        certificates."""
        self._session = session
        self._prefix = prefix
        self._patient_until = -math.inf
        """Time until which a refusal is not final, because the server may still know a former session [s]."""
        self._server_key = f"{prefix}server/{name}"
        self._key = f"{prefix}join/{name}/{session.zid()}"
        self._name = name
        self._world = world
        self._endpoint = endpoint
        self._is_secured = is_secured
        self._submit = submit
        self._seal = seal
        self.is_served = True
        """Whether the server of this world is present. Also true if there never was a server."""
        self.rejection = ""
        """Reason why a server that was restarted does not admit this actor; empty if none has rejected it."""
        self.count = 0
        """Number of times that a server has admitted this actor."""
        self.spectators_speak_to = SpectatorsSpeakTo.PEOPLE
        """Actors that hear spectators, as set by the server that admitted this actor."""
        self._servers: frozenset[str] | None = None
        """Session of the server that admitted this actor; empty: no server has; None: the actor has not asked."""
        self._declared: list[object] = []
        self._querier: zenoh.Querier | None = None
        """Querier whose matching status tells whether a server is present; None before the first hello."""
        self._was_announced = False
        """Whether the querier has ever matched a server, even if no reply arrived."""
        self._hello = b""
        self._is_join_submitted = False

    def is_server(self, replier: zenoh.EntityGlobalId | None) -> bool:
        """Whether to accept replies about the clock and retained records from the session ``replier``.

        It must be the server that admitted this actor. A program that never joins accepts all replies.
        """
        return self._servers is None or (replier is not None and str(replier.zid) in self._servers)

    def find_server(self) -> None:
        """Return when a server of vinesim has answered, which may keep this world or only route.

        A server of which the router knows, but whose program is too busy to answer, has :data:`SLOW_TIMEOUT` more.

        Raises :class:`NoServer` if a router answers, but no server does within :data:`CONNECT_TIMEOUT`;
        :class:`ServerUnreachable` if a server stays too slow; with certificates :class:`JoinRejected`, because a server
        does not answer names without a certificate in its folder.
        """
        querier = self._session.declare_querier(self._server_key)
        deadline = time.monotonic() + CONNECT_TIMEOUT
        is_slow = False
        while not any(reply.ok is not None for reply in self._session.get(self._server_key, timeout=CONNECT_TIMEOUT)):
            if time.monotonic() <= deadline:
                time.sleep(RETRY_PERIOD)
            elif is_slow:
                waited = CONNECT_TIMEOUT + SLOW_TIMEOUT
                raise ServerUnreachable(self._endpoint, "a server is there, but too busy to answer", waited)
            elif has_match(querier):
                log.warning("%s: the server at %s is slow; waits for its answer", self._name, self._endpoint)
                deadline += SLOW_TIMEOUT
                is_slow = True
            elif self._is_secured:
                raise self._unknown_name()
            else:
                tokens = self._session.liveliness().get(ROS_TOKENS, timeout=CONNECT_TIMEOUT)
                raise NoServer(self._endpoint, sum(reply.ok is not None for reply in tokens))
        querier.undeclare()

    def _unknown_name(self) -> JoinRejected:
        """Returns the error for an actor to which a server with certificates does not reply."""
        return JoinRejected(
            f"the server at {self._endpoint} refuses actors named {self._name!r} in world {self._world!r}: its folder "
            f"of certificates must hold {self._name}.pem, which it notices within seconds, and it must keep that world"
        )

    def join(self, hello: bytes) -> None:
        """Send an encoded hello to the server, and wait for the reply.

        Raises :class:`JoinRejected` if the server rejects the actor, or if a secured server does not reply. Without a
        server the hello is sent when one appears.
        """
        welcomes = self._query(hello)
        if welcomes and welcomes[0].refused:
            raise JoinRejected(welcomes[0].refused)
        if not welcomes and self._is_secured:
            raise self._unknown_name()
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
        self._hello = hello
        self._watch_matches()
        if not welcomes:
            self._submit_join()

    def watch(self) -> None:
        """Correct :attr:`is_served` by the present matching status of the querier. The bus's thread calls this
        regularly.

        Zenoh's threads may report events late or in another order: that a server left before the reply of that server
        is read, after its successor was reported, or before the server itself was reported.
        """
        if self._querier is None:
            return
        if not self.is_served:
            self._submit_join()
        elif self._was_announced and not has_match(self._querier):
            self.is_served = False

    def answers(self, session: zenoh.Session) -> bool:
        """Whether the server of this world is to be seen from another session. Waits up to
        :data:`CONNECT_TIMEOUT`."""
        querier = session.declare_querier(f"{self._prefix}join/{self._name}/{session.zid()}")
        deadline = time.monotonic() + CONNECT_TIMEOUT
        while not (found := has_match(querier)) and time.monotonic() < deadline:
            time.sleep(RETRY_PERIOD)
        return found

    def move_to(self, session: zenoh.Session) -> None:
        """Ask for admission again from another session, which replaces the present one."""
        self._session = session
        self._key = f"{self._prefix}join/{self._name}/{session.zid()}"
        self._declared.clear()
        self._patient_until = time.monotonic() + REJOIN_TIMEOUT
        self._watch_matches()

    def close(self) -> None:
        """Undeclare what was declared, because the session closes."""
        querier, self._querier = self._querier, None
        if querier is not None:
            with contextlib.suppress(zenoh.ZError):
                querier.undeclare()
        self._declared.clear()

    def _watch_matches(self) -> None:
        querier = self._session.declare_querier(self._key)
        self._querier = querier

        def on_matching(status: zenoh.MatchingStatus) -> None:
            if self._querier is not querier:
                return  # of a session that was replaced
            self.is_served = status.matching
            self._was_announced |= status.matching
            self._submit_join()

        self._declared.append(querier.declare_matching_listener(on_matching))

    def _submit_join(self) -> None:
        """Submit to the bus's own thread to send the hello again, unless that is already submitted."""
        if not self._is_join_submitted:
            self._is_join_submitted = True
            self._submit(self._join_again)

    def _join_again(self) -> None:
        """Send the hello to a server that has appeared, and note whether the server rejects this actor.

        Between linked routers the querier may match a server before queries are routed to it. If no reply arrives, this
        method is therefore submitted again, after other tasks of the thread, while the querier matches.
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
        if welcomes[0].refused and time.monotonic() < self._patient_until:
            self.is_served = False  # the server still knows the former session; :meth:`watch` asks again
            return
        self.is_served = True  # whatever Zenoh's threads reported before
        self.rejection = welcomes[0].refused
        self.count += not self.rejection
        if self.rejection:
            log.error("%s: the server that came back rejects this actor: %s", self._name, self.rejection)

    def _query(self, hello: bytes) -> list[Welcome]:
        """Send the hello and return the replies of all servers. The first reply counts.

        A reply that cannot be decoded is returned as a rejection.
        """
        replies = self._session.get(
            self._key,
            payload=hello,
            attachment=self._seal(self._key, hello),
            timeout=CONNECT_TIMEOUT,
            consolidation=zenoh.ConsolidationMode.NONE,
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
        """Decode a reply of a server. If that is impossible, return a rejection with the reason."""
        try:
            return decode_welcome(answer)
        except WrongVersion as error:
            return Welcome(
                f"the server at {self._endpoint} speaks protocol version {error.theirs}, {self._name!r} version "
                f"{PROTOCOL}: use the same release of vinesim"
            )
        except MessageError as error:
            return Welcome(f"the reply of the server at {self._endpoint} cannot be decoded: {error}")
