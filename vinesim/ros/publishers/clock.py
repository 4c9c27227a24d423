"""/clock: simulation time for nodes that run with use_sim_time."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from rosgraph_msgs.msg import Clock as ClockMessage

from vinesim.ros.messages import convert
from vinesim.ros.topic import RELIABLE, Advertise, PendingMessage


class ClockPublisher:
    """/clock: one for each ROS domain, so its name is absolute under every namespace."""

    def __init__(self, advertise: Advertise) -> None:
        self._topic = advertise(ClockMessage, "/clock", RELIABLE)

    def pending(self, time: float) -> Iterator[PendingMessage]:
        """The message of a simulation time [s]."""
        yield self._topic, partial(convert.clock, time)
