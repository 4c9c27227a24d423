"""The sensors that a robot can carry: what each kind measures, how it is mounted, and the table of the kinds."""

from __future__ import annotations

import dataclasses
import enum
from typing import ClassVar, Literal, Protocol

import msgspec
import numpy as np

from vinesim.scene.ids import LABEL_STRIDE, Organ, label

MIN_BERRY_PIXELS = 4
"""Number of visible pixels of a berry from which the berry counts as visible."""

Box = tuple[int, int, int, int]
"""Rectangle of pixels: first column, first row, last column, last row (inclusive)."""
MIN_CAMERA_SIZE = 16
MAX_CAMERA_SIZE = 4096
"""Largest width and height of a camera's picture [px]. ``MIN_CAMERA_SIZE``: smallest width and height [px]."""


class SensorMount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sensor on a robot, as described by a table of the robot's TOML file: ``name`` in topics, ``frame`` at which the
    sensor is mounted, ``type`` (name of the sensor's data file)."""

    name: str
    frame: str
    type: str = ""


class ImuMount(SensorMount, frozen=True, forbid_unknown_fields=True):
    """An inertial measurement unit on a robot."""

    angular_velocity_noise: float = 0.0
    """Standard deviation of each measured angular velocity [rad/s]."""
    acceleration_noise: float = 0.0
    """Standard deviation of each measured acceleration [m/s2]."""


class RenderedMount(SensorMount, frozen=True, forbid_unknown_fields=True):
    """A sensor on a robot whose measurements are rendered, such as a camera or a lidar: one of :data:`SENSOR_KINDS`."""

    kind: ClassVar[str]
    """Name of the kind of sensor, a key of :data:`SENSOR_KINDS`."""
    rate: float | None = None
    """Frame rate [Hz]; by default the rate in the sensor's data file."""

    def fault(self) -> tuple[str, str] | None:
        """Returns the name of an invalid field and how to correct it; None if all values are valid."""
        if self.rate is not None and not 0.01 <= self.rate <= 1000.0:
            return f"the rate {self.rate}", "give 0.01 to 1000 Hz"
        return None


class PictureMount(RenderedMount, frozen=True, forbid_unknown_fields=True):
    """A sensor on a robot that delivers pictures."""

    size: tuple[int, int] | None = None
    """Width and height of the picture [px]; by default the size in the sensor's data file. The angle of view does not
    depend on the size."""

    def fault(self) -> tuple[str, str] | None:
        """Returns the name of an invalid field and how to correct it; None if all values are valid."""
        if self.size is not None and not all(MIN_CAMERA_SIZE <= n <= MAX_CAMERA_SIZE for n in self.size):
            bounds = f"give width and height from {MIN_CAMERA_SIZE} to {MAX_CAMERA_SIZE} px"
            return f"the size {list(self.size)}", bounds
        return super().fault()


class SensorFrame(Protocol):
    """One measurement of a sensor, such as a picture or a scan. It is a frozen dataclass, so that its time can be
    replaced."""

    @property
    def time(self) -> float:
        """Simulated time of the measurement [s]."""
        ...

    @property
    def name(self) -> str:
        """The sensor's name."""
        ...

    @property
    def measured(self) -> tuple[np.ndarray, ...]:
        """Returns the arrays that are equal to the bit in two runs with lockstep (:class:`SensorMode`)."""
        ...


@dataclasses.dataclass(frozen=True, slots=True)
class CameraInfo:
    """Intrinsics of a camera in pixels, with the names of sensor_msgs/CameraInfo."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    frame_id: str
    """Name of the camera's optical frame: z forward, x right, y down."""
    distortion: tuple[float, ...] = ()
    """5 or 8 distortion coefficients of the lens (:mod:`vinesim.scene.camera_geometry`); empty for a pinhole."""


class SensorMode(enum.StrEnum):
    """Whether simulated time waits for cameras and lidars."""

    LIVE = "live"
    """Sensors deliver frames as fast as they can, up to their rates. Simulated time waits only for sensors slower than
    ``SensorPacing.least_rate``."""
    PACED = "paced"
    """Every sensor delivers all frames of its rate in simulated time, as in Gazebo."""
    LOCKSTEP = "lockstep"
    """Every frame shows exactly the step at its time. Simulated time waits until the frame is rendered and sent, so two
    runs are equal to the bit. All sensors always render."""


@dataclasses.dataclass(frozen=True, slots=True)
class SensorPacing:
    """How simulated time waits for the cameras and lidars of one robot."""

    mode: SensorMode = SensorMode.LIVE
    least_rate: float = 5.0
    """Least rate of live sensors [Hz of simulated time]; a sensor whose own rate is lower keeps its own rate."""


class CameraOutput(enum.Flag):
    """Parts of a :class:`CameraFrame`. A camera renders only the requested parts. Sensors that are not cameras render
    completely if any part is requested.
    """

    RGB = enum.auto()
    DEPTH = enum.auto()
    """Depth as the sensor would measure it, with its errors. ``EXACT_DEPTH``: depth without errors."""
    EXACT_DEPTH = enum.auto()
    LABELS = enum.auto()
    BUNCHES = enum.auto()
    """Ground truth about the visible bunches, made by :class:`vinesim.sensors.scheduler.SensorScheduler`, not by a
    camera alone."""
    NONE = 0
    ALL = RGB | DEPTH | EXACT_DEPTH | LABELS
    """All parts that a camera makes alone."""


@dataclasses.dataclass(frozen=True, slots=True)
class BunchTruth:
    """Ground truth about one bunch in one picture: its berries, rachis and pedicels, but not its peduncle.

    Parts outside the picture count only in ``berries``, ``frame`` and ``size``.
    """

    bunch: int
    """Index of the bunch in the model."""
    variety: int
    """Index into :data:`vinesim.scene.berries.VARIETIES`."""
    tree: int
    """The tree on which the bunch grew."""
    attached: bool
    """Whether the bunch still hangs on its tree."""
    amodal_box: Box
    """Box of the pixels that would show the bunch if nothing hid it."""
    amodal: np.ndarray
    """Pixels that would show the bunch if nothing hid it, bool [rows, columns] of ``amodal_box``."""
    visible: np.ndarray
    """Pixels that show the bunch, bool [rows, columns] of ``amodal_box``."""
    visible_box: Box | None
    """Box of the pixels that show the bunch; None if there are none."""
    berries_seen: int
    """Number of berries with at least :data:`MIN_BERRY_PIXELS` visible pixels."""
    berries: int
    """Number of all berries of the bunch."""
    frame: np.ndarray
    """[7] pose of the centre of the 3D box in the world; x runs down the rachis."""
    size: np.ndarray
    """[3] m, edges of the 3D box around all parts of the bunch, in ``frame``."""
    cut: np.ndarray | None
    """[3] m, cut point in the world, which is the middle of the peduncle; None for a picked bunch."""
    cut_pixel: np.ndarray | None
    """[2] column and row of the cut point, also outside the picture; None behind the camera."""
    cut_seen: bool
    """Whether the cut point is in the picture and the ray to it first meets the bunch's own peduncle."""

    @property
    def label(self) -> int:
        """Label of the bunch in label images."""
        return label(Organ.BUNCH, self.bunch)

    @property
    def pixels(self) -> int:
        """Number of pixels in which the bunch is visible."""
        return int(self.visible.sum())

    @property
    def amodal_pixels(self) -> int:
        """Number of pixels that would show the bunch if nothing hid it."""
        return int(self.amodal.sum())

    @property
    def occlusion(self) -> float:
        """Share of the amodal pixels that show something else, 0 to 1."""
        return 1.0 - self.pixels / self.amodal_pixels

    def mask(self, window: np.ndarray, info: CameraInfo) -> np.ndarray:
        """Expand ``window`` (``visible`` or ``amodal``) to a mask [height, width] of the whole picture."""
        whole = np.zeros((info.height, info.width), bool)
        left, top, right, bottom = self.amodal_box
        whole[top : bottom + 1, left : right + 1] = window
        return whole


@dataclasses.dataclass(frozen=True, slots=True)
class CameraFrame:
    """One RGB-D picture. Arrays that were not requested (:class:`CameraOutput`) have size 0."""

    time: float
    name: str
    info: CameraInfo
    pose: np.ndarray
    """[7] pose of the optical frame in the world when the picture was taken."""
    rgb: np.ndarray
    """[height, width, 3] uint8, colours in sRGB."""
    depth: np.ndarray
    """[height, width] float32 m along z; NaN: no return, -Inf: too near, +Inf: too far (REP-118)."""
    labels: np.ndarray
    """[height, width] int32, :func:`vinesim.scene.ids.label` of the object in each pixel (organ and index); 0: the
    sky."""
    exact_depth: np.ndarray | None = None
    """[height, width] float32 m along z, without noise, gaps or range limits; +Inf for the sky."""
    bunches: tuple[BunchTruth, ...] | None = None
    """Ground truth of every bunch with at least one visible pixel, sorted by index."""

    @property
    def measured(self) -> tuple[np.ndarray, ...]:
        """Returns the measured arrays; see :attr:`SensorFrame.measured`."""
        return self.rgb, self.depth, self.labels

    @property
    def outputs(self) -> CameraOutput:
        """Parts of the picture that this frame contains."""
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
        """[height, width] :class:`~vinesim.scene.ids.Organ` (class of the object) in each pixel; 0: the sky."""
        return self.labels // LABEL_STRIDE

    @property
    def instances(self) -> np.ndarray:
        """[height, width] Index of the object in each pixel among the objects of its kind, from 0: the bunch for a
        bunch or peduncle; the tree for a cane or leaf; the pole, wire, trunk, arm, box, robot or person.

        Sky and ground have the index 0, too. Use :attr:`organs` to distinguish the kinds.
        """
        return self.labels % LABEL_STRIDE


@dataclasses.dataclass(frozen=True, slots=True)
class LevelLaser:
    """The most horizontal laser of a spinning lidar, and its shots of one revolution.

    The head turns clockwise seen from above: the azimuth of shot k is ``azimuth - 2 pi k / count``.
    """

    ring: int
    """Number of the laser in :attr:`LidarScan.ring`, counted from 0 for the lowest laser."""
    count: int
    """Number of shots in one revolution."""
    delay: float
    """Time from the first firing of the scan to the laser's first shot [s]."""
    period: float
    """Time between two shots of the laser [s]."""
    azimuth: float
    """Azimuth of the laser's first shot, counter-clockwise from ahead [rad]."""
    nearest: float
    """Smallest range that the lidar can measure [m]."""
    farthest: float
    """Largest range that the lidar can measure [m]."""


@dataclasses.dataclass(frozen=True, slots=True)
class LidarScan:
    """One revolution of a lidar; shots that returned nothing are left out."""

    time: float
    """Time of the first firing [s]."""
    name: str
    frame_id: str
    pose: np.ndarray
    """[7] pose of the lidar in the world at ``time``."""
    xyz: np.ndarray
    """[point, 3] float32 m, in the lidar's frame (x forward, z up) at the firing of each point."""
    intensity: np.ndarray
    """[point] float32, intensity of each echo, 0 to 255."""
    ring: np.ndarray
    """[point] uint16, number of the laser that measured each point; 0 for the lowest laser."""
    offset: np.ndarray
    """[point] float32 s, time of each point's firing after ``time``."""
    labels: np.ndarray
    """[point] int32, :func:`vinesim.scene.ids.label` (organ and index) of the object that each point is on."""
    level: LevelLaser | None = None
    """The laser nearest to the horizontal, None if unknown."""
    returned: np.ndarray | None = None
    """[point] uint8: 1 for the strongest echo of a shot, 2 for another echo; None for lidars that report at most one
    echo."""

    @property
    def measured(self) -> tuple[np.ndarray, ...]:
        """Returns the measured arrays; see :attr:`SensorFrame.measured`."""
        return self.xyz, self.intensity, self.labels

    @property
    def organs(self) -> np.ndarray:
        """[point] :class:`~vinesim.scene.ids.Organ` of the object that each point is on."""
        return self.labels // LABEL_STRIDE


@dataclasses.dataclass(frozen=True, slots=True)
class Band:
    """One band of a multispectral camera. Its response is a Gaussian."""

    name: str
    centre: float
    """[nm] Wavelength at the maximum of the response."""
    width: float
    """Full width at half maximum of the response [nm]."""
    irradiance: float
    """Irradiance by sun and sky of a level surface without shadow [W/(m2 nm)]."""


@dataclasses.dataclass(frozen=True, slots=True)
class MultispectralFrame:
    """One picture in several spectral bands with the same optics, so that a pixel shows the same point in all bands."""

    time: float
    name: str
    info: CameraInfo
    pose: np.ndarray
    """[7] Pose of the optical frame in the world when the picture was taken."""
    bands: tuple[Band, ...]
    """Bands, sorted by wavelength."""
    reflectance: np.ndarray
    """[band, height, width] float32: radiance divided by that of a level white panel without shadow. It is smaller than
    the surface's reflectance in shadow, and larger on a leaf that faces a low sun."""
    labels: np.ndarray
    """[height, width] int32, :func:`vinesim.scene.ids.label` of the object in each pixel (organ and index); 0: the
    sky."""

    @property
    def measured(self) -> tuple[np.ndarray, ...]:
        """Returns the measured arrays; see :attr:`SensorFrame.measured`."""
        return (self.reflectance,)

    @property
    def radiance(self) -> np.ndarray:
        """[band, height, width] float32 W/(m2 sr nm), spectral radiance of the surface in each pixel."""
        irradiance = np.array([band.irradiance for band in self.bands], np.float32)
        return self.reflectance * (irradiance / np.float32(np.pi))[:, None, None]

    def band(self, name: str) -> np.ndarray:
        """Returns the reflectance [height, width] in the band ``name``. Raises :class:`KeyError` if there is no such
        band."""
        return self.reflectance[{band.name: k for k, band in enumerate(self.bands)}[name]]

    @property
    def ndvi(self) -> np.ndarray:
        """[height, width] float32, normalised difference vegetation index (nir - red) / (nir + red) of the reflectances
        in the bands ``nir`` and ``red``; 0 where both are 0 (Rouse et al. 1974)."""
        red = self.band("red")
        nir = self.band("nir")
        total = nir + red
        return np.divide(nir - red, total, out=np.zeros_like(total), where=total > 0.0)


class FixKind(enum.StrEnum):
    """Kinds of fixes of a GNSS receiver."""

    NONE = "none"
    SINGLE = "single"
    """Without corrections."""
    FLOAT = "float"
    """With corrections of a base station; ambiguities of the carrier phases are not whole numbers yet."""
    FIXED = "fixed"
    """With corrections of a base station and whole ambiguities."""


@dataclasses.dataclass(frozen=True, slots=True)
class GnssFix:
    """One position of a GNSS receiver on WGS 84."""

    time: float
    name: str
    frame_id: str
    """Link of the antenna."""
    kind: FixKind
    latitude: float
    """Latitude [deg]; NaN without a fix."""
    longitude: float
    """Longitude [deg]; NaN without a fix."""
    altitude: float
    """Height above the ellipsoid [m]; NaN without a fix."""
    variance: np.ndarray
    """[3] m2, variances of east, north and up; 0 for an exact position."""

    @property
    def measured(self) -> tuple[np.ndarray, ...]:
        """Returns the measured numbers; see :attr:`SensorFrame.measured`."""
        return (np.array([self.latitude, self.longitude, self.altitude]),)


class GnssMount(RenderedMount, frozen=True, forbid_unknown_fields=True):
    """A GNSS receiver on a robot; ``frame`` is the link of its antenna."""

    kind: ClassVar[str] = "gnss"
    fix: Literal["single", "float", "fixed"] = "fixed"
    """Kind of fix, except in and after an outage."""
    datum: tuple[float, float, float] | None = None
    """Latitude [deg], longitude [deg] and height above the ellipsoid [m] of the world's origin; by default the scene's
    datum."""
    outage_rate: float = 0.0
    """Mean number of outages in an hour."""
    outage_duration: float = 10.0
    """Duration of an outage [s]."""

    def fault(self) -> tuple[str, str] | None:
        """Returns the name of an invalid field and how to correct it; None if all values are valid."""
        if self.datum is not None:
            latitude, longitude, altitude = self.datum
            if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(altitude) <= 1e5):
                return f"the datum {list(self.datum)}", "give latitude and longitude in degrees, and altitude in m"
        if not 0.0 <= self.outage_rate <= 1000.0:
            return f"the outage_rate {self.outage_rate}", "give 0 to 1000 an hour"
        if not 0.0 < self.outage_duration <= 1800.0:
            return f"the outage_duration {self.outage_duration}", "give more than 0 and at most 1800 s"
        return super().fault()


