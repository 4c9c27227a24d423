"""What cameras and lidars measure."""

from __future__ import annotations

import dataclasses
import enum

import numpy as np

from vinesim.scene.ids import LABEL_STRIDE


@dataclasses.dataclass(frozen=True, slots=True)
class CameraInfo:
    """Pinhole intrinsics (sensor_msgs/CameraInfo; plumb_bob with zero distortion)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    frame_id: str
    """Optical frame: z forward, x right, y down."""


class CameraOutput(enum.Flag):
    """Parts of a :class:`CameraFrame`: a camera makes only those that are asked for."""

    RGB = enum.auto()
    DEPTH = enum.auto()
    """Depth as the sensor measures it."""
    EXACT_DEPTH = enum.auto()
    LABELS = enum.auto()
    NONE = 0
    ALL = RGB | DEPTH | EXACT_DEPTH | LABELS


@dataclasses.dataclass(frozen=True, slots=True)
class CameraFrame:
    """One RGB-D picture. Arrays that were not asked for (:class:`CameraOutput`) have the size 0."""

    time: float
    name: str
    info: CameraInfo
    pose: np.ndarray
    """[7] optical frame in the world when the picture was taken."""
    rgb: np.ndarray
    """[height, width, 3] uint8"""
    depth: np.ndarray
    """[height, width] float32 m along z; NaN no return, -Inf too near, +Inf too far (REP-118)."""
    labels: np.ndarray
    """[height, width] int32, :func:`vinesim.scene.ids.label`; 0 is nothing."""
    exact_depth: np.ndarray | None = None
    """[height, width] float32 m along z, whatever the sensor can measure: no noise, no gaps; +Inf for the sky."""

    @property
    def outputs(self) -> CameraOutput:
        """The arrays that were made."""
        made = CameraOutput.NONE
        for output, array in (
            (CameraOutput.RGB, self.rgb), (CameraOutput.DEPTH, self.depth), (CameraOutput.LABELS, self.labels),
            (CameraOutput.EXACT_DEPTH, self.exact_depth),
        ):  # fmt: skip
            if array is not None and array.size:
                made |= output
        return made

    @property
    def organs(self) -> np.ndarray:
        """[height, width] :class:`~vinesim.scene.ids.Organ` of each pixel; 0 is nothing."""
        return self.labels // LABEL_STRIDE

    @property
    def instances(self) -> np.ndarray:
        """[height, width] index of the bunch, box, tree or actor of each pixel, counted for each organ from 0."""
        return self.labels % LABEL_STRIDE


@dataclasses.dataclass(frozen=True, slots=True)
class LevelLaser:
    """The laser of a spinning lidar that looks least up or down, and its shots of one revolution.

    The head turns clockwise seen from above: shot k looks at ``azimuth - 2 pi k / count``.
    """

    ring: int
    """Its number in :attr:`LidarScan.ring`."""
    count: int
    """Shots of a revolution."""
    delay: float
    """Time of its first shot after the first firing [s]."""
    period: float
    """Between two shots [s]."""
    azimuth: float
    """Of its first shot, counter-clockwise from ahead [rad]."""
    nearest: float
    """Ranges that the lidar can measure [m]: least."""
    farthest: float
    """Greatest [m]."""


@dataclasses.dataclass(frozen=True, slots=True)
class LidarScan:
    """One revolution of a lidar; shots that returned nothing are left out."""

    time: float
    """Time of the first firing [s]."""
    name: str
    frame_id: str
    pose: np.ndarray
    """[7] of the lidar in the world at ``time``."""
    xyz: np.ndarray
    """[point, 3] float32 m, in the lidar's frame (x forward, z up) at the firing of each point."""
    intensity: np.ndarray
    """[point] float32 0..255"""
    ring: np.ndarray
    """[point] uint16"""
    offset: np.ndarray
    """[point] float32 s after ``time``."""
    labels: np.ndarray
    """[point] int32"""
    level: LevelLaser | None = None
    """The laser nearest to the horizontal, None if unknown."""
    returned: np.ndarray | None = None
    """[point] uint8: 1 the strongest echo of its shot, 2 another; None if each shot reports one at most."""

    @property
    def organs(self) -> np.ndarray:
        """[point] :class:`~vinesim.scene.ids.Organ` that each point lies on."""
        return self.labels // LABEL_STRIDE
