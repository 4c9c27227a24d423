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
        self._start = self._feet.copy()
        self._swing = [1.0, 1.0]
        """Phase of each foot's step, 0 to 1 [foot]."""
        self._head = np.asarray(pose.head[:3], float).copy()

    def stand(self, head: np.ndarray) -> None:
        """Put both feet under the head pose ``head`` [7] at once, for a person who was moved there without walking."""
        there = frames.compose(_upright(head), self._below_head)
        self._feet = there[1:]
        for foot in (0, 1):
            self._feet[foot, 2] += self._rise(there[1 + foot], there[0])
        self._swing = [1.0, 1.0]
        self._head = np.asarray(head[:3], float).copy()

    def update(self, head: np.ndarray) -> np.ndarray:
        """Advance by ``dt`` to the head pose ``head`` [7]; returns the poses [3, 7] of the hips and both feet."""
        there = frames.compose(_upright(head), self._below_head)
        ahead = (head[:3] - self._head) / self.dt * SWING_TIME
        self._head = np.asarray(head[:3], float).copy()
        ahead[2] = 0.0
        ahead *= min(1.0, 1.5 * STEP_LENGTH / max(float(np.linalg.norm(ahead)), 1e-9))
        far = [float(np.linalg.norm(self._feet[foot, :2] - there[1 + foot, :2])) for foot in (0, 1)]
        foot = int(far[1] > far[0])
        if min(self._swing) >= 1.0 and far[foot] > STEP_LENGTH:
            self._start[foot] = self._feet[foot]
            self._swing[foot] = 0.0
        for foot in (0, 1):
            if self._swing[foot] < 1.0:
                share = self._swing[foot] = min(1.0, self._swing[foot] + self.dt / SWING_TIME)
                goal = there[1 + foot, :3] + (1.5 - share) * ahead
                gone = share * share * (3.0 - 2.0 * share)  # smoothstep: no jump of velocity at either end
                self._feet[foot, :3] = self._start[foot, :3] + gone * (goal - self._start[foot, :3])
                sole = there[1 + foot, 2] + self._rise(self._feet[foot], there[0])
                self._feet[foot, 2] = sole + LIFT_HEIGHT * np.sin(np.pi * share)
                self._feet[foot, 3:] = there[1 + foot, 3:]
        return np.stack([there[0], *self._feet])

    def _rise(self, foot: np.ndarray, hips: np.ndarray) -> float:
        """Returns by how much the ground under ``foot`` [2 or more] m is higher than below ``hips`` [2 or more] m."""
        if self._terrain is None:
            return 0.0
        return float(np.subtract(*self._terrain.height(*np.stack([foot[:2], hips[:2]], 1))))


def _upright(head: np.ndarray) -> np.ndarray:
    """Returns the pose [7] of a head without its pitch and roll."""
    return frames.pose(head[:3], frames.from_yaw(frames.to_yaw(head[3:])))
