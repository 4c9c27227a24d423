"""Direct messages: all messages between actors except poses and states of objects. This module contains those with
forces.

Each kind of message has a :class:`MessageSync`, which sends and receives messages of this kind. :func:`make_syncs`
makes the syncs of forces. The receiver passes the messages of a kind to its sync. The replicator passes the values of
each step to the syncs, which publish them. The inbox of each step contains the present value of each sync, by kind.

The client of the actor that pushes computes the forces, and the client that owns the pushed robot or tree applies them.
Keys: ``force/<to>/<from>`` (``docs/decisions/forces-between-clients.md``).

Wrenches: forces and moments of a person's hands on each link of a robot, averaged over a sixtieth of a second, sent
best effort during contact. The robot's client applies the last message for :data:`WRENCH_MAX_AGE`. In its simulation
copies of people's hands do not collide with robots, so that no contact counts twice. Only people push, only links that
their hands reach, and no harder than two hands can.

Couplings: the virtual couplings (:class:`vinesim.net.codec.forces.Coupling`) of one actor to all trees of one owner,
sent while the actor touches these trees. The owner replies with the couplings of its own contacts, which act on the
copies of the trees. If only one actor touches a tree, nothing is sent.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Container, Iterable, Mapping
from typing import Any, ClassVar

import numpy as np

from vinesim.net.codec.forces import (
    COUPLINGS,
    MAX_COUPLINGS,
    WRENCHES,
    Coupling,
    CouplingMessage,
    WrenchMessage,
    decode_couplings,
    decode_wrenches,
    encode_couplings,
    encode_wrenches,
)
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.messages import Counters
from vinesim.net.replication.remote_pose import RemotePose
from vinesim.net.transport.bus import KEEP_LAST_64, Bus, Publisher
from vinesim.scene.model import Model
from vinesim.scene.values import HumanUpdate, RobotUpdate

SEND_PERIOD = 1.0 / 60.0
"""Time between two messages with forces to the same actor [s]."""

MAX_POSE_AGE = 1.0
"""Largest age of the last pose of an actor whose forces are applied [s]."""

WRENCH_MAX_AGE = 0.1
"""Time for which a wrench is applied after its arrival, unless a newer one arrives [s]."""

HAND_FORCE = 100.0
"""Largest force of one hand [N] (CANOPIES D6.4, section 3.1.1)."""

HAND_LEVER = 1.0
"""Lever arm of a hand's force about the centre of mass of a link [m], which limits the moment. GUESSED."""

MAX_PUSHING_PEOPLE = 4
"""Number of people whose largest forces limit the force of all people together on one robot. GUESSED."""

REACH = 1.2
"""Largest distance of a palm from the centre of mass of a link that the hand touches [m].

It covers half the length of a long link, and the distance that a person runs until the pose arrives. GUESSED.
"""

COUPLING_MAX_AGE = 0.2
"""Time for which couplings (virtual springs) are applied after their arrival, unless newer ones arrive [s].

Couplings are springs, so old ones are stable, too. Over a link with a delay of 100 +- 40 ms and a loss of 4 %, messages
arrive up to 0.15 s apart. With a value of 0.1 s the bunch jumped.
"""

ARM_REACH = 2.5
"""Largest distance on the ground of a coupling's anchor from the base of its actor [m]: a long arm. GUESSED."""

LinkCentre = Callable[[str], np.ndarray | None]
"""Function that returns the centre of mass [3] m of a link of the own robot, or None if the robot has no such link."""


