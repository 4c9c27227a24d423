"""Cameras and lidars for a simulation, at a given pose or in a frame of a robot.

    frame = Camera("d435").render(simulation, look_at((1.0, -1.0, 1.5), (0.0, 0.0, 1.2)))
    scan = Lidar("vlp16").scan(simulation, robot=robot)

A sensor may be used with several simulations in turn; it computes on the device of the simulation.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from vinesim.api.simulation import Simulation, base_pose
from vinesim.core.errors import UsageError
from vinesim.core.numbers import as_numbers
from vinesim.perception.clouds import picture_cloud, scan_cloud
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import CameraFrame, CameraInfo, CameraMount, LidarMount, LidarScan
from vinesim.sensors.camera import camera as rgbd
from vinesim.sensors.camera.sunlight import DEFAULT_SUN
from vinesim.sensors.export import images
from vinesim.sensors.export.dataset import resized_intrinsics
from vinesim.sensors.lidar import lidar

T = TypeVar("T", bound=CameraFrame | LidarScan)


@dataclasses.dataclass(frozen=True, slots=True)
class Picture(CameraFrame):
    """An RGB-D picture of :class:`Camera`."""

    def to_point_cloud(self, *, world: bool = False, exact: bool = False, ids: bool = False, step: int = 1) -> Any:
        """Returns an ``open3d.t.geometry.PointCloud`` [m] with a coloured point for every pixel that has depth.

        :class:`~vinesim.perception.open3d_library.Open3DMissing` if Open3D (``vinesim[perception]``) is not installed.

        Args:
            world: points in the frame of the world instead of the camera's optical frame.
            exact: use the exact depth instead of the measured depth.
            ids: add the attributes ``labels`` [point, 1] and ``pixels`` [point, 2] (column, row), int32.
            step: use every ``step``-th row and column only.
        """
        return picture_cloud(self, world=world, exact=exact, ids=ids, step=step)


@dataclasses.dataclass(frozen=True, slots=True)
class Scan(LidarScan):
    """One revolution of :class:`Lidar`."""

    def to_open3d(self, *, world: bool = False, ids: bool = False) -> Any:
        """Returns an ``open3d.t.geometry.PointCloud`` [m] with the attributes ``intensity``, ``ring`` and ``time``.

        :class:`~vinesim.perception.open3d_library.Open3DMissing` if Open3D (``vinesim[perception]``) is not installed.

        Args:
            world: points in the frame of the world instead of the lidar's frame.
            ids: add the attribute ``labels`` [point, 1] int32.
        """
        return scan_cloud(self, world=world, ids=ids)


class Camera:
    """An RGB-D camera described by a file in ``data/cameras`` or another file."""

    def __init__(
        self,
        kind: str = "d435",
        *,
        size: tuple[int, int] | None = None,
        quality: str = "full",
        colour: str = "camera",
        name: str = "camera",
        seed: int = 0,
    ) -> None:
        """Make a camera.

        Args:
            kind: name of a file in ``data/cameras``, or path of a camera file.
            size: width and height [px] at the same angle of view; the camera's own size unless given.
            quality: ``"fast"``, ``"full"`` or ``"still"``: cost and quality of the picture. Exact depth and labels do
                not depend on it.
            colour: ``"camera"``: colours, noise and clipping as the camera file describes them; ``"exact"``: without.
            name: name of the camera. Name and ``seed`` together determine the noise of the measured depth.
            seed: see ``name``.

        Raises :class:`~vinesim.sensors.spec_file.SensorError` if the file cannot be used.
        """
        self.spec = rgbd.CameraSpec.load(kind).coloured(colour)
        self.info: CameraInfo = resized_intrinsics(self.spec, size)
        """Intrinsics of the camera."""
        self._name = name
        self._quality = quality
        self._seed = seed
        self._camera: rgbd.Camera | None = None
        self._last: Simulation | None = None

    def render(
        self,
        simulation: Simulation,
        pose: Sequence[float] | np.ndarray | None = None,
        *,
        robot: Robot | None = None,
        frame: str | None = None,
    ) -> Picture:
        """Returns the picture at the simulation's current time: ``rgb``, ``depth`` [m] with the camera's errors,
        ``labels``, ``exact_depth`` [m].

        Args:
            simulation: the world to look at.
            pose: pose [7] of the optical frame in the world (z forward, x right, y down), as from :func:`look_at`.
            robot: robot that carries the camera; give either ``robot`` or ``pose``.
            frame: frame of the robot at which the camera is mounted; the frame of its first camera unless given.
        """
        frame = frame or _first_frame(robot, CameraMount.kind)
        if self._camera is None or self._last is not simulation:
            sun = DEFAULT_SUN if simulation.scene is None else simulation.scene.sun.direction()
            self._camera = rgbd.Camera(
                self.spec,
                self.info,
                self._name,
                sun,
                self._quality,
                seed=self._seed,
                shadow_period=0.0,
                device=simulation.device,
            )
            self._last = simulation
        return _as(
            Picture,
            self._camera.render(
                simulation.primitives(), _sensor_pose(pose, robot, frame, simulation.model.terrain), simulation.time
            ),
        )


class Lidar:
    """A spinning lidar described by a file in ``data/lidars`` or another file."""

    def __init__(self, kind: str = "vlp16", *, name: str = "lidar", seed: int = 0) -> None:
        """Make a lidar. ``kind``: name of a file in ``data/lidars``, or path of a lidar file. ``name`` and ``seed``
        together determine its noise.

        Raises :class:`~vinesim.sensors.spec_file.SensorError` if the file cannot be used.
        """
        self.spec = lidar.LidarSpec.load(kind)
        self._name = name
        self._seed = seed
        self._lidars: dict[str, lidar.Lidar] = {}

    def scan(
        self,
        simulation: Simulation,
        pose: Sequence[float] | np.ndarray | None = None,
        *,
        robot: Robot | None = None,
        frame: str | None = None,
    ) -> Scan:
        """Returns the scan of one revolution during which nothing moves: ``xyz`` [point, 3] m in the lidar's frame,
        ``intensity``, ``labels``.

        Args:
            simulation: the world to measure.
            pose: pose [7] of the lidar in the world (x forward, z up), or (x, y, yaw) for a lidar on the ground.
            robot: robot that carries the lidar; give either ``robot`` or ``pose``.
            frame: frame of the robot at which the lidar is mounted; the frame of its first lidar unless given.
        """
        frame = frame or _first_frame(robot, LidarMount.kind)
        device = simulation.device
        if device not in self._lidars:
            self._lidars[device] = lidar.Lidar(self.spec, self._name, seed=self._seed, device=device)
        made = self._lidars[device].scan(
            simulation.primitives(), _sensor_pose(pose, robot, frame, simulation.model.terrain), simulation.time
        )
        return _as(Scan, made)


def look_at(eye: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray) -> np.ndarray:
    """Returns the pose [7] of the optical frame of an upright camera at ``eye`` [3] m that looks at ``target`` [3]
    m."""
    start = as_numbers(eye)
    end = as_numbers(target)
    if start.shape != (3,) or end.shape != (3,) or not 1e-6 <= np.linalg.norm(end - start) < np.inf:
        raise UsageError(f"cannot look from {eye} at {target}; give two points [3] m that differ")
    return images.look_at(start, end)


def _as(kind: type[T], value: CameraFrame | LidarScan) -> T:
    """Returns ``value`` as an object of its subclass ``kind``, with the same arrays."""
    return kind(**{field.name: getattr(value, field.name) for field in dataclasses.fields(value)})


def _first_frame(robot: Robot | None, kind: str) -> str | None:
    """Returns the name of the frame of the robot's first sensor of a kind; None if there is none."""
    mounts = () if robot is None else robot.description.sensors_of(kind)
    return mounts[0].frame if mounts else None


def _sensor_pose(
    pose: Sequence[float] | np.ndarray | None, robot: Robot | None, frame: str | None, terrain: Terrain | None
) -> np.ndarray:
    """Returns the pose [7] of a sensor in the world. Raises :class:`UsageError` unless either ``pose`` or ``robot`` is
    given."""
    if (pose is None) == (robot is None):
        raise UsageError("the sensor has no place, or two; give either a pose [7] or a robot")
    if robot is None:
        assert pose is not None
        return base_pose(pose, terrain)
    if frame is None:
        raise UsageError(f"robot {robot.name!r} carries no such sensor; give the frame of one of its links")
    return robot.frame_pose(frame)
