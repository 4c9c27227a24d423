"""Replication of one actor's world: :meth:`Replicator.receive` before a step of the physics, :meth:`Replicator.send`
after it.

The decisions are pure functions in other modules: who owns an object (:mod:`~vinesim.net.replication.authority`), who
is near (:mod:`~vinesim.net.replication.interest`), whether copies are wrong
(:mod:`~vinesim.net.replication.dead_reckoning`).

Keys: :data:`vinesim.net.codec.messages.FAMILIES`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from vinesim.net.codec.control import Hello, RetainedRecord
from vinesim.net.codec.messages import MESSAGES, Counters
from vinesim.net.pace import PaceReport
from vinesim.net.replication import interest
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.clock_sync import STEP_THRESHOLD
from vinesim.net.replication.direct_messages import HAND_FORCE, LinkCentre
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

    ``now`` is any clock of the client in seconds; own time, which runs at the world's real-time factor, and its offset
    to the server's clock are kept inside. Objects are trees, boxes and free bunches, by
    :func:`vinesim.scene.ids.object_id`.
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
    ) -> None:
        """``interest_radius`` [m]: peers nearer than this to an object receive its states; at most 5 m.

        ``jitter_buffer`` [s]: delay with which poses of peers are shown (:mod:`vinesim.net.replication.jitter_buffer`).
        ``hand_force`` [N]: limit of each hand of a peer that pushes this robot. ``link_centre(link)``: centre of mass
        [3] m of a link of this robot, None for a link that it has not; without it people of other clients push nothing.
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
        )
        self._receiver = Receiver(self._state)
        self._sender = Sender(self._state)
        self.step_time: Callable[[], float] | None = None
        """Returns the world's time at the present step [s], for a client whose steps follow the world's clock. All
        states that are sent and shown in a step have this time, however late the step is. None: they have the time of
        the call."""
        self.received_at = 0.0
        """Own time of the last :meth:`receive` [s], to which the states in its inbox belong."""
        self._last_sent = -1e9
        self._offset = self.offset

    @property
    def counters(self) -> Counters:
        """Traffic and rejected messages since the start."""
        return self._state.counters

    @property
    def voices(self) -> VoiceSync:
        """The sender and receiver of voices of this actor."""
        return self._state.voices

    @property
    def interest_radius(self) -> float:
        """Interest radius [m]."""
        return self._state.cells.interest_radius

    def share_client(self, siblings: Iterable[Replicator]) -> None:
        """Set the other actors of the same client. They share its simulation, so no messages are exchanged with them,
        and none of the objects that they own is taken over."""
        states = tuple(sibling._state for sibling in siblings)
        self._state.siblings = states
        self._state.ownership.siblings = tuple(state.ownership for state in states)
        self._state.peers.local_actors = {state.hello.name for state in states}

    def owner(self, object_id: int) -> str | None:
        """Name of the live actor that owns an object now (perhaps this one), or None."""
        return self._state.ownership.owner(object_id)

    def is_present(self, name: str) -> bool:
        """Whether an actor is in this world now, as a peer or before its hello has arrived."""
        return self._state.peers.may_join(name)

    def claim(self, object_id: int) -> Claim:
        """The greatest claim on an object that was made or received."""
        return self._state.ownership.claim(object_id)

    def record(self, object_id: int) -> RetainedRecord | None:
        """The retained record of an object, if any."""
        return self._state.retained.state.get(object_id)

    @property
    def owned(self) -> frozenset[int]:
        """Objects that this actor owns."""
        return frozenset(self._state.ownership.owned)

    @property
    def known(self) -> frozenset[int]:
        """Objects on which any claim was made or received."""
        return frozenset(self._state.ownership.known)

    @property
    def peers(self) -> dict[str, Hello]:
        """The hello of each peer that is in this world now."""
        return {name: peer.hello for name, peer in self._state.peers.known.items()}

    def peer_positions(self) -> list[np.ndarray]:
        """Positions [3] m of the peers whose pose is known, including spectators. They may receive object states."""
        return list(self._state.peers.positions().values())

    @property
    def offset(self) -> float:
        """Network time minus the client's own time [s]."""
        return self._state.peers.clock.offset

    @property
    def real_time_factor(self) -> float:
        """Real-time factor of the world; 1 unless a server reports another."""
        return self._state.peers.clock.factor

    @property
    def pace_cause(self) -> str:
        """Client that limits the world's real-time factor, and the cause: "picker: sensors". Empty if none does."""
        return self._state.peers.clock.cause

    def report_pace(self, report: Callable[[], PaceReport | None]) -> None:
        """Send the value of ``report()``, how fast this client can follow, to the server with every ping."""
        self._state.peers.clock.report = report

    def keep_clock(self, now: float) -> None:
        """Ping the server's clock when due, and take its replies, while no step is made. So network time advances, and
        the server knows that this client lives."""
        self._state.peers.keep_clock(now)
        self._follow_clock()

    def network_time(self, now: float) -> float:
        """Network time [s] at the time ``now`` [s] of the client's clock."""
        return self._state.peers.clock.own(now) + self.offset

    def is_clock_current(self, now: float) -> bool:
        """Whether the server has told the world's time so recently that network time at ``now`` [s] is right."""
        return self._state.peers.clock.is_current(now)

    @property
    def has_clock(self) -> bool:
        """Whether a server has reported its clock, so that network time is the server's time."""
        return bool(self._state.peers.clock.estimate.pings)

    @property
    def round_trip(self) -> float | None:
        """Shortest of the last pings to the server and back [s]; None without a reply."""
        return self._state.peers.clock.round_trip

    def receive(self, now: float) -> Inbox:
        """Everything that arrived since the last call.

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
    ) -> list[TreeUpdate]:
        """Publish one step. Returns the states of trees at rest that were sent, quantised as all copies hold them.

        ``pose``: of this actor; its ``time`` is replaced. A spectator passes its viewpoint, without joints.
        ``read(object_id)``: joints ([n, 4], [n, 3] rad/s) of a tree, pose [7] and velocity [6] of another object;
        called only for objects that a peer may need.
        ``touched``: objects in contact with this actor; boxes and bunches only while they move in their parent's frame.
        ``moving``: objects that move by themselves; trees and boxes of other owners are ignored.
        ``grabbed``: objects that this actor grabbed, picked or cut in this step. ``detached``: the objects among them
        that left their plant. ``detached_roots(tree)``: bodies that were cut off a tree.
        ``pose_on_support(object_id)``: parent frame and pose [7] in it of an object at rest.
        ``is_changed(tree)``: picks or cuts have changed the tree, so that its state at rest is retained.
        ``has_body(object_id)``: whether the own simulation moves a box or a bunch; others are not read.
        ``messages``: values that this actor sends to others in this step, by kind of message:
        :meth:`vinesim.net.replication.direct_messages.MessageSync.publish`.
        ``carried_on``: objects at rest on this actor that it has carried so far that their records are published again,
        with their present place.
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
            )
        )

    def _own_time(self, now: float) -> float:
        """Own time [s] of the present step, which is made at the time ``now`` [s] of the client's clock."""
        if self.step_time is None or not self.has_clock:
            return self._state.peers.clock.own(now)
        return self.step_time() - self.offset

    def _follow_clock(self) -> None:
        """Shift all times of peers and objects when the network clock was set, as by a server that was restarted.

        Otherwise everything that arrives after a step back would count as older than what is known.
        """
        step = self.offset - self._offset
        self._offset = self.offset
        if abs(step) >= STEP_THRESHOLD:
            self._last_sent += step
            self._state.shift_time(step)
