"""Publishers and subscriptions of :class:`vinesim.net.transport.zenoh_bus.ZenohBus`, which move between its sessions.

The real-time loop publishes, and the bus's thread moves entities to another session at any time: what fails in between
is counted and declared again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING

import zenoh

from vinesim.net.transport.zenoh_session import has_match

if TYPE_CHECKING:
    from vinesim.net.transport.zenoh_bus import ZenohBus


class BusPublisher:
    """See :class:`vinesim.net.transport.bus.Publisher`. What the network refuses is counted, never raised."""

    def __init__(self, bus: ZenohBus, declare: Callable[[zenoh.Session], zenoh.Publisher], reliable: bool) -> None:
        self._bus, self._declare, self._reliable = bus, declare, reliable
        self._publisher: zenoh.Publisher | None = None
        self._is_closed = self._is_renewing = False
        if not reliable:
            bus.unreliable.add(self)
        session = bus.session_for(reliable)
        try:
            self._publisher = declare(session)
        except zenoh.ZError as error:
            self._fail(error)
        if bus.session_for(reliable) is not session:  # poses have moved meanwhile
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
        if self._reliable:
            if not self._bus.submit_put(lambda: publisher.put(payload, source_info=self._bus.source), len(payload)):
                return False
        else:
            try:
                publisher.put(payload, source_info=self._bus.source)
            except zenoh.ZError as error:
                self._fail(error)
                return False
        self._bus.bytes_out += len(payload)
        return True

    def move_to(self, session: zenoh.Session) -> None:
        """Publish over another session from now on."""
        before, self._publisher = self._publisher, self._declare(session)
        _undeclare(before)

    def close(self) -> None:
        self._is_closed = True
        self._bus.unreliable.discard(self)
        self._bus.submit(lambda: _undeclare(self._publisher))

    def _fail(self, error: zenoh.ZError) -> None:
        self._bus.count_failure(error)
        self._renew_soon()

    def _renew_soon(self) -> None:
        """Let the bus's thread declare the publisher again, over the session of now."""
        if not self._is_renewing:
            self._is_renewing = True
            self._bus.submit(self._renew)

    def _renew(self) -> None:
        self._is_renewing = False
        if not self._is_closed:
            self.move_to(self._bus.session_for(self._reliable))


class BusSubscription:
    """See :class:`vinesim.net.transport.bus.Subscription`."""

    def __init__(self, bus: ZenohBus, declare: Callable[[zenoh.Session], zenoh.Subscriber], reliable: bool) -> None:
        self._bus, self._declare = bus, declare
        self._declared: zenoh.Subscriber | None = None
        if not reliable:
            bus.unreliable.add(self)
        bus.submit(lambda: self.move_to(bus.session_for(reliable)))

    def move_to(self, session: zenoh.Session) -> None:
        """Subscribe over another session from now on."""
        before, self._declared = self._declared, self._declare(session)
        _undeclare(before)

    def close(self) -> None:
        self._bus.unreliable.discard(self)
        self._bus.submit(lambda: _undeclare(self._declared))


def _undeclare(entity: zenoh.Publisher | zenoh.Subscriber | None) -> None:
    """Undeclare; that of a closed session is gone already."""
    if entity is not None:
        with contextlib.suppress(zenoh.ZError):
            entity.undeclare()
