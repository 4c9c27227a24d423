"""The sensors that a robot can carry: what each kind measures, how it is mounted, and the table of the kinds."""

from __future__ import annotations

import dataclasses
import enum
from typing import ClassVar, Literal, Protocol

import msgspec
import numpy as np

from vinesim.scene.ids import LABEL_STRIDE, Organ, label

MIN_BERRY_PIXELS = 4
"""A berry is seen if at least so many pixels show it."""

Box = tuple[int, int, int, int]
"""First column, first row, last column, last row (inclusive)."""
MIN_CAMERA_SIZE = 16
MAX_CAMERA_SIZE = 4096
"""Bounds of the width and height of a camera's picture [px]."""


class SensorMount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sensor of a robot, as a table of its TOML file says: its name in topics, the link it sits in, its data file."""

    name: str
    frame: str
    type: str = ""


class RenderedMount(SensorMount, frozen=True, forbid_unknown_fields=True):
    """A sensor that is rendered: one of :data:`SENSOR_KINDS`."""

    kind: ClassVar[str]
    """Name of its kind."""
    rate: float | None = None
    """Frames a second [Hz]; the sensor's own unless given."""

    def fault(self) -> tuple[str, str] | None:
        """What is wrong with its values, and the remedy; None if they are fit."""
        if self.rate is not None and not 0.01 <= self.rate <= 1000.0:
            return f"the rate {self.rate}", "give 0.01 to 1000 Hz"
        return None


class PictureMount(RenderedMount, frozen=True, forbid_unknown_fields=True):
    """A sensor that delivers pictures."""

    size: tuple[int, int] | None = None
    """Width and height [px] with the same angle of view; the sensor's own unless given."""

    def fault(self) -> tuple[str, str] | None:
        """See :meth:`RenderedMount.fault`."""
        if self.size is not None and not all(MIN_CAMERA_SIZE <= n <= MAX_CAMERA_SIZE for n in self.size):
            bounds = f"give width and height from {MIN_CAMERA_SIZE} to {MAX_CAMERA_SIZE} px"
            return f"the size {list(self.size)}", bounds
        return super().fault()


class SensorFrame(Protocol):
    """What a sensor delivers at once; a frozen dataclass, so that its time can be replaced."""

    @property
    def time(self) -> float:
        """[s]"""
        ...

    @property
    def name(self) -> str:
        """The sensor's name."""
        ...

    @property
    def measured(self) -> tuple[np.ndarray, ...]:
        """The arrays that two runs in lockstep must have equal to the bit."""
        ...


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
    """Parts of a :class:`CameraFrame`: a camera makes only those that are asked for. Others render if any is."""

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
    def measured(self) -> tuple[np.ndarray, ...]:
        """See :attr:`SensorFrame.measured`."""
        return self.rgb, self.depth, self.labels

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
    def measured(self) -> tuple[np.ndarray, ...]:
        """See :attr:`SensorFrame.measured`."""
        return self.xyz, self.intensity, self.labels

    @property
    def organs(self) -> np.ndarray:
        """[point] :class:`~vinesim.scene.ids.Organ` that each point lies on."""
        return self.labels // LABEL_STRIDE


@dataclasses.dataclass(frozen=True, slots=True)
class Band:
    """One band of a multispectral camera. Its response is a Gaussian."""

    name: str
    centre: float
    """[nm]"""
    width: float
    """Between the wavelengths at which the response is half of its greatest [nm]."""
    irradiance: float
    """Of a level surface in the open, sun and sky [W/(m2 nm)]."""


