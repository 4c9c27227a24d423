"""Estimates the hips and feet of a person whose head and hands alone are tracked."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import HumanPose

STEP_LENGTH = 0.28
"""Distance of a foot from its place under the hips, beyond which the foot makes a step [m]. GUESSED."""
SWING_TIME = 0.35
"""[s] Duration of a step. GUESSED."""
LIFT_HEIGHT = 0.08
"""Height to which a foot is lifted in a step [m]. GUESSED."""
VELOCITY_TIME = 0.1
"""Time over which the velocity of the head is averaged, which says where a foot shall land [s]. GUESSED."""
MAX_FOOT_SPEED = 5.0
"""Largest horizontal speed of a foot [m/s]: about that of the swinging foot of a person who walks fast. GUESSED."""
MAX_FOOT_TURN = 10.0
"""Largest angular velocity of a foot about the vertical [rad/s]. GUESSED."""


class LegEstimator:
    """Places the hips below the head, and lets a foot step when the body has moved away from it.

    The feet depend on past motion: two estimators with the same head pose may give different legs.
    """

    def __init__(self, pose: HumanPose, dt: float = 0.01, terrain: Terrain | None = None) -> None:
        """``pose``: pose at the start; ``dt`` [s]: time between calls of :meth:`update`; ``terrain``: uneven ground, on
        which the feet stand."""
        self.dt = dt
        self._terrain = terrain
        self._below_head = frames.compose(
            frames.inverse(_upright(pose.head)), np.stack([pose.hips, pose.left_foot, pose.right_foot])
        )
        self._feet = np.stack([pose.left_foot, pose.right_foot]).astype(float)
        self._swing = [1.0, 1.0]
        """Phase of each foot's step, 0 to 1 [foot]."""
        self._head = np.asarray(pose.head[:3], float).copy()
        self._velocity = np.zeros(2)
        """Horizontal velocity [2] m/s of the head, averaged."""

    def stand(self, head: np.ndarray) -> None:
        """Put both feet under the head pose ``head`` [7] at once, for a person who was moved there without walking."""
        there = frames.compose(_upright(head), self._below_head)
        self._feet = there[1:]
        for foot in (0, 1):
            self._feet[foot, 2] += self._rise(there[1 + foot], there[0])
        self._swing = [1.0, 1.0]
        self._head = np.asarray(head[:3], float).copy()
        self._velocity = np.zeros(2)

    def update(self, head: np.ndarray) -> np.ndarray:
        """Advance by ``dt`` to the head pose ``head`` [7]; returns the poses [3, 7] of the hips and both feet."""
        there = frames.compose(_upright(head), self._below_head)
        velocity = (head[:2] - self._head[:2]) / self.dt
        self._velocity += min(1.0, self.dt / VELOCITY_TIME) * (velocity - self._velocity)
        self._head = np.asarray(head[:3], float).copy()
        ahead = self._velocity * SWING_TIME
        ahead *= min(1.0, 1.5 * STEP_LENGTH / max(float(np.linalg.norm(ahead)), 1e-9))
        far = [float(np.linalg.norm(self._feet[foot, :2] - there[1 + foot, :2])) for foot in (0, 1)]
        foot = int(far[1] > far[0])
        if min(self._swing) >= 1.0 and far[foot] > STEP_LENGTH:
            self._swing[foot] = 0.0
        for foot in (0, 1):
            if self._swing[foot] < 1.0:
                self._swing_foot(foot, there[1 + foot], there[0], ahead)
        return np.stack([there[0], *self._feet])

    def _swing_foot(self, foot: int, below: np.ndarray, hips: np.ndarray, ahead: np.ndarray) -> None:
        """Advance a swinging foot by ``dt`` towards where it shall land.

        ``below`` [7]: pose of the foot below the hips [7] of a person who stands. ``ahead`` [2] m: way of the body in
        the time of a step. If the body stops or turns, the landing place moves, but the foot moves on evenly.
        """
        before = self._swing[foot]
        share = self._swing[foot] = min(1.0, before + self.dt / SWING_TIME)
        pose = self._feet[foot]
        # smoothstep: no jump of velocity at either end
        rest = (1.0 - share) ** 2 * (1.0 + 2.0 * share) / ((1.0 - before) ** 2 * (1.0 + 2.0 * before))
        way = below[:2] + (1.5 - share) * ahead - pose[:2]
        length = max(float(np.linalg.norm(way)), 1e-9)
        pose[:2] += min(1.0 - rest, MAX_FOOT_SPEED * self.dt / length) * way
        turn = float(frames.log(frames.multiply(below[3:], frames.conjugate(pose[3:])))[2])
        most = MAX_FOOT_TURN * self.dt
        pose[3:] = frames.from_yaw(frames.to_yaw(pose[3:]) + float(np.clip((1.0 - rest) * turn, -most, most)))
        pose[2] = below[2] + self._rise(pose, hips) + LIFT_HEIGHT * np.sin(np.pi * share)

    def _rise(self, foot: np.ndarray, hips: np.ndarray) -> float:
        """Returns by how much the ground under ``foot`` [2 or more] m is higher than below ``hips`` [2 or more] m."""
        if self._terrain is None:
            return 0.0
        return float(np.subtract(*self._terrain.height(*np.stack([foot[:2], hips[:2]], 1))))


def _upright(head: np.ndarray) -> np.ndarray:
    """Returns the pose [7] of a head without its pitch and roll."""
    return frames.pose(head[:3], frames.from_yaw(frames.to_yaw(head[3:])))
