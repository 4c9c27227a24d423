"""The schedule of a robot's sensors: it renders those that are due and wanted, and counts the frames that are late.

Most sensors, such as cameras, render a whole frame at once, from the newest snapshot. A swept sensor, such as a lidar,
takes at every snapshot the parts of a frame that are due, each from the pose at its own time, and delivers the frame
after the last part.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from vinesim.scene.model import Model
from vinesim.scene.values import CameraOutput, SensorFrame, SensorMode, SensorPacing, Snapshot
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.sensor import Sensor, SweptSensor
from vinesim.wind.sway import Sway

LEAST_RATE_MARGIN = 0.9
"""Margin on the least rate of live sensors: snapshots come at whole steps, so sensors are taken more often than the
least rate requires, by the inverse of this factor."""
COST_GAIN = 0.3
"""Weight of the newest frame in the smoothed time that frames take."""

DemandQuery = Callable[[], CameraOutput]
"""Gives the outputs of a sensor that are wanted now. The sensor renders if there is any."""


@dataclasses.dataclass(frozen=True, slots=True)
class ScheduledSensor:
    """One sensor, the callback for its frames, and the outputs that are wanted of it."""

    sensor: Sensor
    deliver: Callable[[Any], None]
    """Called with every frame."""
    wanted: DemandQuery = lambda: CameraOutput.ALL
    rate: float | None = None
    """Frames a second of simulation time [Hz]; the sensor's own rate unless given."""
    present_rate: Callable[[], float] | None = None
    """Frames a second of simulation time [Hz] where that may change: a function that is called before every frame."""

    @property
    def period(self) -> float:
        """Time between two frames [s]."""
        if self.present_rate is not None:
            return 1.0 / self.present_rate()
        return 1.0 / (self.rate or self.sensor.rate)

    @property
    def name(self) -> str:
        """The sensor's name; its pose has the same name."""
        return self.sensor.name


