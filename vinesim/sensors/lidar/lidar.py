"""Spinning lidars: firing times and angles from a table, beams with a width, echoes and reported returns.

Each laser shot is sampled by a few rays over the beam's footprint. Surfaces that are closer to each other along the
beam than the pulse is long cause one echo with a range in between: the mixed returns at edges of leaves. Points are
raw, as in the messages of lidar drivers: each in the lidar's frame at the time of its own firing, with that time.

Two classes share the work and can be exchanged: a :class:`RayGrid` finds the surfaces that rays hit, and a
:class:`Lidar` computes the returns.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from typing import Annotated, Literal, Protocol

import msgspec
import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.thread_pool import MAX_THREADS, ThreadPool, usable_cores
from vinesim.kernels.graph import outside_captures
from vinesim.kernels.lidar import lidar_echoes, lidar_raster
from vinesim.scene.ids import PARTS_OF_CANE, Organ, label
from vinesim.scene.plant_parameters import Number
from vinesim.scene.values import CameraOutput, LevelLaser, LidarMount, LidarScan, Snapshot
from vinesim.sensors import spec_file
from vinesim.sensors.lidar.lidar_rasterizer import LidarRasterizer
from vinesim.sensors.lidar.spinning_scan import SpinningScan
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.sensor import SensorMaker, SensorSetting
from vinesim.sensors.spec_file import Numbers

MAX_RAYS = 8
"""Largest number of rays that sample one laser shot."""
FOOTPRINT_RANGE = 3.0
"""Range [m] at which the simulated beam has the real width. All rays start from one point, so the simulated beam is
narrower than the real one at shorter range, and wider at longer range."""
MAX_SHARED_TRANSLATION = 4e-3
MAX_SHARED_ROTATION = 3.5e-3
"""Rotation [rad] of the lidar's mount during successive firings below which these firings are all computed from the
pose of the lidar at the middle one. ``MAX_SHARED_TRANSLATION`` [m] is the corresponding distance.

