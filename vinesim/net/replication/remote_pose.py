"""The pose of a peer between two messages: dead reckoning and error smoothing, or a jitter buffer."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.net.codec.control import Hello
from vinesim.net.codec.header import MessageError
from vinesim.net.replication import dead_reckoning
from vinesim.net.replication.jitter_buffer import JitterBuffer
from vinesim.net.transport.bus import Subscription
from vinesim.scene.values import POINT_NAMES, HumanUpdate, RobotUpdate

TELEPORT_DISTANCE = 1.0
"""Size of a correction above which it is shown at once instead of blended [m]. GUESSED."""

FAR_SAMPLE_PERIOD = 0.1
"""Time between two computations of the pose of a far peer, whose messages arrive every 200 ms [s]."""

_BASE = np.arange(3, 7)[None]
_HIPS = slice(7 * POINT_NAMES.index("hips"), 7 * POINT_NAMES.index("hips") + 3)
_TURNS = 7 * np.arange(len(POINT_NAMES))[:, None] + _BASE


class RemotePose:
    """A peer and the last pose that it has sent. Computes the pose to show at a given time."""

    def __init__(self, hello: Hello, buffer: float = 0.0) -> None:
        """``buffer``: delay of the :class:`JitterBuffer` [s]; 0: poses are extrapolated to the present."""
        self.hello = hello
        self._buffer = JitterBuffer(buffer)
        self.joints = hello.joints
        self.update: RobotUpdate | HumanUpdate | None = None
        self.near: list[Subscription] = []
        """Subscriptions to the layers of the peer's poses after the first one; empty while the peer is far."""
        self.place: np.ndarray | None = None
        """Last known position [3] m of the peer, from any of its poses; None: unknown."""
        self.placed_at = -1e9
        """Network time of :attr:`place` [s], as the peer states it."""
        self.moved_at = -1e9
        self._turns = _TURNS if hello.kind == "human" else _BASE
        """Indices [k, 4] of the quaternions in the flat array of a pose."""
        self._place = _HIPS if hello.kind == "human" else slice(3)
        """Slice of the flat array of a pose with the position that is compared with :data:`TELEPORT_DISTANCE`."""
        self._state = self._rate = self._correction = np.zeros(0)
        self._cached: RobotUpdate | HumanUpdate | None = None

    def receive(self, update: RobotUpdate | HumanUpdate, time: float) -> bool:
        """Store a pose of the peer that arrived at network ``time`` [s]. Returns whether the pose is newer than the
        last one.

        Raises :class:`MessageError` if the kind of pose or its number of joints does not fit the peer.
        """
        if (self.hello.kind == "human") != isinstance(update, HumanUpdate):
            raise MessageError(f"pose of a {type(update).__name__} by {update.actor!r}, which is a {self.hello.kind}")
        if update.time > time + dead_reckoning.MAX_CLOCK_SKEW:
            update = dataclasses.replace(update, time=time + dead_reckoning.MAX_CLOCK_SKEW)
        if self.update is not None and update.time <= self.update.time:
            return False
        if isinstance(update, RobotUpdate):
            if self.joints < 0:
                self.joints = len(update.position)
            if len(update.position) != self.joints:
                raise MessageError(f"pose of {update.actor!r} with {len(update.position)} joints, it has {self.joints}")
        shown = None if self.update is None else self._shown(time)
        self.put(update, time)
        self.update = update
        self._cached = None
        self._state, self._rate = _numbers(update)
        self._correction = np.zeros(0)
        if self._buffer.delay > 0.0:
            self._buffer_sample(update.time)
        elif shown is not None:
            here = self._shown(time)
            turn = shown[self._turns]
            shown[self._turns] = np.copysign(1.0, (turn * here[self._turns]).sum(1, keepdims=True)) * turn
            if float(np.linalg.norm((shown - here)[self._place])) < TELEPORT_DISTANCE:
                self._correction = shown - here
            self.moved_at = time
        return True

    def put(self, update: RobotUpdate | HumanUpdate, time: float) -> bool:
        """Store only the position in a pose of the peer that arrived at network ``time`` [s]. Returns False if the pose
        is older than the last one."""
        stated = min(update.time, time + dead_reckoning.MAX_CLOCK_SKEW)
        if stated < self.placed_at:
            return False
        self.place = update.base_q[:3]
        self.placed_at = stated
        return True

    def forget(self) -> None:
        """Forget the peer's poses, but not its position, because the peer is far away now."""
        for channel in self.near:
            channel.close()
        self.near.clear()
        self.update = self._cached = None
        self._buffer = JitterBuffer(self._buffer.delay)
        self._correction = np.zeros(0)

    def shift_time(self, step: float) -> None:
        """Shift all stored times, because the network clock was set by ``step`` [s].

        Of a jitter buffer only the newest pose is kept.
        """
        self.placed_at += step
        if self.update is not None:
            self.update = dataclasses.replace(self.update, time=self.update.time + step)
            self.moved_at += step
        if self._buffer.states:
            assert self.update is not None
            self._buffer = JitterBuffer(self._buffer.delay).insert(self.update.time, self._state, self._rate)

    def sample(self, time: float, now: float) -> RobotUpdate | HumanUpdate:
        """Returns the pose to show at network ``time`` [s], with own time ``now`` [s] as its time.

        The pose of a far peer is computed only every 100 ms.
        """
        if self._cached is None or self.near or not 0.0 <= now - self._cached.time < FAR_SAMPLE_PERIOD:
            self._cached = self._at(time, now)
        return self._cached

    def _at(self, time: float, now: float) -> RobotUpdate | HumanUpdate:
        """Compute the pose to show at network ``time`` [s], with own time ``now`` [s] as its time."""
        update = self.update
        shown = self._shown(time)
        assert update is not None
        moving = 1.0 if time - update.time <= dead_reckoning.MAX_EXTRAPOLATION else 0.0
        turn = shown[self._turns]
        shown[self._turns] = turn / np.sqrt((turn * turn).sum(1, keepdims=True))
        if self._buffer.delay > 0.0 and isinstance(update, RobotUpdate):
            rate = self._buffer.rate(time)
            twist = np.concatenate([rate[:3], update.base_qd[3:]])
            return RobotUpdate(update.actor, now, shown[:7], twist, shown[7:], rate[7:], update.lights)
        if isinstance(update, HumanUpdate):
            return HumanUpdate(
                update.actor,
                now,
                update.pose.with_points(shown.reshape(-1, 7)),
                update.velocity * moving,
                update.intention,
            )
        return dataclasses.replace(
            update,
            time=now,
            base_q=shown[:7],
            base_qd=update.base_qd * moving,
            position=shown[7:],
            velocity=update.velocity * moving,
        )

    def _buffer_sample(self, time: float) -> None:
        """Insert the newest pose into the jitter buffer.

        The signs of its quaternions are chosen such that they are nearest to those of the previous pose.
        """
        if self._buffer.states:
            before = self._buffer.states[-1]
            turns = self._turns
            side = np.copysign(1.0, (before[turns] * self._state[turns]).sum(1, keepdims=True))
            self._state[turns] *= side
            self._rate[turns] *= side
        self._buffer = self._buffer.insert(time, self._state, self._rate)

    def _shown(self, time: float) -> np.ndarray:
        """Returns the flat array of the pose to show at network ``time`` [s]. Its quaternions are not normalised."""
        assert self.update is not None
        if self._buffer.delay > 0.0:
            return self._buffer.sample(time).copy()
        shown = self._state + self._rate * dead_reckoning.clamp_age(time - self.update.time)
        if len(self._correction):
            shown += self._correction * dead_reckoning.blend_weight(time - self.moved_at)
        return shown


def _numbers(update: RobotUpdate | HumanUpdate) -> tuple[np.ndarray, np.ndarray]:
    """Returns a pose as a flat array, and its time derivative [1/s] as an equal array."""
    if isinstance(update, HumanUpdate):
        points = update.pose.points
        rate = np.concatenate(
            [update.velocity[:, :3], dead_reckoning.quaternion_rate(points[:, 3:], update.velocity[:, 3:])], 1
        )
        return points.ravel(), rate.ravel()
    spin = dead_reckoning.quaternion_rate(update.base_q[3:], update.base_qd[3:])
    return (
        np.concatenate([update.base_q, update.position]),
        np.concatenate([update.base_qd[:3], spin, update.velocity]),
    )
