"""Pictures of a moving camera or a moving scene: motion blur, and the rolling shutter.

A picture is the mean of several pictures of short moments. Each row has its own exposure, which begins later than that
of the row above it by the line delay. So a row is the mean of the moments that its exposure covers, each weighted by
the covered share.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from vinesim.core import frames

MAX_MOMENTS = 31
"""Largest number of moments in one picture."""
_PIXELS_PER_MOMENT = 1.0
"""Motion in the picture [px] between two moments, where :data:`MAX_MOMENTS` suffice."""
_NEAREST = 0.5
"""Distance [m] of the surfaces for which the motion in the picture is estimated."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """Motion during the exposure of one picture."""

    linear: Sequence[float] = (0.0, 0.0, 0.0)
    """Velocity of the camera [m/s], world axes."""
    angular: Sequence[float] = (0.0, 0.0, 0.0)
    """Angular velocity of the camera [rad/s], world axes."""
    pose_scene: Callable[[float], None] | None = None
    """Moves the primitives to their poses at a time [s] after the middle of the exposure; None: the scene is at rest.
    It is called with 0 at the end."""
    scene_speed: float = 0.0
    """Largest speed of the bodies that ``pose_scene`` moves [m/s]; it determines the number of moments."""

    def pose_at(self, pose: np.ndarray, time: float) -> np.ndarray:
        """Returns the pose [7] of the camera ``time`` [s] after it was at ``pose`` [7]."""
        turn = frames.exp(time * np.asarray(self.angular, float))
        moved = pose[:3] + time * np.asarray(self.linear, float)
        return np.concatenate([moved, frames.normalize(frames.multiply(turn, pose[3:]))])


@dataclasses.dataclass(frozen=True)
class Moments:
    """The moments of which one picture is the mean."""

    times: np.ndarray
    """[moment] s after the middle of the exposure of the middle row; the middle one is 0."""
    weights: np.ndarray
    """[moment, row] Weight of each moment in each row; the sum over moments is 1."""
    nearest: np.ndarray
    """[row] Moment that is nearest to the middle of the row's exposure."""

    @classmethod
    def of(cls, motion: Motion, height: int, focal: float, exposure_time: float, line_delay: float) -> Moments:
        """Returns the moments of a picture with ``height`` rows.

        Args:
            motion: of camera and scene.
            height: number of rows.
            focal: focal length [px].
            exposure_time: time for which one row is exposed [s].
            line_delay: time from the exposure of one row to that of the next [s].
        """
        middle = line_delay * (np.arange(height) - 0.5 * (height - 1))
        span = exposure_time + line_delay * (height - 1)
        speed = float(np.linalg.norm(motion.angular))
        speed += (float(np.linalg.norm(motion.linear)) + motion.scene_speed) / _NEAREST
        count = math.ceil(min(focal * speed * span / _PIXELS_PER_MOMENT, MAX_MOMENTS))
        count = min(count | 1, MAX_MOMENTS)
        step = span / count
        times = step * (np.arange(count) - count // 2)
        nearest = np.abs(times[:, None] - middle).argmin(0)
        if exposure_time <= 0.0 or count == 1:
            weights = np.zeros((count, height))
            weights[nearest, np.arange(height)] = 1.0
            return cls(times, weights, nearest)
        begin = middle - 0.5 * exposure_time
        end = middle + 0.5 * exposure_time
        covered = np.minimum(end, times[:, None] + 0.5 * step) - np.maximum(begin, times[:, None] - 0.5 * step)
        weights = np.maximum(covered, 0.0)
        return cls(times, weights / weights.sum(0), nearest)
