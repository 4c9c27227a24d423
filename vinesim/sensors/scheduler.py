"""The schedule of a robot's sensors: it renders those that are due and wanted, and counts the frames that are late.

A camera renders a whole frame at once, from the newest snapshot. A lidar fires at every snapshot the shots that are
due, from where it was at each of them, and delivers a revolution after its last shot.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import warp as wp

from vinesim.kernels.lidar import lidar_echoes, lidar_raster
from vinesim.kernels.raster import transform_primitives
from vinesim.scene.model import Model
from vinesim.scene.values import CameraFrame, CameraOutput, LidarScan, SensorMode, SensorPacing, Snapshot
from vinesim.sensors.camera.camera import Camera, load_camera_kernels
from vinesim.sensors.ground_truth import visible_bunches
from vinesim.sensors.lidar.lidar import Lidar
from vinesim.sensors.lidar.spinning_scan import SpinningScan
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.wind.sway import Sway


def load_kernels() -> None:
    """Compile the kernels of cameras and lidars, or read them from the cache, before the first frame is due."""
    load_camera_kernels()
    for module in (transform_primitives, lidar_raster, lidar_echoes):
        wp.load_module(module, device="cpu")


LEAST_RATE_MARGIN = 0.9
"""Live sensors are taken so much more often than their least rate asks, since snapshots come at whole steps."""
COST_GAIN = 0.3
"""Share of the newest frame in the time that frames take."""

DemandQuery = Callable[[], CameraOutput]
"""The outputs of a sensor that are wanted now; a lidar scans if there is any, exactly if it is exact depth alone."""


@dataclasses.dataclass(frozen=True, slots=True)
class ScheduledSensor:
    """One sensor, the callback for its output, and what is wanted of it."""

    sensor: Camera | Lidar
    deliver: Callable[[CameraFrame | LidarScan], None]
    """Called with every frame or scan."""
    wanted: DemandQuery = lambda: CameraOutput.ALL
    rate: float | None = None
    """Frames a second of simulation time [Hz]; the sensor's own rate unless given."""
    present_rate: Callable[[], float] | None = None
    """The same where it may change, asked before every frame."""

    @property
    def period(self) -> float:
        """Time between two frames [s]."""
        if self.present_rate is not None:
            return 1.0 / self.present_rate()
        return 1.0 / (self.rate or self.sensor.rate)

    @property
    def name(self) -> str:
        """The sensor's name, which its pose carries too."""
        return self.sensor.name


SensorPoses = Mapping[str, np.ndarray]
"""World pose [7] of each sensor by name; of a camera that of its optical frame."""


