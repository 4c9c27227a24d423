"""The process of a robot's senses: renders what somebody wants, and is the robot's ROS node."""

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
from typing import Any

import numpy as np

from vinesim import frames
from vinesim.client.sensing.latest_value import LatestValue, poller
from vinesim.robot.description.description import RobotDescription
from vinesim.ros.names import ros_name
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import CameraFrame, LidarScan, RigidVisual, RobotSample, Snapshot
from vinesim.sensors.camera.sunlight import SunPath

log = logging.getLogger(__name__)

STATISTICS_PERIOD = 0.1
"""Simulated time between two reports to the tick: what is wanted, what was sent [s]."""
SWITCH_INTERVAL = 5e-4
"""How long one thread here may hold the interpreter lock when another wants it [s]."""
PROCESS_NICE, RENDER_NICE = 10, 15
"""Where cores are scarce, the tick goes first, then what ROS is told, then the pictures."""


@dataclasses.dataclass(frozen=True)
class SensorConfig:
    """All that the process must know beforehand."""

    name: str
    model: Model
    description: RobotDescription
    sun: SunPath
    namespace: str
    ros: bool
    keep_pictures: bool
    sensor_hz: float | None
    clock: bool
    renderer: str = "warp"


@dataclasses.dataclass(frozen=True, slots=True)
class StepSnapshot:
    """What the tick hands over. Poses are given only when the eyes want them, and of plants only those that moved."""

    number: int
    tick: int
    time: float
    sample: RobotSample
    bodies: np.ndarray | None
    body_q: np.ndarray | None
    trees: np.ndarray | None
    attached: np.ndarray
    links: tuple[RigidVisual, ...] | None
    link_q: np.ndarray | None
    poses: dict[str, np.ndarray] | None
    frame_score: float
    """How much there is to see: see ``Client.worth``."""


