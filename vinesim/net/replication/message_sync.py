"""What actors tell each other directly, kind by kind: forces, voices, and whatever else is neither a pose nor a state.

A :class:`MessageSync` of each kind is made in one place,
:class:`vinesim.net.replication.replication_state.ReplicationState`. The receiver gives it the messages of its kind, the
replicator the values of each step to publish; what it knows stands in the inbox of each step under its kind.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, ClassVar

from vinesim.net.codec.messages import Counters
from vinesim.net.replication.remote_pose import RemotePose
from vinesim.net.transport.bus import Bus, Publisher

SEND_PERIOD = 1.0 / 60.0
"""Time between two messages to one actor [s]."""


class MessageSync:
    """Messages of one kind to and from one actor."""

    kind: ClassVar[int]
    """Of :data:`vinesim.net.codec.messages.MESSAGES`."""

    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Take a message of a peer at own time ``now`` and network ``time`` [s]; ``MessageError`` if it is invalid."""
        raise NotImplementedError

    def current(self, now: float) -> Any:
        """What holds at own time ``now`` [s] of all that was received: for the inbox."""

    def publish(self, value: Any, now: float, time: float) -> list[bytes]:
        """Publish what the own actor says in the step at own time ``now`` and network ``time`` [s], None if nothing;
        the messages that were sent."""
        return []

    def remove_peer(self, name: str) -> None:
        """An actor has left."""

    def shift_time(self, step: float) -> None:
        """The network clock was set by ``step`` [s]."""


@dataclasses.dataclass(slots=True)
class Partner:
    """An actor to which messages are sent."""

    publisher: Publisher
    due: float
    """Own time of the next message [s]."""
    is_active: bool = False
    """The last message was not empty."""


class DirectedSync(MessageSync):
    """Messages to single actors under ``force/<to>/<from>``: at most 60 a second while there is something to say, then
    one empty message and silence. The last message of each sender is kept; all have a field ``time``.

    Whoever makes it subscribes to ``force/<name>/*``, once for all kinds.
    """

    def __init__(self, bus: Bus, name: str, counters: Counters) -> None:
        self._bus = bus
        self._name = name
        self._counters = counters
        self._partners: dict[str, Partner] = {}
        self._received: dict[str, tuple[float, Any]] = {}
        """Own time of arrival [s] and message, by sender."""

    def remove_peer(self, name: str) -> None:
        """An actor has left."""
        self._received.pop(name, None)
        if (partner := self._partners.pop(name, None)) is not None:
            partner.publisher.close()

    def shift_time(self, step: float) -> None:
        """The network clock was set by ``step`` [s]."""
        for sender, (arrived, message) in self._received.items():
            self._received[sender] = arrived, dataclasses.replace(message, time=message.time + step)

    def _is_outdated(self, sender: str, message: Any) -> bool:
        """Whether a message is not newer than the last one of its sender; that is counted."""
        is_outdated = sender in self._received and message.time <= self._received[sender][1].time
        self._counters.dropped += is_outdated
        return is_outdated

    def _recent(self, now: float, max_age: float) -> list[tuple[str, Any]]:
        """Senders and their last messages, of those that arrived within the last ``max_age`` [s]."""
        return [
            (sender, message)
            for sender, (arrived, message) in sorted(self._received.items())
            if now - arrived <= max_age
        ]

    def _add_partners(self, names: Iterable[str], now: float) -> None:
        """Be ready to send to these actors from own time ``now`` [s] on."""
        for name in names:
            if name not in self._partners:
                self._partners[name] = Partner(self._bus.publisher(f"force/{name}/{self._name}"), now)

    def _send(self, partner: Partner, payload: bytes, now: float, *, is_empty: bool) -> list[bytes]:
        """Send a message that is due; the messages that were sent: this one, or none without a subscriber."""
        partner.due = max(partner.due, now - SEND_PERIOD) + SEND_PERIOD
        partner.is_active = not is_empty
        return [payload] if partner.publisher.put(payload) else []
