"""One outgoing topic: who listens, what was sent, what came too late to be sent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
TRANSFORMS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""What tf2 listeners expect of /tf."""
TRANSIENT_LOCAL = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""The last message reaches late joiners too."""
SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)

Build = Callable[[], Any]
"""Makes a message, its serialised bytes, or a list of messages; called only when somebody listens."""


class Topic:
    """A publisher with its counts; only the ROS thread sends."""

    def __init__(self, name: str, publisher: Publisher, high_priority: bool) -> None:
        self.name = name
        """As asked for: relative to the node's namespace unless it begins with a slash."""
        self.high_priority = high_priority
        """Sent before anything that is not: what the tick brings, before pictures and clouds."""
        self.subscription_count = 0
        """Subscribers when last counted."""
        self.sent = 0
        """Messages."""
        self.dropped = 0
        """Messages replaced by newer ones before they could be sent, or that could not be built."""
        self._publisher = publisher

    def update_subscription_count(self) -> None:
        """Ask the middleware how many subscribers there are."""
        self.subscription_count = self._publisher.get_subscription_count()

    def send(self, message: Any) -> None:
        """Publish a message, its serialised bytes, or each message of a list."""
        for one in message if isinstance(message, list) else (message,):
            self._publisher.publish(one)
            self.sent += 1


class Advertise(Protocol):
    """How a topic family gets its topics from the node."""

    def __call__(self, message: type, name: str, qos: QoSProfile = ..., *, high_priority: bool = ...) -> Topic: ...


PendingMessage = tuple[Topic, Build]
"""A message to be: the node builds and sends it on its own thread."""