The error is at most half of the angle by which the head turns between two firings. This saves a search of the nearby
primitives for every firing.
"""
_BANDS_PER_THREAD = 2
"""Average number of bands (successive firings that one thread computes) for each thread. A thread that has finished a
band computes the next one."""
_MIN_BAND = 32
"""Least number of firings in a band, which one thread computes. Every band searches all clusters of primitives nearby,
so small bands waste time."""
_RETURNS = {"strongest": 0, "last": 1, "dual": 2}


class LidarSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The data sheet of one model of lidar, from a file in ``data/lidars``."""

    model: str
    elevation: Annotated[Numbers, "deg", (-90.0, 90.0)]
    """Elevation of each laser, in the order of firing."""
    azimuth: Annotated[Numbers, "deg", (-180.0, 180.0)] | None = None
    """Azimuth of each laser, counter-clockwise from the direction of the head; None: all zero."""
    laser_period: Annotated[Number, "s", (0.0, 0.01)]
    """Time between the shots of two successive lasers within a firing."""
    firing_period: Annotated[Number, "s", (1e-6, 0.1)]
    """Time between two firings; a firing is one shot of every laser."""
    rate: Annotated[Number, "Hz", (0.1, 200.0)]
    """Revolutions per second."""
    nearest: Annotated[Number, "m", (0.0, 100.0)]
    farthest: Annotated[Number, "m", (0.1, 500.0)]
    rays: Annotated[Number, "1", (1, MAX_RAYS)]
    """Number of rays that sample one laser shot."""
    aperture: Annotated[Numbers, "m", (0.0, 0.1)]
    """Width and height of the beam where it leaves the lidar."""
    divergence: Annotated[Numbers, "mrad", (0.0, 50.0)]
    """Full angles of divergence of the beam, horizontal and vertical, at 1/e^2 of the power on the axis."""
    merge: Annotated[Number, "m", (0.0, 10.0)]
    """Distance along the beam below which two surfaces cause one echo."""
    separation: Annotated[Number, "m", (0.0, 10.0)]
    """Least distance along the beam between two reported echoes of one shot."""
    returns: Literal["strongest", "last", "dual"] = "strongest"
    """Echoes of a shot that are reported. ``dual``: the strongest and the last one, or the two strongest if the
    strongest is the last."""
    noise: Annotated[Number, "m", (0.0, 1.0)]
    """Standard deviation of the range of strong echoes."""
    weak_noise: Annotated[Number, "m", (0.0, 1.0)]
    """Standard deviation of the range of the weakest detectable echo; for stronger echoes it decreases with the square
    root of the signal, down to ``noise``."""
    step: Annotated[Number, "m", (0.0, 1.0)]
    """Quantisation step of the range."""
    weakest: Annotated[Number, "1/m^2", (0.0, 1.0)]
    """Signal from which an echo is detected; the signal is reflectance times the cosine of the incidence angle, divided
    by the square of the range."""
    flicker: Annotated[Number, "1", (0.0, 2.0)]
    """Standard deviation of the logarithm of the signal, from shot to shot."""
    reflectance: dict[str, Annotated[Number, "1"]]
    """Diffuse reflectance of each class of object: by name of an :class:`~vinesim.scene.ids.Organ` in lower case.
    Spurs, nodes and buds reflect as canes."""

    @classmethod
    def load(cls, name: str) -> LidarSpec:
        """Read a lidar's data sheet: ``name`` is the path of a file, or the name of a file in ``data/lidars``."""
        spec = spec_file.load("lidars", name, cls)
        organs = {o.name.lower() for o in Organ if o != Organ.NOTHING and o not in PARTS_OF_CANE}
        if set(spec.reflectance) != organs:
            wrong = sorted(set(spec.reflectance) ^ organs)[0]
            raise spec_file.SensorError(
                f"{name}: reflectance.{wrong} is missing or unknown; give one for each of {', '.join(sorted(organs))}"
            )
        for what, organ in spec.reflectance.items():
            if not 0.0 <= organ.value <= 10.0:
                raise spec_file.SensorError(f"{name}: reflectance.{what} is {organ.value:g}; give 0 to 10")
        if not spec.nearest.value < spec.farthest.value:
            raise spec_file.SensorError(
                f"{name}: measures from {spec.nearest.value} to {spec.farthest.value} m, an empty range; "
                "give nearest < farthest"
            )
        lasers = len(spec.elevation.value)
        for field, needed in (("azimuth", lasers), ("aperture", 2), ("divergence", 2)):
            found = getattr(spec, field)
            if found is not None and len(found.value) != needed:
                raise spec_file.SensorError(f"{name}: {field} has {len(found.value)} values; give {needed}")
        if not lasers or spec.firing_period.value * spec.rate.value > 0.5:
            raise spec_file.SensorError(
                f"{name}: fires {lasers} lasers less than twice a turn; give a shorter firing_period"
            )
        return spec

    def mounted(self, mount: LidarMount) -> LidarSpec:
        """Returns the data sheet with the values that a robot's ``mount`` gives instead."""
        spec = self if mount.noise is None else self.ideal()

        def but(name: str, value: float) -> dict[str, Number]:
            return {name: msgspec.structs.replace(getattr(spec, name), value=value)}

        given: dict[str, object] = {}
        if mount.noise is not None:
            given |= but("noise", mount.noise) | but("weak_noise", mount.noise)
        if mount.range is not None:
            given |= but("nearest", mount.range[0]) | but("farthest", mount.range[1])
        if mount.elevations is not None:
            degrees = tuple(math.degrees(angle) for angle in mount.elevations)
            given |= {"elevation": msgspec.structs.replace(spec.elevation, value=degrees), "azimuth": None}
        if mount.columns is not None or mount.elevations is not None:
            rate = mount.rate or self.rate.value
            columns = mount.columns or round(1.0 / (self.rate.value * self.firing_period.value))
            period = 1.0 / (rate * columns)
            lasers = len(mount.elevations or self.elevation.value)
            given |= but("rate", rate) | but("firing_period", period) | but("laser_period", period / lasers)
        return msgspec.structs.replace(spec, **given)

    def ideal(self) -> LidarSpec:
        """Returns the data sheet of an ideal lidar with the same firing times and angles: its beams have no width, it
        measures exactly, and it detects every echo."""

        def but(number: Number, value: float) -> Number:
            return msgspec.structs.replace(number, value=value)

        thin = {
            name: msgspec.structs.replace(getattr(self, name), value=(0.0, 0.0)) for name in ("aperture", "divergence")
        }
        exact = {name: but(getattr(self, name), 0.0) for name in ("noise", "weak_noise", "step", "weakest", "flicker")}
        return msgspec.structs.replace(self, rays=but(self.rays, 1), returns="strongest", **thin, **exact)


