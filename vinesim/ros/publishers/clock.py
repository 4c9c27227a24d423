"""/clock: time of the world for nodes with use_sim_time. One node of each ROS domain publishes this topic.

A node that has found no other publisher of /clock for a second creates one, but sends nothing yet. If two nodes do so
at the same time, the one whose publisher has the greater identifier withdraws it meanwhile, so that two clocks never
mix. When the publishing node ends, another node follows within a few seconds.
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
"""Wall time between two searches for publishers of /clock [s]."""
FREE_LOOKS = 4
"""Number of successive searches without another publisher of /clock after which a node creates its own: one second.
Searches are counted instead of time, because a process that does not run discovers nothing."""
CLAIM_LOOKS = 3
"""Number of successive searches without another publisher after which a node that has created its publisher starts
to send."""
FIRST_LOOKS = 13
"""Number of searches of a new node before it may create its publisher, so that it does not displace a publisher that
it has not discovered yet. Discovery on the same machine usually takes 0.3 s. If that fails, Fast DDS announces the
publisher again after 3 s."""


class ClockPublisher:
    """Publishes /clock if no other node does. The topic name is absolute, whatever the node's namespace."""

    def __init__(self, node: rclpy.node.Node, advertise: Advertise, withdraw: Callable[[Topic], None]) -> None:
        self._node = node
        self._advertise = advertise
        self._withdraw = withdraw
        self._topic: Topic | None = None
        self._sends = False
        self._write = stamp_writer(convert.clock)
        self._lone_looks = 0
        """Number of successive searches that found no other publisher."""
        self._looks = 0
        self._next_look = 0.0

    @property
    def has_subscribers(self) -> bool:
        """Whether this node publishes /clock, and the topic has subscribers."""
        topic = self._topic
        return topic is not None and self._sends and topic.subscription_count > 0

    def update(self) -> None:
        """Every :data:`LOOK_PERIOD`, search for other publishers of /clock, and decide whether this node publishes it.

        The node creates its publisher after :data:`FREE_LOOKS` searches without another publisher, and sends after
        :data:`CLAIM_LOOKS` further ones. It withdraws its publisher if another one has a smaller identifier. The
        node's receiving thread calls this method.
        """
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
        """Yield the message for a ``time`` of the world [s], if this node publishes /clock."""
        topic = self._topic
        if topic is not None and self._sends:
            yield topic, partial(self._write, time)
