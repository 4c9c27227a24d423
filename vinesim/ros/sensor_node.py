"""The ROS 2 node of a robot's cameras and lidars, as their drivers are on a real robot.

Frames are passed by the thread that renders them; a thread of the node builds and sends the messages. Of each topic
only the newest frame waits: an older one that was not sent is replaced and counted as dropped.
"""

from __future__ import annotations

import pathlib
import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from vinesim.ros.messages import message_packages
from vinesim.ros.node import Node
from vinesim.ros.publishers.camera import CameraPublisher
from vinesim.ros.publishers.lidar import LidarPublisher
from vinesim.ros.topic import Build, PendingMessage, Topic
from vinesim.scene.values import CameraFrame, CameraOutput, LidarScan

TRUTH = "publish_truth"
"""Name of a parameter."""
SensorPublisher = TypeVar("SensorPublisher", CameraPublisher, LidarPublisher)


class SensorNode(Node):
    """The topics of ``cameras`` and ``lidars``, the names under which they publish."""

    def __init__(
        self,
        name: str,
        *,
        namespace: str = "",
        cameras: Sequence[str] = (),
        lidars: Sequence[str] = (),
        rates: Mapping[str, float] | None = None,
        params_file: pathlib.Path | None = None,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        """``rates``: those of sensors [Hz], with which their parameters start; others have none. ``params_file``,
        ``parameters``: see :class:`Node`."""
        if cameras:
            message_packages.ensure_importable(["vision_msgs"])
        self._camera_names = cameras
        self._lidar_names = lidars
        self._rates = rates or {}
        self._pending: dict[Topic, Build] = {}
        """The newest message of each topic; the one that waits longest is the first."""
        self._changed = threading.Condition()
        self._sending = False
        super().__init__(name, namespace, (*cameras, *lidars), params_file, parameters)

    def _open(self) -> None:
        parameters = self._parameters
        self._cameras = {one: CameraPublisher(self._advertise, one, parameters) for one in self._camera_names}
        self._lidars = {  # Nav2 expects /scan
            one: LidarPublisher(self._advertise, one, f"{one}/scan" if i else "scan", parameters)
            for i, one in enumerate(self._lidar_names)
        }
        for sensor, rate in self._rates.items():
            parameters.declare(
                f"{sensor}.rate", rate, "Pictures or revolutions a second [Hz].", (0.1, max(rate, 100.0))
            )
        parameters.declare(TRUTH, True, "Publish labels of pictures, and detections.", changed=self._mute_truth)

    def _mute_truth(self) -> None:
        for camera in self._cameras.values():
            camera.mute_truth(not self._parameters[TRUTH])

    def rate(self, sensor: str) -> float:
        """Rate [Hz] that is asked for of a sensor of ``rates``."""
        return self._parameters[f"{sensor}.rate"]

    def _own_threads(self, name: str) -> list[threading.Thread]:
        return [threading.Thread(target=self._send, name=f"ros send {name}", daemon=True)]

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def publish_camera(self, frame: CameraFrame) -> None:
        """Publish one picture of one of ``cameras``; :class:`ValueError` if there is no such camera."""
        self._enqueue(self._publisher(self._cameras, "camera", frame.name).pending(frame))

    def publish_lidar(self, scan: LidarScan) -> None:
        """Publish one revolution of one of ``lidars``; :class:`ValueError` if there is no such lidar."""
        self._enqueue(self._publisher(self._lidars, "lidar", scan.name).pending(scan))

    def camera_outputs_wanted(self, camera: str) -> CameraOutput:
        """What subscribers need of the frames of one of ``cameras``; :class:`ValueError` if there is no such camera."""
        return self._publisher(self._cameras, "camera", camera).wanted()

    def lidar_outputs_wanted(self, lidar: str) -> CameraOutput:
        """What subscribers need of the scans of one of ``lidars``: depth, exact depth, or none.

        :class:`ValueError` if there is no such lidar.
        """
        return self._publisher(self._lidars, "lidar", lidar).wanted()

    @property
    def has_pending(self) -> bool:
        """Whether any message waits to be sent or is being sent."""
        with self._changed:
            return bool(self._pending) or self._sending

    def _publisher(self, kinds: Mapping[str, SensorPublisher], kind: str, name: str) -> SensorPublisher:
        if name not in kinds:
            raise ValueError(f"no {kind} {name!r} in this node; it was made with: {', '.join(kinds) or 'none'}")
        return kinds[name]

    def _enqueue(self, messages: Iterable[PendingMessage], *, always: bool = False) -> None:
        with self._changed:
            for topic, build in messages:
                if topic.subscription_count or always:
                    topic.dropped += topic in self._pending
                    self._pending[topic] = build
            self._changed.notify()

    def _send(self) -> None:
        """The sending thread: of the topics with a message the one that waits longest comes first."""
        while True:
            with self._changed:
                self._sending = False
                self._changed.wait_for(lambda: self._pending or self._closing.is_set())
                if self._closing.is_set():
                    return
                self._sending = True
                topic = next(iter(self._pending))
                build = self._pending.pop(topic)
            topic.build_and_send(build)