class RayGrid(Protocol):
    """Interface of an object that finds the surfaces that the rays of a spinning lidar head hit, such as
    :class:`vinesim.sensors.lidar.lidar_rasterizer.LidarRasterizer`. A column has the rays of one firing, a row the
    rays of one direction relative to the head."""

    direction: wp.array
    """[column * row] Unit vectors of the rays, in the head's frame."""
    distance: wp.array
    """[column * row] Distance to the nearest hit of each ray [m]."""
    primitive: wp.array
    """[column * row] Index of the primitive (shape) that each ray hits; -2: the ground, -1: no hit."""

    def cast(self, primitives: Primitives, pose: np.ndarray, first: int, count: int, reach: float) -> object:
        """Compute distances and primitives of ``count`` columns from column ``first`` on, with the head at ``pose``
        [7].

        ``reach``: largest distance of a hit [m]. Several threads may call this at the same time for different columns.
        """
        ...


class Lidar:
    """One spinning lidar: the times and angles of its shots, and the returns of the present revolution."""

    def __init__(
        self,
        spec: LidarSpec,
        name: str = "lidar",
        frame_id: str = "lidar",
        device: str = "cpu",
        *,
        seed: int = 0,
        threads: int | None = None,
        grid: Callable[[np.ndarray, np.ndarray, float, int, str], RayGrid] = LidarRasterizer,
    ) -> None:
        """Make a lidar with the data sheet ``spec``. ``seed`` and ``name`` together determine the noise of each
        revolution.

        ``threads``: number of CPU threads that share the firings, without effect on the result; None: the number of
        cores that this process may use, at most four. ``grid(elevation, azimuth, step, columns, device)`` makes the
        :class:`RayGrid`; its arguments are those of :class:`LidarRasterizer`.
        """
        self.spec = spec
        self.name = name
        self.frame_id = frame_id
        self.device = device
        self.seed = seed
        self.is_exact = False
        """Whether the next revolutions measure exactly, without noise and along the axis of each beam. The revolution
        that has begun already is not affected."""
        self.revolution = 0
        """Index of the present revolution."""
        self.sector: tuple[float, float] | None = None
        """First and last azimuth of the returns that are reported, counter-clockwise from ahead [rad]; None: all."""
        self.lasers = len(spec.elevation.value)
        self.firing_period = spec.firing_period.value
        """Time between two firings [s]."""
        self.firings = round(1.0 / (spec.rate.value * spec.firing_period.value))
        """Number of firings of one revolution."""
        within = np.arange(self.lasers) * spec.laser_period.value
        offset = np.arange(self.firings)[:, None] * spec.firing_period.value + within
        self.offset = offset.ravel().astype(np.float32)
        """[shot] Time of each shot after the first shot of the revolution [s]."""
        elevation = np.radians(spec.elevation.value)
        order = np.argsort(np.argsort(elevation, kind="stable"), kind="stable")
        self.ring = np.tile(order, self.firings).astype(np.uint16)
        """[shot] Number of the laser of each shot, counted from 0 for the lowest laser."""
        # the head turns clockwise seen from above; the first shot looks forward
        beside = np.radians(spec.azimuth.value) if spec.azimuth else np.zeros(self.lasers)
        azimuth = beside - 2.0 * np.pi * spec.rate.value * within
        flat = int(np.argmin(np.abs(elevation)))
        self.level = LevelLaser(
            int(order[flat]),
            self.firings,
            float(within[flat]),
            spec.firing_period.value,
            float(azimuth[flat]),
            spec.nearest.value,
            spec.farthest.value,
        )
        """Properties of the laser that is nearest to the horizontal, for 2D scans."""
        across, up = self._footprint()
        self.ray_grid = grid(
            (elevation[:, None] + up).ravel(),
            (azimuth[:, None] + across / np.maximum(np.cos(elevation[:, None]), 0.01)).ravel(),
            -2.0 * np.pi * spec.rate.value * spec.firing_period.value,
            self.firings,
            device,
        )
        """Object that finds the surfaces that the rays hit. It has a column for each firing, and a row for each ray of
        each laser."""
        self._workers = ThreadPool((threads or min(usable_cores(), MAX_THREADS)) if device == "cpu" else 1)
        wp.load_module(lidar_echoes, device=device)  # here, because only one thread may load a module at a time
        self._measuring, self._exact = self._receiver_parameters(spec), self._receiver_parameters(spec.ideal())
        self._receiver = self._measuring
        """Parameters of the receiver in the present revolution: with errors, or exact."""
        kept = 2 if spec.returns == "dual" else 1
        self._noise = wp.zeros((len(self.offset), 3), dtype=float, device=device)
        self._xyz = wp.zeros((len(self.offset), kept), dtype=wp.vec3, device=device)
        self._intensity = wp.zeros((len(self.offset), kept), dtype=float, device=device)
        self._label = wp.full((len(self.offset), kept), -1, dtype=wp.int32, device=device)

    def _footprint(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the angles of the rays that sample one shot, from the beam's axis: [ray] rad sideways and [ray] rad
        upwards.

        The first ray is along the axis, all others are on a ring around it. Each ray represents an equal share of the
        energy of a Gaussian beam.
        """
        count = round(self.spec.rays.value)
        ring = np.sqrt(-0.5 * np.log(0.5 * (1.0 - 1.0 / count))) if count > 1 else 0.0
        turn = (np.arange(count - 1) + 0.5) * 2.0 * np.pi / max(count - 1, 1)
        sizes = zip(self.spec.aperture.value, self.spec.divergence.value, strict=True)
        wide, high = (0.5 * leaving / FOOTPRINT_RANGE + 0.5e-3 * growing for leaving, growing in sizes)
        return np.append(0.0, ring * wide * np.cos(turn)), np.append(0.0, ring * high * np.sin(turn))

    def _receiver_parameters(self, spec: LidarSpec) -> lidar_echoes.Receiver:
        """Returns the kernel's receiver parameters for data sheet ``spec``; ``spec.rays`` rays of each shot are
        evaluated."""
        receiver = lidar_echoes.Receiver()
        reflectance = np.zeros(len(Organ), np.float32)
        for organ, number in spec.reflectance.items():
            reflectance[Organ[organ.upper()]] = number.value
        reflectance[list(PARTS_OF_CANE)] = reflectance[Organ.CANE]
        receiver.reflectance = wp.array(reflectance, dtype=float, device=self.device)
        receiver.rays = round(self.spec.rays.value)
        receiver.used = round(spec.rays.value)
        receiver.returns = _RETURNS[self.spec.returns]
        for name in ("nearest", "farthest", "merge", "separation", "noise", "weak_noise", "step", "weakest", "flicker"):
            setattr(receiver, name, float(getattr(spec, name).value))
        return receiver

    @property
    def rate(self) -> float:
        """Revolutions per second [Hz]."""
        return self.spec.rate.value

    @outside_captures()
    def scan(self, primitives: Primitives, pose: np.ndarray, time: float = 0.0) -> LidarScan:
        """Compute one revolution from ``pose`` [7] of the lidar in the world (x forward, z up), in a world that stands
        still, with ``time`` [s] as the time of the first firing."""
        pose = np.array(pose, float)
        self.begin_revolution()
        self.fire(primitives, 0, np.broadcast_to(pose, (self.firings, 7)))
        return self.finish_revolution(pose, time)

    def frame(self, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, outputs: CameraOutput) -> LidarScan:
        """Compute one revolution from ``pose`` [7] of the lidar in a world that stands still, as the interface
        :class:`vinesim.sensors.sensor.Sensor` defines a frame."""
        return self.scan(primitives, pose, snapshot.time)

    def sweep(self, rate: float | None) -> SpinningScan:
        """Returns an object that measures revolutions in a moving world, as the interface
        :class:`vinesim.sensors.sensor.SweptSensor` defines it. ``rate``: number of revolutions to deliver per second
        [Hz], at most the lidar's own rate, which is the default."""
        return SpinningScan(self, rate)

    def begin_revolution(self) -> None:
        """Begin a new revolution, which measures exactly if :attr:`is_exact`, else with the errors of the lidar."""
        self._receiver = self._exact if self.is_exact else self._measuring
        noise = spec_file.noise_rng(self.seed, self.name, self.revolution).standard_normal(
            (len(self.offset), 3), np.float32
        )
        self._noise.assign(noise)

    @outside_captures()
    def fire(self, primitives: Primitives, first: int, poses: np.ndarray) -> None:
        """Compute the firings from index ``first`` on, one for each pose in ``poses`` [firing, 7] of the lidar."""
        poses = np.array(poses, float)
        if not np.isfinite(poses).all():
            wrong = poses[~np.isfinite(poses).all(1)][0]
            raise ValueError(f"lidar {self.name!r} has the pose {wrong.tolist()}; give finite numbers")
        poses[:, 3:] = frames.normalize(poses[:, 3:])
        together = self._firings_per_pose(poses)
        for start in range(0, len(poses), together):
            part = poses[start : start + together]
            self._fire(primitives, first + start, len(part), part[len(part) // 2])

    def _firings_per_pose(self, poses: np.ndarray) -> int:
        """Returns the number of successive firings that may be computed from one pose, because the lidar moves
        slowly."""
        if len(poses) < 2:
            return 1
        way = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1).max() / MAX_SHARED_TRANSLATION
        turn = 2.0 * np.linalg.norm(np.diff(poses[:, 3:], axis=0), axis=1).max() / MAX_SHARED_ROTATION
        return max(int(1.0 / max(way, turn, 1e-6)), 1)

    def _fire(self, primitives: Primitives, first: int, count: int, pose: np.ndarray) -> None:
        """Compute ``count`` firings from index ``first`` on from one ``pose`` [7], in bands that threads share."""
        size = self._workers.size
        bands = max(min(_BANDS_PER_THREAD * size, count // _MIN_BAND), 1) if size > 1 else 1
        ends = [first + count * i // bands for i in range(bands + 1)]
        fire_band = functools.partial(self._fire_band, primitives, pose)
        self._workers.share([functools.partial(fire_band, i, j - i) for i, j in itertools.pairwise(ends)])

    def _fire_band(self, primitives: Primitives, pose: np.ndarray, first: int, count: int) -> None:
        """Compute ``count`` firings from index ``first`` on from one ``pose`` [7], in the calling thread."""
        grid = self.ray_grid
        grid.cast(primitives, pose, first, count, self.spec.farthest.value)
        wp.launch(
            lidar_echoes.detect_returns,
            count * self.lasers,
            inputs=[
                primitives.shapes,
                primitives.labels,
                primitives.organs,
                self._receiver,
                primitives.ground,
                first * self.lasers,
                wp.transform(*map(float, pose)),
                grid.direction,
                grid.distance,
                grid.primitive,
                label(Organ.GROUND, 0),
                int(Organ.GROUND),
                self._noise,
            ],
            outputs=[self._xyz, self._intensity, self._label],
            device=self.device,
        )

    def finish_revolution(self, pose: np.ndarray, time: float) -> LidarScan:
        """Returns the scan of the firings since :meth:`begin_revolution`. ``pose`` [7], ``time`` [s]: pose of the lidar
        in the world at its first firing, and time of this firing."""
        labels = self._label.numpy()
        shot, which = np.nonzero(labels >= 0)
        if self.sector is not None:
            points = self._xyz.numpy()[shot, which]
            beyond_first = (np.arctan2(points[:, 1], points[:, 0]) - self.sector[0]) % (2.0 * np.pi)
            seen = beyond_first <= self.sector[1] - self.sector[0]
            shot, which = shot[seen], which[seen]
        self.revolution += 1
        return LidarScan(
            time=float(time),
            name=self.name,
            frame_id=self.frame_id,
            pose=np.array(pose, float),
            xyz=self._xyz.numpy()[shot, which],
            intensity=self._intensity.numpy()[shot, which],
            ring=self.ring[shot],
            offset=self.offset[shot],
            labels=labels[shot, which],
            level=self.level,
            returned=(which + 1).astype(np.uint8) if self.spec.returns == "dual" else None,
        )


def _make(mount: LidarMount, setting: SensorSetting) -> Lidar:
    spec = LidarSpec.load(mount.type).mounted(mount)
    lidar = Lidar(spec, mount.name, mount.frame, setting.device, seed=setting.seed, threads=setting.threads)
    lidar.revolution = setting.number
    lidar.sector = mount.sector
    return lidar


def _load_kernels() -> None:
    for module in (lidar_raster, lidar_echoes):
        wp.load_module(module, device="cpu")


MAKER = SensorMaker(lambda name: LidarSpec.load(name).rate.value, _make, _load_kernels)
