"""One published topic with its QoS and counts: subscriptions, messages sent, messages dropped."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, Protocol

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

log = logging.getLogger(__name__)

RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""A hundred messages wait for a subscriber that has no processor."""
HISTORY = 1000
"""Messages that wait of the topics of every step, ten seconds of them; see :mod:`vinesim.ros.flow_control`."""
EVERY_STEP = QoSProfile(depth=HISTORY, reliability=ReliabilityPolicy.RELIABLE)
"""Of these topics; tf2 listeners expect reliable of /tf."""
TRANSIENT_LOCAL = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""A late subscriber receives the last message, too."""
SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
"""Pictures and clouds: reliable, so that reliable and best-effort subscribers both receive them (REP-2003)."""

_AT_ONCE = Duration()

Build = Callable[[], Any]
"""Makes a message, its serialised bytes, or a list of messages; called only if the topic has subscribers."""


class Topic:
    """A publisher with its counts; one thread at a time may send."""

    def __init__(self, name: str, publisher: Publisher, *, is_of_every_step: bool = False) -> None:
        self.name = name
        """Relative to the node's namespace unless it begins with a slash."""
        self.is_of_every_step = is_of_every_step
        """Whether every step publishes it, or every other one."""
        self.subscription_count = 0
        """Number of subscribers when last counted."""
        self.is_local = True
        """Whether all subscribers run on this machine."""
        self.sent = 0
        """Messages."""
        self.dropped = 0
        """Messages that were replaced by newer ones before their turn, or that could not be built or sent."""
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
        """Whether nothing is sent, as if there were no subscribers; for the thread that counts them."""
        self._is_muted = is_muted
        self.subscription_count = 0
        self.update_subscription_count()

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
