"""What cameras and lidars measure."""

from __future__ import annotations

import dataclasses
import enum

import numpy as np

from vinesim.scene.ids import LABEL_STRIDE, Organ, label

MIN_BERRY_PIXELS = 4
"""A berry is seen if at least so many pixels show it."""

Box = tuple[int, int, int, int]
"""First column, first row, last column, last row (inclusive)."""


@dataclasses.dataclass(frozen=True, slots=True)
class CameraInfo:
    """Intrinsics (sensor_msgs/CameraInfo)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    frame_id: str
    """Optical frame: z forward, x right, y down."""
    distortion: tuple[float, ...] = ()
    """Coefficients of the lens (:mod:`vinesim.scene.camera_geometry`), 5 or 8; none: a pinhole."""


class SensorMode(enum.StrEnum):
    """Whether simulated time waits for cameras and lidars."""

    LIVE = "live"
    """They give what they can up to their rates, and time waits only below a least rate."""
    PACED = "paced"
    """Every frame comes at its rate in simulated time, as in Gazebo."""
    LOCKSTEP = "lockstep"
    """Every frame is of exactly its step: time waits until it is rendered and sent, and two runs are equal to the
    bit. All sensors render always."""


@dataclasses.dataclass(frozen=True, slots=True)
class SensorPacing:
    """How cameras and lidars of one robot and simulated time wait for each other."""

    mode: SensorMode = SensorMode.LIVE
    least_rate: float = 5.0
    """Of live sensors [Hz] of simulated time; a sensor whose own rate is lower keeps that."""


class CameraOutput(enum.Flag):
    """Parts of a :class:`CameraFrame`: a camera makes only those that are asked for."""

    RGB = enum.auto()
    DEPTH = enum.auto()
    """Depth as the sensor measures it."""
    EXACT_DEPTH = enum.auto()
    LABELS = enum.auto()
    BUNCHES = enum.auto()
    """What is true of the bunches that are seen; a camera alone does not make it
    (:class:`vinesim.sensors.scheduler.SensorScheduler`)."""
    NONE = 0
    ALL = RGB | DEPTH | EXACT_DEPTH | LABELS
    """All that a camera makes."""


@dataclasses.dataclass(frozen=True, slots=True)
class BunchTruth:
    """One bunch in one picture, be it seen or hidden. Berries, rachis and pedicels belong to it, the peduncle not.

    What lies outside the picture counts nowhere but in ``berries``, ``frame`` and ``size``.
    """

    bunch: int
    """Index in the model."""
    variety: int
    """Index into :data:`vinesim.scene.berries.VARIETIES`."""
    tree: int
    """The tree on which it grew."""
    attached: bool
    """Whether it still hangs there."""
    amodal_box: Box
    """Of the pixels that would show it if there were nothing else."""
    amodal: np.ndarray
    """Those pixels, bool [rows, columns] of ``amodal_box``."""
    visible: np.ndarray
    """The pixels that do show it, bool, in the same window."""
    visible_box: Box | None
    """Of the pixels that show it; None if none does."""
    berries_seen: int
    """Berries of which at least :data:`MIN_BERRY_PIXELS` pixels are seen."""
    berries: int
    """All its berries."""
    frame: np.ndarray
    """[7] pose of the 3D box's middle in the world; x runs down the rachis."""
    size: np.ndarray
    """[3] m, edges of the 3D box around all its parts, in that frame."""
    cut: np.ndarray | None
    """[3] m, where to cut: the middle of the peduncle, in the world; None for a bunch that has been picked."""
    cut_pixel: np.ndarray | None
    """[2] column and row of that point, whether inside the picture or not; None behind the camera."""
    cut_seen: bool
    """Whether the point is in the picture and the ray to it meets its own peduncle first."""

    @property
    def label(self) -> int:
        """Its value in label images."""
        return label(Organ.BUNCH, self.bunch)

    @property
    def pixels(self) -> int:
        """How many pixels show it."""
        return int(self.visible.sum())

    @property
    def amodal_pixels(self) -> int:
        """How many pixels would show it if there were nothing else."""
        return int(self.amodal.sum())

    @property
    def occlusion(self) -> float:
        """Share of its amodal pixels that show something else, 0..1."""
        return 1.0 - self.pixels / self.amodal_pixels

    def mask(self, window: np.ndarray, info: CameraInfo) -> np.ndarray:
        """``visible`` or ``amodal`` as a mask [height, width] of the whole picture."""
        whole = np.zeros((info.height, info.width), bool)
        left, top, right, bottom = self.amodal_box
        whole[top : bottom + 1, left : right + 1] = window
        return whole


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
    bunches: tuple[BunchTruth, ...] | None = None
    """Of every bunch of which at least one pixel is seen, by index."""

    @property
    def outputs(self) -> CameraOutput:
        """The parts that were made."""
        made = CameraOutput.NONE if self.bunches is None else CameraOutput.BUNCHES
        for output, array in (
            (CameraOutput.RGB, self.rgb),
            (CameraOutput.DEPTH, self.depth),
            (CameraOutput.LABELS, self.labels),
            (CameraOutput.EXACT_DEPTH, self.exact_depth),
        ):
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
