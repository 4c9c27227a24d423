"""The scheduler of a robot's sensors, which renders sensors that are due and wanted, and counts late frames.

Most sensors, such as cameras, render a whole frame at once, from the newest snapshot. A swept sensor, such as a lidar,
renders at every snapshot the parts of a frame that are due, each from the sensor's pose at the time of the part, and
delivers the frame after the last part.
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
"""Factor on the longest time between frames of live sensors. It is below 1, because snapshots exist only at whole
steps, so that sensors would otherwise fall below the least rate."""
COST_GAIN = 0.3
"""Weight of the newest frame in the smoothed real time that a sensor's frames take."""

DemandQuery = Callable[[], CameraOutput]
"""Function that returns the outputs of a sensor that are wanted now; the sensor renders only if any is wanted."""


@dataclasses.dataclass(frozen=True, slots=True)
class ScheduledSensor:
    """A sensor in the schedule, with the callback for its frames and the function that returns its wanted outputs."""

    sensor: Sensor
    deliver: Callable[[Any], None]
    """Function that is called with every rendered frame of the sensor."""
    wanted: DemandQuery = lambda: CameraOutput.ALL
    rate: float | None = None
    """Frames a second of simulated time [Hz]; None: the sensor's own rate."""
    present_rate: Callable[[], float] | None = None
    """Function that is called before every frame and returns the rate [Hz] in simulated time, for a rate that changes.
    """

    @property
    def period(self) -> float:
        """Simulated time between two frames [s]."""
        if self.present_rate is not None:
            return 1.0 / self.present_rate()
        return 1.0 / (self.rate or self.sensor.rate)

    @property
    def name(self) -> str:
        """The sensor's name, which is also the key of its pose in :data:`SensorPoses`."""
        return self.sensor.name


SensorPoses = Mapping[str, np.ndarray]
"""World pose [7] of each sensor, by name; for a camera the pose of its optical frame."""


