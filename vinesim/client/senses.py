"""What a robot perceives and tells ROS: joins the sensing thread, the ROS node and the tick."""

from __future__ import annotations

import contextlib
import logging
import pathlib
import types
from collections.abc import Callable
from typing import Any, Self

import numpy as np

from vinesim import frames
from vinesim.client.client import Client
from vinesim.client.jobs import Obey
from vinesim.ros import environment
from vinesim.sensors import picture
from vinesim.sensors.camera import Camera, CameraSpec
from vinesim.sensors.eyes import Eyes, Mount
from vinesim.sensors.lidar import Lidar, LidarSpec
from vinesim.world.ids import Organ
from vinesim.world.values import CameraFrame, LidarScan

log = logging.getLogger(__name__)

TRUTH_TICKS = 10
"""Ticks between two messages of true poses (/tf_environment): 10 Hz."""
VIEW_TICKS = 2
"""Ticks between two views for the eyes: 50 Hz, faster than any camera here."""


class Senses:
    """Cameras, lidars and the ROS node of the client's robot. A context: its threads end with it."""

    def __init__(
        self,
        client: Client,
        *,
        namespace: str = "",
        ros: bool = True,
        keep_pictures: bool = False,
        camera_hz: float | None = None,
    ) -> None:
        """``keep_pictures`` renders the first camera even if no ROS peer listens, and keeps the picture of the greatest
        displacement of the watched bunch for :meth:`save`. ``camera_hz`` replaces the cameras' own rate.
        """
        self.client = client
        self._keep = keep_pictures
        self._kept: CameraFrame | None = None
        self._greatest = -1.0
        self._stack = contextlib.ExitStack()
        self._bunch_names = tuple(f"bunch_{i:05d}" for i in range(len(client.model.bunch_body)))
        self._attached: np.ndarray | None = None
        self._names: tuple[str, ...] = ()
        self._truth_q = np.zeros((0, 7))
        self.node = self._open_node(namespace) if ros else None
        self._frames = {}
        self.eyes = self._open_eyes(camera_hz)
        client.senses.append(self._every_tick)
        if self.node is not None:
            client.jobs.insert(0, Obey(client.robot, self.node.commands))

    def _open_node(self, namespace: str) -> Any:
        reason = environment.available()
        if reason is not None:
            log.warning("running without ROS 2: %s", reason)
            return None
        from vinesim.ros.node import Node

        description = self.client.robot.description
        fixed = [(p, c, q) for (p, c), q in zip(description.fixed, description.fixed_q, strict=True)]
        node = self._stack.enter_context(
            Node(
                self.client.name.replace("-", "_").replace(".", "_"), description.urdf, namespace=namespace,
                static_transforms=fixed, cameras=[m.name for m in description.cameras],
                lidars=[m.name for m in description.lidars], base=description.base,
                clock=not namespace,  # one clock in a ROS domain: that of the client without a namespace
            )
        )  # fmt: skip
        poles = np.flatnonzero(self.client.model.fixed_organ == Organ.POLE)
        at = frames.pose(self.client.model.fixed_start[poles])
        node.publish_environment_static(tuple(f"pole_{i:04d}" for i in range(len(poles))), at)
        return node

    def _open_eyes(self, camera_hz: float | None) -> Eyes:
        description, sun = self.client.robot.description, self.client.scene.sun.direction()
        mounts = []
        for i, place in enumerate(description.cameras):
            spec = CameraSpec.load(place.type)
            camera = Camera(spec, spec.info(place.frame), place.name, sun)
            wanted = self._wanted(place.name, always=self._keep and i == 0)
            mounts.append(Mount(camera, self._deliver_camera, wanted, camera_hz))
            self._frames[place.name] = place.frame
        for place in description.lidars:
            lidar = Lidar(LidarSpec.load(place.type), place.name, place.frame)
            mounts.append(Mount(lidar, self._deliver_lidar, self._wanted(place.name)))
            self._frames[place.name] = place.frame
        return self._stack.enter_context(Eyes(self.client.model, mounts))

    def _wanted(self, name: str, always: bool = False) -> Callable[[], bool]:
        return lambda: always or (self.node is not None and self.node.wanted(name))

    def _deliver_camera(self, frame: CameraFrame | LidarScan) -> None:
        assert isinstance(frame, CameraFrame)
        if self.node is not None:
            self.node.publish_camera(frame)
        if self._keep and frame.name == self.eyes.mounts[0].name:
            trace = self.client.trace
            shift = 0.0 if trace is None else trace.displacement
            if shift >= self._greatest:
                self._greatest, self._kept = shift, frame

    def _deliver_lidar(self, scan: CameraFrame | LidarScan) -> None:
        assert isinstance(scan, LidarScan)
        if self.node is not None:
            self.node.publish_lidar(scan)

    # ------------------------------------------------------------------ the tick

    def _every_tick(self, client: Client) -> None:
        physics, node = client.physics, self.node
        if physics.tick % VIEW_TICKS == 0 and any(mount.wanted() for mount in self.eyes.mounts):
            poses = {name: client.robot.frame_pose(frame) for name, frame in self._frames.items()}
            self.eyes.see(physics.view(), poses)
        if node is None:
            return
        node.publish_tick(physics.time, client.robot.sample(physics.time, physics.contacts))
        if physics.tick % TRUTH_TICKS == 0 and node.wanted("tf_environment"):
            attached = physics.state.bunch_attached
            if self._attached is None or not np.array_equal(attached, self._attached):
                self._attached = attached.copy()
                self._names = tuple(self._bunch_names[i] for i in np.flatnonzero(attached))
            bodies = client.model.bunch_body[self._attached]
            node.publish_environment(physics.time, self._names, physics.state.body_q[bodies].astype(float))

    # ------------------------------------------------------------------ questions

    def side_of(self, point: np.ndarray) -> str:
        """The arm that is on the same side as a point [3] in the world."""
        base, _ = self.client.robot.rigid.base(self.client.name)
        local = frames.rotate(frames.conjugate(base[3:]), point - base[:3])
        return "left" if local[1] >= 0.0 else "right"

    def sent(self) -> dict[str, int]:
        """Messages sent so far, by topic."""
        return {} if self.node is None else self.node.sent

    def diagnose(self, figures: dict[str, Any]) -> None:
        """Pass the client's figures to /diagnostics."""
        if self.node is not None:
            keys = ("tick_hz", "tick_p99_ms", "overruns", "real_time_factor", "awake", "bytes_in", "bytes_out")
            healthy = figures["real_time_factor"] > 0.99
            self.node.publish_diagnostics(figures["time"], {key: figures[key] for key in keys}, healthy=healthy)

    def report(self) -> dict[str, Any]:
        """What was dropped and refused."""
        figures: dict[str, Any] = {"frames": dict(self.eyes.frames), "frames_dropped": dict(self.eyes.dropped)}
        if self.node is not None:
            figures |= {"ros_sent": self.node.sent, "ros_dropped": self.node.dropped}
        return figures

    def save(self, folder: pathlib.Path) -> None:
        """Write the kept picture: ``rgb``, ``depth`` (colours), ``depth_mm`` (16 bit) and ``labels`` PNGs."""
        if self._kept is not None:
            picture.save(self._kept, folder, "")

    def close(self) -> None:
        """End all threads."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: types.TracebackType | type[BaseException] | BaseException | None) -> None:
        self.close()
