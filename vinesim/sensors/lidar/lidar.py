"""Spinning lidars: firing times and angles from a table, beams with a width, echoes, and what is reported.

Each shot is a handful of rays over the beam's footprint. What they meet closer together along the beam than the pulse
is long comes back as one echo, whose range lies in between: mixed returns at the edges of leaves. Points are raw, as
drivers give them: each in the lidar's frame at its own firing, with the time of that firing.

Two halves, so that either can be exchanged: a :class:`RayGrid` tells what rays meet, a :class:`Lidar` what is reported.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Annotated, Literal, Protocol

import msgspec
import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.kernels.launch import MAX_THREADS, ThreadPool, usable_cores
from vinesim.kernels.lidar import lidar_echoes, lidar_raster
from vinesim.scene.ids import Organ, label
from vinesim.scene.plant_parameters import Number
from vinesim.scene.values import CameraOutput, LevelLaser, LidarMount, LidarScan, Snapshot
from vinesim.sensors import spec_file
from vinesim.sensors.lidar.lidar_rasterizer import LidarRasterizer
from vinesim.sensors.lidar.spinning_scan import SpinningScan
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.sensor import SensorMaker, SensorSetting
from vinesim.sensors.spec_file import Numbers

MAX_RAYS = 8
"""Of one shot."""
FOOTPRINT_RANGE = 3.0
"""All rays leave from one point; beams have their real width at this range [m], less nearer, more beyond."""
MAX_SHARED_TRANSLATION = 4e-3
MAX_SHARED_ROTATION = 3.5e-3
"""Firings within which the lidar moves by less [m] and turns by less [rad] are taken from one place, their middle one.

That is at most half a step of the head aside, and saves the finding of what is near for every few firings.
"""
_BANDS_PER_THREAD = 2
"""Bands of firings that one thread takes on average: what meets more gets more time from whichever is free."""
_MIN_BAND = 32
"""Firings of a band, at least: each band looks through all that is near."""
_RETURNS = {"strongest": 0, "last": 1, "dual": 2}


class LidarSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One kind of lidar (``data/lidars``)."""

    model: str
    elevation: Annotated[Numbers, "deg", (-90.0, 90.0)]
    """By laser, in the order of firing."""
    azimuth: Annotated[Numbers, "deg", (-180.0, 180.0)] | None = None
    """By laser: how far it looks counter-clockwise of the head."""
    laser_period: Annotated[Number, "s", (0.0, 0.01)]
    """Between two lasers."""
    firing_period: Annotated[Number, "s", (1e-6, 0.1)]
    """Between two firings of all lasers."""
    rate: Annotated[Number, "Hz", (0.1, 200.0)]
    """Revolutions a second."""
    nearest: Annotated[Number, "m", (0.0, 100.0)]
    farthest: Annotated[Number, "m", (0.1, 500.0)]
    rays: Annotated[Number, "1", (1, MAX_RAYS)]
    """Of one shot."""
    aperture: Annotated[Numbers, "m", (0.0, 0.1)]
    """Width and height of the beam where it leaves."""
    divergence: Annotated[Numbers, "mrad", (0.0, 50.0)]
    """How fast they grow: full angles, to 1/e^2 of the middle's power."""
    merge: Annotated[Number, "m", (0.0, 10.0)]
    """Surfaces closer than this along the beam come back as one echo."""
    separation: Annotated[Number, "m", (0.0, 10.0)]
    """Two returns of one shot lie at least so far apart."""
    returns: Literal["strongest", "last", "dual"] = "strongest"
    """Which echoes of a shot are reported; ``dual``: the strongest and the last, or the two strongest."""
    noise: Annotated[Number, "m", (0.0, 1.0)]
    """Standard deviation of the range of a strong echo."""
    weak_noise: Annotated[Number, "m", (0.0, 1.0)]
    """The same of the weakest echo; between them it falls with the root of the signal."""
    step: Annotated[Number, "m", (0.0, 1.0)]
    """Resolution of the range."""
    weakest: Annotated[Number, "1/m^2", (0.0, 1.0)]
    """Signal from which on an echo is noticed: reflectance, times the cosine, over the square of the range."""
    flicker: Annotated[Number, "1", (0.0, 2.0)]
    """Standard deviation of the signal's logarithm from shot to shot."""
    reflectance: dict[str, Annotated[Number, "1"]]
    """Diffuse, by organ in lower case."""

    @classmethod
    def load(cls, name: str) -> LidarSpec:
        """The spec in a file, or the one of that name in ``data/lidars``."""
        spec = spec_file.load("lidars", name, cls)
        organs = {o.name.lower() for o in Organ if o != Organ.NOTHING}
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
                f"{name}: measures from {spec.nearest.value} to {spec.farthest.value} m, which is no range; "
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

    def ideal(self) -> LidarSpec:
        """The same table of firings with thin beams that measure exactly, however weak the echo."""

        def but(number: Number, value: float) -> Number:
            return msgspec.structs.replace(number, value=value)

        thin = {
            name: msgspec.structs.replace(getattr(self, name), value=(0.0, 0.0)) for name in ("aperture", "divergence")
        }
        exact = {name: but(getattr(self, name), 0.0) for name in ("noise", "weak_noise", "step", "weakest", "flicker")}
        return msgspec.structs.replace(self, rays=but(self.rays, 1), returns="strongest", **thin, **exact)