class CameraMount(PictureMount, frozen=True, forbid_unknown_fields=True):
    """An RGB-D camera on a robot. ``quality``: quality of its live pictures, see
    :data:`vinesim.sensors.camera.camera.QUALITIES`."""

    kind: ClassVar[str] = "camera"
    quality: Literal["fast", "full", "still"] = "fast"
    colour: Literal["camera", "exact"] = "camera"
    """``camera``: colours with the camera's response, if its data file has one; ``exact``: without."""
    field_of_view: float | None = None
    """Horizontal angle of view [rad]; by default that of the sensor's data file."""
    range: tuple[float, float] | None = None
    """Smallest and largest depth that is measured [m]; by default those of the sensor's data file."""
    noise: float = 0.0
    """Standard deviation of each colour value [1], as a share of the largest value."""

    def fault(self) -> tuple[str, str] | None:
        """Returns the name of an invalid field and how to correct it; None if all values are valid."""
        if self.field_of_view is not None and not 0.01 <= self.field_of_view <= 3.1:
            return f"the field_of_view {self.field_of_view}", "give 0.01 to 3.1 rad"
        if self.range is not None and not 0.0 <= self.range[0] < self.range[1] <= 1000.0:
            return f"the range {list(self.range)}", "give 0 <= nearest < farthest <= 1000 m"
        if not 0.0 <= self.noise <= 1.0:
            return f"the noise {self.noise}", "give 0 to 1"
        return super().fault()


