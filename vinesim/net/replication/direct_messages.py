"""Messages that actors send each other directly, apart from poses and states of objects: forces so far.

Each kind of message has a :class:`MessageSync`, which sends and receives it. :func:`make_syncs` makes them all. The
receiver passes the messages of a kind to its sync, and the replicator passes the values of each step to publish. The
inbox of each step has the present value of each sync under its kind.

The client of the actor that pushes computes the forces, and the client that owns the pushed robot or tree applies them.
Keys: ``force/<to>/<from>`` (``docs/decisions/forces-between-clients.md``).

Wrenches: the mean wrench of a person's hands on each link of a robot over a sixtieth of a second, best effort, during
contact. The robot's client applies the last message for :data:`WRENCH_MAX_AGE`, and in its simulation copies of
people's hands do not collide with robots: no contact counts twice. Only people push, only what their hands reach, and
no harder than two hands can.

Couplings: the virtual couplings (:class:`vinesim.net.codec.forces.Coupling`) of one actor to all trees of one owner,
while the actor touches them. The owner replies with the couplings of its own contacts, for the copies of these trees.
If only one actor is at a tree, nothing is sent.
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
"""Time between two forces that are sent to one actor [s]."""

MAX_POSE_AGE = 1.0
"""An actor whose last pose is older than this pushes nothing [s]."""

WRENCH_MAX_AGE = 0.1
"""Time for which a wrench is applied after its arrival [s], unless a newer one arrives."""

HAND_FORCE = 100.0
"""Largest force of one hand [N] (CANOPIES D6.4, section 3.1.1)."""

HAND_LEVER = 1.0
"""Lever of that force about the centre of mass of a link [m], which bounds the moment. GUESSED."""

MAX_PUSHING_PEOPLE = 4
"""All people together push a robot no harder than this number of people could. GUESSED."""

REACH = 1.2
"""Farthest centre of mass of a link that a hand touches [m], from the palm: half of a long link, and the way of a
running person until the pose arrives. GUESSED."""

COUPLING_MAX_AGE = 0.2
"""Time for which couplings hold after their arrival [s], unless newer ones arrive. They are springs, which are stable
also when they are old. Over a link with a delay of 100 +- 40 ms and a loss of 4 %, messages come up to 0.15 s apart; a
value of 0.1 s let the bunch jump."""

ARM_REACH = 2.5
"""Farthest anchor of a coupling from the base of its actor on the ground [m]: a long arm. GUESSED."""

LinkCentre = Callable[[str], np.ndarray | None]
"""Centre of mass [3] m of a link of the own robot; None if it has no such link."""


class MessageSync(abc.ABC):
    """Messages of one kind to and from one actor."""

    kind: ClassVar[int]
    """Kind of the messages, a key of :data:`vinesim.net.codec.messages.MESSAGES`."""

    @abc.abstractmethod
    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Take a message of a peer at own time ``now`` and network ``time`` [s]; ``MessageError`` if it is invalid."""

    def current(self, now: float) -> Any:  # noqa: B027 - optional
        """Returns the received values that are valid at own time ``now`` [s], for the inbox."""

    def publish(self, value: Any, now: float, time: float) -> list[bytes]:
        """Publish the ``value`` of the own actor in the step at own time ``now`` and network ``time`` [s]; None: it has
        nothing to say. Returns the messages that were sent."""
        return []

    def remove_peer(self, name: str) -> None:  # noqa: B027 - optional
        """An actor has left."""

    def shift_time(self, step: float) -> None:  # noqa: B027 - optional
        """The network clock was set by ``step`` [s]."""


@dataclasses.dataclass(slots=True)
class _Partner:
    """An actor to which messages are sent."""

    publisher: Publisher
    due: float
    """Own time of the next message [s]."""
    is_active: bool = False
    """Whether the last message to it was not empty."""


