"""Cameras and lidars that look at a simulation: from a pose, or from a frame of a robot.

    frame = Camera("d435").render(simulation, look_at((1.0, -1.0, 1.5), (0.0, 0.0, 1.2)))
    scan = Lidar("vlp16").scan(simulation, robot=robot)

A sensor may look at several simulations in turn; it computes on the device of the one that it looks at.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vinesim.api.simulation import Simulation, base_pose
from vinesim.core.errors import UsageError
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.values import CameraFrame, CameraInfo, CameraMount, LidarMount, LidarScan
from vinesim.sensors.camera import camera as rgbd
from vinesim.sensors.camera.sunlight import DEFAULT_SUN
from vinesim.sensors.export import images
from vinesim.sensors.export.dataset import resized_intrinsics
from vinesim.sensors.lidar import lidar


class Camera:
    """An RGB-D camera of a kind in ``data/cameras``, or of a file."""

    def __init__(
        self,
        kind: str = "d435",
        *,
        size: tuple[int, int] | None = None,
        quality: str = "full",
        name: str = "camera",
        seed: int = 0,
    ) -> None:
        """A camera that is not mounted yet.

        Args:
            kind: name or path of a camera file; :class:`~vinesim.sensors.spec_file.SensorError` if it cannot be used.
            size: width and height [px] with the same angle of view; the camera's own unless given.
            quality: ``"fast"``, ``"full"`` or ``"still"``: what a picture may cost, not exact depth and labels.
            name: with ``seed`` it decides the noise of the measured depth.
            seed: see ``name``.
        """
        self.spec = rgbd.CameraSpec.load(kind)
        self.info: CameraInfo = resized_intrinsics(self.spec, size)
        """Intrinsics."""
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
    ) -> CameraFrame:
        """The picture at the simulation's time: ``rgb``, ``depth`` [m], ``labels``, ``exact_depth`` [m].

        Args:
            simulation: the world to look at.
            pose: [7] of the optical frame in the world (z forward, x right, y down), as :func:`look_at` makes it.
            robot: take the pose of a frame of this robot instead.
            frame: which one; the frame of the robot's first camera unless given.
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
        return self._camera.render(simulation.primitives(), _sensor_pose(pose, robot, frame), simulation.time)


class Lidar:
    """A spinning lidar of a kind in ``data/lidars``, or of a file."""

    def __init__(self, kind: str = "vlp16", *, name: str = "lidar", seed: int = 0) -> None:
        """A lidar that is not mounted yet; ``name`` and ``seed`` decide the noise.

        :class:`~vinesim.sensors.spec_file.SensorError` if the file cannot be used.
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
    ) -> LidarScan:
        """One revolution while nothing moves: ``xyz`` [point, 3] m in the lidar's frame, ``intensity``, ``labels``.

        Args:
            simulation: the world to measure.
            pose: [7] of the lidar in the world (x forward, z up), or (x, y, yaw) for one that stands on the ground.
            robot: take the pose of a frame of this robot instead.
            frame: which one; the frame of the robot's first lidar unless given.
        """
        frame = frame or _first_frame(robot, LidarMount.kind)
        device = simulation.device
        if device not in self._lidars:
            self._lidars[device] = lidar.Lidar(self.spec, self._name, seed=self._seed, device=device)
        return self._lidars[device].scan(simulation.primitives(), _sensor_pose(pose, robot, frame), simulation.time)


def look_at(eye: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray) -> np.ndarray:
    """Pose [7] of the optical frame of a camera at ``eye`` [3] m that points at ``target`` [3] m, upright."""
    start = np.asarray(eye, float)
    end = np.asarray(target, float)
    if start.shape != (3,) or end.shape != (3,) or np.linalg.norm(end - start) < 1e-6:
        raise UsageError(f"cannot look from {start.tolist()} at {end.tolist()}; give two points [3] m that differ")
    return images.look_at(start, end)


def _first_frame(robot: Robot | None, kind: str) -> str | None:
    """Where the first sensor of a kind sits on a robot; None if there is none."""
    mounts = () if robot is None else robot.description.sensors_of(kind)
    return mounts[0].frame if mounts else None


def _sensor_pose(pose: Sequence[float] | np.ndarray | None, robot: Robot | None, frame: str | None) -> np.ndarray:
    """Pose [7] of a sensor in the world; :class:`UsageError` unless it was given in exactly one way."""
    if (pose is None) == (robot is None):
        raise UsageError("the sensor has no place, or two; give either a pose [7] or a robot")
    if robot is None:
        assert pose is not None
        return base_pose(pose)
    if frame is None:
        raise UsageError(f"robot {robot.name!r} carries no such sensor; give the frame of one of its links")
    return robot.frame_pose(frame)