class LidarMount(RenderedMount, frozen=True, forbid_unknown_fields=True):
    """A spinning lidar on a robot."""

    kind: ClassVar[str] = "lidar"
    columns: int | None = None
    """Number of shots of one laser in a full turn; by default that of the sensor's data file."""
    elevations: tuple[float, ...] | None = None
    """Elevation of each laser [rad]; by default those of the sensor's data file."""
    sector: tuple[float, float] | None = None
    """First and last azimuth that is measured, counter-clockwise from ahead [rad]; by default a full turn."""
    range: tuple[float, float] | None = None
    """Smallest and largest range that is measured [m]; by default those of the sensor's data file."""
    noise: float | None = None
    """Standard deviation of every range [m]. If it is given, beams have no width, and every echo is detected."""

    def fault(self) -> tuple[str, str] | None:
        """Returns the name of an invalid field and how to correct it; None if all values are valid."""
        if self.columns is not None and not 2 <= self.columns <= 10_000:
            return f"the columns {self.columns}", "give 2 to 10000"
        if self.elevations is not None and not (
            1 <= len(self.elevations) <= 256 and all(abs(angle) <= 1.58 for angle in self.elevations)
        ):
            return f"{len(self.elevations)} elevations", "give 1 to 256 from -1.57 to 1.57 rad"
        if self.sector is not None and not -6.3 <= self.sector[0] < self.sector[1] <= 6.3:
            return f"the sector {list(self.sector)}", "give first < last, -6.28 to 6.28 rad"
        if self.range is not None and not 0.0 <= self.range[0] < self.range[1] <= 500.0:
            return f"the range {list(self.range)}", "give 0 <= nearest < farthest <= 500 m"
        if self.noise is not None and not 0.0 <= self.noise <= 1.0:
            return f"the noise {self.noise}", "give 0 to 1 m"
        return super().fault()


