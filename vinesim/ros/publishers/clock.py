"""/clock: time of the world for nodes that run with use_sim_time. Of all nodes of a ROS domain one publishes it.

A node that has seen no other publisher of /clock for a second becomes one, but sends nothing yet: of two that did so at
once the one with the greater identifier of its publisher gives way meanwhile, so that two clocks do not mix. When the
publisher goes, another node follows within a few seconds.
"""

from __future__ import annotations

import time as wall
from collections.abc import Callable, Iterator
from functools import partial

import rclpy.node
from rosgraph_msgs.msg import Clock as ClockMessage

from vinesim.ros.messages import convert
from vinesim.ros.messages.convert import stamp_writer
from vinesim.ros.topic import EVERY_STEP, Advertise, PendingMessage, Topic

CLOCK = "/clock"
LOOK_PERIOD = 0.25
"""Wall time between two looks at the publishers [s]."""
FREE_LOOKS = 4
"""Looks in a row that find no publisher of /clock before a node becomes it, a second. Looks are counted, not time: a
process without a processor discovers nothing meanwhile."""
CLAIM_LOOKS = 3
"""Looks in a row that find no other publisher before a node that has become it sends its first message."""
FIRST_LOOKS = 13
"""Looks of a new node before it becomes the publisher, or it might displace one that it does not know yet. Discovery of
a node on the same machine takes 0.3 s as a rule, but where that fails, until Fast DDS announces it again after 3 s."""


class ClockPublisher:
    """This node's part in /clock; its name is absolute under every namespace."""

    def __init__(self, node: rclpy.node.Node, advertise: Advertise, withdraw: Callable[[Topic], None]) -> None:
        self._node = node
        self._advertise = advertise
        self._withdraw = withdraw
        self._topic: Topic | None = None
        self._sends = False
        self._write = stamp_writer(convert.clock)
        self._lone_looks = 0
        """Looks in a row that found no other publisher."""
        self._looks = 0
        self._next_look = 0.0

    @property
    def has_subscribers(self) -> bool:
        """Whether this node publishes /clock, and has subscribers."""
        topic = self._topic
        return topic is not None and self._sends and topic.subscription_count > 0

    def update(self) -> None:
        """Look who publishes /clock, and begin or stop; called by the receiving thread of the node."""
        now = wall.monotonic()
        if now < self._next_look:
            return
        self._next_look = now + LOOK_PERIOD
        own = []
        others = []
        for publisher in self._node.get_publishers_info_by_topic(CLOCK):
            is_own = (publisher.node_name, publisher.node_namespace) == (
                self._node.get_name(),
                self._node.get_namespace(),
            )
            (own if is_own else others).append(tuple(publisher.endpoint_gid))
        self._looks += 1
        self._lone_looks = 0 if others else self._lone_looks + 1
        if self._topic is None:
            if self._lone_looks >= FREE_LOOKS and self._looks >= FIRST_LOOKS:
                self._topic = self._advertise(ClockMessage, CLOCK, EVERY_STEP)
                self._lone_looks = 0
        elif own and any(other < own[0] for other in others):
            topic = self._topic
            self._topic = None
            self._sends = False
            self._withdraw(topic)
        elif self._lone_looks >= CLAIM_LOOKS:
            self._sends = True

    def pending(self, time: float) -> Iterator[PendingMessage]:
        """The message of a time [s], if this node publishes it."""
        topic = self._topic
        if topic is not None and self._sends:
            yield topic, partial(self._write, time)
