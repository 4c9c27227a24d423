"""State that the two halves of replication, receiver and sender, share for one actor."""

from __future__ import annotations

import numpy as np

from vinesim.net.codec.control import Description, Hello
from vinesim.net.codec.messages import Counters, Traffic
from vinesim.net.replication import authority, interest
from vinesim.net.replication.cell_channels import CellChannels, TreeChannels
from vinesim.net.replication.direct_messages import LinkCentre, MessageSync, make_syncs
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.ownership import Ownership
from vinesim.net.replication.peers import PeerRegistry
from vinesim.net.replication.retained_sync import RetainedSync
from vinesim.net.replication.streams import ObjectStream, TreeStream, object_counts
from vinesim.net.replication.voices import VoiceSync
from vinesim.net.transport.bus import Bus, Publisher
from vinesim.scene.ids import is_tree
from vinesim.scene.model import Model

SPECTATOR = "spectator"
"""Kind of actor that owns no objects and publishes only its pose and its voice."""


class ReplicationState:
    """State of replication of one actor: its peers, the claims on objects, the streams of states, the retained records,
    and the channels (subscriptions and publishers) of cells."""

    def __init__(
        self,
        bus: Bus,
        hello: Hello,
        model: Model,
        *,
        interest_radius: float,
        jitter_buffer: float,
        hand_force: float,
        link_centre: LinkCentre,
        descriptions: dict[str, Description] | None = None,
    ) -> None:
        self.bus = bus
        self.hello = hello
        self.model = model
        self.cells = CellChannels(bus, interest_radius)
        self.tree_channels = TreeChannels(bus, interest_radius)
        self.counters = Counters()
        self.peers = PeerRegistry(bus, hello, self.counters, jitter_buffer, descriptions)
        self.ownership = Ownership(hello.name, self.peers.known)
        self.voices = VoiceSync(bus, hello, self.counters)
        direct = make_syncs(
            bus,
            hello.name,
            model,
            self.counters,
            owner=self.ownership.owner,
            peers=self.peers.known,
            hand_force=hand_force,
            link_centre=link_centre,
        )
        self.syncs: dict[int, MessageSync] = {sync.kind: sync for sync in (*direct, self.voices)}
        """The senders and receivers of direct messages between actors
        (:class:`~vinesim.net.replication.direct_messages.MessageSync`), by kind of message."""
        self.siblings: tuple[ReplicationState, ...] = ()
        """States of replication of the other actors of the same client."""
        self.retained = RetainedSync(bus, self.counters)
        self.tree_stream = TreeStream(model)
        self.object_stream = ObjectStream()
        self.object_counts = object_counts(model)
        """Number of objects of each kind in the scene."""

    @property
    def is_spectator(self) -> bool:
        """Whether this actor is a spectator, which owns no objects."""
        return self.hello.kind == SPECTATOR

    def position_of(self, object_id: int) -> np.ndarray:
        """Returns the last known position [3] m of an object, for a tree its centre at rest."""
        return self.tree_stream.middle[object_id] if is_tree(object_id) else self.object_stream.position(object_id)

    def cell_of(self, object_id: int) -> Cell | None:
        """Returns the cell of the ground under which an object is published; None if the object was never published."""
        return self.tree_stream.cell[object_id] if is_tree(object_id) else self.object_stream.cell(object_id)

    def owner_candidates(self) -> dict[str, np.ndarray]:
        """Returns the positions [3] m of all actors that can own objects, by name: all but spectators."""
        known = self.peers.known
        positions = self.peers.positions()
        positions = {name: place for name, place in positions.items() if known[name].hello.kind != SPECTATOR}
        for state in (self, *self.siblings):
            if state.cells.centre is not None and not state.is_spectator:
                positions[state.hello.name] = state.cells.position
        return positions

    def successor_of(self, object_id: int) -> str:
        """Returns the name of the actor that takes over an object whose owner has left."""
        return authority.choose_successor(self.position_of(object_id), self.owner_candidates())

    def shift_time(self, step: float) -> None:
        """Shift all stored network times, because the network clock was set by ``step`` [s]."""
        for peer in self.peers.known.values():
            peer.shift_time(step)
        self.ownership.shift_time(step)
        self.object_stream.shift_time(step)
        for sync in self.syncs.values():
            sync.shift_time(step)

    def count_listeners(self, positions: np.ndarray, distance: float | None = None) -> np.ndarray:
        """Returns the number of peers near each position [k, 3] m: [k] int.

        ``distance`` [m]: within which a peer is near; None: the interest radius.
        """
        others = self.peers.near_positions()
        return interest.count_listeners(positions, others, distance or self.cells.interest_radius)


def put_counted(publisher: Publisher, payload: bytes, traffic: Traffic) -> bool:
    """Publish a message and count it in ``traffic``. Returns False, and does nothing, if there is no subscriber."""
    if not publisher.put(payload):
        return False
    traffic.count_out(payload)
    return True
