"""How people push robots of other clients: the client of whoever touches computes the wrench, the robot's applies it.

``force/<robot>/<person>``: the mean wrench of a sixtieth of a second on each link, best effort, while somebody touches;
then one empty message, and silence. A robot's client believes the last message for :data:`STALE`, and there the copies
of people's hands do not touch robots: no touch is counted twice (``docs/decisions/forces-between-clients.md``).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.net.codec.wrenches import WrenchMessage, decode_wrenches, encode_wrenches
from vinesim.net.transport.bus import KEEP_LAST_1, Bus, Publisher

SEND_PERIOD = 1.0 / 60.0
"""Between two messages about one robot [s]."""

MAX_AGE = 0.1
"""A wrench is applied for so long after it arrived [s], unless news come."""


@dataclasses.dataclass(slots=True)
class _PushedRobot:
    """One robot that I push: what was felt since the last message."""

    publisher: Publisher
    due: float
    total: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    ticks: int = 0
    told: bool = False
    """The last message was not empty."""


class WrenchSync:
    """One actor's share: what its hands do to others' robots, and what others' hands do to it."""

    def __init__(self, bus: Bus, name: str) -> None:
        self._bus, self._name = bus, name
        self._touched: dict[str, _PushedRobot] = {}
        self._heard: dict[str, tuple[float, WrenchMessage]] = {}
        bus.subscribe(f"force/{name}/*", KEEP_LAST_1)

    def receive(self, payload: bytes, sender: str, now: float) -> bool:
        """Take what ``sender`` says it does to me; False if it is not newer. :class:`MessageError` if it cannot be."""
        push = decode_wrenches(payload)
        if sender in self._heard and push.time <= self._heard[sender][1].time:
            return False
        self._heard[sender] = now, push
        return True

    def net_wrenches(self, now: float) -> dict[str, np.ndarray]:
        """Wrenches [6] on my links of all who push me, by link: see :class:`Push`."""
        links: dict[str, np.ndarray] = {}
        for sender in sorted(self._heard):
            arrived, push = self._heard[sender]
            if now - arrived > MAX_AGE:
                continue
            for link, wrench in push.wrenches.items():
                links[link] = links.get(link, 0.0) + wrench
        return links

    def remove_peer(self, name: str) -> None:
        """An actor left."""
        self._heard.pop(name, None)
        if (touch := self._touched.pop(name, None)) is not None:
            touch.publisher.close()

    def publish(self, wrenches: dict[str, dict[str, np.ndarray]], now: float, time: float) -> list[bytes]:
        """Tell robots, by name, what my hands did to their links in the last tick; the messages that left."""
        left = []
        for robot in wrenches.keys() - self._touched.keys():
            self._touched[robot] = _PushedRobot(self._bus.publisher(f"force/{robot}/{self._name}"), now)
        for robot, touch in sorted(self._touched.items()):
            if not (touch.told or touch.ticks or robot in wrenches):
                continue
            touch.ticks += 1
            for link, wrench in wrenches.get(robot, {}).items():
                touch.total[link] = touch.total.get(link, 0.0) + wrench
            if now < touch.due - 1e-9:
                continue
            mean = {link: total / touch.ticks for link, total in touch.total.items()}
            payload = encode_wrenches(WrenchMessage(time, mean))
            touch.due = max(touch.due, now - SEND_PERIOD) + SEND_PERIOD
            touch.total, touch.ticks, touch.told = {}, 0, bool(mean)
            if touch.publisher.put(payload):
                left.append(payload)
        return left
