"""The part of a sensor process that runs in the client: it writes snapshots of the world to shared memory.

The sensor process renders and publishes the cameras and lidars of one robot. Snapshots are written while a sensor has
subscribers.
"""

from __future__ import annotations

import logging
import math
import pathlib
import threading
import types
from typing import Any, Self

import numpy as np

from vinesim.client.client import Client
from vinesim.client.pace import Limit
from vinesim.client.processes.rigid_visual_list import VisualListSender
from vinesim.client.processes.sensor_worker import POSE_HISTORY, SensorChannel, SensorConfig, run_sensor_worker
from vinesim.client.processes.worker_process import (
    SENSOR_WORKER,
    Hold,
    Run,
    WorkerProcess,
    cpu_use,
    sensor_modules,
)
from vinesim.core.errors import WriteError
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.ros import middleware
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene
from vinesim.scene.values import SensorMode, SensorPacing
from vinesim.scene.wind import wind_of

log = logging.getLogger(__name__)

SNAPSHOT_PERIOD = 2
"""Number of steps from one snapshot to the next. Snapshots come at 50 Hz, faster than any camera of a robot here."""
START_TIMEOUT = 300.0
"""Longest time in which the process starts [s]. A first run compiles kernels."""
COUNT_TIMEOUT = 20.0
"""Longest time in which the process reports its counts [s]. It completes its present picture first."""
SAVE_TIMEOUT = 60.0
"""Longest time in which the process writes the kept picture [s]. It completes its present picture first, on a busy
machine."""


def time_of_snapshot(time: float, dt: float) -> float:
    """Returns the simulated time of the first snapshot at ``time`` or later [s], for steps of ``dt`` [s]."""
    period = SNAPSHOT_PERIOD * dt
    return math.ceil(time / period - 1e-6) * period if math.isfinite(time) else time