class SensorScheduler:
    """Renders the sensors of one robot when they are due and wanted, in the caller's thread."""

    def __init__(
        self,
        model: Model,
        sensors: Sequence[ScheduledSensor],
        *,
        primitives: Primitives | None = None,
        pacing: SensorPacing = SensorPacing(),
        on_taken: Callable[[], None] = lambda: None,
    ) -> None:
        """``on_taken``: called for each snapshot when the sensors to render from it are known, before they are
        rendered."""
        names = [m.name for m in sensors]
        if len(set(names)) != len(names):
            twice = next(n for n in names if names.count(n) > 1)
            raise ValueError(f"two sensors are named {twice!r}; give each its own name")
        self.sensors = tuple(sensors)
        self.primitives = primitives or Primitives(model)
        self.frames = dict.fromkeys(names, 0)
        """Number of frames that each sensor has delivered, by name."""
        self.dropped = dict.fromkeys(names, 0)
        """Number of frames of each sensor that were due but were not rendered in time, by name."""
        self._next_time = dict.fromkeys(names, -np.inf)
        self._is_first = dict.fromkeys(names, True)
        """Whether a sensor has rendered at most one frame since it became wanted. The first frame may take longer, so
        frames that are missed meanwhile are not counted."""
        self._sweeps = {m.name: m.sensor.sweep(m.rate) for m in sensors if isinstance(m.sensor, SweptSensor)}
        self._pacing = pacing
        self._on_taken = on_taken
        self._taken: dict[str, float] = {}
        """Simulated time of the newest snapshot that each wanted sensor has taken [s]."""
        self._costs: dict[str, float] = {}
        """Smoothed real time that a frame of each sensor takes [s]."""
        self._unfinished = dict.fromkeys(names, 0.0)
        """Real time that the unfinished frame of each swept sensor has taken so far [s]."""
        self._sway = Sway(model)
        self._moved = np.zeros(len(model.tree_first), bool)
        """[tree] Whether each tree has moved since the primitives were last posed."""

    def warm_up(self, snapshot: Snapshot, poses: SensorPoses) -> Iterator[str]:
        """Render one frame of every sensor and discard it; yield the name of each sensor before its frame.

        The first frame of a sensor takes many times as long as later frames, because it allocates buffers and compiles
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
        """Render and deliver the frames that are due, from the newest ``snapshot``.

        ``snapshot.moved_trees`` must contain all trees that moved since the last call. ``poses``: poses of the sensors
        at the snapshot; ``earlier``: times [s] and poses of the sensors between the last call and this one.
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
        """Record the real time ``seconds`` that sensor ``name`` took in one call, which completed ``count`` frames."""
        self._unfinished[name] += seconds
        if count:
            cost = self._unfinished[name] / count
            before = self._costs.get(name, cost)
            self._costs[name] = before + COST_GAIN * (cost - before)
            self._unfinished[name] = 0.0

    def horizon(self) -> float:
        """Returns the simulated time [s] up to which the world may advance before the sensors take a newer snapshot.

        Beyond that time a wanted sensor would fall below the rate that its mode guarantees. Infinite if no sensor is
        wanted. Call this regularly, also while no snapshots come: the guarantee for a sensor that is no longer wanted
        ends in this call, and begins again with the first snapshot that the sensor takes.
        """
        for one in self.sensors:
            if not one.wanted():
                self._taken.pop(one.name, None)
        return min(
            (max(self._taken[one.name] + self._gap(one), self._due_time(one)) for one in self._wanted()), default=np.inf
        )

    def sustainable_factor(self) -> float:
        """Returns the largest real-time factor at which all wanted sensors reach the rate that their mode guarantees.

        It is estimated from the real time of recent frames, and infinite if no sensor is wanted.
        """
        load = sum(self._costs.get(one.name, 0.0) / self._gap(one) for one in self._wanted())
        return 1.0 / load if load > 0.0 else np.inf

    def _wanted(self) -> list[ScheduledSensor]:
        return [one for one in self.sensors if one.name in self._taken and one.wanted()]

    def _gap(self, scheduled: ScheduledSensor) -> float:
        """Returns the longest simulated time [s] that the mode allows between two snapshots that a sensor takes."""
        is_live = self._pacing.mode is SensorMode.LIVE
        if scheduled.name in self._sweeps and not is_live:
            return 1.0 / scheduled.sensor.rate  # a swept sensor leaves a frame out if it begins later
        return max(scheduled.period, LEAST_RATE_MARGIN / self._pacing.least_rate) if is_live else scheduled.period

    def _due_time(self, scheduled: ScheduledSensor) -> float:
        """Returns the simulated time [s] at which the next frame of a sensor that renders whole frames is due."""
        return -np.inf if scheduled.name in self._sweeps else self._next_time[scheduled.name]

    def _update_primitives(self, snapshot: Snapshot, poses: SensorPoses) -> Snapshot:
        """Move the primitives to the poses of ``snapshot``. Returns the snapshot to render, valid until the next
        call."""
        eye = next((pose[:3] for pose in poses.values()), None)
        seen = self._sway.apply(snapshot, np.flatnonzero(self._moved), eye)
        self.primitives.update(seen, seen.moved_trees)
        self._moved[:] = False
        return seen

    def _results(self, scheduled: ScheduledSensor, snapshot: Snapshot, pose: np.ndarray) -> Iterator[SensorFrame]:
        """Render and yield the frames that a sensor delivers from ``snapshot``, to which the primitives are posed."""
        sweep = self._sweeps.get(scheduled.name)
        if sweep is None:
            yield scheduled.sensor.frame(self.primitives, snapshot, pose, scheduled.wanted())
            return
        sweep.set_demand(scheduled.period, scheduled.wanted())
        missed = sweep.dropped
        yield from sweep.advance(self.primitives, snapshot.time)
        self.dropped[scheduled.name] += sweep.dropped - missed

    def _is_due(self, scheduled: ScheduledSensor, now: float, poses: SensorPoses) -> bool:
        """Returns whether a sensor has a frame, or a part of one, to render at simulated time ``now`` [s].

        Also counts the frames that the sensor has missed.
        """
        name = scheduled.name
        if name not in poses or not scheduled.wanted():
            # a later subscriber gets a frame at once; frames without a subscriber do not count as missed
            self._next_time[name] = -np.inf
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
