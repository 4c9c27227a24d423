"""The sensing thread: it takes the latest snapshot, renders the sensors that are due, and drops what is late.

Physics calls :meth:`SensorScheduler.submit` every step and never waits. Warp's launches release the interpreter lock,
so that rendering costs the physics thread the other core, not its step. A camera renders a whole frame at once. A lidar
fires at every snapshot the shots that are due, and delivers a revolution after its last shot.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping

import numpy as np
import warp as wp

from vinesim.kernels.raster import lidar_raster, transform_primitives
from vinesim.kernels.sensing import lidar_echoes
from vinesim.scene.model import Model
from vinesim.scene.values import CameraFrame, CameraOutput, LidarScan, Snapshot
from vinesim.sensors.camera.camera import Camera, load_camera_kernels
from vinesim.sensors.lidar.lidar import Lidar
from vinesim.sensors.lidar.spinning_scan import SpinningScan
from vinesim.sensors.scene.primitives import Primitives

log = logging.getLogger(__name__)

_MAX_PENDING_POSES = 1024
"""Lidar poses that may wait for the thread; more than it ever needs."""


def load_kernels() -> None:
    """Compile the kernels of cameras and lidars, or read them from the cache, before the first frame is due."""
    load_camera_kernels()
    for module in (transform_primitives, lidar_raster, lidar_echoes):
        wp.load_module(module, device="cpu")


DemandQuery = Callable[[], CameraOutput]
"""The outputs of a sensor that are wanted now; a lidar scans if there is any."""


@dataclasses.dataclass(frozen=True, slots=True)
class ScheduledSensor:
    """One sensor, the callback for its output, and what is wanted of it."""

    sensor: Camera | Lidar
    deliver: Callable[[CameraFrame | LidarScan], None]
    """Called in the sensing thread with every frame or scan."""
    wanted: DemandQuery = lambda: CameraOutput.ALL
    rate: float | None = None
    """Frames a second of simulation time [Hz]; the sensor's own rate unless given."""

    @property
    def name(self) -> str:
        """The sensor's name, which its pose carries too."""
        return self.sensor.name


