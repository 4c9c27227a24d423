"""A first camera picture and a first lidar revolution of a sensor process that stands by. Kernels and modules that they
need are loaded after that."""

from __future__ import annotations

import numpy as np

from vinesim.core import allocator, frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.state import State
from vinesim.scene.values import CameraMount, LidarMount, Snapshot
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.scheduler import ScheduledSensor, SensorScheduler
from vinesim.sensors.sensor import load_kernels

SCENE = "demo"
CAMERA = "d435"
LIDAR = "vlp16"
SIZE = (64, 48)
"""Size of the picture [px]. It may be small, because it is the first call of each kernel that takes long."""


def rehearse() -> None:
    """Render with sensors of a small vineyard on the CPU, and release their memory."""
    load_kernels(CameraMount.kind, LidarMount.kind)
    scene = load_scene(SCENE)
    spec = CameraSpec.load(CAMERA)
    model = generate(scene)
    camera = Camera(spec, spec.info("camera", size=SIZE), "camera", scene.sun.direction)
    sensors = [ScheduledSensor(sensor, lambda _: None) for sensor in (camera, Lidar(LidarSpec.load(LIDAR), "lidar"))]
    state = State.at_rest(model)
    trees = np.arange(len(model.tree_first))
    pose = frames.pose(np.array([0.0, 0.0, 1.0]))
    snapshot = Snapshot(0.0, 0, state.body_q, state.bunch_attached, (), np.zeros((0, 7)), trees)
    for _ in SensorScheduler(model, sensors).warm_up(snapshot, {sensor.name: pose for sensor in sensors}):
        pass
    del sensors, camera, model, state, snapshot
    allocator.release_free_memory()