class SensorProcess:
    """Cameras and lidars of one robot of a client. A context manager: the process ends with the context."""

    def __init__(
        self,
        name: str,
        scene: Scene,
        model: Model,
        description: RobotDescription,
        *,
        namespace: str = "",
        params_file: pathlib.Path | None = None,
        ros: bool = True,
        keep_pictures: bool = False,
        sensor_hz: float | None = None,
        device: str = "cpu",
        pacing: SensorPacing | None = None,
        standby: bool = False,
    ) -> None:
        """Starts the process. :meth:`attach` connects it with a client.

        ``name``: name of the robot. ``namespace``: prefix of the robot's topics. ``params_file``: file with ROS
        parameters of the node. ``ros``: whether the process runs a ROS node, if ROS 2 can be used. ``keep_pictures``:
        whether the picture of the first camera with the highest ``Client.frame_score`` is kept for
        :meth:`save_picture`, and rendered even without subscribers. ``sensor_hz``: rate of all sensors instead of their
        own rates [Hz]. ``pacing``: whether simulated time waits for sensors; by default as in the ``description``.
        ``standby``: whether another process stands by and replaces this process if it fails, see
        :class:`WorkerProcess`.
        """
        self.name = name
        self.missed_snapshots = 0
        """Number of snapshots that were written a step later, because the process was reading."""
        self._awaited: tuple[str, ...] = ("process",)
        self._device = device
        self._saved = threading.Event()
        self._save_failure = ""
        """Reason why the last picture could not be written. Empty if it was written."""
        self._moved_trees = np.zeros(len(model.tree_first), bool)
        """[tree] Whether the tree moved since the last snapshot that was written."""
        self._is_overdue = False
        """Whether the last snapshot was not written, because the process was reading."""
        self._written_time = -np.inf
        """Simulated time of the last snapshot that was written [s]."""
        ros = ros and middleware.unavailable_reason() is None
        config = SensorConfig(
            name,
            model,
            description,
            scene.sun.direction,
            namespace,
            ros,
            keep_pictures,
            sensor_hz,
            device,
            pacing=pacing or description.sensor_pacing,
            wind=wind_of(scene),
            datum=scene.datum.place,
            params_file=params_file,
        )
        self._pacing = config.pacing
        self._digests: dict[str, str] = {}
        self._counted = threading.Event()
        self._frames = tuple(config.sensor_frames.values())
        title = f"the sensor process of {name}"
        self._hold = Hold(
            title,
            "simulated time waits" if self.is_lockstep else "simulated time goes on without its pictures",
            lambda run: cpu_use(run.process.pid or 0)[0],
        )
        self.worker = WorkerProcess(
            title,
            sensor_modules(ros),
            run_sensor_worker,
            config,
            lambda context: SensorChannel(config, context),
            self._receive,
            rehearsal=SENSOR_WORKER if standby else "",
        )
        self._run: Run[SensorChannel] | None = None
        """Run of the process for which the last snapshot was written."""
        self._visuals = VisualListSender()
        self._snapshot_count = self._pose_count = 0

    def attach(self, client: Client, robot: Robot | None = None, *, wait: bool = True) -> None:
        """Write snapshots of the client's world for the sensors of ``robot``, by default the first robot of the client.

        Waits until the process has rendered a first picture of every sensor. Raises :class:`WorkerError` if the process
        fails. Without ``wait`` the method returns at once, and a step of the client raises the error.
        """
        self.client = client
        self.robot = robot or client.robot
        self._write(client)
        self._wake()
        if wait:
            self.worker.wait_until_ready(START_TIMEOUT)
        client.holds.append(self.held)
        client.pace_limits.append(self.limit)
        client.post_step.append(self._after_step)
        client.wake_readers.append(self._wake)
        client.after_reset.append(self._begin_anew)

    # ------------------------------------------------------------------ in the loop

    def held(self) -> str:
        """Returns the reason why the next step must wait: "sensors", or "" if the step may run.

        A step waits until the process has taken the snapshots of all frames that the pacing mode promises. In lockstep
        it waits until these frames are sent. A process that is not ready, or has done nothing for
        :data:`~vinesim.client.processes.worker_process.HOLD_TIMEOUT`, holds no step, except in lockstep.
        """
        run = self.worker.current()
        physics = self.client.physics
        wanted = run.shared.wanted
        if self.is_lockstep:
            is_behind = not self.worker.is_ready or run is not self._run or wanted["shown"][0] != self._snapshot_count
        else:
            latest = time_of_snapshot(float(wanted["horizon"][0]), physics.dt)
            is_behind = self.worker.is_ready and physics.time + 0.5 * physics.dt > latest
        # The process may wait for a snapshot while the step waits for the process: a subscriber that leaves and
        # returns between two checks of the process stops the snapshots, but does not end the promise to its sensor.
        is_starved = (
            is_behind
            and not self.is_lockstep
            and wanted["shown"][0] == self._snapshot_count
            and physics.time > self._written_time
        )
        # No step writes the first snapshot for a process that was started again, because lockstep holds all steps.
        is_unfed = self.is_lockstep and run is not self._run
        if is_starved or is_unfed or (self._is_overdue and (is_behind or self.is_lockstep)):
            self._write(self.client)
            self._wake()
            is_behind = True
        if not is_behind:
            self._hold.end()
            return ""
        return "" if self._hold.is_over(run) and not self.is_lockstep else "sensors"

    @property
    def is_lockstep(self) -> bool:
        """Whether simulated time waits for every frame."""
        return self._pacing.mode is SensorMode.LOCKSTEP

    def limit(self) -> Limit:
        """Returns the largest real-time factor at which the sensors deliver the frames that their mode promises."""
        run = self.worker.current()
        return Limit(float(run.shared.wanted["factor"][0]) if self.worker.is_ready else np.inf, "sensors")

    def _begin_anew(self) -> None:
        """After a reset of the client: write all plants again, and take the sensor poses from the new robot."""
        self._moved_trees[:] = True
        self.robot = self.client.robots[self.robot.name]

    def _after_step(self, client: Client) -> None:
        """Write the next snapshot if it is due."""
        self.worker.raise_failure()
        physics = client.physics
        self._moved_trees[physics.plants.awake] = self._moved_trees[physics.remotely_posed] = True
        if physics.tick % SNAPSHOT_PERIOD == 0 or self._is_overdue:
            run = self.worker.current()
            if not self.worker.is_ready or run.shared.wanted["world"][0]:
                self._write(client)

    def _write(self, client: Client) -> None:
        """Write a snapshot of the world, unless the process is reading now."""
        physics = client.physics
        run = self.worker.current()
        if run is not self._run:  # a new run knows nothing yet
            self._run = run
            self._visuals.close()
            self._visuals = VisualListSender()
            self._snapshot_count = self._pose_count = 0
            self._moved_trees[:] = True
        physics.update_kinematics()
        if (message := self._visuals.update(physics.visuals())) is not None:
            run.send("visuals", message)
        with run.shared.snapshot.writing() as shared:
            self._is_overdue = shared is None
            if shared is None:
                self.missed_snapshots += 1
                return
            self._snapshot_count += 1
            self._written_time = physics.time
            trees = np.flatnonzero(self._moved_trees)
            self._moved_trees[:] = False
            bodies = physics.plants.bodies_of(trees)
            shared["body_q"][bodies] = physics.state.body_q[bodies]
            shared["tree_number"][trees] = shared["number"][0] = self._snapshot_count
            shared["bunch_attached"][:] = physics.state.bunch_attached
            stumps = physics.plants.stumps.table
            shared["leaf_off"][:] = physics.state.leaf_off
            shared["stump_count"][0] = len(stumps)
            shared["stumps"][: len(stumps)] = stumps
            wires = physics.wire_shapes.poses()
            shared["wire_count"][0] = moved = len(wires.segment)
            shared["wire_segment"][:moved], shared["wire_q"][:moved] = wires.segment, wires.q
            shared["wind_strength"][0] = 0.0 if (wind := physics.wind_on_plants.state) is None else wind.strength
            if wind is not None:
                shared["wind_time"][0] = wind.time
                shared["tree_air"][:], shared["tree_drawn"][:] = wind.tree_air, wind.tree_drawn
            shared["time"][0], shared["tick"][0] = physics.time, physics.tick
            shared["frame_score"][0] = client.frame_score()
            visual_q = physics.visual_q()
            self._visuals.memory["visual_q"][: len(visual_q)] = visual_q
            shared["visual_count"][0], shared["visuals_version"][0] = len(visual_q), self._visuals.version
            row = self._pose_count % POSE_HISTORY
            shared["pose_time"][row], shared["pose_world_offset"][row] = physics.time, client.world_time.offset
            for pose, frame in zip(shared["pose"][row], self._frames, strict=True):
                pose[:] = self.robot.frame_pose(frame)
            self._pose_count += 1
            shared["pose_count"][0] = self._pose_count

    def _wake(self) -> None:
        self.worker.current().shared.snapshot.wake()

    # ------------------------------------------------------------------ outside the loop

    def _receive(self, kind: str, value: Any) -> None:
        """Take a message of the process. This method is called in a thread."""
        if kind == "awaited":
            self._awaited = value
            if value:
                log.info("the sensors of %s are not ready, awaited: %s", self.name, ", ".join(value))
        elif kind == "digests":
            self._digests = value
        elif kind == "counted":
            self._counted.set()
        elif kind == "device":
            self._device = value
        elif kind == "saved":
            self._save_failure = value
            self._saved.set()

    def awaited(self) -> list[str]:
        """Returns the names of the steps of preparation that the sensors still need. Empty when they are ready."""
        if self.worker.is_ready:
            return []
        return [f"{self.name}: {part}" for part in self._awaited or ("process",)]

    def sent_messages(self) -> dict[str, int]:
        """Returns the number of ROS messages sent so far, by topic."""
        return self.worker.total("sent")

    def dropped_messages(self) -> dict[str, int]:
        """Returns the number of ROS messages that newer messages replaced before they were sent, by topic."""
        return self.worker.total("ros_dropped")

    def report(self) -> dict[str, Any]:
        """Returns the counts of delivered and dropped frames, by sensor, of snapshots that could not be shown or were
        late, and of restarts. Also the device and, in lockstep, a digest of all frames of each sensor."""
        digests = {"frame_digests": self._digests} if self.is_lockstep else {}
        return digests | {
            "frames": self.worker.total("frames"),
            "frames_dropped": self.worker.total("frames_dropped"),
            "frames_skipped": self.worker.total("frames_skipped").get("snapshots", 0),
            "snapshots_missed": self.missed_snapshots,
            "sensor_restarts": self.worker.restarts,
            "sensor_device": self._device,
        }

    def complete_counts(self) -> None:
        """Wait until the counts and digests include all frames so far, at most :data:`COUNT_TIMEOUT`."""
        self._counted.clear()
        if self.worker.is_ready:
            self.worker.send("count")
            self._counted.wait(COUNT_TIMEOUT)

    def save_picture(self, folder: pathlib.Path) -> None:
        """Write the kept picture to ``folder``, as PNG files: ``rgb``, ``depth`` (colours), ``depth_mm`` (16 bit) and
        ``labels``.

        If the process is not ready, or fails now, the picture is lost and a message is logged. Raises
        :class:`WriteError` if the folder cannot be written.
        """
        self._saved.clear()
        if self.worker.is_ready:
            self.worker.send("save", folder)
            if self._saved.wait(SAVE_TIMEOUT):
                if self._save_failure:
                    raise WriteError(
                        f"{folder} cannot be written: {self._save_failure}; make room there or give another"
                    )
                return
        log.error("no picture in %s: the sensor process of %s did not save it", folder, self.name)

    def close(self) -> None:
        """End the process. A second call does nothing."""
        self.worker.close()
        self._visuals.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: types.TracebackType | type[BaseException] | BaseException | None) -> None:
        self.close()