class SensorScheduler:
    """Renders all sensors of one client in one thread. Use as a context manager, or :meth:`start` and :meth:`stop`."""

    def __init__(
        self,
        model: Model,
        sensors: list[ScheduledSensor] | tuple[ScheduledSensor, ...],
        *,
        primitives: Primitives | None = None,
        nice: int = 0,
    ) -> None:
        """``nice``: how far the thread poses_by_time back where cores are scarce, as in nice(1); Linux only."""
        names = [m.name for m in sensors]
        if len(set(names)) != len(names):
            twice = next(n for n in names if names.count(n) > 1)
            raise ValueError(f"two sensors are named {twice!r}; give each its own name")
        self.sensors = tuple(sensors)
        self._nice = nice
        self.primitives = primitives or Primitives(model)
        self.frames = dict.fromkeys(names, 0)
        """Frames delivered by each sensor."""
        self.dropped = dict.fromkeys(names, 0)
        """Frames that were due and not rendered in time, by sensor."""
        self.failure: BaseException | None = None
        """What stopped the thread, if anything did; :meth:`see` and :meth:`stop` raise it."""
        self._next_time = dict.fromkeys(names, -np.inf)
        self._scans = {m.name: SpinningScan(m.sensor, m.rate) for m in sensors if isinstance(m.sensor, Lidar)}
        self._pending_poses: dict[str, list[tuple[float, np.ndarray]]] = {name: [] for name in self._scans}
        self._condition = threading.Condition()
        self._latest: tuple[Snapshot, Mapping[str, np.ndarray]] | None = None
        self._moved_trees: list[np.ndarray] = []
        self._stopping = False
        self._thread: threading.Thread | None = None

    def start(self) -> SensorScheduler:
        """Start the thread."""
        if self._thread is not None:
            raise RuntimeError("the sensing thread runs already; stop it first")
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="sensors", daemon=True)
        self._thread.start()
        return self

    def stop(self, timeout: float = 10.0) -> None:
        """End the thread after its present frame; raises RuntimeError with the failure of the thread, once."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(timeout)
            if thread.is_alive():
                raise TimeoutError(f"the sensing thread did not end within {timeout} s")
        self._raise()

    def __enter__(self) -> SensorScheduler:
        return self.start()

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            self.stop()
        except Exception:
            if kind is None:  # a failure of the body comes first
                raise

    def submit(self, snapshot: Snapshot, poses: Mapping[str, np.ndarray]) -> None:
        """Submit the latest snapshot and the world pose [7] of each sensor (optical frame of a camera). Never waits."""
        self._raise()
        with self._condition:
            self._latest = (snapshot, poses)
            for name in self._pending_poses.keys() & poses.keys():
                self._pending_poses[name].append((snapshot.time, poses[name]))
                if len(self._pending_poses[name]) > _MAX_PENDING_POSES:
                    del self._pending_poses[name][: _MAX_PENDING_POSES // 2]
            if len(snapshot.moved_trees):
                self._moved_trees.append(snapshot.moved_trees)
                if len(self._moved_trees) > 256:
                    self._moved_trees = [np.unique(np.concatenate(self._moved_trees))]
            self._condition.notify()

    def _raise(self) -> None:
        if self.failure is not None:
            failure, self.failure = self.failure, None
            raise RuntimeError(f"the sensing thread failed: {failure!r}") from failure

    def _run(self) -> None:
        moved: list[np.ndarray] = []
        if self._nice and sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._nice)
        try:
            while True:
                with self._condition:
                    self._condition.wait_for(lambda: self._stopping or self._latest is not None)
                    if self._stopping:
                        return
                    assert self._latest is not None
                    (snapshot, poses), self._latest = self._latest, None
                    moved += self._moved_trees
                    self._moved_trees = []
                    for name, poses_by_time in self._pending_poses.items():
                        for time, pose in poses_by_time:
                            self._scans[name].pose_history.add(time, pose)
                        poses_by_time.clear()
                due = [m for m in self.sensors if self._is_due(m, snapshot.time, poses)]
                if not due:
                    continue
                self.primitives.update(snapshot, np.concatenate(moved) if moved else np.zeros(0, np.int64))
                moved = []
                for scheduled in due:
                    if self._stopping:
                        return
                    for result in self._results(scheduled, snapshot.time, poses[scheduled.name]):
                        scheduled.deliver(result)
                        self.frames[scheduled.name] += 1
        except BaseException as failure:  # raised by the next submit() or stop()
            log.exception("the sensing thread stops")
            self.failure = failure

    def _results(self, scheduled: ScheduledSensor, now: float, pose: np.ndarray) -> Iterator[CameraFrame | LidarScan]:
        """Render what a sensor has to deliver at simulation time ``now`` [s]."""
        if isinstance(scheduled.sensor, Camera):
            yield scheduled.sensor.render(self.primitives, pose, now, outputs=scheduled.wanted())
            return
        scan = self._scans[scheduled.name]
        missed = scan.dropped
        yield from scan.advance(self.primitives, now)
        self.dropped[scheduled.name] += scan.dropped - missed

    def _is_due(self, scheduled: ScheduledSensor, now: float, poses: Mapping[str, np.ndarray]) -> bool:
        """Whether a sensor has something to render at simulation time ``now`` [s]; counts the frames it has missed."""
        name = scheduled.name
        if name not in poses or not scheduled.wanted():
            self._next_time[name] = -np.inf  # a subscriber that returns gets a frame at once, and missed none
            if name in self._scans:
                self._scans[name].cancel(now)
            return False
        if name in self._scans:
            return self._scans[name].is_due(now)
        due, period = self._next_time[name], 1.0 / (scheduled.rate or scheduled.sensor.rate)
        if now < due - 2.0 * period:  # time was set back
            due = -np.inf
        if now < due - 1e-6:
            return False
        if not np.isfinite(due):
            self._next_time[name] = now + period
            return True
        late = int((now - due + 1e-6) / period)
        self.dropped[name] += late
        self._next_time[name] = due + (late + 1) * period
        return True
