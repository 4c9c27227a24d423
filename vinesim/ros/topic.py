"""One published topic with its QoS and counts: subscriptions, messages sent, messages dropped."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, Protocol

from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

log = logging.getLogger(__name__)

RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""A second of messages of every step waits for a subscriber that has no processor; tf2 listeners expect it of /tf."""
TRANSIENT_LOCAL = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""A late subscriber receives the last message, too."""
SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
"""Pictures and clouds: reliable, so that reliable and best-effort subscribers both receive them (REP-2003)."""

Build = Callable[[], Any]
"""Makes a message, its serialised bytes, or a list of messages; called only if the topic has subscribers."""


class Topic:
    """A publisher with its counts; one thread at a time may send."""

    def __init__(self, name: str, publisher: Publisher) -> None:
        self.name = name
        """Relative to the node's namespace unless it begins with a slash."""
        self.subscription_count = 0
        """Number of subscribers when last counted."""
        self.sent = 0
        """Messages."""
        self.dropped = 0
        """Messages that were replaced by newer ones before their turn, or that could not be built or sent."""
        self.publisher = publisher
        self._lock, self._is_closed = threading.Lock(), False

    def update_subscription_count(self) -> None:
        """Query the middleware for the number of subscribers."""
        if not self._is_closed:
            self.subscription_count = self.publisher.get_subscription_count()

    def close(self) -> None:
        """Send nothing any more; returns when nothing is being sent."""
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
