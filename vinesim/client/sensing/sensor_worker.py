"""The sensor process of one robot: renders what is subscribed to, and runs the robot's ROS node."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import pathlib
import pickle
import signal
import sys
import zlib
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np

from vinesim import frames
from vinesim.client.sensing.latest_value import LatestValue, make_poll
from vinesim.robot.description.description import RobotDescription
from vinesim.ros.names import ros_name
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import CameraFrame, CameraOutput, LidarScan, RigidVisual, RobotSample, Snapshot

if TYPE_CHECKING:
    from vinesim.ros.node import Node
    from vinesim.sensors.camera.sunlight import SunPath
    from vinesim.sensors.scheduler import SensorScheduler

log = logging.getLogger(__name__)

STATISTICS_PERIOD = 0.1
"""Simulated time between two reports to the client: subscriptions and message counts [s]."""
GROUND_TRUTH_PERIOD = 10
"""Ticks between two messages of true poses: 10 Hz."""
SWITCH_INTERVAL = 5e-4
"""How long one thread here may hold the interpreter lock when another wants it [s]."""
PROCESS_NICE, RENDER_NICE = 10, 15
"""Niceness where cores are scarce: the client's loop comes first (0), then ROS messages, then pictures."""


@dataclasses.dataclass(frozen=True)
class SensorConfig:
    """What the process needs to start."""

    name: str
    """The robot's."""
    model: Model
    description: RobotDescription
    sun: SunPath
    namespace: str
    """Prefix of its topics."""
    ros: bool
    """Whether it runs a ROS node."""
    keep_pictures: bool
    """Whether the first camera renders even without subscribers, and the best picture is kept."""
    sensor_hz: float | None
    """Rate of all sensors [Hz]; None: each sensor's own."""
    clock: bool
    """Whether the node publishes /clock."""
    renderer: str = "warp"


@dataclasses.dataclass(frozen=True, slots=True)
class MovedPlants:
    """Poses of the plants that moved since the last snapshot that was acknowledged."""

    trees: np.ndarray
    """[tree] indices."""
    bodies: np.ndarray
    """[body] indices of their bodies."""
    body_q: np.ndarray
    """[body, 7] m, 1."""


@dataclasses.dataclass(frozen=True, slots=True)
class StepSnapshot:
    """What the client passes to the worker after a step; poses only when a sensor or subscriber needs them."""

    number: int
    """Counts snapshots from 1."""
    tick: int
    time: float
    """[s]"""
    sample: RobotSample
    plants: MovedPlants | None
    attached: np.ndarray
    """Bit field: whether each bunch hangs on its plant."""
    visuals: tuple[RigidVisual, ...] | None
    """All rigid bodies, if the list is not the one of the last acknowledged snapshot."""
    visual_q: np.ndarray | None
    """[visual, 7] their poses, if a sensor renders."""
    sensor_poses: dict[str, np.ndarray] | None
    """[7] world pose of each sensor by name, if one renders."""
    frame_score: float
    """How much there is to see: see ``Client.frame_score``."""