@dataclasses.dataclass(frozen=True, slots=True)
class MultispectralFrame:
    """One picture in several bands, which all show the same at the same pixel."""

    time: float
    name: str
    info: CameraInfo
    pose: np.ndarray
    """[7] optical frame in the world when the picture was taken."""
    bands: tuple[Band, ...]
    """By wavelength."""
    reflectance: np.ndarray
    """[band, height, width] float32: light over that of a level white panel in the open. In shadow it is less than what
    the surface reflects, on a leaf that faces a low sun it is more."""
    labels: np.ndarray
    """[height, width] int32, :func:`vinesim.scene.ids.label`; 0 is nothing."""

    @property
    def measured(self) -> tuple[np.ndarray, ...]:
        """See :attr:`SensorFrame.measured`."""
        return (self.reflectance,)

    @property
    def radiance(self) -> np.ndarray:
        """[band, height, width] float32 W/(m2 sr nm)."""
        irradiance = np.array([band.irradiance for band in self.bands], np.float32)
        return self.reflectance * (irradiance / np.float32(np.pi))[:, None, None]

    def band(self, name: str) -> np.ndarray:
        """Reflectance [height, width] in a band; :class:`KeyError` if there is none of that name."""
        return self.reflectance[{band.name: k for k, band in enumerate(self.bands)}[name]]

    @property
    def ndvi(self) -> np.ndarray:
        """[height, width] float32: (nir - red) / (nir + red), 0 where both are dark (Rouse et al. 1974)."""
        red = self.band("red")
        nir = self.band("nir")
        total = nir + red
        return np.divide(nir - red, total, out=np.zeros_like(total), where=total > 0.0)


class CameraMount(PictureMount, frozen=True, forbid_unknown_fields=True):
    """An RGB-D camera, and in which quality it is rendered live."""

    kind: ClassVar[str] = "camera"
    quality: Literal["fast", "full", "still"] = "fast"


class LidarMount(RenderedMount, frozen=True, forbid_unknown_fields=True):
    """A spinning lidar."""

    kind: ClassVar[str] = "lidar"


class MultispectralMount(PictureMount, frozen=True, forbid_unknown_fields=True):
    """A multispectral camera."""

    kind: ClassVar[str] = "multispectral"


@dataclasses.dataclass(frozen=True, slots=True)
class SensorKind:
    """A kind of sensor, as all layers know it. The layers above are named, not imported: each imports its own part."""

    table: str
    """Its array of tables in the TOML file of a robot."""
    mount: type[RenderedMount]
    """One such table."""
    maker: str
    """Module of vinesim.sensors whose ``MAKER`` is the :class:`vinesim.sensors.sensor.SensorMaker`."""
    publisher: str
    """Module of vinesim.ros.publishers whose ``PUBLISHER`` is the :class:`vinesim.ros.sensor_node.SensorPublisher`."""
    whole: CameraOutput
    """What is rendered of it where every frame counts: in lockstep."""
    topics: tuple[str, ...]
    """Topics below its name that a user watches all the time; the first alone shows that it works."""
    costly_topics: tuple[str, ...] = ()
    """Topics below its name that a user looks at now and then."""


SENSOR_KINDS: dict[str, SensorKind] = {
    CameraMount.kind: SensorKind(
        table="cameras",
        mount=CameraMount,
        maker="vinesim.sensors.camera.camera",
        publisher="vinesim.ros.publishers.camera",
        whole=CameraOutput.RGB | CameraOutput.DEPTH | CameraOutput.LABELS,
        topics=("rgb/image_raw", "rgb/camera_info", "depth/image_raw", "depth/camera_info"),
        costly_topics=("depth/points", "labels"),
    ),
    LidarMount.kind: SensorKind(
        table="lidars",
        mount=LidarMount,
        maker="vinesim.sensors.lidar.lidar",
        publisher="vinesim.ros.publishers.lidar",
        whole=CameraOutput.DEPTH,
        topics=("points",),
    ),
    MultispectralMount.kind: SensorKind(
        table="multispectral_cameras",
        mount=MultispectralMount,
        maker="vinesim.sensors.camera.multispectral",
        publisher="vinesim.ros.publishers.multispectral",
        whole=CameraOutput.RGB,
        topics=("ndvi/image_raw", "ndvi/camera_info"),
    ),
}
"""All kinds by name. A robot's sensors are in this order, those of one kind in the order of its file."""
