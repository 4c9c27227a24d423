"""One published topic with its QoS and counts: subscriptions, messages sent, messages dropped."""

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
"""Default QoS: reliable. Up to a hundred messages wait for a subscriber that gets no processor."""
HISTORY = 1000
"""History depth of the topics that every step publishes: ten seconds of messages."""
EVERY_STEP = QoSProfile(depth=HISTORY, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of the topics that every step publishes. tf2 listeners expect /tf to be reliable."""
TRANSIENT_LOCAL = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""QoS of latched topics: a late subscriber receives the last message, too."""
SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of pictures and clouds: reliable, so that reliable and best-effort subscribers both receive them (REP-2003)."""

_AT_ONCE = Duration()

Build = Callable[[], Any]
"""Makes a message, its serialised bytes, or a list of messages; called only if the topic has subscribers."""


class Topic:
    """A publisher with its counts; one thread at a time may send."""

    def __init__(self, name: str, publisher: Publisher, *, is_of_every_step: bool = False) -> None:
        self.name = name
        """Name of the topic, relative to the node's namespace unless it begins with a slash."""
        self.is_of_every_step = is_of_every_step
        """Whether every step publishes it, or every other one."""
        self.subscription_count = 0
        """Number of subscribers when last counted."""
        self.is_local = True
        """Whether all subscribers run on this machine."""
        self.sent = 0
        """Number of messages that were sent."""
        self.dropped = 0
        """Number of messages that newer ones replaced before their turn, or that could not be built or sent."""
        self.publisher = publisher
        self._is_muted = False
        self._lock = threading.Lock()
        self._is_closed = False

    def update_subscription_count(self) -> None:
        """Query the middleware for the number of subscribers."""
        if not self._is_closed and not self._is_muted:
            self.subscription_count = self.publisher.get_subscription_count()

    def is_acknowledged(self) -> bool:
        """Whether all reliable subscribers have acknowledged all messages so far."""
        with self._lock:
            return self._is_closed or self.publisher.wait_for_all_acked(_AT_ONCE)

    def mute(self, is_muted: bool) -> None:
        """Set whether the topic sends nothing, as if it had no subscribers. For the thread that counts subscribers."""
        self._is_muted = is_muted
        self.subscription_count = 0
        self.update_subscription_count()

    def close(self) -> None:
        """Stop sending, and wait until a message that is being sent is complete."""
        with self._lock:
            self._is_closed = True
            self.subscription_count = 0

    def build_and_send(self, build: Build) -> None:
        """Build a message and publish it; a failure is counted, and logged once."""
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
    """How a publisher class creates its topics in the node."""

    def __call__(self, message: type, name: str, qos: QoSProfile = ...) -> Topic: ...


PendingMessage = tuple[Topic, Build]
"""A topic and the function that builds its next message; the node calls it and sends the result."""


# Flow control of the topics that every step publishes: the next step waits until their subscribers keep up.
#
# A subscriber of rclpy keeps the last ten messages of a topic, and overwrites them when more come before it gets a
# processor. So no more than a few are on their way at once. Fast DDS tells only whether all subscribers have
# acknowledged all messages of a topic; they do when the publisher asks them (``heartbeatPeriod`` of ``udp.xml``).
# Nothing is known of subscribers that ask for best effort.


SUBSCRIBER_TIMEOUT = 3.0
"""If subscribers have not acknowledged all messages for this long, publishing no longer waits for them until they do
[s]."""
WINDOW = 5
"""Messages of a topic that may be on their way to subscribers on this machine."""
WIDE_WINDOW = HISTORY // 2
"""Messages of a topic that may be on their way if a subscriber is on another machine: a network may take long to
acknowledge, and the world should not slow down."""
FIRST_LOOK = 3
"""Number of messages after which acknowledgements are checked."""


class FlowControl:
    """Looks at acknowledgements; for the thread that publishes."""

    def __init__(self) -> None:
        self._acknowledged: dict[Topic, int] = {}
        """Number of messages that had been sent when all were last acknowledged, by topic."""
        self._waits_since: float | None = None
        """Time since which publishing waits for subscribers [s]. None: it does not wait."""
        self._given_up: set[Topic] = set()
        """Topics with a subscriber for which publishing no longer waits."""

    def must_wait(self, topics: Sequence[Topic], now: float) -> bool:
        """Whether nothing more shall be sent on ``topics`` at ``now`` [s]; to be called before every step, and many
        times a second meanwhile."""
        if not any(map(self._is_behind, topics)):
            self._waits_since = None
            return False
        if self._waits_since is None:
            self._waits_since = now
        if now - self._waits_since < SUBSCRIBER_TIMEOUT:
            return True
        behind = [topic for topic in topics if self._is_behind(topic)]
        log.warning(
            "a subscriber of %s does not answer for %.0f s: it is waited for no longer, and when it comes back it gets "
            "the last %d messages",
            ", ".join(topic.name for topic in behind),
            SUBSCRIBER_TIMEOUT,
            HISTORY,
        )
        self._given_up.update(behind)
        self._waits_since = None
        return False

    def _is_behind(self, topic: Topic) -> bool:
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