def run_sensor_worker(config: SensorConfig, snapshots: LatestValue, pipe: Connection) -> None:
    """Entry of the process: render and publish until asked to stop, or until the client's process has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the client, which then stops this process
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.setswitchinterval(SWITCH_INTERVAL)
    if hasattr(os, "nice"):
        os.nice(PROCESS_NICE)
    code = 0
    try:
        with contextlib.ExitStack() as stack:
            stack.callback(snapshots.close)
            SensorWorker(config, pipe, stack).run(snapshots)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the client is gone
    except Exception as error:
        log.exception("the sensor process failed")
        with contextlib.suppress(OSError):
            pipe.send(("failed", f"{type(error).__name__}: {error}"))
        code = 1
    # All is closed. Taking the interpreter down in order would only delay the client, which waits.
    logging.shutdown()
    os._exit(code)


class SensorWorker:
    """The robot's ROS node and its sensors, fed with snapshots."""

    def __init__(self, config: SensorConfig, pipe: Connection, stack: contextlib.ExitStack) -> None:
        """Starts the node and the sensors in ``stack``, then reports "ready"."""
        self.config, self.pipe = config, pipe
        self._state = State.at_rest(config.model)
        self._visuals: tuple[RigidVisual, ...] = ()
        self._best_frame: CameraFrame | None = None
        self._best_score = -1.0
        self._frame_score = 0.0
        self._bunch_names = tuple(f"bunch_{i:05d}" for i in range(len(config.model.bunch_body)))
        self._attached_names: tuple[str, ...] = self._bunch_names
        self._next_statistics = 0.0
        self.node = self._open_node(stack) if config.ros else None
        self.scheduler = self._open_sensors(stack)
        pipe.send(("statistics", self._statistics()))
        pipe.send(("ready", None))

    # ------------------------------------------------------------------ construction

    def _open_node(self, stack: contextlib.ExitStack) -> Node:
        from vinesim.ros.node import Node

        config, description = self.config, self.config.description
        fixed = [(p, c, q) for (p, c), q in zip(description.fixed_frames, description.fixed_poses, strict=True)]
        node = stack.enter_context(
            Node(
                ros_name(config.name), description.urdf, namespace=config.namespace,
                static_transforms=fixed, cameras=[m.name for m in description.cameras],
                lidars=[m.name for m in description.lidars], base=description.base,
                clock=config.clock,
            )
        )  # fmt: skip
        poles = np.flatnonzero(config.model.fixed_organ == Organ.POLE)
        poses = frames.pose(config.model.fixed_start[poles])
        node.publish_environment_static(tuple(f"pole_{i:04d}" for i in range(len(poles))), poses)
        return node

    def _open_sensors(self, stack: contextlib.ExitStack) -> SensorScheduler:
        from vinesim.sensors.camera.camera import Camera, CameraSpec
        from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
        from vinesim.sensors.scene.primitives import Primitives
        from vinesim.sensors.scheduler import ScheduledSensor, SensorScheduler, load_kernels

        load_kernels()
        config, sensors = self.config, []
        seed = zlib.crc32(config.name.encode())  # no two robots have the same noise
        for i, mount in enumerate(config.description.cameras):
            spec = CameraSpec.load(mount.type)
            camera = Camera(spec, spec.info(mount.frame), mount.name, config.sun, quality="fast", seed=seed)
            always = config.keep_pictures and i == 0
            wanted = self._camera_demand(mount.name, always)
            sensors.append(ScheduledSensor(camera, self._deliver_camera, wanted, config.sensor_hz))
        for mount in config.description.lidars:
            lidar = Lidar(LidarSpec.load(mount.type), mount.name, mount.frame, seed=seed)
            wanted = self._lidar_demand(mount.name)
            sensors.append(ScheduledSensor(lidar, self._deliver_lidar, wanted, config.sensor_hz))
        primitives = Primitives(config.model, renderer=config.renderer)
        return stack.enter_context(
            SensorScheduler(config.model, sensors, primitives=primitives, nice=RENDER_NICE)
        )  # fmt: skip

    def _camera_demand(self, name: str, always: bool) -> Callable[[], CameraOutput]:
        """The outputs of a camera that its subscribers need now; all but the exact depth if ``always``."""
        if always:
            return lambda: CameraOutput.RGB | CameraOutput.DEPTH | CameraOutput.LABELS
        node = self.node
        return lambda: CameraOutput.NONE if node is None else node.camera_outputs_wanted(name)

    def _lidar_demand(self, name: str) -> Callable[[], CameraOutput]:
        """Whether a lidar has subscribers now."""
        return lambda: (
            CameraOutput.DEPTH if self.node is not None and self.node.has_subscribers(name) else CameraOutput.NONE
        )

    # ------------------------------------------------------------------ loop

    def run(self, snapshots: LatestValue) -> None:
        """Take snapshots and requests until a "stop"."""
        has_request = make_poll(self.pipe)
        while True:
            value = snapshots.take(0.05)
            if value is not None:
                self._take(pickle.loads(value))
            while has_request():
                kind, value = self.pipe.recv()
                if kind == "stop":
                    return
                if kind == "save":
                    self._save_best_frame(value)
                elif kind == "diagnose" and self.node is not None:
                    time = value.pop("time")
                    self.node.publish_diagnostics(time, value, healthy=value["real_time_factor"] > 0.99)

    def _take(self, snapshot: StepSnapshot) -> None:
        """Bring the copy of the world up to date, pass it to the sensors, publish the robot's state."""
        self._frame_score = snapshot.frame_score
        plants = snapshot.plants
        if plants is not None:
            self._state.body_q[plants.bodies] = plants.body_q
        if snapshot.visuals is not None:
            self._visuals = snapshot.visuals
        self._submit(snapshot)
        if plants is not None:
            self.pipe.send(("read", (snapshot.number, snapshot.visuals is not None)))
        if self.node is not None:
            self.node.publish_robot_state(snapshot.time, snapshot.sample)
            is_due = snapshot.tick % GROUND_TRUTH_PERIOD == 0 and plants is not None
            if is_due and self.node.has_subscribers("tf_environment"):
                self._publish_ground_truth(self.node, snapshot.time)
            if commands := self.node.commands():
                self.pipe.send(("commands", commands))
        if snapshot.time >= self._next_statistics:
            self._next_statistics = snapshot.time + STATISTICS_PERIOD
            self.pipe.send(("statistics", self._statistics()))

    def _submit(self, step: StepSnapshot) -> None:
        """Pass the world to the sensors, if the step has the poses of all rigid bodies that are known here."""
        if step.plants is None or step.visual_q is None or step.sensor_poses is None:
            return
        if len(step.visual_q) != len(self._visuals):
            return
        self._state.bunch_attached[:] = np.unpackbits(step.attached, count=len(self._bunch_names))
        world = Snapshot(
            step.time, step.tick, self._state.body_q.copy(), self._state.bunch_attached.copy(), self._visuals,
            step.visual_q, step.plants.trees,
        )  # fmt: skip
        self.scheduler.submit(world, step.sensor_poses)

    def _publish_ground_truth(self, node: Node, time: float) -> None:
        """True poses of the bunches that hang on their plants."""
        attached = np.flatnonzero(self._state.bunch_attached)
        if len(attached) != len(self._attached_names):
            self._attached_names = tuple(self._bunch_names[i] for i in attached)
        poses = self._state.body_q[self.config.model.bunch_body[attached]]
        node.publish_environment(time, self._attached_names, poses.astype(float))

    def _statistics(self) -> dict[str, Any]:
        """What is subscribed to, and what was rendered, sent and dropped."""
        statistics = {
            "sent": {},
            "renders": any(sensor.wanted() for sensor in self.scheduler.sensors),
            "frames": dict(self.scheduler.frames),
            "frames_dropped": dict(self.scheduler.dropped),
        }
        if self.node is not None:
            statistics |= {
                "sent": self.node.sent,
                "ros_dropped": self.node.dropped,
                "publishes_truth": self.node.has_subscribers("tf_environment"),
            }
        return statistics

    def _deliver_camera(self, frame: CameraFrame | LidarScan) -> None:
        assert isinstance(frame, CameraFrame)
        if self.node is not None:
            self.node.publish_camera(frame)
        is_kept = self.config.keep_pictures and frame.name == self.scheduler.sensors[0].name
        if is_kept and self._frame_score >= self._best_score:
            self._best_score, self._best_frame = self._frame_score, frame

    def _deliver_lidar(self, scan: CameraFrame | LidarScan) -> None:
        assert isinstance(scan, LidarScan)
        if self.node is not None:
            self.node.publish_lidar(scan)

    def _save_best_frame(self, folder: pathlib.Path) -> None:
        if self._best_frame is not None:
            from vinesim.sensors.export import images

            images.save_frame(self._best_frame, folder, "")
        self.pipe.send(("statistics", self._statistics()))
        self.pipe.send(("saved", None))
