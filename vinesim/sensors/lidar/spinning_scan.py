"""A spinning lidar in a moving world: each sector of a revolution is computed for its own time and pose of the lidar.

Motion of the lidar and of the world therefore distorts a scan (rolling shutter). Recorded poses of the lidar are
interpolated to the time of each firing, also if the firing is computed later; plants and objects are as in the newest
snapshot.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from vinesim.core import frames
from vinesim.scene.values import CameraOutput, LidarScan
from vinesim.sensors.primitives.scene_primitives import Primitives


class SpinningHead(Protocol):
    """Interface of a lidar for :class:`SpinningScan`, implemented by :class:`vinesim.sensors.lidar.lidar.Lidar`."""

    is_exact: bool
    revolution: int
    firings: int
    firing_period: float
    """Time between two firings [s]."""

    @property
    def rate(self) -> float:
        """Revolutions per second [Hz]."""
        ...

    def begin_revolution(self) -> None:
        """Begin a new revolution, with an empty scan."""
        ...

    def fire(self, primitives: Primitives, first: int, poses: np.ndarray) -> None:
        """Compute the firings from index ``first`` on, one for each pose in ``poses`` [firing, 7]."""
        ...

    def finish_revolution(self, pose: np.ndarray, time: float) -> LidarScan:
        """Returns the scan of the revolution; ``pose`` [7] and ``time`` [s] are those of its first firing."""
        ...


class PoseHistory:
    """Recent poses of a sensor with their times, for interpolation."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []

    def add(self, time: float, pose: np.ndarray) -> None:
        """Add ``pose`` [7] at ``time`` [s], and remove poses with later times, which exist if simulated time was set
        back."""
        kept = int(np.searchsorted(self._times, time))
        del self._times[kept:], self._poses[kept:]
        self._times.append(time)
        self._poses.append(np.array(pose, float))

    def discard_before(self, before: float) -> None:
        """Remove poses that are not needed to interpolate at times after ``before`` [s]."""
        old = max(int(np.searchsorted(self._times, before, side="right")) - 1, 0)
        del self._times[:old], self._poses[:old]

    def interpolate(self, times: np.ndarray) -> np.ndarray:
        """Returns poses [k, 7] at ``times`` [k] s, interpolated linearly between recorded poses (with normalised
        quaternions) and constant before the first and after the last one."""
        known = np.asarray(self._times)
        poses = np.stack(self._poses)
        after = np.clip(np.searchsorted(known, times), 1, max(len(known) - 1, 1))
        if len(known) == 1:
            return np.repeat(poses, len(times), 0)
        share = np.clip((times - known[after - 1]) / (known[after] - known[after - 1]), 0.0, 1.0)[:, None]
        first = poses[after - 1]
        second = poses[after].copy()
        second[(first[:, 3:] * second[:, 3:]).sum(1) < 0.0, 3:] *= -1.0
        between = first + share * (second - first)
        between[:, 3:] = frames.normalize(between[:, 3:])
        return between


class SpinningScan:
    """Computes the revolutions of one lidar sector by sector while the world moves."""

    def __init__(self, lidar: SpinningHead, rate: float | None = None) -> None:
        """``rate``: number of revolutions to deliver per second [Hz], at most the lidar's own rate, which is the
        default."""
        self.lidar = lidar
        self.pose_history = PoseHistory()
        self.dropped = 0
        """Number of revolutions that were left out, because their time had passed before they could begin."""
        self._set_period(1.0 / rate if rate else 0.0)
        self._start: float | None = None
        self._next_column = 0

    def add_pose(self, time: float, pose: np.ndarray) -> None:
        """Record that the lidar was at ``pose`` [7] at ``time`` [s]."""
        self.pose_history.add(time, pose)

    def set_demand(self, period: float, outputs: CameraOutput) -> None:
        """Set the time [s] from one delivered revolution to the next, and the needed ``outputs``.

        If exact depth is the only output, revolutions measure exactly.
        """
        self._set_period(period)
        self.lidar.is_exact = outputs == CameraOutput.EXACT_DEPTH

    def _set_period(self, period: float) -> None:
        """Set the time [s] from one delivered revolution to the next, at least the duration of one revolution."""
        self._period = max(1.0 / self.lidar.rate, period)

    def cancel(self, now: float) -> None:
        """Abandon the present revolution at simulated time ``now`` [s]."""
        self._start = None
        self.pose_history.discard_before(now)

    def is_due(self, now: float) -> bool:
        """Returns whether firings are due at simulated time ``now`` [s]; between revolutions no firing is due."""
        return self._start is None or now >= self._start - 1e-9 or now < self._start - self._period

    def advance(self, primitives: Primitives, now: float) -> Iterator[LidarScan]:
        """Compute all firings that are due at simulated time ``now`` [s], and yield the revolutions that become
        complete."""
        if self._start is None or now < self._start - self._period:
            self._begin(now)
        while self._start is not None:
            lidar = self.lidar
            start = self._start
            step = self.lidar.firing_period
            due = min(int((now - start) / step + 1e-6) + 1, lidar.firings) if now >= start - 1e-9 else 0
            if due > self._next_column:
                times = start + step * np.arange(self._next_column, due)
                lidar.fire(primitives, self._next_column, self.pose_history.interpolate(times))
                self._next_column = due
            if due < lidar.firings:
                return
            yield lidar.finish_revolution(self.pose_history.interpolate(np.array([start]))[0], start)
            start += self._period
            late = max(int((now - start) / self._period + 1e-6), 0)
            self.dropped += late
            lidar.revolution += late
            self._begin(start + late * self._period)

    def _begin(self, start: float) -> None:
        self._start = start
        self._next_column = 0
        self.pose_history.discard_before(start)
        self.lidar.begin_revolution()
