"""Forces of two actors of different clients on one tree: each computed where its actor is, applied on both sides.

Key ``force/<owner>/<actor>``: the virtual couplings (:class:`vinesim.scene.values.Coupling`) of one actor to all trees
of one owner, 60 times a second while it touches them; then one empty message and silence. The owner replies with those
of its own contacts, for the copies of these trees. With one actor at a tree nothing is sent.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from vinesim.net.codec.control import Hello
from vinesim.net.codec.forces import MAX_COUPLINGS, CouplingMessage, decode_couplings, encode_couplings
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.messages import Counters
from vinesim.net.replication.hand_forces import SEND_PERIOD
from vinesim.net.transport.bus import Bus, Publisher
from vinesim.scene.model import Model
from vinesim.scene.values import Coupling, HumanUpdate, RobotUpdate

ARM_REACH = 2.5
"""Farthest anchor of a coupling from the base of its actor on the ground [m]: a long arm. GUESSED."""

MAX_AGE = 0.2
"""Couplings hold for so long after they arrived [s], unless newer ones do. They are springs, stable also when they are
old; over a link of 100 +- 40 ms that loses 4 %, messages come up to 0.15 s apart, and 0.1 s let the bunch jump."""

SPECTATOR = "spectator"


@dataclasses.dataclass(slots=True)
class _Partner:
    """An actor that touches a tree which the own actor touches, too."""

    publisher: Publisher
    due: float
    is_active: bool = False
    """The last message was not empty."""


class CouplingSync:
    """Couplings of the own actor's contacts, and those of others to the same trees."""

    def __init__(self, bus: Bus, name: str, model: Model, counters: Counters) -> None:
        """The bus must be subscribed to ``force/<name>/*`` already."""
        self._bus = bus
        self._name = name
        self._model = model
        self._counters = counters
        self._partners: dict[str, _Partner] = {}
        self._received: dict[str, tuple[float, CouplingMessage]] = {}

    def receive(
        self,
        payload: bytes,
        sender: Hello,
        pose: HumanUpdate | RobotUpdate | None,
        now: float,
        owner: Callable[[int], str | None],
    ) -> None:
        """Take a message of ``sender``, whose last pose is ``pose`` (None: unknown or too old).

        ``owner(tree)``: name of a tree's owner. Couplings to trees that neither side owns, or farther away than an arm
        reaches, are counted and not used.
        Raises :class:`MessageError` if the message is invalid, names bodies that there are not, or is a spectator's.
        """
        if sender.kind == SPECTATOR:
            raise MessageError(f"couplings by {sender.name!r}, a spectator")
        message = decode_couplings(payload)
        for coupling in message.couplings:
            _check_body(coupling.body, self._model)
        if sender.name in self._received and message.time <= self._received[sender.name][1].time:
            self._counters.dropped += 1
            return
        used = tuple(
            coupling
            for coupling in message.couplings
            if pose is not None
            and np.hypot(*(coupling.anchor[:2] - pose.base_q[:2])) <= ARM_REACH
            and owner(int(self._model.body_tree[coupling.body])) in (self._name, sender.name)
        )
        self._counters.couplings_refused += len(message.couplings) - len(used)
        self._received[sender.name] = now, CouplingMessage(message.time, used)

    def shift_time(self, step: float) -> None:
        """The network clock was set by ``step`` [s]."""
        for sender, (arrived, message) in self._received.items():
            self._received[sender] = arrived, dataclasses.replace(message, time=message.time + step)

    def partners(self, tree: int, now: float) -> list[str]:
        """Actors whose couplings to a tree hold now."""
        return [
            name
            for name, theirs in self.couplings(now).items()
            if any(self._model.body_tree[coupling.body] == tree for coupling in theirs)
        ]

    def couplings(self, now: float) -> dict[str, tuple[Coupling, ...]]:
        """Couplings of others that hold now, by actor."""
        return {
            sender: message.couplings
            for sender, (arrived, message) in sorted(self._received.items())
            if message.couplings and now - arrived <= MAX_AGE
        }

    def remove_peer(self, name: str) -> None:
        """An actor has left."""
        self._received.pop(name, None)
        if (partner := self._partners.pop(name, None)) is not None:
            partner.publisher.close()

    def publish(self, couplings: Mapping[str, Sequence[Coupling]], now: float, time: float) -> list[bytes]:
        """Publish the couplings of this step, by the actor that gets them; the messages that were sent."""
        sent = []
        for name in couplings.keys() - self._partners.keys():
            self._partners[name] = _Partner(self._bus.publisher(f"force/{name}/{self._name}"), now)
        for name, partner in sorted(self._partners.items()):
            mine = couplings.get(name, ())
            if not (mine or partner.is_active) or now < partner.due - 1e-9:
                continue
            payload = encode_couplings(CouplingMessage(time, tuple(mine[:MAX_COUPLINGS])))
            partner.due = max(partner.due, now - SEND_PERIOD) + SEND_PERIOD
            partner.is_active = bool(mine)
            if partner.publisher.put(payload):
                sent.append(payload)
        return sent


def _check_body(body: int, model: Model) -> None:
    """Raise :class:`MessageError` unless there is such a body and it can be held: wood or a bunch."""
    if body >= len(model.body_tree):
        raise MessageError(f"a coupling to body {body}; there are {len(model.body_tree)}")
    tree = int(model.body_tree[body])
    if body - int(model.tree_first[tree]) >= int(model.tree_core[tree]):
        raise MessageError(f"a coupling to body {body}, a berry cluster")