class MessageSync(abc.ABC):
    """Sends and receives the direct messages of one kind for one actor."""

    kind: ClassVar[int]
    """Number of the kind of messages, a key of :data:`vinesim.net.codec.messages.MESSAGES`."""

    @abc.abstractmethod
    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Store a message that arrived from a peer at own time ``now`` and network ``time`` [s]. Raises
        ``MessageError`` if the message is invalid."""

    def current(self, now: float) -> Any:  # noqa: B027 - optional
        """Returns the received values that are valid at own time ``now`` [s]. They become part of the inbox."""

    def publish(self, value: Any, now: float, time: float) -> list[bytes]:
        """Publish the ``value`` of the own actor in the step at own time ``now`` and network ``time`` [s].

        None: the actor has no value. Returns the messages that were sent.
        """
        return []

    def remove_peer(self, name: str) -> None:  # noqa: B027 - optional
        """Forget an actor that has left."""

    def shift_time(self, step: float) -> None:  # noqa: B027 - optional
        """Shift all stored network times, because the network clock was set by ``step`` [s]."""


@dataclasses.dataclass(slots=True)
class _Partner:
    """An actor to which a :class:`ForceSync` sends messages."""

    publisher: Publisher
    due: float
    """Earliest own time of the next message [s]."""
    is_active: bool = False
    """Whether the last message contained forces, so that an empty one must follow."""


class ForceSync(MessageSync):
    """Base class for sending and receiving direct messages with forces. Stores the last message of each sender; all
    messages have a field ``time``.

    At most 60 messages a second are sent to an actor while there are forces, then one empty message, then nothing.
    :func:`make_syncs` subscribes to the keys, once for all kinds of forces.
    """

    def __init__(self, bus: Bus, name: str, counters: Counters) -> None:
        self._bus = bus
        self._name = name
        self._counters = counters
        self._partners: dict[str, _Partner] = {}
        self._received: dict[str, tuple[float, Any]] = {}
        """Own time of arrival [s] and content of the last message, by sender."""

    def remove_peer(self, name: str) -> None:
        """Forget an actor that has left."""
        self._received.pop(name, None)
        if (partner := self._partners.pop(name, None)) is not None:
            partner.publisher.close()

    def shift_time(self, step: float) -> None:
        """Shift all stored network times, because the network clock was set by ``step`` [s]."""
        for sender, (arrived, message) in self._received.items():
            self._received[sender] = arrived, dataclasses.replace(message, time=message.time + step)

    def _is_outdated(self, sender: str, message: Any) -> bool:
        """Whether a message is not newer than the last one of its sender. Counts outdated messages as dropped."""
        is_outdated = sender in self._received and message.time <= self._received[sender][1].time
        self._counters.dropped += is_outdated
        return is_outdated

    def _recent(self, now: float, max_age: float) -> list[tuple[str, Any]]:
        """Returns the senders whose last message arrived at most ``max_age`` [s] ago, each with this message."""
        return [
            (sender, message)
            for sender, (arrived, message) in sorted(self._received.items())
            if now - arrived <= max_age
        ]

    def _add_partners(self, names: Iterable[str], now: float) -> None:
        """Declare publishers to the actors ``names``, unless they exist. Messages may be sent from own time ``now`` [s]
        on."""
        for name in names:
            if name not in self._partners:
                self._partners[name] = _Partner(self._bus.publisher(f"force/{name}/{self._name}"), now)

    def _send(self, partner: _Partner, payload: bytes, now: float, *, is_empty: bool) -> list[bytes]:
        """Send a message to a partner. Returns a list with the message, or an empty one if there is no subscriber.

        ``is_empty``: whether the message contains no forces.
        """
        partner.due = max(partner.due, now - SEND_PERIOD) + SEND_PERIOD
        partner.is_active = not is_empty
        return [payload] if partner.publisher.put(payload) else []


def _recent_pose(actor: RemotePose, time: float) -> HumanUpdate | RobotUpdate | None:
    """Returns the last pose of an actor; None if it is unknown or, at network ``time`` [s], too old."""
    return actor.update if actor.update is not None and time - actor.update.time <= MAX_POSE_AGE else None


def limit(wrenches: dict[str, np.ndarray], hands: int, hand_force: float) -> tuple[dict[str, np.ndarray], bool]:
    """Reduce wrenches to the force and moment that a number of ``hands`` can exert, by one factor for all links.

    ``wrenches``: [6] by link, force [N] and moment [N m]. ``hand_force``: largest force of one hand [N]. Returns the
    wrenches, and whether they were reduced.
    """
    force = sum(float(np.linalg.norm(wrench[:3])) for wrench in wrenches.values())
    moment = sum(float(np.linalg.norm(wrench[3:])) for wrench in wrenches.values())
    excess = max(force, moment / HAND_LEVER) / (max(hands, 1) * hand_force)
    if excess <= 1.0:
        return wrenches, False
    return {link: wrench / excess for link, wrench in wrenches.items()}, True


def hands_within_reach(update: HumanUpdate, centre: np.ndarray | None) -> frozenset[str]:
    """Returns which hands of a person (``left``, ``right``) can touch a link.

    ``centre`` [3] m: centre of mass of the link in the world; None: the link does not exist.
    """
    if centre is None:
        return frozenset()
    hands = {"left": update.pose.left, "right": update.pose.right}
    return frozenset(side for side, hand in hands.items() if np.linalg.norm(hand[:3] - centre) <= REACH)


def limit_by_hands(
    wrenches: dict[str, np.ndarray], reach: dict[str, frozenset[str]], hand_force: float
) -> tuple[dict[str, np.ndarray], bool]:
    """Reduce the wrench on each link to what the hands that reach it can exert, and the sum to what all hands can.

    ``wrenches``: [6] by link, force [N] and moment [N m]. ``reach``: hands that reach each link. ``hand_force``:
    largest force of one hand [N]. Returns the wrenches, and whether they were reduced.
    """
    is_limited = False
    for link, wrench in wrenches.items():
        reduced, is_reduced = limit({link: wrench}, len(reach[link]), hand_force)
        wrenches = wrenches | reduced
        is_limited = is_limited or is_reduced
    wrenches, is_reduced = limit(wrenches, len(frozenset().union(*reach.values())), hand_force)
    return wrenches, is_limited or is_reduced


@dataclasses.dataclass(slots=True)
class _Push:
    """Sum of the wrenches of the own hands on one robot since the last message, by link, and the number of steps."""

    total: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    ticks: int = 0


class WrenchSync(ForceSync):
    """Sends wrenches of the own hands on robots of other clients, and receives those of other people on the own
    robot."""

    kind = WRENCHES

    def __init__(
        self,
        bus: Bus,
        name: str,
        counters: Counters,
        hand_force: float = HAND_FORCE,
        link_centre: LinkCentre = lambda _: None,
    ) -> None:
        """``hand_force``: largest force of one hand [N]. ``link_centre(link)``: centre of mass of a link of the own
        robot. Without this function people cannot push the robot."""
        super().__init__(bus, name, counters)
        self._hand_force = hand_force
        self._link_centre = link_centre
        self._pushes: dict[str, _Push] = {}

    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Store a message with the wrenches of a person on the own robot. Refused and reduced wrenches are counted.

        Raises :class:`MessageError` if the message is invalid or not from a person.
        """
        hello = sender.hello
        if hello.kind != "human":
            raise MessageError(f"wrenches by {hello.name!r}, a {hello.kind}: only people's hands send them")
        message = decode_wrenches(payload)
        if self._is_outdated(hello.name, message):
            return
        pose = _recent_pose(sender, time)
        reach: dict[str, frozenset[str]] = {}
        if isinstance(pose, HumanUpdate):
            reach = {link: hands_within_reach(pose, self._link_centre(link)) for link in message.wrenches}
        reached = {link: wrench for link, wrench in message.wrenches.items() if reach.get(link)}
        self._counters.wrenches_refused += len(message.wrenches) - len(reached)
        reached, is_limited = limit_by_hands(reached, {link: reach[link] for link in reached}, self._hand_force)
        self._counters.wrenches_limited += is_limited
        self._received[hello.name] = now, WrenchMessage(message.time, reached)

    def current(self, now: float) -> dict[str, np.ndarray]:
        """Returns the limited sum of the wrenches [6] of all people on each link of the own robot, by link name."""
        links: dict[str, np.ndarray] = {}
        for _, message in self._recent(now, WRENCH_MAX_AGE):
            for link, wrench in message.wrenches.items():
                links[link] = links.get(link, 0.0) + wrench
        links, is_limited = limit(links, 2 * MAX_PUSHING_PEOPLE, self._hand_force)
        self._counters.wrenches_limited += is_limited
        return links

    def remove_peer(self, name: str) -> None:
        """Forget an actor that has left."""
        super().remove_peer(name)
        self._pushes.pop(name, None)

    def publish(self, value: Mapping[str, dict[str, np.ndarray]] | None, now: float, time: float) -> list[bytes]:
        """Publish the wrenches of the own hands in this step, averaged over the steps since the last message.

        ``value``: wrenches [6] by robot and link. Returns the messages that were sent.
        """
        wrenches = value or {}
        self._add_partners(wrenches, now)
        sent = []
        for robot, partner in sorted(self._partners.items()):
            push = self._pushes.setdefault(robot, _Push())
            if not (partner.is_active or push.ticks or robot in wrenches):
                continue
            push.ticks += 1
            for link, wrench in wrenches.get(robot, {}).items():
                push.total[link] = push.total.get(link, 0.0) + wrench
            if now < partner.due - 1e-9:
                continue
            mean = {link: total / push.ticks for link, total in push.total.items()}
            payload = encode_wrenches(WrenchMessage(time, limit(mean, 2, self._hand_force)[0]))
            self._pushes[robot] = _Push()
            sent += self._send(partner, payload, now, is_empty=not mean)
        return sent


