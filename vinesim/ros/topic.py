"""A published topic with its QoS and message counts, and the flow control of the topics that every step publishes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

log = logging.getLogger(__name__)

RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""Default QoS: reliable, with a history of a hundred messages for subscribers that receive late."""
HISTORY = 1000
"""History depth of the topics that are published in every step: ten seconds of messages."""
EVERY_STEP = QoSProfile(depth=HISTORY, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of the topics that are published in every step. It is reliable because tf2 listeners expect a reliable /tf."""
TRANSIENT_LOCAL = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""QoS of latched topics: subscribers that join late receive the last message, too."""
SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of pictures and clouds: reliable, so that reliable and best-effort subscribers both receive them (REP-2003)."""

_AT_ONCE = Duration()

Build = Callable[[], Any]
"""Function that returns a message, its serialised bytes, or a list of messages. It is called only if the topic has
subscribers."""


class Topic:
    """A publisher with counts of its messages. Only one thread at a time may send."""

    def __init__(self, name: str, publisher: Publisher, *, is_of_every_step: bool = False) -> None:
        self.name = name
        """Name of the topic, relative to the node's namespace unless it begins with a slash."""
        self.is_of_every_step = is_of_every_step
        """Whether the topic has the QoS :data:`EVERY_STEP`: it is published in every step or in every second one."""
        self.subscription_count = 0
        """Number of subscribers at the last :meth:`update_subscription_count`."""
        self.is_local = True
        """Whether all subscribers run on this machine."""
        self.sent = 0
        """Number of messages sent."""
        self.dropped = 0
        """Number of messages that were replaced by newer ones before they were sent, or that could not be built or
        sent."""
        self.publisher = publisher
        self._is_muted = False
        self._lock = threading.Lock()
        self._is_closed = False

    def update_subscription_count(self) -> None:
        """Query the middleware for the number of subscribers."""
        if not self._is_closed and not self._is_muted:
            self.subscription_count = self.publisher.get_subscription_count()

    def is_acknowledged(self) -> bool:
        """Returns whether all reliable subscribers have acknowledged all messages sent so far."""
        with self._lock:
            return self._is_closed or self.publisher.wait_for_all_acked(_AT_ONCE)

    def mute(self, is_muted: bool) -> None:
        """Stop sending if ``is_muted``, as if the topic had no subscribers; otherwise resume. Only the thread that
        counts subscribers may call this."""
        self._is_muted = is_muted
        self.subscription_count = 0
        self.update_subscription_count()

    def close(self) -> None:
        """Stop sending for good. Returns when a message that is being sent is complete."""
        with self._lock:
            self._is_closed = True
            self.subscription_count = 0

    def build_and_send(self, build: Build) -> None:
        """Build a message and publish it. Failures are counted; the first one is logged."""
        try:
            self.send(build())
        except Exception:
            self.dropped += 1
            if self.dropped == 1:
                log.exception("could not publish %s; further failures are only counted", self.name)

    def send(self, message: Any) -> None:
        """Publish a message, its serialised bytes, or each message of a list."""
        for one in message if isinstance(message, list) else (message,):
            with self._lock:
                if self._is_closed:
                    return
                self.publisher.publish(one)
            self.sent += 1


class Advertise(Protocol):
    """Signature of the function by which a node creates a topic. Publisher classes receive this function."""

    def __call__(self, message: type, name: str, qos: QoSProfile = ...) -> Topic: ...


PendingMessage = tuple[Topic, Build]
"""A topic and the function that builds its next message. The node calls the function and sends the result."""


# Flow control of the topics that every step publishes: the next step waits until their subscribers have caught up.
#
# By default a subscription of rclpy keeps the last ten messages of a topic. If more arrive before its process runs, the
# oldest are lost. So only a few messages may be unacknowledged at a time. Fast DDS tells only whether all subscribers
# have acknowledged all messages of a topic. Subscribers acknowledge when the publisher asks them (``heartbeatPeriod``
# in ``udp.xml``). Best-effort subscribers never acknowledge, so nothing is known about their progress.


SUBSCRIBER_TIMEOUT = 3.0
"""Time without acknowledgement after which publishing no longer waits for the subscribers of a topic [s]. It waits
again once they have acknowledged all messages."""
WINDOW = 5
"""Largest number of unacknowledged messages of a topic whose subscribers are all on this machine."""
WIDE_WINDOW = HISTORY // 2
"""Largest number of unacknowledged messages of a topic with a subscriber on another machine. It is large because
acknowledgements over a network may take long, and the world should not slow down for them."""
FIRST_LOOK = 3
"""Number of messages of a topic that are sent before its acknowledgements are checked again."""


class FlowControl:
    """Decides from acknowledgements whether publishing must wait for subscribers. Only the publishing thread may use
    it."""

    def __init__(self) -> None:
        self._acknowledged: dict[Topic, int] = {}
        """Number of messages that had been sent when all were last acknowledged, by topic."""
        self._waits_since: float | None = None
        """Time since which publishing waits for subscribers [s]; None while it does not wait."""
        self._given_up: set[Topic] = set()
        """Topics for whose subscribers publishing no longer waits, because they did not acknowledge within
        :data:`SUBSCRIBER_TIMEOUT`."""

    def must_wait(self, topics: Sequence[Topic], now: float) -> bool:
        """Returns whether publishing on ``topics`` must wait at time ``now`` [s], because subscribers have not
        caught up. Call it before each step, and many times a second while it returns True."""
        if not any(map(self._is_behind, topics)):
            self._waits_since = None
            return False
        if self._waits_since is None:
            self._waits_since = now
        if now - self._waits_since < SUBSCRIBER_TIMEOUT:
            return True
        behind = [topic for topic in topics if self._is_behind(topic)]
        log.warning(
            "a subscriber of %s has acknowledged nothing for %.0f s: publishing no longer waits for it; when it comes "
            "back, it receives the last %d messages",
            ", ".join(topic.name for topic in behind),
            SUBSCRIBER_TIMEOUT,
            HISTORY,
        )
        self._given_up.update(behind)
        self._waits_since = None
        return False

    def _is_behind(self, topic: Topic) -> bool:
        """Returns whether too many messages of a topic are unacknowledged and publishing still waits for its
        subscribers."""
        sent = topic.sent
        on_their_way = sent - self._acknowledged.get(topic, 0)
        if on_their_way < FIRST_LOOK:
            return False
        if not topic.subscription_count or topic.is_acknowledged():
            self._acknowledged[topic] = sent
            self._given_up.discard(topic)
            return False
        window = WINDOW if topic.is_local else WIDE_WINDOW
        return on_their_way >= window and topic not in self._given_up
