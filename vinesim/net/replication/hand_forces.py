"""Wrenches of people's hands on robots of other clients: computed by the client of the person, applied by the robot's.

Key ``force/<robot>/<person>``: the mean wrench on each link over a sixtieth of a second, best effort, during contact;
then one empty message and silence. The robot's client applies the last message for :data:`MAX_AGE`, and in its
simulation copies of people's hands do not collide with robots: no contact counts twice
(``docs/decisions/forces-between-clients.md``).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.net.codec.wrenches import WrenchMessage, decode_wrenches, encode_wrenches
from vinesim.net.transport.bus import KEEP_LAST_1, Bus, Publisher

SEND_PERIOD = 1.0 / 60.0
"""Time between two messages about one robot [s]."""

MAX_AGE = 0.1
"""A wrench is applied for so long after it arrived [s], unless a newer one does."""


@dataclasses.dataclass(slots=True)
class _PushedRobot:
    """One robot that the own hands are in contact with, and the wrenches since the last message."""

    publisher: Publisher
    due: float
    total: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    ticks: int = 0
    is_active: bool = False
    """The last message was not empty."""


class WrenchSync:
    """Wrenches of the own hands on others' robots, and of others' hands on the own robot."""

    def __init__(self, bus: Bus, name: str) -> None:
        self._bus, self._name = bus, name
        self._pushed: dict[str, _PushedRobot] = {}
        self._received: dict[str, tuple[float, WrenchMessage]] = {}
        bus.subscribe(f"force/{name}/*", KEEP_LAST_1)

    def receive(self, payload: bytes, sender: str, now: float) -> bool:
        """Take a message of ``sender``; False if it is not newer. Raises :class:`MessageError` if it is invalid."""
        message = decode_wrenches(payload)
        if sender in self._received and message.time <= self._received[sender][1].time:
            return False
        self._received[sender] = now, message
        return True

    def net_wrenches(self, now: float) -> dict[str, np.ndarray]:
        """Sum of the wrenches [6] of all people on each own link, by link name."""
        links: dict[str, np.ndarray] = {}
        for sender in sorted(self._received):
            arrived, message = self._received[sender]
            if now - arrived > MAX_AGE:
                continue
            for link, wrench in message.wrenches.items():
                links[link] = links.get(link, 0.0) + wrench
        return links

    def remove_peer(self, name: str) -> None:
        """An actor has sent."""
        self._received.pop(name, None)
        if (robot_state := self._pushed.pop(name, None)) is not None:
            robot_state.publisher.close()

    def publish(self, wrenches: dict[str, dict[str, np.ndarray]], now: float, time: float) -> list[bytes]:
        """Publish wrenches of this step on others' robots, by robot and link; the messages that sent."""
        sent = []
        for robot in wrenches.keys() - self._pushed.keys():
            self._pushed[robot] = _PushedRobot(self._bus.publisher(f"force/{robot}/{self._name}"), now)
        for robot, robot_state in sorted(self._pushed.items()):
            if not (robot_state.is_active or robot_state.ticks or robot in wrenches):
                continue
            robot_state.ticks += 1
            for link, wrench in wrenches.get(robot, {}).items():
                robot_state.total[link] = robot_state.total.get(link, 0.0) + wrench
            if now < robot_state.due - 1e-9:
                continue
            mean = {link: total / robot_state.ticks for link, total in robot_state.total.items()}
            payload = encode_wrenches(WrenchMessage(time, mean))
            robot_state.due = max(robot_state.due, now - SEND_PERIOD) + SEND_PERIOD
            robot_state.total, robot_state.ticks, robot_state.is_active = {}, 0, bool(mean)
            if robot_state.publisher.put(payload):
                sent.append(payload)
        return sent