SensorPoses = Mapping[str, np.ndarray]
"""World pose [7] of each sensor, by name; for a camera the pose of its optical frame."""


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
        """Number of frames that each sensor has delivered, by name."""
        self.dropped = dict.fromkeys(names, 0)
        """Number of frames of each sensor that were due and were not rendered in time, by name."""
        self._next_time = dict.fromkeys(names, -np.inf)
        self._is_first = dict.fromkeys(names, True)
        """Whether a sensor has delivered at most one frame since it became wanted; the first may take longer."""
        self._sweeps = {m.name: m.sensor.sweep(m.rate) for m in sensors if isinstance(m.sensor, SweptSensor)}
        self._pacing = pacing
        self._on_taken = on_taken
        self._taken: dict[str, float] = {}
        """Simulated time of the newest snapshot that each wanted sensor has taken [s]."""
        self._costs: dict[str, float] = {}
        """Real time that a frame of each sensor takes, smoothed [s]."""
        self._unfinished = dict.fromkeys(names, 0.0)
        """Real time that the present frame of each swept sensor has taken so far [s]."""
        self._sway = Sway(model)
        self._moved = np.zeros(len(model.tree_first), bool)
        """[tree] Whether each tree has moved since the primitives were last posed."""

    def warm_up(self, snapshot: Snapshot, poses: SensorPoses) -> Iterator[str]:
        """Render one frame of every sensor and discard it; yields the name of each sensor before its frame.

        The first frame of a sensor takes many times as long as later ones: it makes buffers, tables and the last
        kernels.
        """
        outputs = CameraOutput.RGB | CameraOutput.DEPTH | CameraOutput.LABELS
        self._update_primitives(snapshot, poses)
        for scheduled in self.sensors:
            yield scheduled.name
            scheduled.sensor.frame(self.primitives, snapshot, poses[scheduled.name], outputs)

    def advance(
        self, snapshot: Snapshot, poses: SensorPoses, earlier: Sequence[tuple[float, SensorPoses]] = ()
    ) -> None:
        """Render and deliver the frames that are due, from the newest snapshot.

        Its ``moved_trees`` must be those that moved since the last call. ``earlier``: poses of the sensors between the
        last call and this one, with their times [s].
        """
        self._moved[snapshot.moved_trees] = True
        for name, sweep in self._sweeps.items():
            for moment, then in (*earlier, (snapshot.time, poses)):
                if name in then:
                    sweep.add_pose(moment, then[name])
        due = [m for m in self.sensors if self._is_due(m, snapshot.time, poses)]
        for scheduled in self.sensors:
            if scheduled in due or (scheduled.name in self._sweeps and scheduled.name in self._taken):
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
        """Simulated time [s] that the world must not pass before a newer snapshot is taken. Beyond it a wanted sensor
        would fall below the rate that its mode promises. Infinite if no sensor is wanted.

        Call it regularly, also while no snapshots come. The promise to a sensor that is not wanted ends here, and
        begins again with the first snapshot that the sensor takes.
        """
        for one in self.sensors:
            if not one.wanted():
                self._taken.pop(one.name, None)
        return min(
            (max(self._taken[one.name] + self._gap(one), self._due_time(one)) for one in self._wanted()), default=np.inf
        )

    def sustainable_factor(self) -> float:
        """The largest real-time factor at which the wanted sensors keep the rate that their mode promises, from the
        time that their last frames took. Infinite if no sensor is wanted."""
        load = sum(self._costs.get(one.name, 0.0) / self._gap(one) for one in self._wanted())
        return 1.0 / load if load > 0.0 else np.inf

    def _wanted(self) -> list[ScheduledSensor]:
        return [one for one in self.sensors if one.name in self._taken and one.wanted()]

    def _gap(self, scheduled: ScheduledSensor) -> float:
        """Longest simulated time between two snapshots that the mode allows a sensor to take [s]."""
        is_live = self._pacing.mode is SensorMode.LIVE
        if scheduled.name in self._sweeps and not is_live:
            return 1.0 / scheduled.sensor.rate  # a frame that is taken later than this is left out
        return max(scheduled.period, LEAST_RATE_MARGIN / self._pacing.least_rate) if is_live else scheduled.period

    def _due_time(self, scheduled: ScheduledSensor) -> float:
        """Simulated time [s] at which the next frame is due, of a sensor that renders whole frames."""
        return -np.inf if scheduled.name in self._sweeps else self._next_time[scheduled.name]

    def _update_primitives(self, snapshot: Snapshot, poses: SensorPoses) -> Snapshot:
        """Pose the primitives. Returns the snapshot as it is drawn, valid until the next call."""
        eye = next((pose[:3] for pose in poses.values()), None)
        seen = self._sway.apply(snapshot, np.flatnonzero(self._moved), eye)
        self.primitives.update(seen, seen.moved_trees)
        self._moved[:] = False
        return seen

    def _results(self, scheduled: ScheduledSensor, snapshot: Snapshot, pose: np.ndarray) -> Iterator[SensorFrame]:
        """Render the frames that a sensor has to deliver from a snapshot, to which the primitives are posed."""
        sweep = self._sweeps.get(scheduled.name)
        if sweep is None:
            yield scheduled.sensor.frame(self.primitives, snapshot, pose, scheduled.wanted())
            return
        sweep.set_demand(scheduled.period, scheduled.wanted())
        missed = sweep.dropped
        yield from sweep.advance(self.primitives, snapshot.time)
        self.dropped[scheduled.name] += sweep.dropped - missed

    def _is_due(self, scheduled: ScheduledSensor, now: float, poses: SensorPoses) -> bool:
        """Whether a sensor has something to render at simulation time ``now`` [s]; counts the frames it has missed."""
        name = scheduled.name
        if name not in poses or not scheduled.wanted():
            self._next_time[name] = -np.inf  # a subscriber that returns gets a frame at once, and missed none
            self._is_first[name] = True
            self._taken.pop(name, None)
            if name in self._sweeps:
                self._sweeps[name].cancel(now)
                self._unfinished[name] = 0.0
            return False
        self._taken.setdefault(name, now)
        if name in self._sweeps:
            return self._sweeps[name].is_due(now)
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
