"""Replication of the world for one actor: :meth:`Replicator.receive` is called before a step of the physics, and
:meth:`Replicator.send` after it.

Pure functions in other modules decide who owns an object (:mod:`~vinesim.net.replication.authority`), which actors are
near (:mod:`~vinesim.net.replication.interest`), and whether copies are wrong
(:mod:`~vinesim.net.replication.dead_reckoning`).

Keys: :data:`vinesim.net.codec.messages.FAMILIES`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from vinesim.net.codec.control import Description, Hello, RetainedRecord
from vinesim.net.codec.messages import MESSAGES, Counters
from vinesim.net.pace import PaceReport
from vinesim.net.replication import interest
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.clock_sync import STEP_THRESHOLD
from vinesim.net.replication.direct_messages import HAND_FORCE, LinkCentre
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.receiver import Inbox, Receiver
from vinesim.net.replication.replication_state import ReplicationState
from vinesim.net.replication.sender import LocalStep, Sender
from vinesim.net.replication.streams import NO_ROOTS, DetachedRoots, StateReader
from vinesim.net.replication.voices import VoiceSync
from vinesim.net.transport.bus import Bus
from vinesim.scene.model import Model
from vinesim.scene.values import HumanUpdate, RobotUpdate, TreeUpdate


class Replicator:
    """Replicates the objects of a scene for one actor. Call :meth:`receive` and :meth:`send` once a step, from one
    thread.

    Arguments ``now`` are times [s] of any one clock of the client. From them follow own time, which runs at the world's
    real-time factor, and network time, which is own time plus :attr:`offset`. Objects are trees, boxes and free
    bunches, by :func:`vinesim.scene.ids.object_id`.
    """

    def __init__(
        self,
        bus: Bus,
        hello: Hello,
        model: Model,
        *,
        interest_radius: float = interest.INTEREST_RADIUS,
        jitter_buffer: float = 0.0,
        hand_force: float = HAND_FORCE,
        link_centre: LinkCentre = lambda _: None,
        descriptions: dict[str, Description] | None = None,
    ) -> None:
        """Join the world of ``bus`` with the actor that ``hello`` describes.

        ``interest_radius``: distance from an object within which peers receive its states [m], at most 5 m.
        ``jitter_buffer``: delay with which poses of peers are shown [s] (:mod:`vinesim.net.replication.jitter_buffer`).
        ``hand_force``: largest force of each hand of a person that pushes this robot [N]. ``link_centre(link)``: centre
        of mass [3] m of a link of this robot, None if the link does not exist. Without this function people of other
        clients cannot push the robot. ``descriptions``: known descriptions of robots by digest, which the actors of one
        client share.

        Raises ValueError if the hello has another name than the bus.
        """
        if hello.name != bus.name:
            raise ValueError(f"greeting of {hello.name!r} on the bus of {bus.name!r}: one actor has one name")
        self.bus = bus
        self.hello = hello
        self.model = model
        self._state = ReplicationState(
            bus,
            hello,
            model,
            interest_radius=interest_radius,
            jitter_buffer=jitter_buffer,
            hand_force=hand_force,
            link_centre=link_centre,
            descriptions=descriptions,
        )
        self._receiver = Receiver(self._state)
        self._sender = Sender(self._state)
        self.step_time: Callable[[], float] | None = None
        """Function that returns the world's time of the present step [s], for a client whose steps follow that time.

        All states that are sent and shown in a step have this time, however late the step is. None: they have the time
        of the call."""
        self.received_at = 0.0
        """Own time of the last :meth:`receive` [s], which is the time of the states in the inbox."""
        self._last_sent = -1e9
        self._offset = self.offset

    @property
    def counters(self) -> Counters:
        """Counters of traffic and of rejected messages since the start."""
        return self._state.counters

    @property
    def voices(self) -> VoiceSync:
        """Sender and receiver of voices for this actor."""
        return self._state.voices

    @property
    def interest_radius(self) -> float:
        """Distance from an object within which peers receive its states [m]."""
        return self._state.cells.interest_radius

    def share_client(self, siblings: Iterable[Replicator]) -> None:
        """Set the replicators of the other actors of the same client.

        Actors of one client share its simulation. So they exchange no messages with each other.
        """
        states = tuple(sibling._state for sibling in siblings)
        self._state.siblings = states
        self._state.ownership.siblings = tuple(state.ownership for state in states)
        self._state.peers.local_actors = {state.hello.name for state in states}

    def owner(self, object_id: int) -> str | None:
        """Returns the name of the live actor that owns an object now, which may be this actor, or None."""
        return self._state.ownership.owner(object_id)

    def is_present(self, name: str) -> bool:
        """Whether an actor is live in this world, even if its hello has not arrived, and was not rejected."""
        return self._state.peers.may_join(name)

    def claim(self, object_id: int) -> Claim:
        """Returns the greatest claim on an object that this actor has made or received."""
        return self._state.ownership.claim(object_id)

    def record(self, object_id: int) -> RetainedRecord | None:
        """Returns the retained record of an object, or None."""
        return self._state.retained.state.get(object_id)

    @property
    def record_window(self) -> frozenset[Cell]:
        """Cells whose retained records this actor receives now. Of other cells it may know records that are no longer
        valid."""
        return self._state.retained.window

    def record_cell(self, object_id: int) -> Cell | None:
        """Returns the cell of the retained record of an object, or None."""
        return self._state.retained.state.cell_of(object_id)

    @property
    def owned(self) -> frozenset[int]:
        """Ids of the objects that this actor owns."""
        return frozenset(self._state.ownership.owned)

    @property
    def known(self) -> frozenset[int]:
        """Ids of the objects on which this actor has made or received a claim."""
        return frozenset(self._state.ownership.known)

    @property
    def peers(self) -> dict[str, Hello]:
        """Hellos of all peers that are in this world now, by name."""
        return {name: peer.hello for name, peer in self._state.peers.known.items()}

    def is_peer(self, name: str) -> bool:
        """Whether an actor is a peer in this world now."""
        return name in self._state.peers.known

    def peer_positions(self) -> dict[str, np.ndarray]:
        """Returns the last known positions [3] m of all peers, including spectators and far ones, by name."""
        return self._state.peers.positions()

    def near_positions(self) -> np.ndarray:
        """Returns the positions [k, 3] m of the peers that are near, including spectators."""
        return self._state.peers.near_positions()

    def describe(self, name: str) -> Hello | None:
        """Returns the hello of a peer with its URDF; None: it is not known yet, and was queried.

        Raises KeyError if ``name`` is no peer.
        """
        return self._state.peers.describe(name, self.received_at)

    @property
    def offset(self) -> float:
        """Network time minus own time [s]."""
        return self._state.peers.clock.offset

    @property
    def real_time_factor(self) -> float:
        """Real-time factor of the world, as reported by the server; 1 without a server."""
        return self._state.peers.clock.factor

    @property
    def pace_cause(self) -> str:
        """Client that limits the world's real-time factor, and the cause, like "picker: sensors"; empty if none
        does."""
        return self._state.peers.clock.cause

    def report_pace(self, report: Callable[[], PaceReport | None]) -> None:
        """Send the value of ``report()``, which is how fast this client can follow, to the server with every ping."""
        self._state.peers.clock.report = report

    def keep_clock(self, now: float) -> None:
        """Send due pings to the server's clock, and take the replies, between steps that are far apart.

        So network time advances, and the server knows that this client is still running.
        """
        self._state.peers.keep_clock(now)
        self._follow_clock()

    def network_time(self, now: float) -> float:
        """Returns network time [s] at the time ``now`` [s] of the client's clock."""
        return self._state.peers.clock.own(now) + self.offset

    def is_clock_current(self, now: float) -> bool:
        """Whether the server has answered a ping so recently that network time at ``now`` [s] is reliable."""
        return self._state.peers.clock.is_current(now)

    @property
    def has_clock(self) -> bool:
        """Whether a server has answered a ping, so that network time is the server's time."""
        return bool(self._state.peers.clock.estimate.pings)

    @property
    def round_trip(self) -> float | None:
        """Shortest round trip of the last pings to the server [s]; None before the first reply."""
        return self._state.peers.clock.round_trip

    def receive(self, now: float) -> Inbox:
        """Apply everything that arrived since the last call, and return the inbox for the step at ``now`` [s].

        Raises :class:`vinesim.net.replication.peers.WorldMismatch` if this actor does not belong to the world.
        """
        self._state.peers.clock.advance(now)
        self._follow_clock()
        now = self.received_at = self._own_time(now)
        return self._receiver.receive(now, self.offset)

    def send(
        self,
        now: float,
        pose: RobotUpdate | HumanUpdate,
        *,
        read: StateReader,
        touched: Iterable[int] = (),
        moving: Iterable[int] = (),
        grabbed: Iterable[int] = (),
        detached: Iterable[int] = (),
        detached_roots: Callable[[int], DetachedRoots] = lambda _: NO_ROOTS,
        pose_on_support: Callable[[int], tuple[str, np.ndarray]] | None = None,
        is_changed: Callable[[int], bool] = lambda _: False,
        has_body: Callable[[int], bool] = lambda _: True,
        messages: Mapping[int, Any] = MappingProxyType({}),
        carried_on: Iterable[int] = (),
        stalk_of: Callable[[int], tuple[int, int] | None] = lambda _: None,
        stumps_of: Callable[[int], tuple[tuple[int, int, int], ...]] = lambda _: (),
        wood_of: Callable[[int], bytes] = lambda _: b"",
        fruit_of: Callable[[int], tuple[float, float] | None] = lambda _: None,
        passed_by: Callable[[int], tuple[int, ...]] = lambda _: (),
    ) -> list[TreeUpdate]:
        """Publish the results of one step. Returns the states of trees at rest that were sent, as all receivers decode
        them.

        * ``pose``: pose of this actor. Its ``time`` is replaced. For a spectator, the viewpoint without joints.
        * ``read(object_id)``: function that returns the joints ([n, 4], [n, 3] rad/s) of a tree, or pose [7] and
          velocity [6] of another object. It is called only for objects that a peer may need.
        * ``touched``: objects in contact with this actor. Boxes and bunches only while they move in their parent's
          frame.
        * ``moving``: objects that move without contact. Trees and boxes of other owners are ignored.
        * ``grabbed``: objects that this actor has grabbed, picked or cut in this step.
        * ``detached``: objects of ``grabbed`` that have left their plant.
        * ``detached_roots(tree)``: function that returns the bodies that were cut off a tree.
        * ``pose_on_support(object_id)``: function that returns the parent frame of an object at rest, and the pose [7]
          in this frame.
        * ``is_changed(tree)``: whether picks or cuts have changed a tree, so that its state at rest is retained.
        * ``has_body(object_id)``: whether the own simulation moves a box or a bunch. Others are not read.
        * ``messages``: values of direct messages in this step, by kind of message
          (:meth:`vinesim.net.replication.direct_messages.MessageSync.publish`).
        * ``carried_on``: objects at rest on this actor that it has carried so far that their records shall be published
          again, with the present place.
        * ``stalk_of(object_id)``: where a bunch was cut in its peduncle
          (:attr:`vinesim.net.codec.control.RetainedRecord.stalk`).
        * ``stumps_of(tree)``: the stumps of a tree (:attr:`vinesim.net.codec.control.RetainedRecord.stumps`).
        * ``wood_of(tree)``: how the wood and ties of a tree have given
          (:attr:`vinesim.net.codec.control.RetainedRecord.wood`).
        * ``fruit_of(object_id)``: the berries that a bunch has lost
          (:attr:`vinesim.net.codec.control.RetainedRecord.fruit`).
        * ``passed_by(object_id)``: the trees through which a bunch passes
          (:attr:`vinesim.net.codec.control.RetainedRecord.passed`).
        """
        state = self._state
        self._follow_clock()
        now = self._own_time(now)
        time = self._last_sent = max(now + self.offset, self._last_sent + 1e-6)
        state.cells.position = np.asarray(pose.base_q[:3], float)
        state.peers.publish_pose(pose, now, time)
        for kind, sync in state.syncs.items():
            for payload in sync.publish(messages.get(kind), now, time):
                state.counters.of(MESSAGES[kind].families[0]).count_out(payload)
        touched, moving, grabbed, detached, carried_on = (
            {int(object_id) for object_id in ids} for ids in (touched, moving, grabbed, detached, carried_on)
        )
        return self._sender.send(
            LocalStep(
                now,
                time,
                touched,
                moving,
                grabbed,
                detached,
                read,
                detached_roots,
                pose_on_support,
                is_changed,
                has_body,
                carried_on,
                stalk_of,
                stumps_of,
                wood_of,
                fruit_of,
                passed_by,
            )
        )

    def _own_time(self, now: float) -> float:
        """Returns own time [s] of the present step, which is called at the time ``now`` [s] of the client's clock."""
        if self.step_time is None or not self.has_clock:
            return self._state.peers.clock.own(now)
        return self.step_time() - self.offset

    def _follow_clock(self) -> None:
        """Shift all stored times of peers and objects if network time was set, as after a restart of the server.

        Without this, after network time was set back, all states that arrive would count as older than the stored ones.
        """
        step = self.offset - self._offset
        self._offset = self.offset
        if abs(step) >= STEP_THRESHOLD:
            self._last_sent += step
            self._state.shift_time(step)