def run_sensor_worker(setup: SensorConfig, mailbox: LatestValue, pipe: Connection) -> None:
    """Entry of the process: perceive until told to stop, or until whoever started it is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the client, which then says stop
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.setswitchinterval(SWITCH_INTERVAL)
    if hasattr(os, "nice"):
        os.nice(PROCESS_NICE)
    code = 0
    try:
        with contextlib.ExitStack() as stack:
            stack.callback(mailbox.close)
            SensorWorker(setup, pipe, stack).run(mailbox)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the client is gone
    except Exception as error:
        log.exception("the senses fail")
        with contextlib.suppress(OSError):
            pipe.send(("failed", f"{type(error).__name__}: {error}"))
        code = 1
    # All is closed. Taking the engines down in order would only keep the one who waits for us.
    logging.shutdown()
    os._exit(code)


class SensorWorker:
    def __init__(self, setup: SensorConfig, pipe: Connection, stack: contextlib.ExitStack) -> None:
        self.setup, self.pipe = setup, pipe
        self._state = State.at_rest(setup.model)
        self._links: tuple[RigidVisual, ...] = ()
        self._kept: CameraFrame | None = None
        self._greatest = -1.0
        self._worth = 0.0
        self._bunch_names = tuple(f"bunch_{i:05d}" for i in range(len(setup.model.bunch_body)))
        self._names: tuple[str, ...] = self._bunch_names
        self._next_figures = 0.0
        self.node = self._open_node(stack) if setup.ros else None
        self.eyes = self._open_eyes(stack)
        pipe.send(("figures", self._figures()))
        pipe.send(("ready", None))

    # ------------------------------------------------------------------ building

    def _open_node(self, stack: contextlib.ExitStack) -> Any:
        from vinesim.ros.node import Node

        setup, description = self.setup, self.setup.description
        fixed = [(p, c, q) for (p, c), q in zip(description.fixed_frames, description.fixed_poses, strict=True)]
        node = stack.enter_context(
            Node(
                ros_name(setup.name), description.urdf, namespace=setup.namespace,
                static_transforms=fixed, cameras=[m.name for m in description.cameras],
                lidars=[m.name for m in description.lidars], base=description.base,
                clock=setup.clock,
            )
        )  # fmt: skip
        poles = np.flatnonzero(setup.model.fixed_organ == Organ.POLE)
        at = frames.pose(setup.model.fixed_start[poles])
        node.publish_environment_static(tuple(f"pole_{i:04d}" for i in range(len(poles))), at)
        return node

    def _open_eyes(self, stack: contextlib.ExitStack) -> Any:
        from vinesim.sensors.camera.camera import Camera, CameraSpec
        from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
        from vinesim.sensors.scene.primitives import Primitives
        from vinesim.sensors.scheduler import ScheduledSensor, SensorScheduler, load_kernels

        load_kernels()
        setup, mounts = self.setup, []
        seed = zlib.crc32(setup.name.encode())  # no two robots have the same noise
        for i, place in enumerate(setup.description.cameras):
            spec = CameraSpec.load(place.type)
            camera = Camera(spec, spec.info(place.frame), place.name, setup.sun, quality="fast", seed=seed)
            wanted = self._wanted(place.name, always=setup.keep_pictures and i == 0)
            depth = self._wanted(f"{place.name}/depth", always=setup.keep_pictures and i == 0)
            mounts.append(ScheduledSensor(camera, self._deliver_camera, wanted, depth, setup.sensor_hz))
        for place in setup.description.lidars:
            lidar = Lidar(LidarSpec.load(place.type), place.name, place.frame, seed=seed)
            mounts.append(ScheduledSensor(lidar, self._deliver_lidar, self._wanted(place.name), rate=setup.sensor_hz))
        primitives = Primitives(setup.model, renderer=setup.renderer)
        return stack.enter_context(SensorScheduler(setup.model, mounts, primitives=primitives, nice=RENDER_NICE))

    def _wanted(self, name: str, always: bool = False) -> Callable[[], bool]:
        return lambda: always or (self.node is not None and self.node.has_subscribers(name))

    # ------------------------------------------------------------------ running

    def run(self, mailbox: LatestValue) -> None:
        """Until somebody says stop."""
        has_news = poller(self.pipe)
        while True:
            letter = mailbox.take(0.05)
            if letter is not None:
                self._read(pickle.loads(letter))
            while has_news():
                kind, value = self.pipe.recv()
                if kind == "stop":
                    return
                if kind == "save":
                    self._save(value)
                elif kind == "diagnose" and self.node is not None:
                    time = value.pop("time")
                    self.node.publish_diagnostics(time, value, healthy=value["real_time_factor"] > 0.99)

    def _read(self, letter: StepSnapshot) -> None:
        self._worth = letter.frame_score
        if letter.bodies is not None:
            self._state.body_q[letter.bodies] = letter.body_q
        if letter.links is not None:
            self._links = letter.links
        if letter.link_q is not None and len(letter.link_q) == len(self._links):
            self._state.bunch_attached[:] = np.unpackbits(letter.attached, count=len(self._bunch_names))
            view = Snapshot(
                letter.time, letter.tick, self._state.body_q.copy(), self._state.bunch_attached.copy(), self._links,
                letter.link_q, letter.trees,
            )  # fmt: skip
            self.eyes.submit(view, letter.poses)
        if letter.bodies is not None:
            self.pipe.send(("read", (letter.number, letter.links is not None)))
        if self.node is not None:
            self.node.publish_robot_state(letter.time, letter.sample)
            if letter.tick % 10 == 0 and letter.bodies is not None and self.node.has_subscribers("tf_environment"):
                self._publish_truth(letter.time)
            if commands := self.node.commands():
                self.pipe.send(("commands", commands))
        if letter.time >= self._next_figures:
            self._next_figures = letter.time + STATISTICS_PERIOD
            self.pipe.send(("figures", self._figures()))

    def _publish_truth(self, time: float) -> None:
        here = np.flatnonzero(self._state.bunch_attached)
        if len(here) != len(self._names):
            self._names = tuple(self._bunch_names[i] for i in here)
        poses = self._state.body_q[self.setup.model.bunch_body[here]]
        self.node.publish_environment(time, self._names, poses.astype(float))

    def _figures(self) -> dict[str, Any]:
        figures = {
            "sent": {},
            "eyes": any(sensor.is_wanted() for sensor in self.eyes.sensors),
            "frames": dict(self.eyes.frames),
            "frames_dropped": dict(self.eyes.dropped),
        }
        if self.node is not None:
            figures |= {
                "sent": self.node.sent,
                "ros_dropped": self.node.dropped,
                "truth": self.node.has_subscribers("tf_environment"),
            }
        return figures

    def _deliver_camera(self, frame: CameraFrame | LidarScan) -> None:
        assert isinstance(frame, CameraFrame)
        if self.node is not None:
            self.node.publish_camera(frame)
        if self.setup.keep_pictures and frame.name == self.eyes.mounts[0].name and self._worth >= self._greatest:
            self._greatest, self._kept = self._worth, frame

    def _deliver_lidar(self, scan: CameraFrame | LidarScan) -> None:
        assert isinstance(scan, LidarScan)
        if self.node is not None:
            self.node.publish_lidar(scan)

    def _save(self, folder: pathlib.Path) -> None:
        if self._kept is not None:
            from vinesim.sensors.export import images

            images.save_frame(self._kept, folder, "")
        self.pipe.send(("figures", self._figures()))
        self.pipe.send(("saved", None))