class ForceSync(MessageSync):
    """Messages to single actors: at most 60 a second while there is something to say, then one empty message and
    silence. The last message of each sender is kept; all have a field ``time``.

    :func:`make_syncs` subscribes to their keys, once for all kinds.
    """

    def __init__(self, bus: Bus, name: str, counters: Counters) -> None:
        self._bus = bus
        self._name = name
        self._counters = counters
        self._partners: dict[str, _Partner] = {}
        self._received: dict[str, tuple[float, Any]] = {}
        """Own time of arrival [s] and message, by sender."""

    def remove_peer(self, name: str) -> None:
        """An actor has left."""
        self._received.pop(name, None)
        if (partner := self._partners.pop(name, None)) is not None:
            partner.publisher.close()

    def shift_time(self, step: float) -> None:
        """The network clock was set by ``step`` [s]."""
        for sender, (arrived, message) in self._received.items():
            self._received[sender] = arrived, dataclasses.replace(message, time=message.time + step)

    def _is_outdated(self, sender: str, message: Any) -> bool:
        """Whether a message is not newer than the last one of its sender. Outdated messages are counted."""
        is_outdated = sender in self._received and message.time <= self._received[sender][1].time
        self._counters.dropped += is_outdated
        return is_outdated

    def _recent(self, now: float, max_age: float) -> list[tuple[str, Any]]:
        """Senders whose last message arrived within the last ``max_age`` [s], and that message."""
        return [
            (sender, message)
            for sender, (arrived, message) in sorted(self._received.items())
            if now - arrived <= max_age
        ]

    def _add_partners(self, names: Iterable[str], now: float) -> None:
        """Add these actors as partners, to whom messages may be sent from own time ``now`` [s] on."""
        for name in names:
            if name not in self._partners:
                self._partners[name] = _Partner(self._bus.publisher(f"force/{name}/{self._name}"), now)

    def _send(self, partner: _Partner, payload: bytes, now: float, *, is_empty: bool) -> list[bytes]:
        """Send a message that is due. Returns the messages that were sent: this one, or none without a subscriber."""
        partner.due = max(partner.due, now - SEND_PERIOD) + SEND_PERIOD
        partner.is_active = not is_empty
        return [payload] if partner.publisher.put(payload) else []


def _recent_pose(actor: RemotePose, time: float) -> HumanUpdate | RobotUpdate | None:
    """The last pose of an actor at network ``time`` [s]; None if it is unknown or older than :data:`MAX_POSE_AGE`."""
    return actor.update if actor.update is not None and time - actor.update.time <= MAX_POSE_AGE else None


def limit(wrenches: dict[str, np.ndarray], hands: int, hand_force: float) -> tuple[dict[str, np.ndarray], bool]:
    """Scale the wrenches [6], by link, with a common factor to what ``hands`` hands of ``hand_force`` [N] can exert.

    Returns the wrenches, and whether they were reduced.
    """
    force = sum(float(np.linalg.norm(wrench[:3])) for wrench in wrenches.values())
    moment = sum(float(np.linalg.norm(wrench[3:])) for wrench in wrenches.values())
    excess = max(force, moment / HAND_LEVER) / (max(hands, 1) * hand_force)
    if excess <= 1.0:
        return wrenches, False
    return {link: wrench / excess for link, wrench in wrenches.items()}, True


def hands_within_reach(update: HumanUpdate, centre: np.ndarray | None) -> frozenset[str]:
    """Hands of a person that can touch a link with its centre of mass at ``centre`` [3] m; None: there is no link."""
    if centre is None:
        return frozenset()
    hands = {"left": update.pose.left, "right": update.pose.right}
    return frozenset(side for side, hand in hands.items() if np.linalg.norm(hand[:3] - centre) <= REACH)


def limit_by_hands(
    wrenches: dict[str, np.ndarray], reach: dict[str, frozenset[str]], hand_force: float
) -> tuple[dict[str, np.ndarray], bool]:
    """Reduce the wrenches [6], by link, to what the hands within ``reach`` of each link can exert, and all of these
    hands together. Returns the wrenches, and whether they were reduced."""
    is_limited = False
    for link, wrench in wrenches.items():
        reduced, is_reduced = limit({link: wrench}, len(reach[link]), hand_force)
        wrenches = wrenches | reduced
        is_limited = is_limited or is_reduced
    wrenches, is_reduced = limit(wrenches, len(frozenset().union(*reach.values())), hand_force)
    return wrenches, is_limited or is_reduced