class SensorScheduler:
    """Renders the sensors of one robot, in the caller's thread."""

    def __init__(
        self,
        model: Model,
        sensors: Sequence[ScheduledSensor],
        *,
        primitives: Primitives | None = None,
        pacing: SensorPacing = SensorPacing(),
        on_taken: Callable[[], None] = lambda: None,
    ) -> None:
        """``on_taken`` is called when it is known what a snapshot is needed for, before that is rendered."""
        names = [m.name for m in sensors]
        if len(set(names)) != len(names):
            twice = next(n for n in names if names.count(n) > 1)
            raise ValueError(f"two sensors are named {twice!r}; give each its own name")
        self.sensors = tuple(sensors)
        self.primitives = primitives or Primitives(model)
        self.frames = dict.fromkeys(names, 0)
        """Frames delivered by each sensor."""
        self.dropped = dict.fromkeys(names, 0)
        """Frames that were due and not rendered in time, by sensor."""
        self._next_time = dict.fromkeys(names, -np.inf)
        self._is_first = dict.fromkeys(names, True)
        """Whether a sensor has delivered at most one frame since it became wanted; the first may take longer."""
        self._scans = {m.name: SpinningScan(m.sensor, m.rate) for m in sensors if isinstance(m.sensor, Lidar)}
        self._pacing = pacing
        self._on_taken = on_taken
        self._taken: dict[str, float] = {}
        """Simulated time of the newest snapshot that each wanted sensor has taken [s]."""
        self._costs: dict[str, float] = {}
        """Real time that a frame or revolution of each sensor takes, smoothed [s]."""
        self._unfinished = dict.fromkeys(names, 0.0)
        """Real time that the present revolution of each lidar has taken so far [s]."""
        self._sway = Sway(model)
        self._moved = np.zeros(len(model.tree_first), bool)
        """[tree] whether it moved since the primitives were posed."""

    def warm_up(self, snapshot: Snapshot, poses: SensorPoses) -> Iterator[str]:
        """Render one frame or revolution of every sensor and discard it; yields the name of each before.

        The first of each takes many times as long as the others: buffers, tables and the last kernels are made.
        """
        outputs = CameraOutput.RGB | CameraOutput.DEPTH | CameraOutput.LABELS
        self._update_primitives(snapshot, poses)
        for scheduled in self.sensors:
            yield scheduled.name
            pose = poses[scheduled.name]
            if isinstance(scheduled.sensor, Camera):
                scheduled.sensor.render(self.primitives, pose, snapshot.time, outputs=outputs)
            else:
                lidar = scheduled.sensor
                lidar.begin_revolution()
                lidar.fire(self.primitives, 0, np.repeat(pose[None], lidar.firings, 0))
                lidar.finish_revolution(pose, snapshot.time)

    def advance(
        self, snapshot: Snapshot, poses: SensorPoses, earlier: Sequence[tuple[float, SensorPoses]] = ()
    ) -> None:
        """Render and deliver what is due in the newest snapshot, its ``moved_trees`` being those since the last call.

        ``earlier``: poses of the sensors between the last call and this one, with their times [s].
        """
        self._moved[snapshot.moved_trees] = True
        for name, scan in self._scans.items():
            for moment, then in (*earlier, (snapshot.time, poses)):
                if name in then:
                    scan.pose_history.add(moment, then[name])
        due = [m for m in self.sensors if self._is_due(m, snapshot.time, poses)]
        for scheduled in self.sensors:
            if scheduled in due or (scheduled.name in self._scans and scheduled.name in self._taken):
                self._taken[scheduled.name] = snapshot.time
        self._on_taken()
        if not due:
            return
        begun = time.perf_counter()
        seen = self._update_primitives(snapshot, poses)
        for scheduled in due:
            count = 0
            for result in self._results(scheduled, seen, poses[scheduled.name]):
                scheduled.deliver(result)
                count += 1
            self.frames[scheduled.name] += count
            now = time.perf_counter()
            self._note_cost(scheduled.name, now - begun, count)
            begun = now

    def _note_cost(self, name: str, seconds: float, count: int) -> None:
        """Note the real time that a sensor took in one call, in which ``count`` frames were completed."""
        self._unfinished[name] += seconds
        if count:
            cost = self._unfinished[name] / count
            before = self._costs.get(name, cost)
            self._costs[name] = before + COST_GAIN * (cost - before)
            self._unfinished[name] = 0.0

    def horizon(self) -> float:
        """Simulated time [s] that the world must not pass before a newer snapshot is taken, or a wanted sensor falls
        below the rate that its mode promises; infinite if none is wanted."""
        return min(
            (max(self._taken[one.name] + self._gap(one), self._due_time(one)) for one in self._wanted()), default=np.inf
        )

    def sustainable_factor(self) -> float:
        """The largest real-time factor at which the wanted sensors keep the rate that their mode promises, by what
        their frames took lately; infinite if none is wanted."""
        load = sum(self._costs.get(one.name, 0.0) / self._gap(one) for one in self._wanted())
        return 1.0 / load if load > 0.0 else np.inf

    def _wanted(self) -> list[ScheduledSensor]:
        return [one for one in self.sensors if one.name in self._taken and one.wanted()]

    def _gap(self, scheduled: ScheduledSensor) -> float:
        """Longest simulated time between two snapshots that the mode allows a sensor to take [s]."""
        is_live = self._pacing.mode is SensorMode.LIVE
        if isinstance(scheduled.sensor, Lidar) and not is_live:
            return 1.0 / scheduled.sensor.rate  # a revolution that is taken later than this is left out
        return max(scheduled.period, LEAST_RATE_MARGIN / self._pacing.least_rate) if is_live else scheduled.period

    def _due_time(self, scheduled: ScheduledSensor) -> float:
        """When the next picture of a camera is due [s]: the world must get so far."""
        return -np.inf if scheduled.name in self._scans else self._next_time[scheduled.name]

    def _update_primitives(self, snapshot: Snapshot, poses: SensorPoses) -> Snapshot:
        """Pose the primitives; the snapshot as it is drawn, good until the next call."""
        eye = next((pose[:3] for pose in poses.values()), None)
        seen = self._sway.apply(snapshot, np.flatnonzero(self._moved), eye)
        self.primitives.update(seen, seen.moved_trees)
        self._moved[:] = False
        return seen

    def _results(
        self, scheduled: ScheduledSensor, snapshot: Snapshot, pose: np.ndarray
    ) -> Iterator[CameraFrame | LidarScan]:
        """Render what a sensor has to deliver of a snapshot that the primitives show."""
        now = snapshot.time
        if isinstance(scheduled.sensor, Camera):
            camera = scheduled.sensor
            outputs = scheduled.wanted()
            frame = camera.render(self.primitives, pose, now, outputs=outputs)
            if CameraOutput.BUNCHES in outputs:
                bunches = visible_bunches(self.primitives, snapshot, camera.info, frame.pose, camera.rasterizer)
                frame = dataclasses.replace(frame, bunches=bunches)
            yield frame
            return
        scan = self._scans[scheduled.name]
        scheduled.sensor.is_exact = scheduled.wanted() == CameraOutput.EXACT_DEPTH
        scan.set_period(scheduled.period)
        missed = scan.dropped
        yield from scan.advance(self.primitives, now)
        self.dropped[scheduled.name] += scan.dropped - missed

    def _is_due(self, scheduled: ScheduledSensor, now: float, poses: SensorPoses) -> bool:
        """Whether a sensor has something to render at simulation time ``now`` [s]; counts the frames it has missed."""
        name = scheduled.name
        if name not in poses or not scheduled.wanted():
            self._next_time[name] = -np.inf  # a subscriber that returns gets a frame at once, and missed none
            self._is_first[name] = True
            self._taken.pop(name, None)
            if name in self._scans:
                self._scans[name].cancel(now)
                self._unfinished[name] = 0.0
            return False
        self._taken.setdefault(name, now)
        if name in self._scans:
            return self._scans[name].is_due(now)
        due = self._next_time[name]
        period = scheduled.period
        if now < due - 2.0 * period:  # time was set back
            due = -np.inf
        if now < due - 1e-6:
            return False
        if not np.isfinite(due):
            self._next_time[name] = now + period
            self._is_first[name] = True
            return True
        late = int((now - due + 1e-6) / period)
        if not self._is_first[name]:
            self.dropped[name] += late
        self._is_first[name] = False
        self._next_time[name] = due + (late + 1) * period
        return True
