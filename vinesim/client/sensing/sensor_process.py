"""The client's side of a sensor process, which renders for one robot and runs its ROS node.

Rendering and publishing hold Python's interpreter lock for milliseconds at a time. In threads beside the loop they make
its steps late (docs/decisions/sensor-process.md has the figures), so they run in a process of their own. The loop
passes it one snapshot a step through shared memory and never waits for an answer.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import pathlib
import pickle
import types
from typing import Any, Self

import numpy as np

from vinesim.client.client import Client
from vinesim.client.sensing.latest_value import LatestValue, make_poll
from vinesim.client.sensing.sensor_worker import (
    GROUND_TRUTH_PERIOD,
    MovedPlants,
    SensorConfig,
    StepSnapshot,
    run_sensor_worker,
)
from vinesim.client.tasks.ros_command_handler import RosCommandHandler
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.ros import middleware
from vinesim.ros.commands.types import Command
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene
from vinesim.scene.values import RigidVisual

log = logging.getLogger(__name__)

SNAPSHOT_PERIOD = 2
"""Ticks between two snapshots for the sensors: 50 Hz, faster than any camera here."""
START_TIMEOUT = 300.0
"""How long the process may take to start; a first run compiles kernels [s]."""
SAVE_TIMEOUT = 60.0
"""How long the process may take to write its pictures [s]; on a busy machine it renders first."""
EXIT_TIMEOUT = 1.2
"""How long it may take to end [s]."""
VISUALS_CAPACITY = 4 << 20
"""Size of a snapshot beside the poses of the plants [bytes]."""
POSE_SIZE = 40
"""Size of one plant body in a snapshot [bytes]."""


class SensorProcessError(RuntimeError):
    """The sensor process failed; the text says how."""

    exit_code = 3


class SensorProcess:
    """Cameras, lidars and the ROS node of one robot of the client. A context: the process ends with it."""

    def __init__(
        self,
        name: str,
        scene: Scene,
        model: Model,
        description: RobotDescription,
        *,
        namespace: str = "",
        ros: bool = True,
        keep_pictures: bool = False,
        sensor_hz: float | None = None,
        clock: bool | None = None,
        renderer: str = "warp",
    ) -> None:
        """Starts the process; :meth:`attach` connects it with a client.

        ``keep_pictures`` renders the first camera even without subscribers, and keeps the picture with the highest
        ``Client.frame_score`` for :meth:`save_picture`. ``sensor_hz`` replaces the sensors' own rates. ``clock``:
        publish /clock; unless given, a robot without a namespace does, since a ROS domain has one clock.
        """
        self.name = name
        self._attached = False
        if ros and (reason := middleware.unavailable_reason()) is not None:
            log.warning("running without ROS 2: %s", reason)
            ros = False
        self._ros = ros
        self._sensor_frames = {mount.name: mount.frame for mount in (*description.cameras, *description.lidars)}
        self._commands: list[Command] = []
        self._statistics: dict[str, Any] = {"sent": {}, "renders": keep_pictures}
        self._moved_trees = np.zeros(len(model.tree_first), bool)
        """[tree] whether it moved since the last snapshot that was acknowledged."""
        self._visuals: tuple[RigidVisual, ...] | None = None
        """The list of rigid bodies that the worker has."""
        self._sent_snapshots = 0
        self._unacknowledged: list[tuple[int, np.ndarray]] = []
        """Number and trees of snapshots with plants that the worker has not read yet."""
        context = multiprocessing.get_context("spawn")
        self._snapshots = LatestValue(POSE_SIZE * len(model.body_mass) + VISUALS_CAPACITY, context)
        self._pipe, worker_end = context.Pipe()
        config = SensorConfig(
            name, model, description, scene.sun.direction, namespace, ros, keep_pictures, sensor_hz,
            clock=not namespace if clock is None else clock, renderer=renderer,
        )  # fmt: skip
        self._process = context.Process(
            target=run_sensor_worker, args=(config, self._snapshots, worker_end), name=f"sensors of {name}", daemon=True
        )
        self._process.start()
        worker_end.close()
        self._has_message = make_poll(self._pipe)

    def attach(self, client: Client, robot: Robot | None = None) -> None:
        """Pass the client's world to the process from now on, as seen by its first robot unless ``robot`` is given.

        Waits until the process is ready; :class:`SensorProcessError` if it fails.
        """
        self.client = client
        self.robot = robot or client.robot
        self._wait_for("ready", START_TIMEOUT)
        self._attached = True
        client.post_step.append(self._after_step)
        if self._ros:
            client.pre_step.insert(0, RosCommandHandler(self.robot, self._take_commands))

    # ------------------------------------------------------------------ in the loop

    def _after_step(self, client: Client) -> None:
        """Receive what the worker sent, and put the next snapshot."""
        self._receive()
        physics = client.physics
        self._moved_trees[physics.plants.awake] = self._moved_trees[physics.remotely_posed] = True
        renders = self._statistics["renders"] and physics.tick % SNAPSHOT_PERIOD == 0
        truth = self._statistics.get("publishes_truth", False) and physics.tick % GROUND_TRUTH_PERIOD == 0
        plants = visual_q = sensor_poses = visuals = None
        if renders or truth:
            physics.update_kinematics()
            trees = np.flatnonzero(self._moved_trees)
            bodies = physics.plants.bodies_of(trees)
            plants = MovedPlants(trees, bodies, physics.state.body_q[bodies])
        if renders:
            visual_q = physics.visual_q()
            sensor_poses = {name: self.robot.frame_pose(frame) for name, frame in self._sensor_frames.items()}
            if physics.visuals() is not self._visuals:
                visuals = physics.visuals()
        snapshot = StepSnapshot(
            number=self._sent_snapshots + 1, tick=physics.tick, time=physics.time,
            sample=self.robot.sample(physics.time, physics.contacts),
            plants=plants, attached=np.packbits(physics.state.bunch_attached),
            visuals=visuals, visual_q=visual_q, sensor_poses=sensor_poses, frame_score=client.frame_score(),
        )  # fmt: skip
        if self._snapshots.put(pickle.dumps(snapshot, pickle.HIGHEST_PROTOCOL)):
            self._sent_snapshots += 1
            if plants is not None:
                self._unacknowledged.append((self._sent_snapshots, plants.trees))

    def _receive(self) -> None:
        """Take the worker's messages; :class:`SensorProcessError` if it has failed."""
        while self._has_message():
            try:
                kind, value = self._pipe.recv()
            except EOFError:
                self._process.join(EXIT_TIMEOUT)
                code = self._process.exitcode
                raise SensorProcessError(f"the sensor process of {self.name} ended with exit code {code}") from None
            if kind == "commands":
                self._commands += value
            elif kind == "statistics":
                self._statistics = value
            elif kind == "read":
                self._acknowledge(*value)
            elif kind == "failed":
                raise self._failure(value)

    def _acknowledge(self, number: int, had_visuals: bool) -> None:
        """The worker has read a snapshot: trees that have rested since then need not be sent again."""
        if had_visuals:
            self._visuals = self.client.physics.visuals()
        read = [trees for n, trees in self._unacknowledged if n == number]
        self._unacknowledged = [(n, trees) for n, trees in self._unacknowledged if n > number]
        if read:
            self._moved_trees[read[0]] = False
            for _, trees in self._unacknowledged:
                self._moved_trees[trees] = True
            self._moved_trees[self.client.physics.plants.awake] = True

    def _take_commands(self) -> list[Command]:
        commands, self._commands = self._commands, []
        return commands

    # ------------------------------------------------------------------ outside the loop

    def sent_messages(self) -> dict[str, int]:
        """ROS messages sent so far, by topic."""
        return self._statistics["sent"]

    def publish_diagnostics(self, status: dict[str, Any]) -> None:
        """Publish a client's status on /diagnostics."""
        keys = ("time", "tick_hz", "tick_p99_ms", "overruns", "real_time_factor", "awake", "bytes_in", "bytes_out")
        with contextlib.suppress(OSError):
            self._pipe.send(("diagnose", {key: status[key] for key in keys}))

    def report(self) -> dict[str, Any]:
        """Frames rendered and dropped by sensor, messages dropped by topic."""
        keys = ("frames", "frames_dropped", "ros_dropped")
        return {key: self._statistics[key] for key in keys if key in self._statistics}

    def save_picture(self, folder: pathlib.Path) -> None:
        """Write the kept picture: ``rgb``, ``depth`` (colours), ``depth_mm`` (16 bit) and ``labels`` PNGs."""
        self._pipe.send(("save", folder))
        self._wait_for("saved", SAVE_TIMEOUT)

    def _wait_for(self, answer: str, timeout: float) -> None:
        while self._pipe.poll(timeout):
            try:
                kind, value = self._pipe.recv()
            except EOFError:
                break
            if kind == "failed":
                raise self._failure(value)
            if kind == "statistics":
                self._statistics = value
            if kind == answer:
                return
        raise SensorProcessError(f"the sensor process of {self.name} was not {answer} within {timeout:.0f} s")

    def _failure(self, reason: str) -> SensorProcessError:
        return SensorProcessError(f"the sensor process of {self.name} failed: {reason}")

    def close(self) -> None:
        """End the process."""
        with contextlib.suppress(OSError):
            self._pipe.send(("stop", None))
        if self._attached:
            self._process.join(EXIT_TIMEOUT)
        if self._process.is_alive():
            if self._attached:
                log.warning("the sensor process of %s did not end by itself", self.name)
            self._process.kill()
            self._process.join()
        self._pipe.close()
        self._snapshots.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: types.TracebackType | type[BaseException] | BaseException | None) -> None:
        self.close()