class CouplingSync(ForceSync):
    """Sends couplings (virtual springs) of the own actor's contacts with trees, and receives couplings of other
    actors."""

    kind = COUPLINGS

    def __init__(
        self,
        bus: Bus,
        name: str,
        model: Model,
        counters: Counters,
        owner: Callable[[int], str | None],
        peers: Container[str],
    ) -> None:
        """``owner(tree)``: name of the tree's owner, or None. ``peers``: names of the actors that may receive
        couplings."""
        super().__init__(bus, name, counters)
        self._model = model
        self._owner = owner
        self._peers = peers

    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Store a message with the couplings (virtual springs) of another actor.

        Couplings to trees that neither actor owns, or that the other actor's arms do not reach, are counted and not
        used. Raises :class:`MessageError` if the message is invalid or names bodies that do not exist.
        """
        name = sender.hello.name
        message = decode_couplings(payload)
        for coupling in message.couplings:
            _check_body(coupling.body, self._model)
        if self._is_outdated(name, message):
            return
        pose = _recent_pose(sender, time)
        used = tuple(
            coupling
            for coupling in message.couplings
            if pose is not None
            and np.hypot(*(coupling.anchor[:2] - pose.base_q[:2])) <= ARM_REACH
            and self._owner(int(self._model.body_tree[coupling.body])) in (self._name, name)
        )
        self._counters.couplings_refused += len(message.couplings) - len(used)
        self._received[name] = now, CouplingMessage(message.time, used)

    def partners(self, tree: int, now: float) -> list[str]:
        """Returns the other actors whose couplings to a tree are valid at own time ``now`` [s]."""
        return [
            name
            for name, theirs in self.current(now).items()
            if any(self._model.body_tree[coupling.body] == tree for coupling in theirs)
        ]

    def current(self, now: float) -> dict[str, tuple[Coupling, ...]]:
        """Returns the couplings of other actors that are valid at own time ``now`` [s], by actor."""
        return {
            sender: message.couplings for sender, message in self._recent(now, COUPLING_MAX_AGE) if message.couplings
        }

    def publish(self, value: Iterable[Coupling] | None, now: float, time: float) -> list[bytes]:
        """Publish the own couplings of this step, which are ``value``. Returns the messages that were sent."""
        couplings = self._by_partner(value or (), now)
        self._add_partners(couplings, now)
        sent = []
        for name, partner in sorted(self._partners.items()):
            mine = couplings.get(name, ())
            if (mine or partner.is_active) and now >= partner.due - 1e-9:
                payload = encode_couplings(CouplingMessage(time, tuple(mine[:MAX_COUPLINGS])))
                sent += self._send(partner, payload, now, is_empty=not mine)
        return sent

    def _by_partner(self, couplings: Iterable[Coupling], now: float) -> dict[str, list[Coupling]]:
        """Returns the own couplings (virtual springs), by name of the peer that shall receive them.

        The receiver of a coupling is the owner of its tree. A coupling to a tree of the own actor is sent to each peer
        whose couplings to the tree are valid at own time ``now`` [s].
        """
        found: dict[str, list[Coupling]] = {}
        for coupling in couplings:
            tree = int(self._model.body_tree[coupling.body])
            owner = self._owner(tree)
            for name in self.partners(tree, now) if owner == self._name else [owner]:
                if name is not None and name in self._peers:
                    found.setdefault(name, []).append(coupling)
        return found


def _check_body(body: int, model: Model) -> None:
    """Raise :class:`MessageError` unless the index ``body`` exists and the body is no berry cluster."""
    if body >= len(model.body_tree):
        raise MessageError(f"a coupling to body {body}; there are {len(model.body_tree)}")
    tree = int(model.body_tree[body])
    if body - int(model.tree_first[tree]) >= int(model.tree_core[tree]):
        raise MessageError(f"a coupling to body {body}, a berry cluster")


def make_syncs(
    bus: Bus,
    name: str,
    model: Model,
    counters: Counters,
    *,
    owner: Callable[[int], str | None],
    peers: Mapping[str, RemotePose],
    hand_force: float = HAND_FORCE,
    link_centre: LinkCentre = lambda _: None,
) -> tuple[MessageSync, ...]:
    """Make the senders and receivers (:class:`MessageSync`) of all direct messages of the actor ``name`` except voices,
    and subscribe to their keys.

    ``owner(object_id)``: name of the actor that owns an object, or None. ``hand_force``, ``link_centre``: see
    :class:`WrenchSync`.
    """
    bus.subscribe(f"force/{name}/*", KEEP_LAST_64)
    return (
        WrenchSync(bus, name, counters, hand_force, link_centre),
        CouplingSync(bus, name, model, counters, owner, peers),
    )
