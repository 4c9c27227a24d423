"""Wrenches of people's hands on robots of other clients: computed by the client of the person, applied by the robot's.

Key ``force/<robot>/<person>``: the mean wrench on each link over a sixtieth of a second, best effort, during contact;
then one empty message and silence. The robot's client applies the last message for :data:`MAX_AGE`, and in its
simulation copies of people's hands do not collide with robots: no contact counts twice
(``docs/decisions/forces-between-clients.md``). Only people push, only what their hands reach, and no harder than two
hands can.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from vinesim.net.codec.control import Hello
from vinesim.net.codec.forces import WrenchMessage, decode_wrenches, encode_wrenches
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.messages import Counters
from vinesim.net.transport.bus import KEEP_LAST_64, Bus, Publisher
from vinesim.scene.values import HumanUpdate, RobotUpdate

SEND_PERIOD = 1.0 / 60.0
"""Time between two messages about one robot [s]."""

MAX_AGE = 0.1
"""A wrench is applied for so long after it arrived [s], unless a newer one does."""

HAND_FORCE = 100.0
"""Largest force of one hand [N] (CANOPIES D6.4, section 3.1.1)."""

HAND_LEVER = 1.0
"""Lever of that force about the centre of mass of a link [m], which bounds the moment. GUESSED."""

MAX_PUSHING_PEOPLE = 4
"""All people together push a robot no harder than so many of them. GUESSED."""

REACH = 1.2
"""Farthest centre of mass of a link that a hand touches [m], from the palm: half of a long link, and the way of a
running person until the pose arrives. GUESSED."""

MAX_POSE_AGE = 1.0
"""A person whose last pose is older than this pushes nothing [s]."""

LinkCentre = Callable[[str], np.ndarray | None]
"""Centre of mass [3] m of a link of the own robot; None if it has no such link."""


@dataclasses.dataclass(slots=True)
class _PushedRobot:
    """One robot that the own hands are in contact with, and the wrenches since the last message."""

    publisher: Publisher
    due: float
    total: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    ticks: int = 0
    is_active: bool = False
    """The last message was not empty."""


def limit(wrenches: dict[str, np.ndarray], hands: int, hand_force: float) -> tuple[dict[str, np.ndarray], bool]:
    """Wrenches [6] by link, all reduced alike to what so many hands of ``hand_force`` [N] can do; whether that was
    needed."""
    force = sum(float(np.linalg.norm(wrench[:3])) for wrench in wrenches.values())
    moment = sum(float(np.linalg.norm(wrench[3:])) for wrench in wrenches.values())
    excess = max(force, moment / HAND_LEVER) / (max(hands, 1) * hand_force)
    if excess <= 1.0:
        return wrenches, False
    return {link: wrench / excess for link, wrench in wrenches.items()}, True


def hands_within_reach(update: HumanUpdate, centre: np.ndarray | None) -> frozenset[str]:
    """Hands of a person that can touch a link with this centre of mass [3] m; None: there is no such link."""
    if centre is None:
        return frozenset()
    hands = {"left": update.pose.left, "right": update.pose.right}
    return frozenset(side for side, hand in hands.items() if np.linalg.norm(hand[:3] - centre) <= REACH)


def limit_by_hands(
    wrenches: dict[str, np.ndarray], reach: dict[str, frozenset[str]], hand_force: float
) -> tuple[dict[str, np.ndarray], bool]:
    """Wrenches [6] by link, reduced to what the hands within ``reach`` of each link can do, and all of them together;
    whether that was needed."""
    is_limited = False
    for link, wrench in wrenches.items():
        reduced, is_reduced = limit({link: wrench}, len(reach[link]), hand_force)
        wrenches = wrenches | reduced
        is_limited = is_limited or is_reduced
    wrenches, is_reduced = limit(wrenches, len(frozenset().union(*reach.values())), hand_force)
    return wrenches, is_limited or is_reduced


class WrenchSync:
    """Wrenches of the own hands on others' robots, and of others' hands on the own robot."""

    def __init__(self, bus: Bus, name: str, counters: Counters, hand_force: float = HAND_FORCE) -> None:
        """``hand_force`` [N]: limit of each hand."""
        self._hand_force = hand_force
        self._bus = bus
        self._name = name
        self._counters = counters
        self._pushed: dict[str, _PushedRobot] = {}
        self._received: dict[str, tuple[float, WrenchMessage]] = {}
        bus.subscribe(f"force/{name}/*", KEEP_LAST_64)  # couplings to trees come under the same keys

    def receive(
        self, payload: bytes, sender: Hello, pose: HumanUpdate | RobotUpdate | None, now: float, link_centre: LinkCentre
    ) -> None:
        """Take a message of ``sender``, whose last pose is ``pose`` (None: unknown or too old), and count what is not
        used.

        Raises :class:`MessageError` if it is invalid or not from a person.
        """
        if sender.kind != "human":
            raise MessageError(f"wrenches by {sender.name!r}, a {sender.kind}: only people's hands send them")
        message = decode_wrenches(payload)
        if sender.name in self._received and message.time <= self._received[sender.name][1].time:
            self._counters.dropped += 1
            return
        reach: dict[str, frozenset[str]] = {}
        if isinstance(pose, HumanUpdate):
            reach = {link: hands_within_reach(pose, link_centre(link)) for link in message.wrenches}
        reached = {link: wrench for link, wrench in message.wrenches.items() if reach.get(link)}
        self._counters.wrenches_refused += len(message.wrenches) - len(reached)
        reached, is_limited = limit_by_hands(reached, {link: reach[link] for link in reached}, self._hand_force)
        self._counters.wrenches_limited += is_limited
        self._received[sender.name] = now, WrenchMessage(message.time, reached)

    def shift_time(self, step: float) -> None:
        """The network clock was set by ``step`` [s]."""
        for sender, (arrived, message) in self._received.items():
            self._received[sender] = arrived, dataclasses.replace(message, time=message.time + step)

    def net_wrenches(self, now: float) -> dict[str, np.ndarray]:
        """Sum of the wrenches [6] of all people on each own link, by link name; limited as a whole."""
        links: dict[str, np.ndarray] = {}
        for sender in sorted(self._received):
            arrived, message = self._received[sender]
            if now - arrived > MAX_AGE:
                continue
            for link, wrench in message.wrenches.items():
                links[link] = links.get(link, 0.0) + wrench
        links, is_limited = limit(links, 2 * MAX_PUSHING_PEOPLE, self._hand_force)
        self._counters.wrenches_limited += is_limited
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
            payload = encode_wrenches(WrenchMessage(time, limit(mean, 2, self._hand_force)[0]))
            robot_state.due = max(robot_state.due, now - SEND_PERIOD) + SEND_PERIOD
            robot_state.total = {}
            robot_state.ticks = 0
            robot_state.is_active = bool(mean)
            if robot_state.publisher.put(payload):
                sent.append(payload)
        return sent
