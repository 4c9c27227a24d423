"""A person whose head and hands are tracked: by a headset and its controllers, or by mouse and keys."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable

import numpy as np

from vinesim.avatar.gestures import OPEN_HAND, FingerBend, Gestures, shears_grip
from vinesim.avatar.leg_estimator import LegEstimator
from vinesim.core import frames
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import HumanPose

MAX_PERIOD = 0.1
"""Longest time over which motion between two inputs is interpolated [s]. GUESSED."""
MAX_MOTION = 0.5
"""Distance that a head may move between two inputs [m]. Beyond it the head counts as teleported, and its motion is not
interpolated. The physics has an equal rule (``PhysicsParameters.teleport_distance``)."""
_SMOOTHING = 0.2
"""Weight of the newest interval in the running mean of the time between inputs [1]."""


@dataclasses.dataclass(frozen=True, slots=True)
class TrackedPoints:
    """One input from the tracking device: poses of the person's head and hands."""

    head: np.ndarray
    """Pose [7] m, 1 in the world of the point between the eyes, x forward, z up."""
    left: np.ndarray | None = None
    """Pose [7] of the left palm as in :class:`HumanPose`; None: the hand hangs down."""
    right: np.ndarray | None = None
    closed: tuple[bool, bool] = (False, False)
    """Whether the left and the right hand are closed."""
    fingers: tuple[FingerBend, FingerBend] = (OPEN_HAND, OPEN_HAND)
    shears: tuple[bool, bool] = (False, False)
    """Whether the left and the right hand hold shears; their fingers then close around the shears."""


class TrackedHuman:
    """A pose source for :class:`vinesim.avatar.local_human.LocalHuman` that follows tracked head and hands.

    Inputs arrive at the rate of a display, 60 to 90 Hz, while steps run at 100 Hz. Between inputs the points move at
    constant velocity, so that they have the person's velocities. This delays them by one interval between inputs.
    """

    def __init__(
        self,
        root: np.ndarray,
        height: float = 1.75,
        dt: float = 0.01,
        clock: Callable[[], float] | None = None,
        gestures: Gestures | None = None,
        terrain: Terrain | None = None,
    ) -> None:
        """``root`` [7]: pose at which the person stands until the first input. ``height``: of the person [m].
        ``clock``: function that returns a time [s], by which the intervals between inputs are measured. ``terrain``:
        uneven ground, on which the person stands.

        Without a ``clock`` the intervals are counted in steps of ``dt``.
        """
        self.dt = dt
        self.gestures = gestures or Gestures()
        """The finger poses that this person can make."""
        self.pose = standing_pose(root, height)
        self._below_head = frames.compose(frames.inverse(self.pose.head), np.stack([self.pose.left, self.pose.right]))
        """Poses [2, 7] of hands that hang down, in the upright frame of the head."""
        self._legs = LegEstimator(self.pose, dt, terrain)
        self._terrain = terrain
        self._lock = threading.Lock()
        self._next: TrackedPoints | None = None
        self._points: TrackedPoints | None = None
        self._clock = clock
        self._steps = 0
        self._input_at = 0.0
        self._period = 2.0 * dt
        self._start = np.stack([self.pose.head, self.pose.left, self.pose.right])
        self._goal = self._start.copy()
        self._share = 1.0

    def take(self, points: TrackedPoints) -> None:
        """Set the newest input; may be called from any thread."""
        with self._lock:
            self._next = points

    def __call__(self, time: float) -> HumanPose:
        """Advance by one step; returns the pose at its end."""
        self._steps += 1
        with self._lock:
            points = self._next
            self._next = None
        if points is not None:
            self._begin(points)
        self._share = min(1.0, self._share + self.dt / self._period)
        head, left, right = _between(self._start, self._goal, self._share)
        hips, left_foot, right_foot = self._legs.update(head)
        floor = self.pose.root[2] if self._terrain is None else self._terrain.height(*hips[:2])
        root = frames.pose(np.array([*hips[:2], floor]), frames.from_yaw(frames.to_yaw(head[3:])))
        told = self._points or TrackedPoints(head)
        fingers = [
            shears_grip(closed=closed) if shears else bend
            for shears, closed, bend in zip(told.shears, told.closed, told.fingers, strict=True)
        ]
        self.pose = HumanPose(
            root,
            head,
            left,
            right,
            hips,
            left_foot,
            right_foot,
            *told.closed,
            left_fingers=fingers[0],
            right_fingers=fingers[1],
            left_shears=told.shears[0],
            right_shears=told.shears[1],
        )
        return self.pose

    def _begin(self, points: TrackedPoints) -> None:
        """Start to move from the current pose to the pose of an input."""
        now = self._steps * self.dt if self._clock is None else self._clock()
        if self._points is not None:
            interval = float(np.clip(now - self._input_at, self.dt, MAX_PERIOD))
            self._period += _SMOOTHING * (interval - self._period)
        self._input_at = now
        self._points = points
        self._start = np.stack([self.pose.head, self.pose.left, self.pose.right])
        upright = frames.pose(points.head[:3], frames.from_yaw(frames.to_yaw(points.head[3:])))
        hanging = frames.compose(upright, self._below_head)
        left, right = (hanging[k] if hand is None else hand for k, hand in enumerate((points.left, points.right)))
        self._goal = np.stack([points.head, left, right]).astype(float)
        self._share = 0.0
        if np.linalg.norm(self._goal[0, :3] - self._start[0, :3]) > MAX_MOTION:
            self._start = self._goal
            self._legs.stand(self._goal[0])


def _between(start: np.ndarray, goal: np.ndarray, share: float) -> np.ndarray:
    """Returns poses [k, 7] interpolated between ``start`` (``share`` 0) and ``goal`` (``share`` 1)."""
    way = frames.log(frames.multiply(frames.conjugate(start[:, 3:]), goal[:, 3:]))
    turn = frames.multiply(start[:, 3:], frames.exp(share * way))
    return np.concatenate([start[:, :3] + share * (goal[:, :3] - start[:, :3]), turn], 1)