class RayGrid(Protocol):
    """What the rays of a turning head meet; :class:`vinesim.sensors.lidar.lidar_rasterizer.LidarRasterizer` unless
    another one is given."""

    direction: wp.array
    """[column * row] unit vectors in the head's frame."""
    distance: wp.array
    """[column * row] m"""
    primitive: wp.array
    """[column * row], -2 the ground, -1 nothing."""

    def cast(self, primitives: Primitives, pose: np.ndarray, first: int, count: int, reach: float) -> object:
        """Fill distances and primitives of ``count`` columns from ``first`` on, with the head at ``pose`` [7].

        Threads call it for different columns at the same time.
        """
        ...


class Lidar:
    """One lidar: a table of firings, and the returns of one revolution."""

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
        """Noise follows from (``seed``, ``name``, number of the revolution).

        ``threads`` of the CPU share the shots: the cores that this process may use, up to four, unless given. Every
        number of them gives the same bits. ``grid(elevation, azimuth, step, columns, device)`` makes what finds hits:
        see :class:`LidarRasterizer`.
        """
        self.spec = spec
        self.name = name
        self.frame_id = frame_id
        self.device = device
        self.seed = seed
        self.is_exact = False
        """Whether revolutions that begin from now on measure what the middle of each beam meets, exactly."""
        self.revolution = 0
        """Of the present revolution."""
        self.lasers = len(spec.elevation.value)
        self.firing_period = spec.firing_period.value
        """Between two firings [s]."""
        self.firings = round(1.0 / (spec.rate.value * spec.firing_period.value))
        """Of one revolution."""
        within = np.arange(self.lasers) * spec.laser_period.value
        offset = np.arange(self.firings)[:, None] * spec.firing_period.value + within
        self.offset = offset.ravel().astype(np.float32)
        """Time of each shot after the first [shot] s."""
        elevation = np.radians(spec.elevation.value)
        order = np.argsort(np.argsort(elevation, kind="stable"), kind="stable")
        self.ring = np.tile(order, self.firings).astype(np.uint16)
        """[shot], 0 for the lowest laser."""
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
        """The laser nearest to the horizontal."""
        across, up = self._footprint()
        self.ray_grid = grid(
            (elevation[:, None] + up).ravel(),
            (azimuth[:, None] + across / np.maximum(np.cos(elevation[:, None]), 0.01)).ravel(),
            -2.0 * np.pi * spec.rate.value * spec.firing_period.value,
            self.firings,
            device,
        )
        """Finds what rays meet: a column for each firing, in it the rays of each laser's shot."""
        self._workers = ThreadPool((threads or min(usable_cores(), MAX_THREADS)) if device == "cpu" else 1)
        wp.load_module(lidar_echoes, device=device)  # threads must not do so at the same time
        self._measuring, self._exact = self._receiver_parameters(spec), self._receiver_parameters(spec.ideal())
        self._receiver = self._measuring
        """Of the present revolution."""
        kept = 2 if spec.returns == "dual" else 1
        self._noise = wp.zeros((len(self.offset), 3), dtype=float, device=device)
        self._xyz = wp.zeros((len(self.offset), kept), dtype=wp.vec3, device=device)
        self._intensity = wp.zeros((len(self.offset), kept), dtype=float, device=device)
        self._label = wp.full((len(self.offset), kept), -1, dtype=wp.int32, device=device)

    def _footprint(self) -> tuple[np.ndarray, np.ndarray]:
        """Offset of each ray of a shot in its beam, across and up [ray] rad: one in the middle, the others on a ring.

        Each stands for an equal share of a Gaussian beam's energy.
        """
        count = round(self.spec.rays.value)
        ring = np.sqrt(-0.5 * np.log(0.5 * (1.0 - 1.0 / count))) if count > 1 else 0.0
        turn = (np.arange(count - 1) + 0.5) * 2.0 * np.pi / max(count - 1, 1)
        sizes = zip(self.spec.aperture.value, self.spec.divergence.value, strict=True)
        wide, high = (0.5 * leaving / FOOTPRINT_RANGE + 0.5e-3 * growing for leaving, growing in sizes)
        return np.append(0.0, ring * wide * np.cos(turn)), np.append(0.0, ring * high * np.sin(turn))

    def _receiver_parameters(self, spec: LidarSpec) -> lidar_echoes.Receiver:
        """What this lidar makes of its shots with the numbers of ``spec``: of as many rays of each as that has."""
        receiver = lidar_echoes.Receiver()
        reflectance = np.zeros(len(Organ), np.float32)
        for organ, number in spec.reflectance.items():
            reflectance[Organ[organ.upper()]] = number.value
        receiver.reflectance = wp.array(reflectance, dtype=float, device=self.device)
        receiver.rays = round(self.spec.rays.value)
        receiver.used = round(spec.rays.value)
        receiver.returns = _RETURNS[self.spec.returns]
        for name in ("nearest", "farthest", "merge", "separation", "noise", "weak_noise", "step", "weakest", "flicker"):
            setattr(receiver, name, float(getattr(spec, name).value))
        return receiver

    @property
    def rate(self) -> float:
        """Revolutions a second [Hz]."""
        return self.spec.rate.value

    def scan(self, primitives: Primitives, pose: np.ndarray, time: float = 0.0) -> LidarScan:
        """One revolution from ``pose`` [7], the lidar in the world (x forward, z up), while nothing moves."""
        pose = np.array(pose, float)
        self.begin_revolution()
        self.fire(primitives, 0, np.broadcast_to(pose, (self.firings, 7)))
        return self.finish_revolution(pose, time)

    def frame(self, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, outputs: CameraOutput) -> LidarScan:
        """See :class:`vinesim.sensors.sensor.Sensor`: a revolution while nothing moves."""
        return self.scan(primitives, pose, snapshot.time)

    def sweep(self, rate: float | None) -> SpinningScan:
        """See :class:`vinesim.sensors.sensor.SweptSensor`."""
        return SpinningScan(self, rate)

    def begin_revolution(self) -> None:
        """A new revolution, exact or as the lidar measures: :attr:`is_exact`."""
        self._receiver = self._exact if self.is_exact else self._measuring
        noise = spec_file.noise_rng(self.seed, self.name, self.revolution).standard_normal(
            (len(self.offset), 3), np.float32
        )
        self._noise.assign(noise)

    def fire(self, primitives: Primitives, first: int, poses: np.ndarray) -> None:
        """Firings from ``first`` on, one for each pose [firing, 7] of the lidar."""
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
        """How many firings may be taken from one place, so slowly does the lidar move."""
        if len(poses) < 2:
            return 1
        way = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1).max() / MAX_SHARED_TRANSLATION
        turn = 2.0 * np.linalg.norm(np.diff(poses[:, 3:], axis=0), axis=1).max() / MAX_SHARED_ROTATION
        return max(int(1.0 / max(way, turn, 1e-6)), 1)

    def _fire(self, primitives: Primitives, first: int, count: int, pose: np.ndarray) -> None:
        """Firings from one ``pose`` [7], in bands that threads take one after the other."""
        size = self._workers.size
        bands = max(min(_BANDS_PER_THREAD * size, count // _MIN_BAND), 1) if size > 1 else 1
        ends = [first + count * i // bands for i in range(bands + 1)]
        fire_band = functools.partial(self._fire_band, primitives, pose)
        self._workers.share([functools.partial(fire_band, i, j - i) for i, j in itertools.pairwise(ends)])

    def _fire_band(self, primitives: Primitives, pose: np.ndarray, first: int, count: int) -> None:
        """``count`` firings from ``first`` on."""
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
        """What was reported since :meth:`begin`; ``pose`` [7] and ``time`` [s] of the first firing."""
        labels = self._label.numpy()
        shot, which = np.nonzero(labels >= 0)
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
    spec = LidarSpec.load(mount.type)
    lidar = Lidar(spec, mount.name, mount.frame, setting.device, seed=setting.seed, threads=setting.threads)
    lidar.revolution = setting.number
    return lidar


def _load_kernels() -> None:
    for module in (lidar_raster, lidar_echoes):
        wp.load_module(module, device="cpu")


MAKER = SensorMaker(lambda name: LidarSpec.load(name).rate.value, _make, _load_kernels)