class MultispectralMount(PictureMount, frozen=True, forbid_unknown_fields=True):
    """A multispectral camera on a robot."""

    kind: ClassVar[str] = "multispectral"


@dataclasses.dataclass(frozen=True, slots=True)
class SensorKind:
    """A kind of sensor, described for all layers. Modules of higher layers are given by name, because this layer must
    not import them."""

    table: str
    """Name of the array of tables with sensors of this kind in a robot's TOML file."""
    mount: type[RenderedMount]
    """Class of one such table."""
    maker: str
    """Module of vinesim.sensors whose ``MAKER`` is the :class:`vinesim.sensors.sensor.SensorMaker`."""
    publisher: str
    """Module of vinesim.ros.publishers whose ``PUBLISHER`` is the :class:`vinesim.ros.sensor_node.SensorPublisher`."""
    whole: CameraOutput
    """Parts of a frame that are rendered in lockstep (:attr:`SensorMode.LOCKSTEP`), where sensors render with and
    without subscribers."""
    topics: tuple[str, ...]
    """Topics below the sensor's name that a user usually watches. A message on the first one shows that the sensor
    works."""
    costly_topics: tuple[str, ...] = ()
    """Topics below the sensor's name that need much bandwidth or computation, and that a user watches rarely."""


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
    GnssMount.kind: SensorKind(
        table="gnss",
        mount=GnssMount,
        maker="vinesim.sensors.gnss",
        publisher="vinesim.ros.publishers.gnss",
        whole=CameraOutput.RGB,
        topics=("fix",),
    ),
}
"""All kinds of sensors, by name. A robot's sensors are listed in this order; sensors of one kind in the order of the
robot's file."""