@dataclasses.dataclass(slots=True)
class _Push:
    """Wrenches of the own hands on one robot since the last message."""

    total: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    ticks: int = 0


class WrenchSync(ForceSync):
    """Wrenches of the own hands on others' robots, and of others' hands on the own robot."""

    kind = WRENCHES

    def __init__(
        self,
        bus: Bus,
        name: str,
        counters: Counters,
        hand_force: float = HAND_FORCE,
        link_centre: LinkCentre = lambda _: None,
    ) -> None:
        """``hand_force`` [N]: limit of each hand. ``link_centre(link)``: centre of mass of a link of the own robot;
        without this function people cannot push the robot."""
        super().__init__(bus, name, counters)
        self._hand_force = hand_force
        self._link_centre = link_centre
        self._pushes: dict[str, _Push] = {}

    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Take the wrenches of a person, and count the ones that are not used.

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
        """Sum of the wrenches [6] of all people on each link of the own robot, by link name. The total is limited."""
        links: dict[str, np.ndarray] = {}
        for _, message in self._recent(now, WRENCH_MAX_AGE):
            for link, wrench in message.wrenches.items():
                links[link] = links.get(link, 0.0) + wrench
        links, is_limited = limit(links, 2 * MAX_PUSHING_PEOPLE, self._hand_force)
        self._counters.wrenches_limited += is_limited
        return links

    def remove_peer(self, name: str) -> None:
        """An actor has left."""
        super().remove_peer(name)
        self._pushes.pop(name, None)

    def publish(self, value: Mapping[str, dict[str, np.ndarray]] | None, now: float, time: float) -> list[bytes]:
        """Publish the wrenches of this step on others' robots, by robot and link. Returns the messages that were
        sent."""
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
    """Couplings of the own actor's contacts, and those of others to the same trees."""

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
        """``owner(tree)``: name of a tree's owner. ``peers``: names of the actors to which couplings may be sent."""
        super().__init__(bus, name, counters)
        self._model = model
        self._owner = owner
        self._peers = peers

    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Take the couplings of an actor.

        Couplings to trees that neither side owns, or farther away than an arm reaches, are counted and not used.
        Raises :class:`MessageError` if the message is invalid, or names bodies that there are not.
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
        """Actors whose couplings to a tree hold now."""
        return [
            name
            for name, theirs in self.current(now).items()
            if any(self._model.body_tree[coupling.body] == tree for coupling in theirs)
        ]

    def current(self, now: float) -> dict[str, tuple[Coupling, ...]]:
        """Couplings of others that hold now, by actor."""
        return {
            sender: message.couplings for sender, message in self._recent(now, COUPLING_MAX_AGE) if message.couplings
        }

    def publish(self, value: Iterable[Coupling] | None, now: float, time: float) -> list[bytes]:
        """Publish the couplings of this step. Returns the messages that were sent."""
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
        """Couplings by the peer that receives them: the owner of the tree or, for an own tree, each peer that touches
        it, too."""
        found: dict[str, list[Coupling]] = {}
        for coupling in couplings:
            tree = int(self._model.body_tree[coupling.body])
            owner = self._owner(tree)
            for name in self.partners(tree, now) if owner == self._name else [owner]:
                if name is not None and name in self._peers:
                    found.setdefault(name, []).append(coupling)
        return found


def _check_body(body: int, model: Model) -> None:
    """Raise :class:`MessageError` unless the index ``body`` exists and the body can be held: it is wood or a bunch."""
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
    """Make the syncs of all messages, except voices, that actor ``name`` and its ``peers`` send each other directly.

    ``owner(object_id)``: name of the actor that owns an object. For the other arguments see :class:`WrenchSync`.
    """
    bus.subscribe(f"force/{name}/*", KEEP_LAST_64)
    return (
        WrenchSync(bus, name, counters, hand_force, link_centre),
        CouplingSync(bus, name, model, counters, owner, peers),
    )
